"""Concentric tubes on the elastic model, solved by shooting from the base.

Equations of Dupont 2010 and Rucker 2010, unloaded and frictionless. psi_i(s) is the angle of tube i,
EI_i its bending stiffness, GJ_i = EI_i / (1 + nu_i), k_i(s) its pre-curvature, which points along
e_i = (cos psi_i, sin psi_i) (of a helix: psi_i + tau_i times the distance from where its curved part begins):

    u = sum_i EI_i k_i e_i / sum_i EI_i                    over the tubes that reach s
    GJ_i psi_i'' = EI_i k_i (u x e_i)
    psi_i(0) = alpha_i + psi_i'(0) (L_i - beta_i)          the transmission twists evenly over s < 0
    psi_i'(beta_i) = 0

The unknowns are the rates psi_i'(0). They are found by Newton's method, with the sensitivities of the rates at the
tips integrated beside them. In products of complex numbers, exp(1j psi) stands for e, and u x e is Im(conj(u) e).

Arrays carry n robots along their last axis: (d, n) for numbers of tubes, (d, d, n) for sensitivities.
The body is cut at every place where a tube ends or begins to curve: within such a piece all is smooth.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BarycentricInterpolator

Array = npt.NDArray[Any]
Configuration = Callable[..., tuple[Array, Array]]
"""Gives alpha and beta (d, m) of robots (m,) at parts (m,) of the way from one frame to the next."""
Settle = Callable[..., Any]
"""Finds where a robot comes to rest after its equilibrium has ended: (tubes, rates, before, after, most turn)
-> rates at the base, or None where that is not known."""

STEP_MM = 7.0
"""Longest step of integration along the body."""
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
MODE_DEGREE = 5
"""Highest degree of the polynomials, on each piece, that variations of the twist are made of."""
GAUSS_POINTS = 10
"""Per piece, where the energy's second variation is integrated."""


@dataclass(frozen=True, eq=False)
class Tubes:
    """Numbers of n robots of d tubes, (d, n) each: mm, 1/mm, rad/mm, and stiffnesses in one common unit.

    zero: the angle in rad by which a tube's base is ahead of its motor.
    """

    length: Array
    curved: Array
    root: Array
    tip: Array
    bending: Array
    torsional: Array
    helix: Array
    zero: Array
    radius: Array

    def __getitem__(self, rows: Any) -> Tubes:
        """Some of the robots."""
        return Tubes(*(getattr(self, f.name)[:, rows] for f in fields(self)))

    def repeat(self, count: int) -> Tubes:
        """The first robot so many times."""
        return self[np.zeros(count, dtype=int)]


