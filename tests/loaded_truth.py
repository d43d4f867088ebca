"""What loaded robots are tested against: their differential equations shot from base to tip, and their energy.

Written in the material frame of the innermost tube, whose z is the tangent and whose x is where that tube's
pre-curvature bends it; omega are its rotation rates in its own axes, theta_i the angles of the tubes against it:

    EI omega_x = m_x - sum EI_i k_i sin theta_i,   EI omega_y = m_y + sum EI_i k_i cos theta_i,   EI = sum EI_i
    GJ_i u_i' = EI_i k_i (omega_x cos theta_i + omega_y sin theta_i),   theta_i' = u_i - u_d,   omega_z = u_d
    m' = n x t in the base's axes, n(s) the tip's force and the weight beyond s.

Unknown at the base are the rates u_i and two moments; at the tips tubes are untwisted, but for the moment on the
innermost about its tip, and only what else acts there as a moment bends the last one. Loads are raised in steps
from 0, where all tubes are aligned.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.linalg
from scipy.integrate import ODEintWarning, odeint, quad, solve_ivp
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from ctr_nlp import Robot

TURNS, RISES = 8, 6
"""Steps in which tubes are turned from where they are aligned, and in which the load comes."""
UNITS = 0.01, 100.0
"""rad/mm and N mm: what unknown rates and moments are told in."""
GRAVITY = 9.80665e-6
"""N per g/cm^3 and mm^3."""


class Unsolved(Exception):
    """No equilibrium was found on the way."""


@dataclass(frozen=True)
class Pull:
    """What acts: a tip force (3,) N in the base's axes, an axial moment N mm, a density g/cm^3 and down (3,),
    a force (3,) N/mm along the body between two places, mm, and moments (3,) N mm at the tip, one in the base's
    axes, the other in those of the innermost tube there.
    """

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axial_moment: float = 0.0
    density: float = 0.0
    down: tuple[float, float, float] = (0.0, 0.0, 1.0)
    along: tuple[float, float, float] = (0.0, 0.0, 0.0)
    between: tuple[float, float] = (0.0, 1.0)
    moment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tool_moment: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LoadedShot:
    """A robot with moduli in MPa at q (2d + 2,) under a pull, on the branch that the aligned one comes to."""

    robot: Robot
    q: np.ndarray
    pull: Pull

    @cached_property
    def numbers(self):
        """EI, GJ (d,) N mm^2 and weights (d,) N/mm."""
        each = self.robot.tubes
        section = np.array([np.pi / 64 * (t.outer_diameter**4 - t.inner_diameter**4) for t in each])
        bending = section * [t.youngs_modulus for t in each]
        area = np.array([np.pi / 4 * (t.outer_diameter**2 - t.inner_diameter**2) for t in each])
        return bending, bending / [1 + t.poisson_ratio for t in each], area * self.pull.density * GRAVITY

    @property
    def beta(self):
        return self.q[self.robot.d : 2 * self.robot.d]

    @cached_property
    def places(self):
        starts = [b - t.curved_length for b, t in zip(self.beta, self.robot.tubes, strict=True)]
        ends = [s for s in self.pull.between if s < self.beta[-1]]
        return np.array(sorted({0.0, *self.beta, *(s for s in [*starts, *ends] if s > 0)}))

    def pulls(self, s, middle=None):
        """EI_i k_i at s, and which tubes are there; middle: of the piece that s is in, where s is a symbol."""
        middle = s if middle is None else middle
        pulls = [0.0] * self.robot.d
        for i, tube in enumerate(self.robot.tubes):
            part = (self.beta[i] - s) / tube.curved_length
            if 0 <= (self.beta[i] - middle) / tube.curved_length < 1:
                root, tip = np.broadcast_to(tube.curvature, 2)
                pulls[i] = self.numbers[0][i] * (tip + part * (root - tip))
        return pulls, middle < self.beta

    def force(self, s, part, middle=None):
        """n at s, of a part of the load."""
        middle = s if middle is None else middle
        down = np.array(self.pull.down) / np.linalg.norm(self.pull.down)
        there, (begin, end) = middle < self.beta, np.minimum(self.pull.between, self.beta[-1])
        weight = sum(w * (b - s) for w, b in zip(self.numbers[2][there], self.beta[there], strict=True))
        pushed = end - begin if middle < begin else end - s if middle < end else 0.0
        terms = zip(self.pull.force, down, self.pull.along, strict=True)
        return [part * (force + weight * axis + pushed * along) for force, axis, along in terms]

    @cached_property
    def slopes(self):
        """Of each piece between places, the right-hand side of its equations: a function of s, y and the part."""
        return [self._slope((low + high) / 2) for low, high in itertools.pairwise(self.places)]

    def _slope(self, middle):
        d, (bending, torsion, _) = self.robot.d, self.numbers
        s, y, part = ca.SX.sym("s"), ca.SX.sym("y", 2 * d + 15), ca.SX.sym("part")
        theta, u, axes, m = (
            y[:d],
            y[d : 2 * d],
            ca.reshape(y[2 * d : 2 * d + 9], 3, 3).T,
            y[2 * d + 9 : 2 * d + 12],
        )
        pulls, there = self.pulls(s, middle)
        pull, stiff = ca.vertcat(*pulls), bending[there].sum()
        inside = axes.T @ m
        wx = (inside[0] - ca.dot(pull, ca.sin(theta))) / stiff
        wy = (inside[1] + ca.dot(pull, ca.cos(theta))) / stiff
        du = pull * (wx * ca.cos(theta) + wy * ca.sin(theta)) / torsion
        w = ca.skew(ca.vertcat(wx, wy, u[-1]))
        t, n = axes[:, 2], ca.vertcat(*self.force(s, part, middle))
        there = ca.DM(there.astype(float))
        turned = ca.reshape((axes @ w).T, 9, 1)
        right = ca.vertcat(there * (u - u[-1]), du, turned, ca.cross(n, t), t)
        return ca.Function("slope", [s, y, part], [right])

    def shoot(self, unknown, q, part, tolerance=1e-9, dense=False):
        """What tips lack, (d + 2,), and the pieces of the solution."""
        d, torsion = self.robot.d, self.numbers[1]
        rates, moments = unknown[:d] * UNITS[0], unknown[d:] * UNITS[1]
        reach = np.array([t.length for t in self.robot.tubes]) - self.beta
        turned = q[:d] + rates * reach
        base = Rotation.from_rotvec([0, q[-1], 0]) * Rotation.from_rotvec([q[-2], 0, 0])
        axes = (base * Rotation.from_rotvec([0, 0, turned[-1]])).as_matrix()
        moment = base.as_matrix() @ [*moments, torsion @ rates]
        y, lacks, pieces = np.concatenate([turned - turned[-1], rates, axes.ravel(), moment, np.zeros(3)]), [], []
        for (low, high), slope in zip(itertools.pairwise(self.places), self.slopes, strict=True):

            def right(s, y, slope=slope):
                return slope(s, y, part).full().ravel()

            accuracy = {"rtol": tolerance, "atol": 1e-11}
            if dense:
                run = solve_ivp(right, (low, high), y, method="DOP853", dense_output=True, **accuracy)
                y = run.y[:, -1]
                pieces.append(run.sol)
            else:
                y = _ended(right, y, low, high, accuracy)
            lacks += [y[d + i] / UNITS[0] for i in np.flatnonzero(self.beta[:-1] == high)]
        axes = y[2 * d : 2 * d + 9].reshape(3, 3)
        given = axes.T @ self.pull.moment + self.pull.tool_moment + [0.0, 0.0, self.pull.axial_moment]
        last = y[2 * d - 1] - part * given[2] / torsion[-1]
        hidden = [unknown[i] for i in np.flatnonzero(self.beta[:-1] <= 0)]
        bending = (axes.T @ y[2 * d + 9 : 2 * d + 12] - part * given)[:2]
        return np.array([*hidden, *lacks, last / UNITS[0], *(bending / UNITS[1])]), pieces

    @cached_property
    def solution(self):
        """The pieces between places."""
        d = self.robot.d
        aligned, unknown = self.q.copy(), np.zeros(d + 2)
        aligned[:d] = self.q[d - 1]
        way = [(aligned + k / TURNS * (self.q - aligned), 0.0) for k in range(1, TURNS + 1)]
        way += [(self.q, k / RISES) for k in range(1, RISES + 1)]
        before = unknown
        for q, part in way:
            guess = 2 * unknown - before
            before = unknown
            unknown, _, ended, _ = fsolve(
                lambda z, q=q, part=part: self.shoot(z, q, part)[0],
                guess,
                full_output=True,
                xtol=1e-10,
                epsfcn=1e-8,
            )
            lacks = self.shoot(unknown, q, part)[0]
            if ended != 1 and abs(lacks).max() > 1e-7:
                raise Unsolved
        return self.shoot(unknown, self.q, 1.0, 1e-11, dense=True)[1]

    def at(self, s):
        """The state at s mm."""
        k = min(max(int(np.searchsorted(self.places, s)) - 1, 0), len(self.places) - 2)
        return self.solution[k](s)

    def points(self, sigma):
        """Of the shape, (n, 3) mm."""
        return np.array([self.at(s)[-3:] for s in sigma * self.beta[-1]])

    def tips(self):
        """Angles (d,) of the tubes' tips relative to a frame that does not spin along the robot, and that frame
        (3, 3) at the last tip, column by column, where it is the innermost tube's own.
        """
        d, last = self.robot.d, self.beta[-1]
        spin = [
            quad(lambda s: self.at(s)[2 * d - 1], b, last, limit=200)[0] if b < last else 0.0 for b in self.beta
        ]
        return np.array([self.at(b)[i] for i, b in enumerate(self.beta)]) - spin, self.at(last)[
            2 * d : 2 * d + 9
        ].reshape(3, 3)

    def margin(self, elements=24):
        """The least mu of (H - mu K) x = 0, by elements between which the frame and the tubes turn evenly.

        H: the second variation of the energy, K: that of torsion in it, transmissions included.
        """
        stiff, torsional = self._variations(elements)

        def least(mu):
            return scipy.linalg.eigvalsh(stiff - mu * torsional, subset_by_index=[0, 0])[0]

        low, high = -1.0, 1.0
        while least(low) < 0:
            low = 2 * low - 1
            if low < -1000:
                return -np.inf
        for _ in range(24):
            middle = (low + high) / 2
            low, high = (middle, high) if least(middle) > 0 else (low, middle)
        return (low + high) / 2

    def stable(self, elements=8):
        """Whether H is positive definite."""
        stiff, _ = self._variations(elements)
        return bool(scipy.linalg.eigvalsh(stiff, subset_by_index=[0, 0])[0] > 0)

    def _variations(self, elements):
        """H and K there, over turns of the frame at every node and angles of the tubes but the last."""
        d, (bending, torsion, _) = self.robot.d, self.numbers
        grid = np.unique(
            np.concatenate([np.linspace(a, b, elements + 1) for a, b in itertools.pairwise(self.places)])
        )
        n = len(grid)
        turns, angles = ca.SX.sym("turns", 3, n), ca.SX.sym("angles", d - 1, n)
        held = [turns[0, 0], turns[1, 0]]
        energy, twists, weights = ca.SX(0), [], []
        states = np.array([self.at(s) for s in grid])
        frames = [ca.DM(y[2 * d : 2 * d + 9].reshape(3, 3)) @ _turn(turns[:, k]) for k, y in enumerate(states)]
        theta = [ca.vertcat(ca.DM(y[: d - 1]) + angles[:, k], 0) for k, y in enumerate(states)]
        for i, tube in enumerate(self.robot.tubes):
            reach, spin = tube.length - self.beta[i], turns[2, 0] + (angles[i, 0] if i < d - 1 else 0)
            moment = torsion[i] * states[0][d + i]
            energy += torsion[i] / reach * spin**2 / 2 + moment * spin
            twists, weights = [*twists, spin], [*weights, torsion[i] / reach]
        for k in range(n - 1):
            s, h = (grid[k] + grid[k + 1]) / 2, grid[k + 1] - grid[k]
            pull, there = self.pulls(s)
            w = _rates(frames[k].T @ frames[k + 1]) / h
            for i in np.flatnonzero(there):
                at = (theta[k][i] + theta[k + 1][i]) / 2
                own = pull[i] / bending[i]
                bent = (w[0] + own * ca.sin(at)) ** 2 + (w[1] - own * ca.cos(at)) ** 2
                twist = w[2] + (theta[k + 1][i] - theta[k][i]) / h
                energy += h / 2 * (bending[i] * bent + torsion[i] * twist**2)
                twists, weights = [*twists, twist], [*weights, torsion[i] * h]
            energy -= h / 2 * ca.dot(ca.DM(self.force(s, 1.0)), frames[k][:, 2] + frames[k + 1][:, 2])
        free = ca.vertcat(turns[2, 0], ca.vec(turns[:, 1:]), ca.vec(angles))
        energy, twist = ca.substitute([energy, ca.vertcat(*twists)], held, [0, 0])
        gone = [j for j in range(free.numel()) if not ca.depends_on(energy, free[j])]
        kept = [j for j in range(free.numel()) if j not in gone]
        found = ca.Function("h", [free], [ca.hessian(energy, free)[0], ca.jacobian(twist, free)])(0)
        stiff, slopes = (each.full() for each in found)
        torsional = slopes.T @ (np.array(weights)[:, None] * slopes)
        return stiff[np.ix_(kept, kept)], torsional[np.ix_(kept, kept)]


@dataclass(frozen=True)
class AnyShot(LoadedShot):
    """Some equilibrium, stable or not: what is found from unknowns that are drawn with a seed."""

    seed: int = 0

    @cached_property
    def solution(self):
        """The pieces between places."""
        rng = np.random.default_rng(self.seed)
        guess = rng.uniform(0, 1.5) * rng.normal(size=self.robot.d + 2)
        unknown, _, ended, _ = fsolve(
            lambda z: self.shoot(z, self.q, 1.0, 1e-6)[0], guess, full_output=True, maxfev=100
        )
        if ended == 1:
            near = {"xtol": 1e-10, "epsfcn": 1e-8, "full_output": True}
            unknown = fsolve(lambda z: self.shoot(z, self.q, 1.0)[0], unknown, **near)[0]
            lacks, pieces = self.shoot(unknown, self.q, 1.0, 1e-11, dense=True)
            if abs(lacks).max() < 1e-7:
                return pieces
        raise Unsolved


def _ended(right, y, low, high, accuracy):
    """Where y is led from low to high, by LSODA, which is the fastest; raises Unsolved where it gives up."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", ODEintWarning)
        try:
            return odeint(right, y, (low, high), tfirst=True, **accuracy)[-1]
        except ODEintWarning:
            raise Unsolved from None


def _turn(v):
    """The rotation matrix of a small vector, to second order."""
    x, y, z = ca.vertsplit(v)
    cross = ca.vertcat(ca.horzcat(0, -z, y), ca.horzcat(z, 0, -x), ca.horzcat(-y, x, 0))
    return ca.DM.eye(3) + cross + cross @ cross / 2


def _rates(turn):
    """The rotation vector of a matrix that turns little."""
    v = ca.vertcat(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2
    square = ca.dot(v, v)
    return v * (1 + square / 6 + 3 * square**2 / 40)
