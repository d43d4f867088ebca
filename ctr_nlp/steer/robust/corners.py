"""Corners of the tolerances: the robots that are furthest off, and which of them are lost on a motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws, corners, drawn_from
from ctr_nlp.simulation.drawn import lost_draws
from ctr_nlp.typing import Array, Flags, Index

MOST, SPARED = 512, 0.02
"""Corners that are looked at, at most, and the part of them that may be lost."""
NEAR, HALVINGS = 1.05, 5
"""How many times a corner's difference is looked at, since robots near to one that is lost are, too; how often the
range is halved in which a corner comes to be lost."""


@dataclass(frozen=True)
class Corners:
    """Those of a robot's tolerances, moved through motions q (T, 2d + 2)."""

    robot: Robot
    model: Model
    robots: Draws

    @classmethod
    def of(cls, robot: Robot, model: Model) -> Corners:
        """Those within its tolerances."""
        return cls(robot, model, corners(robot, MOST))

    @property
    def allowed(self) -> int:
        """How many may be lost."""
        return int(SPARED * len(self.robots))

    def lost(self, q: Array) -> Flags:
        """Which (C,) are lost."""
        return self._lost(np.arange(len(self.robots)), q, 1.0) > 0

    def borne(self, q: Array) -> Array:
        """At which part of its difference from the robot each is lost, inf where at none up to NEAR; to 4 %."""
        found = np.full(len(self.robots), np.inf)
        gone = np.flatnonzero(self._lost(np.arange(len(self.robots)), q, NEAR))
        low, high = np.zeros(len(gone)), np.full(len(gone), NEAR)
        for _ in range(HALVINGS if len(gone) else 0):
            middle = (low + high) / 2
            lost = self._lost(gone, q, middle) > 0
            low, high = np.where(lost, low, middle), np.where(lost, middle, high)
        found[gone] = high
        return found

    def _lost(self, chosen: Index, q: Array, part: Array | float) -> Index:
        """In which frame each of those chosen is, with so much of its difference; 0 where it is not."""
        return lost_draws(self.robot, self.with_part(chosen, part), q, self.model)

    def with_part(self, chosen: Index, part: Array | float) -> Draws:
        """Those chosen (..), with so much of their difference, (..) or the same for all."""
        robots = self.robots[chosen.ravel()]
        parts = np.broadcast_to(part, chosen.shape).reshape(-1, 1, 1)
        forces = parts[..., 0] * robots.forces
        return drawn_from(self.robot, parts * robots.parts, robots.lags, forces)