def read_tubes(robot: dict, parts: Array | None = None) -> Tubes:
    """Tubes of a robot as a plan's meta describes it.

    Parameters
    ----------
    robot : dict
        ``meta["robot"]``: the key ``tubes`` holds a table of numbers a tube, outermost first.
    parts : (n, d, 5) array, optional
        Differences of n robots from the one described: relative curvature, relative bending stiffness, relative
        EI / GJ, curved length in mm and the motor's zero in rad. One robot as described by default.
    """
    rows = robot["tubes"]
    parts = np.zeros((1, len(rows), 5)) if parts is None else np.asarray(parts, dtype=float)
    curvature, stiffness, ratio, longer, zero = np.moveaxis(parts, (2, 1), (0, 1))

    def column(name: str) -> Array:
        return np.array([float(row[name]) for row in rows])[:, None] + np.zeros_like(zero)

    ends = np.array([np.broadcast_to(row["curvature"], 2) for row in rows], dtype=float)
    outer, inner, length = column("outer_diameter"), column("inner_diameter"), column("length")
    bending = column("youngs_modulus") * np.pi / 64 * (outer**4 - inner**4) * (1 + stiffness)
    return Tubes(
        length=length,
        curved=np.clip(column("curved_length") + longer, 0.0, length),
        root=ends[:, :1] * (1 + curvature),
        tip=ends[:, 1:] * (1 + curvature),
        bending=bending,
        torsional=bending / ((1 + column("poisson_ratio")) * (1 + ratio)),
        # Older files have no helices.
        helix=column("pre_torsion") if "pre_torsion" in rows[0] else np.zeros_like(zero),
        zero=zero,
        radius=outer / 2,
    )


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the body, low to high (n,) mm, on which the same tubes are present (d, n), in equal steps.

    strength (d, n), slope (d, n): EI_i k_i at low and its growth per mm. total (n,): the sum of EI.
    psi, rate, turn (steps + 1, d, n): psi_i, its first and second derivative at the ends of steps.
    """

    low: Array
    high: Array
    present: Array
    strength: Array
    slope: Array
    total: Array
    phase: Array
    helix: Array
    psi: Array
    rate: Array
    turn: Array

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.psi) - 1

    @property
    def h(self) -> Array:
        """Length of a step (n,), mm."""
        return (self.high - self.low) / self.steps

    def angles(self, fraction: float) -> Array:
        """Directions (d, n), rad, in which tubes bend at a fraction of the piece, by Hermite's cubics."""
        k = min(int(fraction * self.steps), self.steps - 1)
        z, h = fraction * self.steps - k, self.h
        psi = (
            (1 + 2 * z) * (1 - z) ** 2 * self.psi[k]
            + z * (1 - z) ** 2 * h * self.rate[k]
            + z**2 * (3 - 2 * z) * self.psi[k + 1]
            + z**2 * (z - 1) * h * self.rate[k + 1]
        )
        return psi + self.phase + self.helix * fraction * (self.high - self.low)

    def strengths(self, fraction: float) -> Array:
        """EI_i k_i (d, n) at a fraction of the piece."""
        return self.strength + self.slope * fraction * (self.high - self.low)

    def bending(self, fraction: float) -> Array:
        """The bending vector u (n,), 1/mm, as complex numbers."""
        return (self.strengths(fraction) * np.exp(1j * self.angles(fraction))).sum(axis=0) / self.total


@dataclass(frozen=True, eq=False)
class Twist:
    """Tubes that are integrated from the base: rates at the tips (d, n), their sensitivities (d, d, n) or None."""

    tubes: Tubes
    beta: Array
    pieces: list[Piece]
    tip_rates: Array
    sensitivity: Any

    @property
    def tip_angles(self) -> Array:
        """Angles psi_i at the tubes' own tips (d, n), rad."""
        last = self.pieces[-1]
        return last.psi[-1] - last.rate[-1] * (last.high - self.beta)


def integrate(
    tubes: Tubes, alpha: Array, beta: Array, rates: Array, sensitivities: bool = True, step: float = STEP_MM
) -> Twist:
    """Integrate psi from the base, where its derivatives are `rates`; all (d, n).

    Nystrom's method of order 4 (three evaluations a step), since psi' does not appear on the right-hand side.
    Beyond its tip a tube is carried on without a moment, so that the last rate is the one at the tip.
    """
    reach = tubes.length - beta
    begin = np.maximum(beta - tubes.curved, 0.0)
    bounds = np.sort(np.concatenate([np.zeros_like(beta[:1]), beta, begin]), axis=0)
    psi, rate = alpha + rates * reach, np.array(rates)
    d, n = psi.shape
    eye = np.eye(d)[:, :, None]
    by, by_rate = eye * reach[:, None], eye + np.zeros((d, d, n))
    pieces = []
    slope_of_k = (tubes.root - tubes.tip) / np.maximum(tubes.curved, 1e-9)
    for low, high in itertools.pairwise(bounds):
        longest = float((high - low).max())
        if longest <= 0:
            continue
        middle = (low + high) / 2
        present = middle < beta
        bends = present & (middle > beta - tubes.curved)
        total = np.where(present, tubes.bending, 0.0).sum(axis=0)
        total = np.where(total > 0, total, 1.0)
        strength = np.where(bends, tubes.bending * (tubes.tip + slope_of_k * (beta - low)), 0.0)
        slope = np.where(bends, -tubes.bending * slope_of_k, 0.0)
        phase = tubes.helix * (low - (beta - tubes.curved))
        steps = int(np.ceil(longest / step))
        h = (high - low) / steps

        def moments(  # the defaults bind what belongs to this piece
            psi: Array,
            by: Array | None,
            s: Any,
            strength: Array = strength,
            slope: Array = slope,
            total: Array = total,
            phase: Array = phase,
        ) -> tuple[Array, Any]:
            """Return psi'' (d, n), and its sensitivities (d, d, n) where `by` is given."""
            force = strength + slope * s
            e = np.exp(1j * (psi + phase + tubes.helix * s))
            u = (force * e).sum(axis=0) / total
            gain = force / tubes.torsional
            turn = gain * (np.conj(u) * e).imag
            if by is None:
                return turn, None
            change = 1j * e[:, None] * by
            du = (force[:, None] * change).sum(axis=0) / total
            return turn, gain[:, None] * (np.conj(du) * e[:, None] + np.conj(u) * change).imag

        y = by if sensitivities else None
        first, d_first = moments(psi, y, 0.0)
        nodes = [(psi, rate, first)]
        for k in range(steps):
            y1 = y2 = None
            if sensitivities:
                y1 = by + h / 2 * by_rate + h**2 / 8 * d_first
            second, d_second = moments(psi + h / 2 * rate + h**2 / 8 * first, y1, (k + 0.5) * h)
            if sensitivities:
                y2 = by + h * by_rate + h**2 / 2 * d_second
            third, d_third = moments(psi + h * rate + h**2 / 2 * second, y2, (k + 1) * h)
            psi = psi + h * rate + h**2 / 6 * (first + 2 * second)
            rate = rate + h / 6 * (first + 4 * second + third)
            if sensitivities:
                by = by + h * by_rate + h**2 / 6 * (d_first + 2 * d_second)
                by_rate = by_rate + h / 6 * (d_first + 4 * d_second + d_third)
            first, d_first = moments(psi, by if sensitivities else None, (k + 1) * h)
            nodes.append((psi, rate, first))
        stacked = [np.array(each) for each in zip(*nodes, strict=True)]
        pieces.append(Piece(low, high, present, strength, slope, total, phase, tubes.helix, *stacked))
    return Twist(tubes, beta, pieces, rate, by_rate if sensitivities else None)


