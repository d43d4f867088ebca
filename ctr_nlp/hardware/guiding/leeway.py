"""How far from its plan a robot may be led, so that all limits are kept there, and can be kept ever after.

A trajectory for a closed loop is timed with a share of the largest speeds and accelerations; the rest is for
corrections. Between knots a correction changes from one offset to the next as 3 x^2 - 2 x^3, which bounds the
offset's change per knot. The offsets that are allowed at a knot are those within limits of position, order and
carriages around it from which one that is allowed can be reached at the knot after. All of these sets are bounds
of offsets and of their differences, x_j - x_i <= D_ij with x_0 = 0, which stay of that form (Mine, 2006).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.typing import Array, Index

MIN_KNOT_SPACING_S = 0.2
"""s between two knots at least: shorter ones would spend the accelerations that are left on stopping between them.
"""

LEEWAY_SAMPLES_PER_FRAME = 8
"""From frame to frame at which the trajectory is looked at."""

CORRECTION_SAFETY_FACTOR = 1.01
"""By which a correction is slower than it may be, for what is between places."""


class Leeway:
    """Of a trajectory with a share below 1. knots (K,): parameters of its path; frames (K,): their numbers.

    The offsets at the first two knots are 0.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        chosen = _choose_knots(trajectory.frame_time)
        self.knots = trajectory.knots[chosen]
        self.frames = trajectory.frames[chosen]
        self.time: Array = trajectory.frame_time[chosen]
        self._change = _largest_offset_changes(trajectory, self.knots)
        self._allowed = self._backwards(_bound_offsets(trajectory, self.knots))

    def _backwards(self, rooms: Array) -> Array:
        """The offsets (K, n + 1, n + 1) from which allowed ones can be reached at the knot after."""
        found = [_tighten_bounds(rooms[-1])]
        for room, change in zip(rooms[-2::-1], self._change[:0:-1], strict=True):
            reach = np.append(0.0, change)
            found.append(_tighten_bounds(np.minimum(room, found[-1] + reach[:, None] + reach)))
        return np.array(found[::-1])

    def _reachable_bounds(self, knot: int, before: Array) -> Array:
        """The bounds (n + 1, n + 1) of offsets at a knot, from 1, after that of the knot before."""
        change = self._change[knot]
        bounds = self._allowed[knot].copy()
        bounds[0, 1:] = np.minimum(bounds[0, 1:], before + change)
        bounds[1:, 0] = np.minimum(bounds[1:, 0], change - before)
        return _tighten_bounds(bounds)

    def box(self, knot: int, before: Array) -> tuple[Array, Array]:
        """The least and the largest offsets (n,) at a knot, from 1, after that of the knot before."""
        bounds = self._reachable_bounds(knot, before)
        return -bounds[1:, 0], bounds[0, 1:]

    def nearest_allowed_offset(self, knot: int, before: Array, wanted: Array) -> Array:
        """An offset (n,) near a wanted one at a knot, from 1, after that of the knot before."""
        bounds = self._reachable_bounds(knot, before)
        found = np.empty_like(wanted)
        for j, value in enumerate(wanted, start=1):
            value = min(max(value, -bounds[j, 0]), bounds[0, j])
            bounds[0], bounds[:, 0] = (
                np.minimum(bounds[0], value + bounds[j]),
                np.minimum(bounds[:, 0], bounds[:, j] - value),
            )
            found[j - 1] = value
        return found

    def offsets_back_to_plan(self, knot: int, offset: Array) -> Array:
        """The offsets (K - knot, n) from a knot on, of a robot that goes back from one there to the trajectory."""
        found = np.zeros((len(self.knots) - knot, len(offset)))
        found[0] = offset
        for later in range(1, len(found)):
            if not found[later - 1].any():
                break
            found[later] = self.nearest_allowed_offset(knot + later, found[later - 1], np.zeros_like(offset))
        return found


