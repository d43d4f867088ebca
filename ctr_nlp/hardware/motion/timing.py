"""Timing of a path: at its own pace times tempo, and slower where the hardware cannot keep up.

Along a path p(s), with the pace v = ds/dt, axes move at p' v and accelerate by p'' v^2 + p' dv/dt. Limits of speed
bound x = v^2, and accelerations are linear in x and dv/dt = (dx/ds) / 2, so that the fastest motion is found by
sweeps of small linear programs, TOPP-RA (Pham and Pham, 2018, IEEE Transactions on Robotics). toppra keeps dv/dt
constant within each cell of a grid in s.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

Path = Any
"""(s, order) -> (.., n): a path's points, or derivatives of that order, at parameters s (..,)."""

TOPPRA_CELLS_PER_SEGMENT = 6
"""Cells of toppra's grid between two frames."""

TOPPRA_SIDE_CELL_FRACTIONS = 1e-3, 1e-2, 0.1
"""Widths, in parts of a cell, of narrow cells before frames; limits must hold on both sides of a frame, where
accelerations may jump. The first with which toppra finds a motion is taken."""

COARSER = 2.0, 16.0, 128.0
"""Divisors of the unit: toppra's linear programs are badly conditioned for paces far from 1, and may fail.
The first with which it finds a motion is taken."""

CLOCK = 100.0
"""1/s: how fast the pace may change where no joint moves."""

CHECKED = np.append(np.arange(40) / 40, 1.0 - 1e-6)
"""Parts of every cell at which limits are checked."""

TIMING_SAFETY_FACTOR = 1.001
"""Factor on the excess found there, for places between them."""


