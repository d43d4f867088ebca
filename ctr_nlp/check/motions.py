"""Robots moved through a plan by continuation: each equilibrium is found from the one before by Newton's method.

The first one is known: tubes that are all turned to the same angle do not twist. Along a motion the determinant of
d psi'(tips) / d psi'(0) stays positive up to the first fold, where the equilibrium ends and a robot snaps. Where
it comes to rest is not looked for: from there on it has no shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from ctr_nlp.check.tubes import Array, Tubes, Twist, integrate

MAX_NEWTON_ITERATIONS = 10
CONVERGED_RATE = 1e-6
"""rad/mm: Newton's last correction of the rates at the base; the error that is left is about its square."""
MAX_RATE_CHANGE = 0.05
"""rad/mm by which one iteration of Newton's method may change a rate."""
MAX_TIP_TURN_RAD = 0.25
"""By how much the tips may turn against each other within one step of a motion."""
MIN_PART = 1 / 20000
"""Of one way: where no shorter step leads on, the equilibrium has ended in a fold."""
LONGEST_PART = 0.5
"""Of the way from frame to frame, that the nominal robot is moved in one step."""


class Follower:
    """n robots that are moved by continuation, each in steps of its own.

    rates, angles (d, n): at the base, rad/mm, and at the tips, rad, NaN of a robot that has snapped. tube, beta
    (d, n): where the tubes' bases are, without the motors' zeros, rad and mm. snapped (n,): whether a robot has
    snapped, and is not moved any further.
    """

    def __init__(self, tubes: Tubes, angle: float = 0.0, lags: Array | float = 0.0) -> None:
        """Untwisted robots whose tubes are all turned to one angle, rad.

        lags (d, n): play of tubes behind their motors to either side, rad. Without play, the angle does not count.
        """
        self.tubes = tubes
        self.rates = np.zeros_like(tubes.zero)
        self.angles = np.full_like(tubes.zero, angle)
        self.tube = self.angles.copy()
        self.beta = self.rates.copy()
        self.snapped = np.zeros(tubes.zero.shape[1], dtype=bool)
        self._lags = lags + np.zeros_like(tubes.zero)
        self._begun = False

    def twist(self, rows: Array) -> Twist:
        """The tubes of some robots as they are now."""
        tubes = self.tubes[rows]
        alpha = self.tube[:, rows] + tubes.zero
        return integrate(tubes, alpha, self.beta[:, rows], self.rates[:, rows], sensitivities=False)

    def move(self, ways: Array, longest: float = LONGEST_PART) -> Iterator[int]:
        """Move the motors through ways (F + 1, 2d, n), alpha and beta; yields the number of each way once passed.

        longest: part of a way that robots are moved in one step. Where Newton's method does not lead on, a robot's
        step is cut to a quarter; where the shortest leads nowhere, its equilibrium ends, and it snaps.
        """
        for way, (before, after) in enumerate(itertools.pairwise(ways)):
            self._advance(before, after, longest)
            yield way

    def _advance(self, before: Array, after: Array, longest: float) -> None:
        """Move all robots that have not snapped from one place of their motors (2d, n) to the next."""

        def place(part: Array, rows: Array) -> tuple[Array, Array]:
            """Alpha and beta (d, m) of tubes of robots (m,) at parts (m,) of the way."""
            # Motors' zeros grow on the first way, as no equilibrium is known of tubes that begin turned.
            # Every motor turns one way between frames, so that play depends on where it is now alone.
            zero = self.tubes.zero[:, rows] * (1.0 if self._begun else part)
            alpha, beta = np.split(before[:, rows] + (after - before)[:, rows] * part, 2)
            lag = self._lags[:, rows]
            return np.clip(self.tube[:, rows], alpha - lag, alpha + lag) + zero, beta

        part, step = np.zeros(len(self.snapped)), np.full(len(self.snapped), longest)
        while len(rows := np.flatnonzero(~self.snapped & (part < 1))):
            goal = np.minimum(part[rows] + step[rows], 1.0)
            reached = self._step(rows, *place(goal, rows))
            part[rows[reached]] = goal[reached]
            step[rows] = np.where(reached, np.minimum(2 * step[rows], longest), step[rows] / 4)
            self.snapped[rows] = step[rows] < MIN_PART
            self.rates[:, self.snapped] = self.angles[:, self.snapped] = np.nan
        alpha, self.beta = place(np.ones(len(part)), np.arange(len(part)))
        self.tube, self._begun = alpha - self.tubes.zero, True

    def _step(self, rows: Array, alpha: Array, beta: Array) -> Array:
        """Which robots (m,) Newton's method leads to a stable equilibrium nearby; these are moved there."""
        tubes, rates = self.tubes[rows], self.rates[:, rows]
        size, diverges = np.full(len(rows), np.inf), np.zeros(len(rows), dtype=bool)
        for _ in range(MAX_NEWTON_ITERATIONS):
            found = integrate(tubes, alpha, beta, rates)
            determinant = np.nan_to_num(np.linalg.det(found.sensitivity))
            # A singular matrix leads nowhere: its determinant is not positive.
            regular = (abs(determinant) > 1e-300)[:, None, None]
            slopes = np.where(regular, found.sensitivity, np.eye(len(rates)))
            change = -np.linalg.solve(slopes, found.rate[-1].T[..., None])[..., 0].T
            before, size = size, abs(change).max(axis=0)
            diverges |= ~(size < np.maximum(2 * before, CONVERGED_RATE))
            rates += np.clip(change, -MAX_RATE_CHANGE, MAX_RATE_CHANGE)
            if (diverges | (size < CONVERGED_RATE)).all():
                break
        turned = found.tip_angles - self.angles[:, rows]
        near = abs(turned - turned[-1:]).max(axis=0) < MAX_TIP_TURN_RAD
        reached = near & ~diverges & (size < CONVERGED_RATE) & (determinant > 0)
        moved = rows[reached]
        self.rates[:, moved], self.angles[:, moved] = rates[:, reached], found.tip_angles[:, reached]
        return reached


