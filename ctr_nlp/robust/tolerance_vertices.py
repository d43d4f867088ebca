"""Corners of the tolerances: robots at the vertices of the box that they span, and which of them are lost on a
motion.

A robot is lost where it snaps or leaves the nominal robot's branch of equilibria. At a corner every number is as
far off as it may be, so that more corners are lost than robots drawn at random.
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
"""Most corners that are looked at, and the share of them that may be lost."""
MAX_VERTEX_SCALE, VERTEX_SCALE_BISECTIONS = 1.05, 5
"""Largest multiple of a corner's difference that is looked at, since robots near to one that is lost are lost,
too; and bisection steps for the multiple at which a corner is lost.
"""


@dataclass(frozen=True)
class ToleranceVertices:
    """Robots at the corners of a robot's tolerances, to be moved through motions q (T, 2d + 2), rad and mm."""

    robot: Robot
    model: Model
    robots: RobotSamples

    @classmethod
    def of(cls, robot: Robot, model: Model) -> ToleranceVertices:
        """Take the corners of a robot's tolerances; all of them, or MAX_TOLERANCE_VERTICES at random."""
        return cls(robot, model, box_vertices_of(robot, MAX_TOLERANCE_VERTICES))

    @property
    def allowed_failures(self) -> int:
        """Number of corners that may be lost."""
        return int(ALLOWED_VERTEX_FAILURE_SHARE * len(self.robots))

    def find_failing_vertices(self, q: Array) -> Flags:
        """Return which corners, (C,), are lost on motion q (T, 2d + 2)."""
        return self._first_failure_frames(np.arange(len(self.robots)), q, 1.0) > 0

    def find_failure_scales(self, q: Array) -> Array:
        """Return at which multiple of its difference each corner is lost on motion q, (C,); inf where at none up
        to MAX_VERTEX_SCALE.

        Found by bisection, to MAX_VERTEX_SCALE / 2^VERTEX_SCALE_BISECTIONS, which is 0.03.
        """
        found = np.full(len(self.robots), np.inf)
        gone = np.flatnonzero(self._first_failure_frames(np.arange(len(self.robots)), q, MAX_VERTEX_SCALE))
        # Bisection takes being lost as monotonic in the difference: nearer robots are lost less. All corners are
        # halved in one batch.
        low = np.zeros(len(gone))
        high = np.full(len(gone), MAX_VERTEX_SCALE)
        for _ in range(VERTEX_SCALE_BISECTIONS if len(gone) else 0):
            middle = (low + high) / 2
            lost = self._first_failure_frames(gone, q, middle) > 0
            low = np.where(lost, low, middle)
            high = np.where(lost, middle, high)
        found[gone] = high
        return found

    def _first_failure_frames(self, chosen: Index, q: Array, part: Array | float) -> Index:
        """Return in which frame, from 1, each chosen corner is lost on motion q with a part of its difference; 0
        for none.
        """
        return find_failure_frames(self.robot, self.with_part(chosen, part), q, self.model)

    def with_part(self, chosen: Index, part: Array | float) -> RobotSamples:
        """Return chosen corners (..) with a part of their difference from the robot, (..) or one for all."""
        robots = self.robots[chosen.ravel()]
        parts = np.broadcast_to(part, chosen.shape).reshape(-1, 1, 1)
        # Lags are left as they are: rotation lag is simulated, but not planned for.
        forces = parts[..., 0] * robots.forces
        return perturb_robot(self.robot, parts * robots.deviations, robots.backlash, forces)
