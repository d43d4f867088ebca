"""The path between frames: a smooth curve through all of them that keeps what the frames keep."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

PATH_IPOPT_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt": {"print_level": 0, "sb": "yes", "bound_relax_factor": 0.0, "tol": 1e-9},
}

STANDSTILL_SPEED_FRACTION = 1e-6
"""Part of the largest speed: what goes slower from one frame to the next stands still at both."""


def path_through(robot: Robot, time: Array, q: Array) -> CubicHermiteSpline:
    """The smoothest cubic in time (T,) through frames q (T, 2d + 2) in which nothing overshoots a frame.

    It has the least integral of |W q''|^2 among those whose joints, and whose distances between neighbouring
    tubes, go steadily from each frame to the next (slopes in the box of de Boor and Swartz, 1977). Where frames
    keep positions, order and carriage gaps, so does all of it. Raises TrajectoryError.
    """
    step = np.diff(time)
    n = q.shape[1]
    chord = np.diff(q * robot.mm_per_unit, axis=0) / step[:, None]
    fastest = abs(chord).max() or 1.0
    chord /= fastest
    between = _neighbours(robot)
    lower, upper = _steady(np.hstack([chord, chord @ between.T]))
    fixed = (lower == upper)[:, :n] @ abs(between).T == 2
    lower[:, n:][fixed], upper[:, n:][fixed] = -np.inf, np.inf
    slope = ca.SX.sym("slope", n, len(q))
    before = slope[:, :-1]
    after = slope[:, 1:]
    mean = ca.DM(chord.T)
    bending = (before**2 + before * after + after**2 - 3 * mean * (before + after)) @ ca.DM(step.mean() / step)
    program = {"x": ca.vec(slope), "f": ca.sum1(bending), "g": ca.vec(ca.DM(between) @ slope)}
    solve = ca.nlpsol("path", "ipopt", program, PATH_IPOPT_OPTIONS)
    found = solve(
        x0=0,
        lbx=lower[:, :n].ravel(),
        ubx=upper[:, :n].ravel(),
        lbg=lower[:, n:].ravel(),
        ubg=upper[:, n:].ravel(),
    )
    if not solve.stats()["success"]:
        raise TrajectoryError(f"no smooth path leads through these frames: {solve.stats()['return_status']}")
    slopes = np.array(found["x"]).reshape(q.shape) * fastest / robot.mm_per_unit
    return CubicHermiteSpline(time, q, slopes)


def _neighbours(robot: Robot) -> Array:
    """Rows (d - 1, 2d + 2) that take beta_i from beta_{i+1}."""
    rows = np.zeros((robot.d - 1, 2 * robot.d + 2))
    for i, row in enumerate(rows):
        row[robot.d + i : robot.d + i + 2] = -1.0, 1.0
    return rows


def _steady(chord: Array) -> tuple[Array, Array]:
    """Bounds (T, k) of slopes at frames; a cubic with these chords (T - 1, k) is then monotone between them."""
    chord = np.where(abs(chord) < STANDSTILL_SPEED_FRACTION, 0.0, chord)
    least = 3.0 * np.minimum(abs(chord[1:]), abs(chord[:-1])) * (chord[1:] * chord[:-1] > 0)
    slopes = np.concatenate([3.0 * chord[:1], least * np.sign(chord[1:]), 3.0 * chord[-1:]])
    return np.minimum(slopes, 0.0), np.maximum(slopes, 0.0)


def backlash_compensation(time: Array, positions: Array, backlash: Array, before: Array) -> CubicHermiteSpline:
    """What is added to positions (T, m) at times (T,) so that play in the drives does not show; the same unit.

    An axis that goes down is put lower by its backlash (m,); on reversal that comes and goes smoothly until the
    next frame. before (m,): what is added at the first. A hundredth of the play back is not a reversal.
    """
    added = np.empty_like(positions)
    added[0], furthest = before, positions[0].copy()
    for j, position in enumerate(positions[1:], start=1):
        down = added[j - 1] < 0
        furthest = np.where(down, np.minimum(furthest, position), np.maximum(furthest, position))
        turns = abs(position - furthest) > 0.01 * backlash
        furthest = np.where(turns, position, furthest)
        added[j] = np.where(down ^ turns, -backlash, 0.0)
    return CubicHermiteSpline(time, added, np.zeros_like(added))