def find_ways(q: Array, count: int = 1) -> Array:
    """Alpha and beta (T + 1, 2d, count) of robots in q (T, 2d + 2); first with tubes turned as the innermost."""
    d = q.shape[1] // 2 - 1
    ways = np.concatenate([q[:1], q])[:, : 2 * d]
    ways[0, :d] = ways[0, d - 1]
    return np.repeat(ways[..., None], count, axis=2)


def move_nominal(tubes: Tubes, q: Array, substeps: int = 10) -> tuple[Array, Array, list[int]]:
    """Move a robot through q (T, 2d + 2), linear between frames, by continuation from aligned tubes.

    The robot is first moved from frame to frame. The sub-steps of all frames are then passed by one batch of
    robots, each from one frame to the next.

    Returns q (T, substeps, 2d + 2) and rates (T, substeps, d) at the base at sub-steps, of which the last is the
    frame, and the frame, from 1, on the way to which the robot snaps, in a list that is empty where it does not.
    From there on rates are NaN. The first frame is entered from where all tubes are aligned, so that its earlier
    sub-steps repeat the frame.
    """
    follower, many, ways = Follower(tubes), Follower(tubes.repeat(len(q))), find_ways(q)
    states = [np.zeros((2, *follower.rates.shape))]
    states += [np.stack([follower.rates, follower.angles]) for _ in follower.move(ways)]
    many.rates[:], many.angles[:] = np.concatenate(states[:-1], axis=2)
    many.snapped[:] = np.isnan(many.rates).any(axis=0)
    parts = np.linspace(0.0, 1.0, substeps + 1)[:, None, None]
    fine = ways[:-1, :, 0].T + parts * np.diff(ways[..., 0], axis=0).T
    rates = np.array([many.rates.copy() for _ in many.move(fine, longest=1.0)]).transpose(2, 0, 1)
    rates[0] = rates[0, -1]
    places = (q + (parts[1:] - 1) * np.diff(q, axis=0, prepend=q[:1])).swapaxes(0, 1)
    return places, rates, (np.flatnonzero(many.snapped)[:1] + 1).tolist()
