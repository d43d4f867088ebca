"""Corners of the tolerances: the robots that are furthest off, and which of them are lost on a motion."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws, drawn_from
from ctr_nlp.robot.tolerances import NAMES
from ctr_nlp.simulation.drawn import lost_draws
from ctr_nlp.typing import Array, Flags, Index

MOST, SPARED = 512, 0.02
"""Corners that are looked at, at most, and the part of them that may be lost."""
NEAR, BEYOND, HALVINGS = 1.05, 1.02, 5
"""How many times a corner's difference is looked at, and planned for, since between frames some are lost that hold
at frames; how often the range is halved in which a corner comes to be lost."""


def corners_within(robot: Robot) -> Draws:
    """The corners of what a robot may be within its tolerances, without lags: all of them, or MOST at random.

    Every independent quantity is as far off as at the end of a uniform band: sqrt(3) standard deviations.
    """
    root = robot.tolerances.root(robot.tubes)
    deviations = root[:, abs(root).max(axis=0) > 0]
    count = deviations.shape[1]
    if 2**count <= MOST:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=count))).reshape(-1, count)
    else:
        signs = np.random.default_rng(0).choice((-1.0, 1.0), (MOST, count))
    parts = math.sqrt(3) * signs @ deviations.T
    return drawn_from(robot, parts.reshape(-1, robot.d, len(NAMES)), np.zeros((len(signs), robot.d)))


@dataclass(frozen=True)
class Corners:
    """Those of a robot's tolerances, moved through motions q (T, 2d + 2)."""

    robot: Robot
    model: Model
    robots: Draws

    @classmethod
    def of(cls, robot: Robot, model: Model) -> Corners:
        """Those within its tolerances."""
        return cls(robot, model, corners_within(robot))

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
            lost = self._lost(gone, q, middle[:, None, None]) > 0
            low, high = np.where(lost, low, middle), np.where(lost, middle, high)
        found[gone] = high
        return found

    def _lost(self, chosen: Index, q: Array, part: Array | float) -> Index:
        """In which frame each of those chosen is, with so much of its difference; 0 where it is not."""
        return lost_draws(self.robot, self._with(chosen, part), q, self.model)

    def guards(self, chosen: Index) -> tuple[Array, Array]:
        """Numbers and offsets of those chosen, with BEYOND times their difference."""
        robots = self._with(chosen, BEYOND)
        return robots.numbers, robots.offsets

    def _with(self, chosen: Index, part: Array | float) -> Draws:
        robots = self.robots[chosen]
        return drawn_from(self.robot, part * robots.parts, robots.lags)