@dataclass(frozen=True)
class TimedPath:
    """A path and its pace: the square of ds/dt is linear in s between grid points.

    path: function of (s, order). s: (K,) parameters of the grid, the plan's time. pace: (K,) ds/dt there. Time
    starts at 0.
    """

    path: Path
    s: Array
    pace: Array

    @cached_property
    def time(self) -> Array:
        """Times at grid points, (K,) s."""
        return np.append(0.0, np.cumsum(2.0 * np.diff(self.s) / (self.pace[1:] + self.pace[:-1])))

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return float(self.time[-1])

    @cached_property
    def change(self) -> Array:
        """Rate of the pace, dv/dt, constant within each cell, (K - 1,) 1/s."""
        return np.diff(self.pace**2) / (2.0 * np.diff(self.s))

    def parameter(self, time: Any) -> Array:
        """Return the parameter s (..,) at a time (..,) s; the ends of the path before and after."""
        time = np.clip(time, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.time, time, "right") - 1, 0, len(self.change) - 1)
        ahead = time - self.time[k]
        return np.asarray(
            np.minimum(self.s[k] + ahead * (self.pace[k] + 0.5 * self.change[k] * ahead), self.s[-1])
        )

    def when(self, s: Array) -> Array:
        """Return the times (..,) s at which parameters s (..,) are reached."""
        k = np.clip(np.searchsorted(self.s, s, "right") - 1, 0, len(self.change) - 1)
        ahead = np.clip(s - self.s[k], 0.0, None)
        # As 2 ds over the sum of both paces, which needs no case for constant pace. At rest at both ends of the
        # way the sum is 0, and so is the way.
        pace = np.sqrt(np.maximum(self.pace[k] ** 2 + 2.0 * self.change[k] * ahead, 0.0))
        total = pace + self.pace[k]
        return np.asarray(self.time[k] + np.where(total > 0, 2.0 * ahead / np.where(total > 0, total, 1.0), 0.0))

    def at(self, time: Any) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations (.., n) at a time (..,)."""
        s = self.parameter(time)
        k = np.clip(np.searchsorted(self.s, s, "right") - 1, 0, len(self.change) - 1)
        squared = np.maximum(self.pace[k] ** 2 + 2.0 * self.change[k] * (s - self.s[k]), 0.0)[..., None]
        tangent = self.path(s, 1)
        return (
            self.path(s),
            tangent * np.sqrt(squared),
            self.path(s, 2) * squared + tangent * self.change[k][..., None],
        )


def compute_time_scaling(
    path: Path, driven: Path, knots: Array, speed: Array, acceleration: Array, tempo: float
) -> TimedPath:
    """Return the motion from rest to rest along a path at its own pace times tempo, slower only where it must.

    path: of the joints. driven: the path that drives take, whose speed and acceleration (n,) are limited. knots:
    (T,) ascending parameters between which both are smooth. tempo: in (0, 1]. Raises TrajectoryError.
    """
    unit = _unit(abs(driven(knots, 1)).max(axis=0), speed, acceleration * (knots[-1] - knots[0]))
    for side, coarser in itertools.product(TOPPRA_SIDE_CELL_FRACTIONS, COARSER):
        grid = _grid(knots, side)
        pace = _fastest(driven, grid, speed, acceleration, tempo, max(unit / coarser, 1.0))
        if pace is not None:
            excess = _excess(TimedPath(driven, grid, pace), speed, acceleration)
            # Dividing the pace by f divides speeds by f and accelerations by f^2: _excess takes the square root of
            # the latter.
            return TimedPath(path, grid, pace / max(1.0, excess))
    raise TrajectoryError("no timing of this motion keeps the hardware's speeds and accelerations")


def _fastest(
    driven: Path, grid: Array, speed: Array, acceleration: Array, tempo: float, unit: float
) -> Array | None:
    """Return the pace (K,) of the fastest motion at grid (K,), None where toppra finds none.

    driven: path of the drives. speed, acceleration: (n,) limits. tempo: largest pace. unit: toppra counts time in
    1 / unit s.
    """
    toppra = import_extra("toppra")
    logging.getLogger("toppra").setLevel(logging.ERROR)
    constraint = toppra.constraint
    kind = toppra.constraint.DiscretizationType.Interpolation
    # A further joint moves by s itself, so that its limit of speed is the limit of the pace. Its acceleration
    # bounds the change of the pace where no other joint moves.
    fastest = np.append(speed, tempo * unit)
    hardest = np.append(np.minimum(acceleration, 1e9), CLOCK)
    solver = toppra.algorithm.TOPPRA(
        [
            constraint.JointVelocityConstraint(np.stack([-fastest, fastest], axis=1)),
            constraint.JointAccelerationConstraint(np.stack([-hardest, hardest], axis=1), kind),
        ],
        _append_clock_joint(driven, grid, len(fastest), unit),
        gridpoints=grid * unit,
    )
    _, pace, _ = solver.compute_parameterization(0, 0)
    found = pace is not None and np.isfinite(pace).all() and (pace[1:] + pace[:-1] > 0).all()
    return pace / unit if found else None


def _unit(tangent: Array, speed: Array, acceleration: Array) -> float:
    """Return 1 / the unit of time, s, in which toppra's paces are about 1, which its tolerances are made for.

    tangent: largest |p'| of each joint. A power of two, so that knots are multiplied without rounding.
    """
    hurry = float(max((tangent / speed).max(), np.sqrt((tangent / acceleration).max())))
    return float(2.0 ** np.ceil(np.log2(np.clip(hurry, 1.0, 1e3))))


def _grid(knots: Array, side: float) -> Array:
    """Return toppra's grid (K,): equal cells between knots (T,), with a narrow one before every inner knot."""
    cell = np.diff(knots)[:, None] / TOPPRA_CELLS_PER_SEGMENT
    inner = knots[:-1, None] + cell * np.arange(TOPPRA_CELLS_PER_SEGMENT)
    return np.unique(np.concatenate([inner.ravel(), knots[-1:], knots[1:-1] - side * cell[:-1, 0]]))


def _append_clock_joint(path: Path, grid: Array, joints: int, unit: float) -> Any:
    """Return the path with its own parameter as one more joint, in toppra's interface.

    joints: number of joints, this one included. unit: the parameter counts in 1 / unit.
    """

    class Clocked(import_extra("toppra").interpolator.AbstractGeometricPath):  # type: ignore[misc]
        dof = joints
        path_interval = grid[[0, -1]] * unit

        def __call__(self, s: Any, order: int = 0) -> Array:
            s = np.asarray(s, dtype=float)
            clock = (s, np.ones_like(s), np.zeros_like(s))[order]
            return np.concatenate([path(s / unit, order) / unit**order, clock[..., None]], axis=-1)

    return Clocked()


def _excess(motion: TimedPath, speed: Array, acceleration: Array) -> float:
    """Return the factor by which all must be slower, since toppra satisfies limits at grid points only."""
    times = (motion.time[:-1, None] + np.diff(motion.time)[:, None] * CHECKED).ravel()
    _, velocity, change = motion.at(times)
    return TIMING_SAFETY_FACTOR * float(
        max((abs(velocity) / speed).max(), np.sqrt((abs(change) / acceleration).max()))
    )
