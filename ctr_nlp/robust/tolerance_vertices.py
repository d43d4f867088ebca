"""Robots at the vertices of the tolerance box, and which of them fail on a motion.

A robot fails where it snaps or leaves the nominal robot's branch of equilibria. At a vertex every parameter is at
its limit, so that more vertices fail than robots sampled at random.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.plan.sample_motions import find_failure_frames
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import RobotSamples, box_vertices_of, perturb_robot
from ctr_nlp.typing import Array, Flags, Index

MAX_TOLERANCE_VERTICES, ALLOWED_VERTEX_FAILURE_SHARE = 512, 0.02
"""Largest number of vertices that are simulated, and the share of them that may fail."""
MAX_VERTEX_SCALE, VERTEX_SCALE_BISECTIONS = 1.05, 5
"""Largest multiple of a vertex's difference that is simulated, a little over 1 so that vertices which nearly fail
are found, too; and bisection steps for the multiple at which a vertex fails.
"""


@dataclass(frozen=True)
class ToleranceVertices:
    """Robots at the vertices of the tolerance box of `robot`, simulated on a model."""

    robot: Robot
    model: Model
    robots: RobotSamples

    @classmethod
    def of(cls, robot: Robot, model: Model) -> ToleranceVertices:
        """Take all vertices of a robot's tolerances, or MAX_TOLERANCE_VERTICES at random.

        robot: with its tolerances. model: on which vertices are simulated.
        """
        return cls(robot, model, box_vertices_of(robot, MAX_TOLERANCE_VERTICES))

    @property
    def allowed_failures(self) -> int:
        """Number of vertices that may fail."""
        return int(ALLOWED_VERTEX_FAILURE_SHARE * len(self.robots))

    def find_failing_vertices(self, q: Array) -> Flags:
        """Return the mask (C,) of the vertices that fail on a motion q (T, 2d + 2)."""
        return self._first_failure_frames(np.arange(len(self.robots)), q, 1.0) > 0

    def find_failure_scales(self, q: Array) -> Array:
        """Return the multiple of its difference at which each vertex fails on a motion q (T, 2d + 2), (C,).

        Found by bisection to 0.03; inf where a vertex does not fail up to MAX_VERTEX_SCALE.
        """
        found = np.full(len(self.robots), np.inf)
        gone = np.flatnonzero(self._first_failure_frames(np.arange(len(self.robots)), q, MAX_VERTEX_SCALE))
        # Bisection assumes that failing is monotonic in the difference. All vertices are bisected in one batch.
        low = np.zeros(len(gone))
        high = np.full(len(gone), MAX_VERTEX_SCALE)
        for _ in range(VERTEX_SCALE_BISECTIONS if len(gone) else 0):
            middle = (low + high) / 2
            lost = self._first_failure_frames(gone, q, middle) > 0
            low = np.where(lost, low, middle)
            high = np.where(lost, middle, high)
        # The upper end of the bracket, at which a vertex is known to fail.
        found[gone] = high
        return found

    def _first_failure_frames(self, chosen: Index, q: Array, part: Array | float) -> Index:
        """Return the frame (..), from 1, in which each chosen vertex first fails on a motion q, or 0.

        part: of its difference from the nominal robot, (..) or one for all.
        """
        return find_failure_frames(self.robot, self.with_part(chosen, part), q, self.model)

    def with_part(self, chosen: Index, part: Array | float) -> RobotSamples:
        """Return chosen vertices (..) with a part of their difference from the robot, (..) or one for all."""
        robots = self.robots[chosen.ravel()]
        parts = np.broadcast_to(part, chosen.shape).reshape(-1, 1, 1)
        # Lags are left as they are: rotation lag is simulated, but not planned for.
        forces = parts[..., 0] * robots.forces
        return perturb_robot(self.robot, parts * robots.deviations, robots.backlash, forces)
