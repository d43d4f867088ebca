"""Robots followed through a motion by shooting, from the differential equations of their tubes and nothing else.

Tube i of a robot that bends nothing but itself turns by psi_i(s) from the base's frame, s from the opening:
GJ_i psi_i'' = EI_i k_i (u_x sin b_i - u_y cos b_i), with u = sum EI_i k_i (cos b_i, sin b_i) / sum EI_i, where it
bends towards b_i = psi_i, and a helix towards b_i = psi_i + torsion (s - begin of its curved part);
psi_i(0) = alpha_i + psi_i'(0) (L_i - beta_i), as transmissions twist evenly, and psi_i'(beta_i) = 0 at the tip.
The unknowns are the rates psi_i'(0); sensitivities of the tips' rates over them are integrated beside, and where
their determinant is 0 an equilibrium ceases to be stable. Robots are integrated at once, piece by piece
between the places where tubes end or begin to curve, each over its own lengths.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from ctr_nlp import Robot

LONGEST = 0.5
"""Of the way from frame to frame, in a step."""
LEAST = LONGEST / 512
"""Shortest step: an equilibrium that is not found within it, or jumps, has ended."""
JUMP = 0.25
"""rad: by how much a robot's tips may turn against each other within a step."""
OPTIONS = {"method": "DOP853", "rtol": 1e-8, "atol": 1e-10}


@dataclass(frozen=True, eq=False)
class Tubes:
    """n robots of d tubes: all (n, d), mm, 1/mm; bending and torsion stiffness in one unit; zeros, rad; rad/mm."""

    length: np.ndarray
    curved: np.ndarray
    root: np.ndarray
    tip: np.ndarray
    bending: np.ndarray
    torsion: np.ndarray
    zero: np.ndarray
    helix: np.ndarray

    def __getitem__(self, rows) -> Tubes:
        return Tubes(*(each[rows] for each in vars(self).values()))


def tubes(robot: Robot, parts: np.ndarray) -> Tubes:
    """Of robots that differ by parts (n, d, 5): curvature, stiffness, torsional ratio, curved length, zero."""

    def each(value):
        return np.array([value(tube) for tube in robot.tubes])

    bent, stiff, ratio, longer, zero = np.moveaxis(parts, -1, 0)
    bending = each(lambda t: t.youngs_modulus * np.pi / 64 * (t.outer_diameter**4 - t.inner_diameter**4))
    bending = bending * (1 + stiff)
    ends = [each(lambda t, k=k: np.broadcast_to(t.curvature, 2)[k]) * (1 + bent) for k in (0, 1)]
    torsion = bending * (1 + ratio) / each(lambda t: 1 + t.poisson_ratio)
    length = np.broadcast_to(each(lambda t: t.length), bending.shape)
    return Tubes(
        length,
        each(lambda t: t.curved_length) + longer,
        *ends,
        bending,
        torsion,
        zero,
        np.broadcast_to(each(lambda t: t.pre_torsion), bending.shape),
    )