def replace_by_dominant(twist: Twist, alpha: Array) -> Twist:
    """Return the tubes on the dominant stiffness model: the outermost tube at a place bends by itself.

    alpha (d, n): angles of the tubes, which do not twist, rad.
    """
    pieces = []
    for piece in twist.pieces:
        outermost = np.arange(len(alpha))[:, None] == piece.present.argmax(axis=0)
        total = np.where(outermost & piece.present, twist.tubes.bending, 0.0).sum(axis=0)
        pieces.append(
            replace(
                piece,
                strength=piece.strength * outermost,
                slope=piece.slope * outermost,
                total=np.where(total > 0, total, 1.0),
                psi=np.broadcast_to(alpha, piece.psi.shape),
                rate=np.zeros_like(piece.rate),
                turn=np.zeros_like(piece.turn),
            )
        )
    return replace(twist, pieces=pieces)


# --- shapes ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RobotShape:
    """Shapes of n robots at the ends of N steps: s (N, n) mm, points and unit tangents (N, n, 3).

    radius (N - 1, n): of the outermost tube on each step, mm. Between ends a shape is a cubic in s.
    """

    s: Array
    points: Array
    tangents: Array
    radius: Array

    def select(self, rows: Array) -> RobotShape:
        """Return the shapes of some of the robots; rows: their numbers."""
        return RobotShape(self.s[:, rows], self.points[:, rows], self.tangents[:, rows], self.radius[:, rows])

    def interpolate(self, s: Array) -> Array:
        """Return points (n, m, 3) mm at arc lengths s (n, m) mm."""
        # The last end at or before s; steps of length 0, where two tubes end together, are passed over.
        step = np.clip((self.s[:, :, None] <= s[None]).sum(axis=0) - 1, 0, len(self.s) - 2)
        rows = np.arange(len(s))[:, None]
        h = self.s[step + 1, rows] - self.s[step, rows]
        z = np.clip((s - self.s[step, rows]) / np.maximum(h, 1e-12), 0.0, 1.0)
        return self.points_in_steps(step, rows, z)

    def points_in_steps(self, step: Array, row: Array, fraction: Array) -> Array:
        """Return points (.., 3) mm at fractions (..,) of steps (..,) of robots (..,), by Hermite's cubics."""
        z = fraction[..., None]
        h = (self.s[step + 1, row] - self.s[step, row])[..., None]
        return np.asarray(
            (1 + 2 * z) * (1 - z) ** 2 * self.points[step, row]
            + z * (1 - z) ** 2 * h * self.tangents[step, row]
            + z**2 * (3 - 2 * z) * self.points[step + 1, row]
            + z**2 * (z - 1) * h * self.tangents[step + 1, row]
        )


