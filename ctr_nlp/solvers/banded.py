"""A primal-dual interior-point method for chains, whose Newton systems are banded.

Slacks turn every row into an equation, and the log barrier keeps slacks within their bounds. Without slacks and
multipliers, the Newton system has the frames' Hessians and what the rows add to them: a symmetric matrix with a
band as wide as the links reach, factorised by Cholesky in time linear in the number of frames. Hessians are
exact; where the whole is not positive definite, the eigenvalues of each frame's own lose their signs (Dauphin et
al., Identifying and attacking the saddle point problem, 2014). After Nocedal and Wright, Numerical
Optimization (2006), chapter 19, and Waechter and Biegler, Math. Program. 106 (2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, solveh_banded

from ctr_nlp.chain import Chain, Slopes
from ctr_nlp.errors import OptionError
from ctr_nlp.solvers.adapter import FEASIBLE, Solution
from ctr_nlp.solvers.band import Band
from ctr_nlp.solvers.chains import WIDE, judged
from ctr_nlp.solvers.watch import Iterate, Watch

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest stationarity (mm^2 per unit of x) and complementarity (mm^2) at a solution."""
LAST_BARRIER = 1e-7
"""mm^2."""
MOST_ITERATIONS = 500
PUSH = 1e-3
"""How far slacks start within their bounds, rad or mm."""
RELAX = 1e-9
"""How far bounds are moved outwards, so that bounds that meet still have an interior, rad or mm."""
DAMPING = 1e-6
"""Added to the diagonal of the Newton matrix, mm^2 per squared unit of x; more where rounding calls for it."""
MOST_DAMPING = 1e6
MOST_HALVINGS = 25
DIVERGED = 1e12
"""Multipliers grow beyond this (mm^2 per unit of a row) where no point is feasible."""
STALL, STALLED = 6, 1e-8
"""Where samples cross from tube to tube second derivatives jump, and near such a point Newton steps go to and fro:
a barrier problem is left when so many iterations lower the merit by less than this part."""
INFINITE = 1e20
"""A bound this far away has no weight, and needs no case of its own."""


@dataclass(frozen=True)
class _Point:
    """x (T n,); slack, at_lower and at_upper (rows,): the slacks and the multipliers of their bounds."""

    x: Array
    slack: Array
    at_lower: Array
    at_upper: Array

    @property
    def multipliers(self) -> Array:
        return self.at_upper - self.at_lower

    def moved(self, step: _Point, primal: float, dual: float) -> _Point:
        return _Point(
            self.x + primal * step.x,
            self.slack + primal * step.slack,
            self.at_lower + dual * step.at_lower,
            self.at_upper + dual * step.at_upper,
        )