@dataclass(frozen=True, eq=False)
class Shooting:
    """All robots at beta (d,), their pieces between places (n, p + 1)."""

    robots: Tubes
    beta: np.ndarray

    @property
    def places(self) -> np.ndarray:
        n = len(self.robots.zero)
        tips = np.broadcast_to(self.beta, (n, len(self.beta)))
        begins = np.maximum(tips - self.robots.curved, 0.0)
        return np.sort(np.concatenate([np.zeros((n, 1)), tips, begins], axis=1), axis=1)

    def twists(self, alpha: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rates at the tips (n, d), their slopes over those at the base (n, d, d), and the angles there (n, d).

        A tube is carried on beyond its tip without a moment, where its rate stays what it is at the tip.
        """
        n, d = rates.shape
        reach = self.robots.length - self.beta
        eye = np.broadcast_to(np.eye(d), (n, d, d))
        start = [alpha + rates * reach, rates, reach[:, :, None] * eye, eye]
        state = np.concatenate([each.reshape(n, -1) for each in start], axis=1)
        places = self.places.T
        for low, high in itertools.pairwise(places):
            if (high - low).max() > 0:
                state = self._over(low, high, state, d)
        return state[:, d : 2 * d], state[:, 2 * d + d * d :].reshape(n, d, d), state[:, :d]

    def _over(self, low, high, state, d):
        """The state at high of that at low, over the piece between, scaled to [0, 1]."""
        n, h = len(state), (high - low)[:, None]

        def slope(z, y):
            y = y.reshape(n, -1)
            pull, total = self._pulls(low + z * (high - low), (low + high) / 2)
            made = self._made(low + z * (high - low))
            turn, rates, sway, change = self._moments(y, made, pull, total, d)
            return (h * np.concatenate([rates, turn, change, sway], axis=1)).ravel()

        return solve_ivp(slope, (0, 1), state.ravel(), **OPTIONS).y[:, -1].reshape(n, -1)

    def _made(self, s):
        """What helices turn by of themselves at s (n,), from where their curved parts begin."""
        return self.robots.helix * (s[:, None] - (self.beta - self.robots.curved))

    def _moments(self, y, made, pull, total, d):
        n, psi, rates = len(y), y[:, :d] + made, y[:, d : 2 * d]
        by = y[:, 2 * d : 2 * d + d * d].reshape(n, d, d)
        cos, sin = np.cos(psi), np.sin(psi)
        x, z = ((pull * each).sum(axis=1, keepdims=True) / total for each in (cos, sin))
        turn = pull * (x * sin - z * cos) / self.robots.torsion
        dx = np.einsum("ni,nik->nk", -pull * sin, by) / total
        dz = np.einsum("ni,nik->nk", pull * cos, by) / total
        sway = dx[:, None] * sin[:, :, None] - dz[:, None] * cos[:, :, None]
        sway += (x * cos + z * sin)[:, :, None] * by
        sway *= (pull / self.robots.torsion)[:, :, None]
        return turn, rates, sway.reshape(n, -1), y[:, 2 * d + d * d :]

    def _pulls(self, s: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """EI k of the tubes at s (n,), and the sum of EI there (n, 1), on the pieces that hold inside (n,)."""
        tube = self.robots
        there = inside[:, None] < self.beta
        bends = there & (self.beta - inside[:, None] < tube.curved)
        part = (self.beta - s[:, None]) / np.maximum(tube.curved, 1e-9)
        curvature = tube.tip + (tube.root - tube.tip) * part
        total = np.where(there, tube.bending, 0.0).sum(axis=1, keepdims=True)
        return np.where(bends, tube.bending * curvature, 0.0), np.where(total > 0, total, 1.0)

    def points(self, alpha, rates, theta, sigma: np.ndarray) -> np.ndarray:
        """The shapes (n, len(sigma), 3), mm, at parts sigma of their lengths."""
        (n, d), places = rates.shape, self.places
        axes = _about_y(theta[1]) @ _about_x(theta[0])
        state = np.concatenate(
            [alpha + rates * (self.robots.length - self.beta), rates, np.tile([0, 0, 0, *axes.T.ravel()], (n, 1))],
            axis=1,
        )
        found, goal = np.zeros((n, len(sigma), 3)), sigma * self.beta[-1]
        for k in range(places.shape[1] - 1):
            low, high = places[:, k], places[:, k + 1]
            if (high - low).max() <= 0:
                continue
            run = solve_ivp(self._curve(low, high, d), (0, 1), state.ravel(), dense_output=True, **OPTIONS)
            for row in range(n):
                at = np.flatnonzero((goal >= low[row]) & (goal <= high[row]) & (high[row] > low[row]))
                if len(at):
                    values = run.sol((goal[at] - low[row]) / (high[row] - low[row]))
                    found[row, at] = values.reshape(n, -1, len(at))[row, 2 * d : 2 * d + 3].T
            state = run.y[:, -1].reshape(n, -1)
        return found

    def _curve(self, low, high, d):
        n, h = len(low), (high - low)[:, None]

        def slope(z, y):
            y = y.reshape(n, -1)
            pull, total = self._pulls(low + z * (high - low), (low + high) / 2)
            psi, axes = y[:, :d] + self._made(low + z * (high - low)), y[:, 2 * d + 3 :].reshape(n, 3, 3)
            x, v = ((pull * each).sum(axis=1, keepdims=True) / total for each in (np.cos(psi), np.sin(psi)))
            d1, d2, t = axes[:, 0], axes[:, 1], axes[:, 2]
            turn = pull * (x * np.sin(psi) - v * np.cos(psi)) / self.robots.torsion
            bends = [-x * t, -v * t, x * d1 + v * d2]
            return (h * np.concatenate([y[:, d : 2 * d], turn, t, *bends], axis=1)).ravel()

        return slope


def _about_x(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _about_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@dataclass(eq=False)
class Followed:
    """n robots on their way: rates at the base, angles at the tips (n, d); snapped (n,): in which frame, or 0."""

    robots: Tubes
    rates: np.ndarray
    angles: np.ndarray
    snapped: np.ndarray

    def advance(self, rows: np.ndarray, before: np.ndarray, after: np.ndarray, frame: int, part: float) -> None:
        """Move robots on from one configuration to another, in halves where that is too far for some."""
        if not len(rows):
            return
        fine = self._step(rows, after)
        rest = rows[~fine]
        if not len(rest):
            return
        if part < LEAST:
            self.snapped[rest] = frame
            return
        middle = (before + after) / 2
        self.advance(rest, before, middle, frame, part / 2)
        self.advance(rest[self.snapped[rest] == 0], middle, after, frame, part / 2)

    def _step(self, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Newton's method from where robots are; which of them (len(rows),) came to an equilibrium nearby."""
        d = self.rates.shape[1]
        robots, rates = self.robots[rows], self.rates[rows].copy()
        alpha, shooting = q[:d] + robots.zero, Shooting(robots, q[d : 2 * d])
        for _ in range(8):
            twists, slopes, angles = shooting.twists(alpha, rates)
            change = np.array([np.linalg.lstsq(*pair, rcond=None)[0] for pair in zip(slopes, twists, strict=True)])
            if (abs(change) < 1e-7).all():
                break
            rates -= np.clip(change, -0.1, 0.1)
        near = abs(change).max(axis=1) < 1e-7
        turned = angles - angles[:, -1:] - self.angles[rows] + self.angles[rows][:, -1:]
        near &= (abs(turned).max(axis=1) < JUMP) & (np.linalg.det(slopes) > 0)
        self.rates[rows[near]], self.angles[rows[near]] = rates[near], angles[near]
        return near


class Motion(NamedTuple):
    """shapes (n, T, m, 3) mm and angles at the tips (n, T, d), NaN from the frame snapped (n,), from 1, on.

    snapped: the frame on the way to which a robot snaps, 0 where it does not.
    """

    shapes: np.ndarray
    tips: np.ndarray
    snapped: np.ndarray

    def lost(self, own: np.ndarray) -> np.ndarray:
        """The frames in which they snap, or tips are turned by 1 rad from own (T, d) against each other."""
        away = abs(self.tips - self.tips[..., -1:] - (own - own[:, -1:])).max(axis=2) > 1
        away[self.snapped > 0, self.snapped[self.snapped > 0] - 1] = True
        return np.where(away.any(axis=1), away.argmax(axis=1) + 1, 0)


def followed(robots: Tubes, q: np.ndarray, sigma: np.ndarray, aligned: bool = True) -> Motion:
    """Robots moved through q (T, 2d + 2) from where motors are aligned, or untwisted; shapes at sigma (m,)."""
    n, d = robots.zero.shape
    at = q[0].copy()
    if aligned:
        at[:d] = at[d - 1]
    way = Followed(robots, np.zeros((n, d)), at[:d] + np.zeros((n, d)), np.zeros(n, dtype=int))
    way.advance(np.arange(n), at, at, 1, 1.0)
    shapes, tips = np.full((n, len(q), len(sigma), 3), np.nan), np.full((n, len(q), d), np.nan)
    for frame, goal in enumerate(q):
        places = np.linspace(at, goal, int(1 / LONGEST) + 1)
        for before, after in itertools.pairwise(places):
            way.advance(np.flatnonzero(way.snapped == 0), before, after, frame + 1, LONGEST)
        at, rows = goal, np.flatnonzero(way.snapped == 0)
        if len(rows):
            shooting, alpha = Shooting(robots[rows], goal[d : 2 * d]), goal[:d] + robots.zero[rows]
            shapes[rows, frame] = shooting.points(alpha, way.rates[rows], goal[2 * d :], sigma)
            tips[rows, frame] = way.angles[rows]
    return Motion(shapes, tips, way.snapped)
