"""When a path is where: as planned, and later where the hardware cannot keep up. The time-scaling is toppra's."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import ProgramError
from ctr_nlp.executor.extras import needed

Array = npt.NDArray[np.float64]

Path = Any
"""(s, order) -> (.., n): a path's points, or derivatives of that order, at parameters s (..,)."""

CELLS = 6
"""Into how many cells toppra's grid divides the way between frames."""

SIDE = 1e-3
"""Part of a cell: limits hold on both sides of a frame, where accelerations may jump."""

CLOCK = 100.0
"""1/s: how fast the pace may change where no joint moves."""

CHECKED = np.array([0.0, 0.25, 0.5, 0.75, 1.0 - 1e-6])
"""At which parts of every cell limits are checked."""

ROOM = 1.001
"""What is left for places between them."""


@dataclass(frozen=True)
class Motion:
    """A path and its pace: the square of ds/dt is linear in s between grid points.

    s, pace: (K,) the plan's time, and how fast it passes. Time starts at 0.
    """

    path: Path
    s: Array
    pace: Array

    @cached_property
    def time(self) -> Array:
        """At grid points, (K,) s."""
        return np.append(0.0, np.cumsum(2.0 * np.diff(self.s) / (self.pace[1:] + self.pace[:-1])))

    @property
    def duration(self) -> float:
        """In s."""
        return float(self.time[-1])

    @cached_property
    def change(self) -> Array:
        """Of pace, constant within each cell, (K - 1,) 1/s."""
        return np.diff(self.pace**2) / (2.0 * np.diff(self.s))

    def parameter(self, time: Any) -> Array:
        """Where on the path it is, s (..,), at a time (..,); the ends before and after."""
        time = np.clip(time, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.time, time, "right") - 1, 0, len(self.change) - 1)
        ahead = time - self.time[k]
        return np.asarray(
            np.minimum(self.s[k] + ahead * (self.pace[k] + 0.5 * self.change[k] * ahead), self.s[-1])
        )

    def when(self, s: Array) -> Array:
        """The times (..,) at which parameters s (..,) are reached."""
        k = np.clip(np.searchsorted(self.s, s, "right") - 1, 0, len(self.change) - 1)
        ahead = np.clip(s - self.s[k], 0.0, None)
        pace = np.sqrt(np.maximum(self.pace[k] ** 2 + 2.0 * self.change[k] * ahead, 0.0))
        total = pace + self.pace[k]
        return np.asarray(self.time[k] + np.where(total > 0, 2.0 * ahead / np.where(total > 0, total, 1.0), 0.0))

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations (N, n) at times (N,)."""
        s = self.parameter(time)
        k = np.clip(np.searchsorted(self.s, s, "right") - 1, 0, len(self.change) - 1)
        squared = np.maximum(self.pace[k] ** 2 + 2.0 * self.change[k] * (s - self.s[k]), 0.0)[:, None]
        tangent = self.path(s, 1)
        return (
            self.path(s),
            tangent * np.sqrt(squared),
            self.path(s, 2) * squared + tangent * self.change[k][:, None],
        )


def timed(path: Path, driven: Path, knots: Array, speed: Array, acceleration: Array, tempo: float) -> Motion:
    """The motion from rest to rest that passes a path at its own pace times tempo, slower only where it must.

    driven: the path that drives take, whose speed and acceleration (n,) are limited. knots: (T,) ascending
    parameters between which both are smooth. The pace is a further joint of toppra's, whose speed is limited to
    tempo. Raises ProgramError.
    """
    toppra = needed("toppra")
    logging.getLogger("toppra").setLevel(logging.ERROR)
    grid = _grid(knots)
    constraint, kind = toppra.constraint, toppra.constraint.DiscretizationType.Interpolation
    fastest, hardest = np.append(speed, tempo), np.append(np.minimum(acceleration, 1e9), CLOCK)
    solver = toppra.algorithm.TOPPRA(
        [
            constraint.JointVelocityConstraint(np.stack([-fastest, fastest], axis=1)),
            constraint.JointAccelerationConstraint(np.stack([-hardest, hardest], axis=1), kind),
        ],
        _clocked(driven, grid, len(fastest)),
        gridpoints=grid,
    )
    _, pace, _ = solver.compute_parameterization(0, 0)
    if pace is None or not np.isfinite(pace).all() or (pace[1:] + pace[:-1] <= 0).any():
        raise ProgramError("no timing of this motion keeps the hardware's speeds and accelerations")
    excess = _excess(Motion(driven, grid, pace), speed, acceleration)
    return Motion(path, grid, pace / max(1.0, excess))


def _grid(knots: Array) -> Array:
    """Every cell of toppra's, with a narrow one before every knot within."""
    cell = np.diff(knots)[:, None] / CELLS
    inner = knots[:-1, None] + cell * np.arange(CELLS)
    return np.unique(np.concatenate([inner.ravel(), knots[-1:], knots[1:-1] - SIDE * cell[:-1, 0]]))


def _clocked(path: Path, grid: Array, joints: int) -> Any:
    """The path with its own parameter as one more joint, as toppra wants it."""

    class Clocked(needed("toppra").interpolator.AbstractGeometricPath):  # type: ignore[misc]
        dof = joints
        path_interval = grid[[0, -1]]

        def __call__(self, s: Any, order: int = 0) -> Array:
            s = np.asarray(s, dtype=float)
            clock = (s, np.ones_like(s), np.zeros_like(s))[order]
            return np.concatenate([path(s, order), clock[..., None]], axis=-1)

    return Clocked()


def _excess(motion: Motion, speed: Array, acceleration: Array) -> float:
    """By which factor all must be slower: toppra keeps limits at grid points only."""
    times = (motion.time[:-1, None] + np.diff(motion.time)[:, None] * CHECKED).ravel()
    _, velocity, change = motion.at(times)
    return ROOM * float(max((abs(velocity) / speed).max(), np.sqrt((abs(change) / acceleration).max())))