def compute_body(twist: Twist, theta: Array) -> RobotShape:
    """Shapes of robots at base tilts theta (2, n), rad: R = Ry(theta_y) Rx(theta_x).

    The frame turns by R' = R hat(w), w = (-u_y, u_x, 0): Magnus' method of order 4 on Gauss's two points of every
    step. Points follow from the tangents t and t' = R (u_x, u_y, 0) by Hermite's quadrature of order 4.
    """
    n = theta.shape[1]
    frame = _tilt(theta)
    point, s = np.zeros((n, 3)), np.zeros(n)
    nodes = [(s, point, frame[:, :, 2])]
    radius = []
    for piece in twist.pieces:
        h, gauss = piece.h, np.sqrt(3) / 6
        outermost = np.take_along_axis(twist.tubes.radius, piece.present.argmax(axis=0)[None], axis=0)[0]
        for k in range(piece.steps):
            u = [piece.bending((k + 0.5 + c) / piece.steps) for c in (-gauss, gauss)]
            first, second = (np.stack([-each.imag, each.real, np.zeros(n)], axis=-1) for each in u)
            turn = h[:, None] / 2 * (first + second) + np.sqrt(3) / 12 * h[:, None] ** 2 * np.cross(first, second)
            bent = _bending_in_space(frame, piece.bending(k / piece.steps))
            after = frame @ _rotation(turn)
            bent_after = _bending_in_space(after, piece.bending((k + 1) / piece.steps))
            step = h[:, None]
            point = point + step / 2 * (frame[:, :, 2] + after[:, :, 2]) + step**2 / 12 * (bent - bent_after)
            frame, s = after, s + h
            nodes.append((s, point, frame[:, :, 2]))
            radius.append(outermost)
    places, points, tangents = (np.array(each) for each in zip(*nodes, strict=True))
    return RobotShape(places, points, tangents, np.array(radius))


def _bending_in_space(frame: Array, u: Array) -> Array:
    """Derivative of the tangent (n, 3) in frames (n, 3, 3) with bending vectors u (n,)."""
    return frame[:, :, 0] * u.real[:, None] + frame[:, :, 1] * u.imag[:, None]