def _choose_knots(time: Array) -> Index:
    """Of frames passed at times (T,), those that are MIN_KNOT_SPACING_S apart at least, the first and last among
    them.
    """
    found = [0]
    for k, each in enumerate(time):
        if each >= time[found[-1]] + MIN_KNOT_SPACING_S and time[-1] - each >= MIN_KNOT_SPACING_S:
            found.append(k)
    return np.array([*found, len(time) - 1])


def _largest_offset_changes(trajectory: Trajectory, knots: Array) -> Array:
    """The largest changes (K, n) of offsets from each knot to the next, at the latter, that speed and acceleration
    allow; 0 at the first.
    """
    motion = trajectory.motion
    robot = trajectory.robot
    left = 1.0 - trajectory.share
    part = np.linspace(0.0, 1.0, 5)
    s = motion.s[:-1, None] + part * np.diff(motion.s)[:, None]
    squared = np.maximum(motion.pace[:-1, None] ** 2 + 2 * motion.change[:, None] * (s - motion.s[:-1, None]), 0.0)
    cell = np.clip(np.searchsorted(knots, s.mean(axis=1), "right") - 1, 0, len(knots) - 2)
    length = np.diff(knots)[cell][:, None]
    x = (s - knots[cell][:, None]) / length
    slope = 6 * x * (1 - x) / length
    bend = (6 - 12 * x) / length**2
    speed = (slope * np.sqrt(squared)).max(axis=1)
    acceleration = abs(bend * squared + slope * motion.change[:, None]).max(axis=1)
    begin = np.searchsorted(cell, np.arange(len(knots) - 1))
    most = [np.maximum.reduceat(rate, begin)[:, None] * CORRECTION_SAFETY_FACTOR for rate in (speed, acceleration)]
    found = np.minimum(left * robot.speed / most[0], left * robot.acceleration / most[1])
    return np.vstack([np.zeros(found.shape[1]), found])


def _bound_offsets(trajectory: Trajectory, knots: Array) -> Array:
    """Bounds (K, n + 1, n + 1) of offsets that keep positions, order and carriages from the knot before to the
    next.
    """
    robot = trajectory.robot
    d = trajectory.robot.d
    ends = trajectory.knots
    s = np.append(
        (
            ends[:-1, None]
            + np.diff(ends)[:, None] * np.arange(LEEWAY_SAMPLES_PER_FRAME) / LEEWAY_SAMPLES_PER_FRAME
        ).ravel(),
        ends[-1],
    )
    q = trajectory.motion.path(s)
    driven = q + trajectory.hardware.in_joints(robot, trajectory.lash(s))
    least, most = trajectory.hardware.reach(robot)
    growth = np.diff(q[:, d : 2 * d], axis=1)
    above = np.minimum(robot.upper - q, most - driven)
    below = np.minimum(q - robot.lower, driven - least)
    near = growth
    apart = robot.max_extension_differences - growth
    found = np.full((len(knots), q.shape[1] + 1, q.shape[1] + 1), np.inf)
    betas = d + 1 + np.arange(d - 1)
    for k, (first, last) in enumerate(_around(s, knots)):
        here = slice(first, last)
        found[k, 0, 1:], found[k, 1:, 0] = above[here].min(axis=0), below[here].min(axis=0)
        found[k, betas + 1, betas], found[k, betas, betas + 1] = near[here].min(axis=0), apart[here].min(axis=0)
    return np.maximum(found, 0.0)


def _around(s: Array, knots: Array) -> list[tuple[int, int]]:
    """Which of places s (N,) lie from the knot before each knot to the one after."""
    first = np.searchsorted(s, np.append(knots[:1], knots[:-1]) - 1e-12, "left")
    last = np.searchsorted(s, np.append(knots[1:], knots[-1:]) + 1e-12, "right")
    return list(zip(first.tolist(), last.tolist(), strict=True))


def _tighten_bounds(bounds: npt.NDArray[np.float64]) -> Array:
    """The tightest bounds (m, m) of the same set: Floyd and Warshall."""
    found = bounds.copy()
    np.fill_diagonal(found, 0.0)
    for k in range(len(found)):
        np.minimum(found, found[:, k, None] + found[k], out=found)
    return found
