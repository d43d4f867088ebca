"""Robots moved through a plan by continuation: each equilibrium is found from the one before by Newton's method.

The first one is known: tubes that are all turned to the same angle do not twist. Along a motion the determinant of
d psi'(tips) / d psi'(0) stays positive up to the first fold, where the equilibrium ends and a robot snaps.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.check.tubes import Array, Tubes, Twist, integrate

Settle = Callable[..., Any]
"""Finds where a robot comes to rest after its equilibrium has ended: (tubes, rates, before, after), the latter
(alpha, beta) at the end and beyond it -> rates at the base, or None where that is not known."""

MAX_NEWTON_ITERATIONS = 10
CONVERGED_RATE = 1e-6
"""rad/mm: Newton's last correction of the rates at the base; the error that is left is about its square."""
MAX_RATE_CHANGE = 0.05
"""rad/mm by which one iteration of Newton's method may change a rate."""
MAX_TIP_TURN_RAD = 0.25
"""By how much the tips may turn against each other within one step of a motion."""
MIN_PART = 1 / 20000
"""Of the way from frame to frame: where no shorter step leads on, the equilibrium has ended in a fold."""
SNAP_RAD = 0.1
"""By how much a tip turns, at least, where a robot leaves its branch and has snapped: less is a slip."""
LONGEST_PART = 0.5
"""Of the way from frame to frame, that the nominal robot is moved in one step."""


class Follower:
    """n robots that are moved by continuation, each in steps of its own.

    rates, angles (d, n): at the base, rad/mm, and at the tips, rad. tube, beta (d, n): where the tubes' bases are,
    without the motors' zeros, rad and mm. snapped (n,): whether a robot has snapped. gone (n,): whether it is not
    moved any further, since where it came to rest is not known.
    """

    def __init__(
        self, tubes: Tubes, angle: float, lags: Array | float = 0.0, settle: Settle | None = None
    ) -> None:
        """Untwisted robots whose tubes are all turned to one angle, rad.

        lags (d, n): play of tubes behind their motors to either side, rad.
        """
        self.tubes = tubes
        self.rates = np.zeros_like(tubes.zero)
        self.angles = np.full_like(tubes.zero, angle)
        self.tube = self.angles.copy()
        self.beta = self.rates.copy()
        self.snapped = np.zeros(tubes.zero.shape[1], dtype=bool)
        self.gone = self.snapped.copy()
        self._lags = lags + np.zeros_like(tubes.zero)
        self._settle = settle
        self._trend = np.zeros_like(tubes.zero)
        self._begun = False

    def twist(self, rows: Array) -> Twist:
        """The tubes of some robots as they are now."""
        tubes = self.tubes[rows]
        alpha = self.tube[:, rows] + tubes.zero
        return integrate(tubes, alpha, self.beta[:, rows], self.rates[:, rows], sensitivities=False)

    def advance(self, before: Array, after: Array, start: float, end: float, longest: float) -> None:
        """Move all robots that are not gone from one part of the way between two frames to another.

        before, after (2d, n): alpha and beta of the motors in the frames. Where Newton's method does not lead on,
        a robot's step is cut to a quarter; where the shortest leads nowhere, its equilibrium ends.
        """

        def place(part: Array, rows: Array) -> tuple[Array, Array]:
            """Alpha and beta (d, m) of tubes of robots (m,) at parts (m,) of the way."""
            # Motors' zeros grow on the first way, as no equilibrium is known of tubes that begin turned.
            # Every motor turns one way between frames, so that play depends on where it is now alone.
            zero = self.tubes.zero[:, rows] * (1.0 if self._begun else part)
            alpha, beta = np.split(before[:, rows] + (after - before)[:, rows] * part, 2)
            lag = self._lags[:, rows]
            return np.clip(self.tube[:, rows], alpha - lag, alpha + lag) + zero, beta

        part, step = np.full(len(self.gone), start), np.full(len(self.gone), longest)
        rows = np.flatnonzero(~self.gone)
        while len(rows):
            goal = np.minimum(part[rows] + step[rows], end)
            reached = self._step(rows, *place(goal, rows), goal - part[rows])
            part[rows[reached]] = goal[reached]
            step[rows] = np.where(reached, np.minimum(2 * step[rows], longest), step[rows] / 4)
            self._trend[:, rows[~reached]] = 0.0
            for row in rows[~reached & (step[rows] < MIN_PART), None]:
                old, step[row] = part[row], longest / 16
                part[row] = np.minimum(old + step[row], end)
                self._leave_branch(row, place(old, row), place(part[row], row))
            rows = rows[~self.gone[rows] & (part[rows] < end)]
        every = np.arange(len(self.gone))
        alpha, self.beta = place(np.full(len(every), end), every)
        self.tube, self._begun = alpha - self.tubes.zero, True

    def _leave_branch(self, row: Array, before: tuple[Array, Array], after: tuple[Array, Array]) -> None:
        """Let one robot, row (1,), whose equilibrium ends come to rest at the configuration after it."""
        rates = self._settle and self._settle(self.tubes[row], self.rates[:, row], before, after)
        if rates is None:
            self.gone[row] = self.snapped[row] = True
            return
        angles = integrate(self.tubes[row], *after, rates, sensitivities=False).tip_angles
        self.snapped[row] |= abs(angles - self.angles[:, row]).max() > SNAP_RAD
        self.rates[:, row], self.angles[:, row] = rates, angles

    def _step(self, rows: Array, alpha: Array, beta: Array, part: Array) -> Array:
        """Which robots (m,) Newton's method leads to a stable equilibrium nearby; these are moved there."""
        tubes, old = self.tubes[rows], self.rates[:, rows]
        rates = old + part * self._trend[:, rows]
        angles, reached = np.empty_like(rates), np.zeros(len(rows), dtype=bool)
        # Robots that have converged, or diverge, leave the batch, so that the last iterations concern few.
        busy, before = np.arange(len(rows)), np.full(len(rows), np.inf)
        for _ in range(MAX_NEWTON_ITERATIONS):
            found = integrate(tubes[busy], alpha[:, busy], beta[:, busy], rates[:, busy])
            determinant = np.nan_to_num(np.linalg.det(found.sensitivity))
            # A singular matrix leads nowhere: its determinant is not positive.
            regular = (abs(determinant) > 1e-300)[:, None, None]
            slopes = np.where(regular, found.sensitivity, np.eye(len(rates)))
            change = -np.linalg.solve(slopes, found.rate[-1].T[..., None])[..., 0].T
            size = abs(change).max(axis=0)
            rates[:, busy] += np.clip(change, -MAX_RATE_CHANGE, MAX_RATE_CHANGE)
            angles[:, busy] = found.tip_angles
            done = size < CONVERGED_RATE
            reached[busy[done & (determinant > 0)]] = True
            goes_on = ~done & np.isfinite(size) & (size < 2 * before)
            busy, before = busy[goes_on], size[goes_on]
            if not len(busy):
                break
        turned = angles - self.angles[:, rows]
        reached &= abs(turned - turned[-1:]).max(axis=0) < MAX_TIP_TURN_RAD
        moved = rows[reached]
        self._trend[:, moved] = (rates[:, reached] - old[:, reached]) / part[reached]
        self.rates[:, moved], self.angles[:, moved] = rates[:, reached], angles[:, reached]
        return reached