def _rotation(turn: Array) -> Array:
    """Rodrigues' formula for rotation vectors (n, 3): matrices (n, 3, 3)."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    x, y, z = turn.T
    zero = np.zeros_like(x)
    hat = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * hat + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * (hat @ hat)


def _tilt(theta: Array) -> Array:
    """Ry(theta_y) Rx(theta_x), (n, 3, 3)."""
    zero = np.zeros(theta.shape[1])
    about_x = _rotation(np.stack([theta[0], zero, zero], axis=-1))
    return _rotation(np.stack([zero, theta[1], zero], axis=-1)) @ about_x


# --- motions -----------------------------------------------------------------------------------------------------


class Follower:
    """n robots that are moved by continuation, each in steps of its own, and which of them lose their equilibrium.

    rates, angles (d, n): at the base, rad/mm, and at the tips, rad. snapped (n,): the frame, from 1, on the way to
    which a robot first snapped; 0 where it has not. part (n,): of the way from frame to frame that they have come.
    Where an equilibrium ends, the robot comes to rest in another one, which `settle` finds. It has snapped if a
    tip turns by more than SNAP_RAD; if not, it goes on from there.
    """

    def __init__(
        self, tubes: Tubes, innermost: float, settle: Settle | None = None, after_snaps: bool = False
    ) -> None:
        """Untwisted robots whose tubes are all turned to one angle, that of the innermost tube, rad.

        settle: finds where a robot comes to rest; without it a robot whose equilibrium ends is not moved on.
        after_snaps: whether robots are moved on after they have snapped.
        """
        d, n = tubes.zero.shape
        self.tubes = tubes
        self.rates = np.zeros((d, n))
        self.angles = np.full((d, n), float(innermost))
        self.snapped = np.zeros(n, dtype=int)
        self.part = np.zeros(n)
        self.snaps: list[int] = []
        self.gone = np.zeros(n, dtype=bool)
        self.departures = 0
        self._settle = settle
        self._after_snaps = after_snaps
        self._trend = np.zeros((d, n))

    def advance(self, configuration: Configuration, frame: int, start: float, end: float, longest: float) -> None:
        """Move all robots that are not gone from one part of the way to a frame, from 1, to another.

        configuration(part (m,), rows (m,)) gives alpha and beta (d, m) of these robots. Where Newton's method does
        not lead on, a robot's step is cut to a quarter; where the shortest leads nowhere, its equilibrium ends.
        """
        rows = np.flatnonzero(~self.gone)
        self.part[rows] = start
        step = np.full(len(self.part), longest)
        while len(rows):
            goal = np.minimum(self.part[rows] + step[rows], end)
            alpha, beta = configuration(goal, rows)
            reached = self._step(rows, alpha, beta, goal - self.part[rows])
            done, failed = rows[reached], rows[~reached]
            self.part[done] = goal[reached]
            step[done] = np.minimum(2 * step[done], longest)
            step[failed] /= 4
            self._trend[:, failed[step[failed] < MIN_PART * 16]] = 0.0
            for row in failed[step[failed] < MIN_PART]:
                goal_of_row = min(self.part[row] + longest / 16, end)
                self._leave_branch(np.array([row]), configuration, frame, goal_of_row)
                step[row] = longest / 16
            rows = rows[~self.gone[rows] & (self.part[rows] < end)]

    def place(self, rates: Array, angles: Array) -> None:
        """Put the robots where their rates at the base and their tips' angles are about these (d, n)."""
        self.rates = rates.copy()
        self.angles = angles.copy()

    def solve(self, alpha: Array, beta: Array) -> Array:
        """Put robots into the equilibria at alpha and beta (d, n) nearby; which (n,) are found."""
        self._trend[:] = 0.0
        return self._step(np.arange(len(self.snapped)), alpha, beta, np.ones(len(self.snapped)))

    def _leave_branch(self, row: Array, configuration: Configuration, frame: int, goal: float) -> None:
        """Let one robot, rows (1,), whose equilibrium ends come to rest at another part of the way."""
        self.departures += 1
        before, after = (configuration(np.array([part]), row) for part in (self.part[row[0]], goal))
        most = np.inf if self._after_snaps else SNAP_RAD
        rates = None
        if self._settle is not None:
            rates = self._settle(self.tubes[row], self.rates[:, row], before, after, most)
        if rates is None:
            self.gone[row] = True
            self._snap(row, frame)
            return
        alpha, beta = after
        angles = integrate(self.tubes[row], alpha, beta, rates, sensitivities=False).tip_angles
        if abs(angles - self.angles[:, row]).max() > SNAP_RAD:
            self._snap(row, frame)
            self.gone[row] = not self._after_snaps
        self.rates[:, row], self.angles[:, row] = rates, angles
        self.part[row] = goal
        self._trend[:, row] = 0.0

    def _snap(self, row: Array, frame: int) -> None:
        self.snaps.append(frame)
        self.snapped[row] = np.where(self.snapped[row] > 0, self.snapped[row], frame)

    def _step(self, rows: Array, alpha: Array, beta: Array, part: Array) -> Array:
        """Which robots (m,) Newton's method leads to a stable equilibrium nearby; these are moved there."""
        tubes = self.tubes[rows]
        old = self.rates[:, rows]
        rates = old + part * self._trend[:, rows]
        # Robots that have converged, or diverge, leave the batch, so that the last iterations concern few.
        busy = np.arange(len(rows))
        before = np.full(len(rows), np.inf)
        reached = np.zeros(len(rows), dtype=bool)
        angles = np.empty_like(rates)
        for _ in range(MAX_NEWTON_ITERATIONS):
            found = integrate(tubes[busy], alpha[:, busy], beta[:, busy], rates[:, busy])
            slopes = np.moveaxis(found.sensitivity, -1, 0)
            change = -_solve_systems(slopes, found.tip_rates.T).T
            size = abs(change).max(axis=0)
            rates[:, busy] += np.clip(change, -MAX_RATE_CHANGE, MAX_RATE_CHANGE)
            angles[:, busy] = found.tip_angles
            done = size < CONVERGED_RATE
            # The determinant is that of d(tip rates)/d(base rates): positive from decoupled tubes up to the first
            # fold of the motion, which is where it comes to 0.
            reached[busy[done & (np.linalg.det(slopes) > 0)]] = True
            goes_on = ~done & np.isfinite(size) & (size < 2 * before)
            busy, before = busy[goes_on], size[goes_on]
            if not len(busy):
                break
        turned = angles - self.angles[:, rows]
        turned = turned - turned[-1:]
        reached &= abs(turned).max(axis=0) < MAX_TIP_TURN_RAD
        moved = rows[reached]
        self._trend[:, moved] = (rates[:, reached] - old[:, reached]) / part[reached]
        self.rates[:, moved], self.angles[:, moved] = rates[:, reached], angles[:, reached]
        return reached


