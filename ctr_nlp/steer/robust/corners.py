"""Corners of the tolerances: robots at the vertices of the box that they span, and which of them are lost on a
motion.

A robot is lost where it snaps or leaves the nominal robot's branch of equilibria. At a corner every number is as
far off as it may be, so that more corners are lost than robots drawn at random.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws, corners, drawn_from
from ctr_nlp.simulation.drawn import lost_draws
from ctr_nlp.typing import Array, Flags, Index

MOST, SPARED = 512, 0.02
"""Most corners that are looked at, and the share of them that may be lost."""
NEAR, HALVINGS = 1.05, 5
"""Largest multiple of a corner's difference that is looked at, since robots near to one that is lost are lost,
too; and bisection steps for the multiple at which a corner is lost.
"""


@dataclass(frozen=True)
class Corners:
    """Robots at the corners of a robot's tolerances, to be moved through motions q (T, 2d + 2), rad and mm."""

    robot: Robot
    model: Model
    robots: Draws

    @classmethod
    def of(cls, robot: Robot, model: Model) -> Corners:
        """Take the corners of a robot's tolerances; all of them, or MOST at random."""
        return cls(robot, model, corners(robot, MOST))

    @property
    def allowed(self) -> int:
        """Number of corners that may be lost."""
        return int(SPARED * len(self.robots))

    def lost(self, q: Array) -> Flags:
        """Return which corners, (C,), are lost on motion q (T, 2d + 2)."""
        return self._lost(np.arange(len(self.robots)), q, 1.0) > 0

    def borne(self, q: Array) -> Array:
        """Return at which multiple of its difference each corner is lost on motion q, (C,); inf where at none up
        to NEAR.

        Found by bisection, to NEAR / 2^HALVINGS, which is 0.03.
        """
        found = np.full(len(self.robots), np.inf)
        gone = np.flatnonzero(self._lost(np.arange(len(self.robots)), q, NEAR))
        # Bisection takes being lost as monotonic in the difference: nearer robots are lost less. All corners are
        # halved in one batch.
        low, high = np.zeros(len(gone)), np.full(len(gone), NEAR)
        for _ in range(HALVINGS if len(gone) else 0):
            middle = (low + high) / 2
            lost = self._lost(gone, q, middle) > 0
            low, high = np.where(lost, low, middle), np.where(lost, middle, high)
        found[gone] = high
        return found

    def _lost(self, chosen: Index, q: Array, part: Array | float) -> Index:
        """Return in which frame, from 1, each chosen corner is lost on motion q with a part of its difference; 0
        for none.
        """
        return lost_draws(self.robot, self.with_part(chosen, part), q, self.model)

    def with_part(self, chosen: Index, part: Array | float) -> Draws:
        """Return chosen corners (..) with a part of their difference from the robot, (..) or one for all."""
        robots = self.robots[chosen.ravel()]
        parts = np.broadcast_to(part, chosen.shape).reshape(-1, 1, 1)
        # Lags are left as they are: rotation lag is simulated, but not planned for.
        forces = parts[..., 0] * robots.forces
        return drawn_from(self.robot, parts * robots.parts, robots.lags, forces)