def move_through(follower: Follower, q: Array, longest: float = LONGEST_PART) -> Iterator[int]:
    """Move aligned robots through q (T, 2d + 2), linear between frames; yields each frame, from 0, once there."""
    ways = np.repeat(_find_ways(q)[..., None], len(follower.gone), axis=2)
    for frame, (before, after) in enumerate(itertools.pairwise(ways)):
        follower.advance(before, after, 0.0, 1.0, longest)
        yield frame


def _find_ways(q: Array) -> Array:
    """Alpha and beta (T + 1, 2d) of q (T, 2d + 2) after a frame in which all tubes are turned as the innermost."""
    d = q.shape[1] // 2 - 1
    ways = np.concatenate([q[:1], q])[:, : 2 * d]
    ways[0, :d] = ways[0, d - 1]
    return ways


@dataclass(frozen=True, eq=False)
class NominalMotion:
    """The robot as described, moved through T frames in `substeps` steps each.

    Rows are frames, columns sub-steps, of which the last is the frame: rates, tip_angles (T, substeps, d), and q
    (T, substeps, 2d + 2). The first frame is entered from where all tubes are aligned, so that its earlier columns
    repeat the frame. snaps: frames, from 1, on the way to which the robot snaps.
    """

    tubes: Tubes
    q: Array
    rates: Array
    tip_angles: Array
    snaps: list[int]

    def twists(self, chosen: Any) -> tuple[Twist, Array]:
        """The tubes integrated anew at chosen frames and sub-steps, an index of both, and theta (2, n) there."""
        d = self.rates.shape[-1]
        q = self.q[chosen].T
        tubes = self.tubes.repeat(q.shape[1])
        return integrate(tubes, q[:d], q[d : 2 * d], self.rates[chosen].T, sensitivities=False), q[2 * d :]


def move_nominal(
    tubes: Tubes, q: Array, substeps: int = 10, settle: Settle | None = None, longest: float = LONGEST_PART
) -> NominalMotion:
    """Move a robot through q (T, 2d + 2), linear between frames, by continuation from aligned tubes.

    The robot is first moved from frame to frame. The sub-steps of all frames are then passed by one batch of
    robots, each from one frame to the next. Where one of these does not arrive in the state that the next began
    in, the steps of the first were too long, and are made as short. After a snap the robot goes on from where it
    comes to rest, which `settle` finds; where that is not found, it has no shape any more (NaN).
    """
    aligned = q[0, len(tubes.zero) - 1]
    follower, many = (
        Follower(tubes, aligned, settle=settle),
        Follower(tubes.repeat(len(q)), aligned, settle=settle),
    )
    states = [np.stack([follower.rates, follower.angles])]
    for _ in move_through(follower, q, longest):
        states.append(np.where(follower.gone, np.nan, np.stack([follower.rates, follower.angles])))
    frames = np.concatenate(states, axis=2)
    many.rates[:], many.angles[:] = frames[..., :-1]
    many.gone[:] = np.isnan(many.rates).any(axis=0)
    ways, parts = _find_ways(q).T, np.linspace(0.0, 1.0, substeps + 1)
    found = []
    for start, end in itertools.pairwise(parts):
        many.advance(ways[:, :-1], ways[:, 1:], start, end, 1 / substeps)
        found.append(np.where(many.gone, np.nan, np.stack([many.rates, many.angles])))
    rates, angles = np.array(found).transpose(1, 3, 0, 2)
    if np.nanmax(abs(angles[:, -1].T - frames[1, :, 1:]), initial=0.0) > SNAP_RAD and longest > 1 / substeps:
        return move_nominal(tubes, q, substeps, settle, longest=1 / substeps)
    places = q[:, None] + (parts[1:, None] - 1) * np.diff(q, axis=0, prepend=q[:1])[:, None]
    rates[0], angles[0] = rates[0, -1], angles[0, -1]
    return NominalMotion(tubes, places, rates, angles, (np.flatnonzero(many.snapped) + 1).tolist())