def _solve_systems(matrices: Array, right: Array) -> Array:
    """Solutions (n, d) of n systems; where one is singular, NaN."""
    good = np.isfinite(matrices).all(axis=(1, 2)) & (abs(np.linalg.det(matrices)) > 1e-300)
    found = np.full_like(right, np.nan)
    found[good] = np.linalg.solve(matrices[good], right[good, :, None])[..., 0]
    return found


def apply_play(tube: Array, motor: Array, lag: Array) -> Array:
    """Angles of tubes after motors have turned to `motor`, with play `lag` to either side; rad."""
    return np.clip(tube, motor - lag, motor + lag)


# --- stability: the discretised energy ---


class Modes:
    """Variations of the twist that are orthonormal in the torsional energy K, of n robots.

    Tube i: its base turns (the transmission twists), and on every piece that it reaches, psi_i' is a polynomial of
    Legendre. So K is the identity, V'' is a matrix, and the margin is 1 plus its smallest eigenvalue.
    """

    def __init__(self, twist: Twist) -> None:
        tubes, beta, pieces = twist.tubes, twist.beta, twist.pieces
        d, n = beta.shape
        self.twist = twist
        nodes, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
        self.fractions = (nodes + 1) / 2
        degree = MODE_DEGREE + 1
        values, wholes = _integrated_legendre(self.fractions)
        count = 1 + degree * len(pieces)
        places = len(pieces) * GAUSS_POINTS
        # shape[i, q, m, r]: angle of tube i at place q in its mode m, of robot r.
        self.shape = np.zeros((d, places, count, n))
        self.weight = np.zeros((places, n))
        self.shape[:, :, 0] = np.sqrt((tubes.length - beta) / tubes.torsional)[:, None]
        for k, piece in enumerate(pieces):
            h = piece.high - piece.low
            own = slice(k * GAUSS_POINTS, (k + 1) * GAUSS_POINTS)
            self.weight[own] = weights[:, None] / 2 * h
            for m in range(degree):
                column = 1 + k * degree + m
                # |P_m|^2 over the piece is h / (2m + 1), so this scale makes GJ int psi'^2 = 1.
                scale = np.where(piece.present, np.sqrt((2 * m + 1) * h / tubes.torsional), 0.0)
                self.shape[:, own, column] = scale[:, None] * values[m][None, :, None]
                self.shape[:, own.stop :, column] = (scale * wholes[m])[:, None]
        self.strength = np.array([p.strengths(f) for p in pieces for f in self.fractions])
        self.total = np.repeat(np.array([p.total for p in pieces]), GAUSS_POINTS, axis=0)

    @property
    def phases(self) -> Array:
        """Angles (places, d, n) that are added to psi for the direction in which tubes bend, rad."""
        pieces = self.twist.pieces
        return np.array([p.phase + p.helix * f * (p.high - p.low) for p in pieces for f in self.fractions])

    def second_variation(self, bends: Array) -> Array:
        """V'' (n, d count, d count) of tubes that bend in directions (places, d, n), rad."""
        d, _, count, n = self.shape.shape
        pull = self.strength * np.exp(1j * bends)
        whole = pull.sum(axis=1)
        found = np.zeros((n, d, count, d, count))
        shape = np.ascontiguousarray(np.moveaxis(self.shape, -1, 0))
        for i in range(d):
            for j in range(i, d):
                # -d^2/dpsi_i dpsi_j of |sum P e|^2 / (2 sum EI)
                density = -(np.conj(pull[:, i]) * pull[:, j]).real / self.total
                if i == j:
                    density = density + (np.conj(pull[:, i]) * whole).real / self.total
                left = shape[:, i] * (density * self.weight).T[:, :, None]
                found[:, i, :, j] = np.swapaxes(left, 1, 2) @ shape[:, j]
                found[:, j, :, i] = np.swapaxes(found[:, i, :, j], 1, 2)
        return found.reshape(n, d * count, d * count)


