"""The path between frames: a smooth curve through all of them that satisfies the limits that frames satisfy.

Piecewise cubics in time with free slopes m_j at the frames. Between frames with the chord c, a step h apart, the
integral of q''^2 is 4 (m_j^2 + m_j m_{j+1} + m_{j+1}^2 - 3 c (m_j + m_{j+1}) + 3 c^2) / h. Its least value over
all slopes in boxes in which a cubic is monotone (de Boor and Swartz, 1977, Piecewise monotone interpolation) is a
convex quadratic program.
"""

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
"""Part of the largest speed below which a joint counts as standing still from one frame to the next."""


def path_through(robot: Robot, time: Array, q: Array) -> CubicHermiteSpline:
    """Return the smoothest cubic in time (T,) through frames q (T, 2d + 2) in which nothing overshoots a frame.

    robot: gives mm per unit, W, and the tubes' order. The path has the least integral of |W q''|^2 among those
    whose joints, and whose distances between neighbouring tubes, are monotone between frames. Where frames satisfy
    limits of position, order and carriage gaps, so does all of it. Raises TrajectoryError.
    """
    step = np.diff(time)
    n = q.shape[1]
    chord = np.diff(q * robot.mm_per_unit, axis=0) / step[:, None]
    fastest = abs(chord).max() or 1.0
    chord /= fastest
    between = _neighbours(robot)
    lower, upper = _steady(np.hstack([chord, chord @ between.T]))
    # Where both betas of a pair stand still, their difference does, too: its equation has no unknowns left, and
    # IPOPT counts it against its degrees of freedom.
    fixed = (lower == upper)[:, :n] @ abs(between).T == 2
    lower[:, n:][fixed], upper[:, n:][fixed] = -np.inf, np.inf
    slope = ca.SX.sym("slope", n, len(q))
    before = slope[:, :-1]
    after = slope[:, 1:]
    mean = ca.DM(chord.T)
    # The integrals of q''^2 without constants and common factors; the mean step keeps them near 1.
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
    """Return rows (d - 1, 2d + 2) that map q to beta_{i+1} - beta_i."""
    rows = np.zeros((robot.d - 1, 2 * robot.d + 2))
    for i, row in enumerate(rows):
        row[robot.d + i : robot.d + i + 2] = -1.0, 1.0
    return rows


def _steady(chord: Array) -> tuple[Array, Array]:
    """Return bounds (T, k) of slopes at frames with which a cubic with these chords (T - 1, k) is monotone."""
    chord = np.where(abs(chord) < STANDSTILL_SPEED_FRACTION, 0.0, chord)
    # 0 where the direction changes: a joint turns back at a frame and nowhere else.
    least = 3.0 * np.minimum(abs(chord[1:]), abs(chord[:-1])) * (chord[1:] * chord[:-1] > 0)
    slopes = np.concatenate([3.0 * chord[:1], least * np.sign(chord[1:]), 3.0 * chord[-1:]])
    return np.minimum(slopes, 0.0), np.maximum(slopes, 0.0)


def backlash_compensation(time: Array, positions: Array, backlash: Array, before: Array) -> CubicHermiteSpline:
    """Return what is added to positions so that play in the drives does not show, a curve over time.

    time: (T,) s. positions: (T, m) of the axes. backlash: play (m,) of their drives. before: what is added (m,) at
    the first; all in the axes' units. An axis that goes down is put lower by its backlash; on reversal this comes
    and goes smoothly until the next frame. A hundredth of the play back is not a reversal.
    """
    added = np.empty_like(positions)
    added[0], furthest = before, positions[0].copy()
    for j, position in enumerate(positions[1:], start=1):
        down = added[j - 1] < 0
        # The furthest place since the last reversal: small steps back add up until they count as one.
        furthest = np.where(down, np.minimum(furthest, position), np.maximum(furthest, position))
        turns = abs(position - furthest) > 0.01 * backlash
        furthest = np.where(turns, position, furthest)
        added[j] = np.where(down ^ turns, -backlash, 0.0)
    return CubicHermiteSpline(time, added, np.zeros_like(added))
