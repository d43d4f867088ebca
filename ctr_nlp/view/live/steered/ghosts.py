"""Robots that are not quite the one described, moved by the same motors beside it."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.sample_motions import MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import apply_backlash, sample_robots
from ctr_nlp.typing import Array, Flags

GHOST_SHAPE_STRIDE = 4
"""Every which of the 101 samples of a shape is found."""
GHOST_SEED = 0
"""Seed of the simulated robots, as in `ctr-nlp robust`."""


class Ghosts:
    """Draws of a robot within its tolerances, each on the equilibrium that it is in; forces at tips are left out.

    shapes (n, 26, 3) mm, NaN where a draw has no equilibrium; lost (n,): whether it has snapped, or its tips are
    turned by more than 1 rad against each other than those of the robot described (simulation.drawn).
    """

    def __init__(self, robot: Robot, model: Model, q: Array, count: int) -> None:
        """So many draws at rest at q (2d + 2,); raises RobotError."""
        self._draws = sample_robots(robot, count, GHOST_SEED)
        self._model = model
        self._d = robot.d
        self._alpha = np.repeat(q[None, : robot.d], count, axis=0)
        self._robots = [
            model.walker(self._draws.structure, numbers, own)
            for numbers, own in zip(self._draws.numbers, self._own(q), strict=True)
        ]
        self.lost: Flags = np.zeros(count, dtype=bool)
        self.shapes = self._sample_shapes()

    def _own(self, q: Array) -> Array:
        """Where the motors of every draw take its tubes, (n, 2d + 2)."""
        self._alpha = apply_backlash(self._alpha, q[: self._d], self._draws.backlash)
        return np.hstack(
            [self._alpha + self._draws.offsets, np.repeat(q[None, self._d :], len(self._alpha), axis=0)]
        )

    def go(self, q: Array, x: Array) -> None:
        """Move all motors to q (2d + 2,), where the robot described has unknowns x (n_x,)."""
        for i, (robot, own) in enumerate(zip(self._robots, self._own(q), strict=True)):
            self.lost[i] |= bool(robot.move_to(own))
        if self._model.several_equilibria:
            apart = np.abs([robot.x - x for robot in self._robots])[:, : self._d - 1]
            self.lost |= ~(apart.max(axis=1, initial=0.0) <= MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD)
        self.shapes = self._sample_shapes()

    def _sample_shapes(self) -> Array:
        x = np.array([[robot.x] for robot in self._robots])
        draws = self._draws
        return self._model.points_batch(draws.structure, draws.numbers, x, SIGMA_GRID[::GHOST_SHAPE_STRIDE])[:, 0]
