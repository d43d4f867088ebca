"""How far from its plan a robot may be led so that all limits hold there, and can hold ever after.

A trajectory for a closed loop is timed with a share of the largest speeds and accelerations; the rest is for
corrections. Between knots a correction changes from one offset to the next as 3 x^2 - 2 x^3, which bounds the
offset's change per knot. The offsets that are allowed at a knot are those within limits of position, order and
carriages around it from which an allowed one can be reached at the knot after. All of these sets are bounds of
offsets and of their differences, x_j - x_i <= D_ij with x_0 = 0, which stay of that form (difference-bound
matrices; Mine, 2006, The octagon abstract domain).
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
"""Places between two frames at which limits are looked at."""

CORRECTION_SAFETY_FACTOR = 1.01
"""Factor by which a correction is slower than it may be, for what is between places."""


class Leeway:
    """Allowed offsets from a trajectory with a share below 1.

    knots (K,): parameters of its path; frames (K,): their numbers; time (K,): s at which they are passed. The
    offsets at the first two knots are 0.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        chosen = _choose_knots(trajectory.frame_time)
        self.knots = trajectory.knots[chosen]
        self.frames = trajectory.frames[chosen]
        self.time: Array = trajectory.frame_time[chosen]
        self._change = _largest_offset_changes(trajectory, self.knots)
        self._allowed = self._backwards(_bound_offsets(trajectory, self.knots))

    def _backwards(self, rooms: Array) -> Array:
        """Return the offsets (K, n + 1, n + 1) from which allowed ones can be reached at the knot after."""
        found = [_tighten_bounds(rooms[-1])]
        for room, change in zip(rooms[-2::-1], self._change[:0:-1], strict=True):
            reach = np.append(0.0, change)
            # Offsets from which some allowed one is within the reach r of the next knot are the allowed ones grown
            # by the box |x_i| <= r_i: D_ij + r_i + r_j with r_0 = 0.
            found.append(_tighten_bounds(np.minimum(room, found[-1] + reach[:, None] + reach)))
        return np.array(found[::-1])

    def _reachable_bounds(self, knot: int, before: Array) -> Array:
        """Return bounds (n + 1, n + 1) of offsets at a knot, from 1, after an offset before (n,) at the last."""
        change = self._change[knot]
        bounds = self._allowed[knot].copy()
        bounds[0, 1:] = np.minimum(bounds[0, 1:], before + change)
        bounds[1:, 0] = np.minimum(bounds[1:, 0], change - before)
        return _tighten_bounds(bounds)

    def box(self, knot: int, before: Array) -> tuple[Array, Array]:
        """Return the least and the largest offsets (n,) at a knot, from 1, after an offset before (n,)."""
        bounds = self._reachable_bounds(knot, before)
        return -bounds[1:, 0], bounds[0, 1:]

    def nearest_allowed_offset(self, knot: int, before: Array, wanted: Array) -> Array:
        """Return an allowed offset (n,) near a wanted one at a knot, from 1, after offset before (n,)."""
        bounds = self._reachable_bounds(knot, before)
        found = np.empty_like(wanted)
        for j, value in enumerate(wanted, start=1):
            # One after the other is enough: in tight bounds every value of x_j in its range can be completed.
            # Fixing it tightens the ranges of the others by D_jk.
            value = min(max(value, -bounds[j, 0]), bounds[0, j])
            bounds[0], bounds[:, 0] = (
                np.minimum(bounds[0], value + bounds[j]),
                np.minimum(bounds[:, 0], bounds[:, j] - value),
            )
            found[j - 1] = value
        return found

    def offsets_back_to_plan(self, knot: int, offset: Array) -> Array:
        """Return the offsets (K - knot, n) from a knot on, of a robot that returns to the plan.

        knot: from 1. offset: (n,) there.
        """
        found = np.zeros((len(self.knots) - knot, len(offset)))
        found[0] = offset
        for later in range(1, len(found)):
            if not found[later - 1].any():
                break
            found[later] = self.nearest_allowed_offset(knot + later, found[later - 1], np.zeros_like(offset))
        return found


def _choose_knots(time: Array) -> Index:
    """Choose frames that are at least MIN_KNOT_SPACING_S apart, the first and the last among them.

    time: (T,) s at which frames are passed. Returns their indices.
    """
    found = [0]
    for k, each in enumerate(time):
        if each >= time[found[-1]] + MIN_KNOT_SPACING_S and time[-1] - each >= MIN_KNOT_SPACING_S:
            found.append(k)
    return np.array([*found, len(time) - 1])


def _largest_offset_changes(trajectory: Trajectory, knots: Array) -> Array:
    """Return the largest changes (K, n) of offsets from the knot before to each knot; 0 at the first.

    They are what is left of speeds and accelerations.
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
    # Derivatives of 3 x^2 - 2 x^3 by s. An offset that changes by delta moves at delta slope v and accelerates by
    # delta (bend v^2 + slope dv/dt), with the pace v.
    slope = 6 * x * (1 - x) / length
    bend = (6 - 12 * x) / length**2
    speed = (slope * np.sqrt(squared)).max(axis=1)
    acceleration = abs(bend * squared + slope * motion.change[:, None]).max(axis=1)
    begin = np.searchsorted(cell, np.arange(len(knots) - 1))
    most = [np.maximum.reduceat(rate, begin)[:, None] * CORRECTION_SAFETY_FACTOR for rate in (speed, acceleration)]
    found = np.minimum(left * robot.speed / most[0], left * robot.acceleration / most[1])
    return np.vstack([np.zeros(found.shape[1]), found])


def _bound_offsets(trajectory: Trajectory, knots: Array) -> Array:
    """Return bounds (K, n + 1, n + 1) of offsets that satisfy positions, order and carriage gaps around knots.

    Around a knot is from the knot before to the one after.
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
        # x_j <= above, -x_j <= below.
        found[k, 0, 1:], found[k, 1:, 0] = above[here].min(axis=0), below[here].min(axis=0)
        # Order: x_i - x_{i+1} <= beta_{i+1} - beta_i. Carriages: x_{i+1} - x_i <= the largest difference less
        # this.
        found[k, betas + 1, betas], found[k, betas, betas + 1] = near[here].min(axis=0), apart[here].min(axis=0)
    return np.maximum(found, 0.0)


def _around(s: Array, knots: Array) -> list[tuple[int, int]]:
    """Return which of places s (N,) lie from the knot before each knot to the one after, as index ranges."""
    first = np.searchsorted(s, np.append(knots[:1], knots[:-1]) - 1e-12, "left")
    last = np.searchsorted(s, np.append(knots[1:], knots[-1:]) + 1e-12, "right")
    return list(zip(first.tolist(), last.tolist(), strict=True))


def _tighten_bounds(bounds: npt.NDArray[np.float64]) -> Array:
    """Return the tightest bounds (m, m) of the same set, by the shortest paths of Floyd and Warshall."""
    found = bounds.copy()
    np.fill_diagonal(found, 0.0)
    for k in range(len(found)):
        np.minimum(found, found[:, k, None] + found[k], out=found)
    return found