def _integrated_legendre(fractions: Array) -> tuple[Array, Array]:
    """Integrals of the polynomials of Legendre over a piece of length 1, up to fractions, and to the end."""
    values, wholes = [], []
    for m in range(MODE_DEGREE + 1):
        whole = np.polynomial.legendre.Legendre.basis(m).integ(lbnd=-1)
        values.append(whole(2 * fractions - 1) / 2)
        wholes.append(whole(1.0) / 2)
    return np.array(values), np.array(wholes)


def compute_stability_margins(twist: Twist) -> Array:
    """Smallest eigenvalues mu (n,) of (K + V'') x = mu K x at equilibria: 1 uncoupled, 0 where a robot snaps."""
    modes = Modes(twist)
    bends = np.array([piece.angles(f) for piece in twist.pieces for f in modes.fractions])
    return 1 + np.linalg.eigvalsh(modes.second_variation(bends))[:, 0]


# --- one robot, and samples, moved through a plan ---


@dataclass(frozen=True, eq=False)
class NominalMotion:
    """The robot as described, moved through T frames in `substeps` steps each.

    Rows are frames, columns sub-steps, of which the last is the frame: rates, tip_angles (T, substeps, d), and q
    (T, substeps, 2d + 2). The first frame is entered from where all tubes are aligned, so that its earlier columns
    repeat the frame. snaps: frames, from 1, on the way to which the equilibrium ended.
    """

    tubes: Tubes
    q: Array
    rates: Array
    tip_angles: Array
    snaps: list[int]

    def twists(self, chosen: Array) -> tuple[Twist, Array]:
        """The tubes integrated anew where a mask (T, substeps) says, and theta (2, n) there."""
        d = self.rates.shape[-1]
        q, rates = self.q[chosen].T, self.rates[chosen].T
        twist = integrate(self.tubes.repeat(q.shape[1]), q[:d], q[d : 2 * d], rates, sensitivities=False)
        return twist, q[2 * d :]


def move_nominal(tubes: Tubes, q: Array, substeps: int = 10, settle: Settle | None = None) -> NominalMotion:
    """Move a robot through q (T, 2d + 2), linear between frames, by continuation from aligned tubes.

    The robot is moved in quarters of a frame's way. Equilibria at sub-steps of all frames are then found in one
    batch, from polynomials through the quarters. Frames on whose way the robot leaves a branch, or where that
    does not lead to equilibria nearby, are gone through again in sub-steps. After a snap the robot goes on from
    where it comes to rest, which `settle` finds; where that is not found, it has no shape any more (NaN).
    """
    d = len(tubes.zero)
    start = q[0].copy()
    start[:d] = start[d - 1]
    ways = list(itertools.pairwise(np.concatenate([start[None], q])))
    parts = np.linspace(0.0, 1.0, substeps + 1)[1:]
    quarters = np.linspace(0.0, 1.0, 5)
    path = np.array([before + parts[:, None] * (after - before) for before, after in ways])
    rates = np.full((len(q), substeps, d), np.nan)
    angles = np.full((len(q), substeps, d), np.nan)
    smooth = np.zeros(len(q), dtype=bool)
    follower = Follower(tubes, start[d - 1], settle, after_snaps=True)
    snaps: list[int] = []
    for frame, (before, after) in enumerate(ways):
        begun = copy.deepcopy(follower)
        known = [(follower.rates[:, 0].copy(), follower.angles[:, 0].copy())]
        for low, high in itertools.pairwise(quarters):
            follower.advance(_along(before, after, d), frame + 1, low, high, 0.25)
            known.append((follower.rates[:, 0].copy(), follower.angles[:, 0].copy()))
        smooth[frame] = frame > 0 and follower.departures == begun.departures
        if smooth[frame]:
            rates[frame], angles[frame] = (
                BarycentricInterpolator(quarters, np.array(each))(parts) for each in zip(*known, strict=True)
            )
            continue
        follower = begun
        if not _in_substeps(follower, before, after, frame, rates, angles):
            break
    snaps += follower.snaps
    places = np.repeat(smooth[:, None], substeps, axis=1)
    if places.any():
        many = Follower(tubes.repeat(int(places.sum())), 0.0)
        many.place(rates[places].T, angles[places].T)
        at = path[places].T
        reached = many.solve(at[:d], at[d : 2 * d])
        rates[places], angles[places] = many.rates.T, many.angles.T
        missed = np.zeros_like(places)
        missed[places] = ~reached
        for frame in np.flatnonzero(missed.any(axis=1)).tolist():
            rates[frame] = np.nan
            follower = Follower(tubes, 0.0, settle, after_snaps=True)
            follower.place(rates[frame - 1, -1][:, None], angles[frame - 1, -1][:, None])
            _in_substeps(follower, *ways[frame], frame, rates, angles)
            snaps += follower.snaps
    path[0], rates[0], angles[0] = q[0], rates[0, -1], angles[0, -1]
    return NominalMotion(tubes, path, rates, angles, sorted(snaps))