class BandedSolver:
    """Solves chains whose frames have inequality constraints only; surest from a feasible start."""

    def __init__(self, chain: Chain) -> None:
        """Prepare for a chain; raises OptionError where a frame has equations."""
        low, high = chain.frame.g_bounds
        if (low == high).any():
            raise OptionError(
                f"solver is 'banded' and {chain.frame.name} has equations; it takes inequalities only"
            )
        self.chain = chain
        self._band = Band(chain)
        self._free = chain.free
        low, high = chain.bounds
        still = ~chain.reached
        self._low = np.where(still | np.isinf(low), -INFINITE, low - RELAX)
        self._high = np.where(still | np.isinf(high), INFINITE, high + RELAX)
        self._least = 1e-14 * (1 + np.minimum(np.abs(self._low), np.abs(self._high)))

    def __call__(self, x0: Array, watch: Watch, barrier: float = WIDE) -> Solution:
        """Solve from x0 (T n,)."""
        low, high = self.chain.lower.ravel(), self.chain.upper.ravel()
        penalty, status = 1.0, "Maximum_Iterations_Exceeded"
        point, merits = self._start(np.clip(x0, low, high), barrier), [np.inf]
        for number in range(MOST_ITERATIONS + 1):
            at, hessian = self.chain.expand(point.x, point.multipliers)
            errors = self._errors(at, point)
            if watch(Iterate(number, at.objective, self.chain.violation(at.value), errors(0.0), point.x)):
                status = "Interrupted"
                break
            if errors(0.0) <= TOLERANCE:
                status = "Solve_Succeeded"
                break
            kept = np.abs(at.value - point.slack).max() <= FEASIBLE
            stalled = (
                kept and len(merits) > STALL and merits[-STALL] - merits[-1] < STALLED * (1 + abs(merits[-1]))
            )
            if stalled and barrier == LAST_BARRIER:
                status = "Solved_To_Acceptable_Level"
                break
            while barrier > LAST_BARRIER and (stalled or errors(barrier) < 10 * barrier):
                barrier, merits, stalled = max(LAST_BARRIER, min(0.2 * barrier, barrier**1.5)), [np.inf], False
            step = self._newton(at, hessian, point, barrier)
            needed = 1.1 * float(np.abs(point.multipliers + step.multipliers).max())
            if needed > DIVERGED:
                status = "Infeasible_Problem_Detected"
                break
            if needed > penalty:
                penalty, merits = needed, [np.inf]
            moved, merit = self._search(at, point, step, barrier, penalty)
            if moved is None:
                status = "Search_Direction_Becomes_Too_Small"
                break
            point = moved
            merits.append(merit)
        return judged(self.chain, np.clip(point.x, low, high), point.multipliers, status, number)

    def _start(self, x: Array, barrier: float) -> _Point:
        _, value = self.chain.evaluate(x)
        push = np.minimum(PUSH, 0.1 * (self._high - self._low))
        slack = np.clip(value, self._low + push, self._high - push)
        return _Point(x, slack, barrier / (slack - self._low), barrier / (self._high - slack))

    def _errors(self, at: Slopes, point: _Point) -> Callable[[float], float]:
        """Barrier -> KKT residual of its problem; with barrier = 0, of the problem itself."""
        slope = at.gradient + self.chain.transposed(at.jacobian, point.multipliers)
        lower = point.at_lower * (point.slack - self._low)
        upper = point.at_upper * (self._high - point.slack)
        products = lower.min(), upper.min(), lower.max(), upper.max()
        rest = max(np.abs(slope[self._free]).max(initial=0.0), np.abs(at.value - point.slack).max())
        return lambda barrier: float(max(rest, *(abs(product - barrier) for product in products)))

    def _newton(self, at: Slopes, hessian: Array, point: _Point, barrier: float) -> _Point:
        """The step to a zero of the barrier problem's KKT conditions, linearised at a point."""
        to_lower, to_upper = point.slack - self._low, self._high - point.slack
        sigma = point.at_lower / to_lower + point.at_upper / to_upper
        push = barrier / to_upper - barrier / to_lower
        residual = at.value - point.slack
        right = at.gradient + self.chain.transposed(at.jacobian, push + sigma * residual)
        x = self._solve(at.jacobian, hessian, sigma, np.where(self._free, -right, 0.0))
        slack = self.chain.times(at.jacobian, x) + residual
        return _Point(
            x,
            slack,
            barrier / to_lower - point.at_lower - point.at_lower * slack / to_lower,
            barrier / to_upper - point.at_upper + point.at_upper * slack / to_upper,
        )

    def _solve(self, jacobian: Array, hessian: Array, sigma: Array, right: Array) -> Array:
        size, (frames, m, _) = right.size, jacobian.shape
        of_frames = sigma[size : size + frames * m].reshape(frames, 1, m)
        added = (jacobian.transpose(0, 2, 1) * of_frames) @ jacobian
        blocks, damping = hessian, DAMPING
        while True:
            band = self._band.assemble(blocks + added, sigma[:size] + damping, sigma[size + frames * m :])
            try:
                return np.asarray(solveh_banded(band, right, lower=True, check_finite=False))
            except LinAlgError:
                if damping > MOST_DAMPING:
                    raise
                if blocks is hessian:
                    blocks = convex(hessian)
                else:
                    damping *= 1e3

    def _search(
        self, at: Slopes, point: _Point, step: _Point, barrier: float, penalty: float
    ) -> tuple[_Point | None, float]:
        """As far along a step as the l1 merit function falls enough, and its value; None where it never does."""
        to_lower, to_upper = point.slack - self._low, self._high - point.slack
        primal = min(_to_boundary(to_lower, step.slack), _to_boundary(to_upper, -step.slack))
        dual = min(_to_boundary(point.at_lower, step.at_lower), _to_boundary(point.at_upper, step.at_upper))
        residual = float(np.abs(at.value - point.slack).sum())
        slope = at.gradient @ step.x + (barrier / to_upper - barrier / to_lower) @ step.slack - penalty * residual
        merit = self._merit(at.objective, at.value, point.slack, barrier, penalty)
        for _ in range(MOST_HALVINGS):
            moved = point.moved(step, primal, dual)
            moved = replace(moved, slack=np.clip(moved.slack, self._low + self._least, self._high - self._least))
            objective, value = self.chain.evaluate(moved.x)
            found = self._merit(objective, value, moved.slack, barrier, penalty)
            if found <= merit + 1e-4 * primal * slope + 1e-12 * abs(merit):
                return moved, found
            primal /= 2
        return None, merit

    def _merit(self, objective: float, value: Array, slack: Array, barrier: float, penalty: float) -> float:
        logs = np.log(slack - self._low).sum() + np.log(self._high - slack).sum()
        return float(objective - barrier * logs + penalty * np.abs(value - slack).sum())


def _to_boundary(distance: Array, change: Array) -> float:
    """The part of a change, at most 1, that leaves a hundredth of every distance."""
    return float(0.99 / max(0.99, -(change / distance).min()))


def convex(hessian: Array) -> Array:
    """Hessians (T, n, n) with the absolute values of their eigenvalues: steps lead away from saddle points."""
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray((vectors * np.abs(values)[:, None]) @ vectors.transpose(0, 2, 1))
