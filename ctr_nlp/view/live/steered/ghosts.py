"""Robots sampled within the tolerances, moved by the same motors beside the nominal robot."""

from __future__ import annotations

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.sample_motions import MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import apply_backlash, sample_robots
from ctr_nlp.typing import Array, Flags

GHOST_SHAPE_STRIDE = 4
"""Stride of the 101 samples of a shape that are computed."""
GHOST_SEED = 0
"""Seed of the simulated robots, as in `ctr-nlp robust`."""


class Ghosts:
    """Robots sampled within the tolerances, each on its branch of equilibria; forces at tips are left out.

    shapes (n, 26, 3) mm, NaN where a robot has no equilibrium. lost (n,): whether a robot has snapped, or its tips
    are turned against each other by more than 1 rad other than the nominal robot's (plan/sample_motions.py).
    """

    def __init__(self, robot: Robot, model: Model, q: Array, count: int) -> None:
        """Sample `count` robots at rest at q (2d + 2,); model: on which they move; raises RobotError."""
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
        """Return where the motors at q (2d + 2,) take the tubes of every robot, (n, 2d + 2)."""
        # Backlash has a memory: where tubes are depends on how the motors came here.
        self._alpha = apply_backlash(self._alpha, q[: self._d], self._draws.backlash)
        return np.hstack(
            [self._alpha + self._draws.offsets, np.repeat(q[None, self._d :], len(self._alpha), axis=0)]
        )

    def go(self, q: Array, x: Array) -> None:
        """Move all motors to q (2d + 2,), where the nominal robot has unknowns x (n_x,)."""
        for i, (robot, own) in enumerate(zip(self._robots, self._own(q), strict=True)):
            self.lost[i] |= bool(robot.move_to(own))
        if self._model.several_equilibria:
            apart = np.abs([robot.x - x for robot in self._robots])[:, : self._d - 1]
            # Negated, so that NaN, a robot without an equilibrium, counts as lost.
            self.lost |= ~(apart.max(axis=1, initial=0.0) <= MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD)
        self.shapes = self._sample_shapes()

    def _sample_shapes(self) -> Array:
        """Return the shapes (n, 26, 3) mm of all robots."""
        x = np.array([[robot.x] for robot in self._robots])
        draws = self._draws
        return self._model.points_batch(draws.structure, draws.numbers, x, SIGMA_GRID[::GHOST_SHAPE_STRIDE])[:, 0]