def _along(before: Array, after: Array, d: int) -> Configuration:
    """Return the configuration (2d + 2,) of frames before and after as a function of the part of the way."""

    def configuration(part: Array, rows: Array) -> tuple[Array, Array]:
        at = before[:, None] + (after - before)[:, None] * part
        return at[:d], at[d : 2 * d]

    return configuration


def _in_substeps(follower: Follower, before: Array, after: Array, frame: int, rates: Array, angles: Array) -> bool:
    """Move one robot on to a frame, from 0, in as many steps as rates and angles (T, substeps, d) have columns."""
    substeps, d = rates.shape[1:]
    parts = np.linspace(0.0, 1.0, substeps + 1)
    for k in range(substeps):
        follower.advance(_along(before, after, d), frame + 1, parts[k], parts[k + 1], 1 / substeps)
        if follower.gone[0]:
            return False
        rates[frame, k], angles[frame, k] = follower.rates[:, 0], follower.angles[:, 0]
    return True


def move_samples(
    tubes: Tubes,
    lags: Array,
    q: Array,
    each_frame: Callable[..., None],
    substeps: int = 4,
    settle: Settle | None = None,
) -> Array:
    """Move n robots, whose motors' offsets are those of the tubes, through q (T, 2d + 2).

    Parameters
    ----------
    tubes : Tubes
        Of the n robots.
    lags : (d, n) array
        Play of tubes behind their motors to either side, rad.
    q : (T, 2d + 2) array
        Motion of the motors, linear between frames; rad and mm.
    each_frame : callable
        Called as ``each_frame(frame, rows, twist, tip_angles)`` at every frame, from 0, with the robots that have
        not snapped, and their tubes there.
    substeps : int
        Steps from frame to frame.
    settle : callable, optional
        Finds where a robot comes to rest whose equilibrium has ended.

    Returns
    -------
    (n,) array
        The frames, from 1, on the way to which robots snap; 0 where they do not.
    """
    d, n = tubes.zero.shape
    start = q[0].copy()
    start[:d] = start[d - 1]
    follower = Follower(tubes, start[d - 1], settle)
    tube = start[:d, None] + np.zeros((d, n))
    for frame, (before, after) in enumerate(itertools.pairwise(np.concatenate([start[None], q]))):

        def configuration(
            part: Array, rows: Array, before: Array = before, after: Array = after, tube: Array = tube
        ) -> tuple[Array, Array]:
            # Every motor turns one way between frames, so that play depends on where it is now alone.
            at = before[:, None] + (after - before)[:, None] * part
            return apply_play(tube[:, rows], at[:d], lags[:, rows]) + tubes.zero[:, rows], at[d : 2 * d]

        follower.advance(configuration, frame + 1, 0.0, 1.0, 1 / substeps)
        tube = apply_play(tube, after[:d, None], lags)
        rows = np.flatnonzero(~follower.gone)
        if len(rows):
            alpha, beta = configuration(np.ones(len(rows)), rows)
            twist = integrate(tubes[rows], alpha, beta, follower.rates[:, rows], sensitivities=False)
            each_frame(frame, rows, twist, follower.angles[:, rows])
    return follower.snapped
