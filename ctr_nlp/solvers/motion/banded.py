"""A primal-dual interior-point method for chains, whose Newton systems are banded.

Time and memory are linear in the number of frames. Hessians are exact; where the whole is not positive definite,
the eigenvalues of each frame's own lose their signs (Dauphin et al., Identifying and attacking the saddle point
problem, 2014). After Nocedal and Wright, Numerical Optimization (2006), chapter 19, and Waechter and Biegler,
Math. Program. 106 (2006); where constraints are curved, slacks follow their values along a step.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.solvers.frame.adapter import FEASIBLE, Solution
from ctr_nlp.solvers.motion.judged import WIDE, judged
from ctr_nlp.solvers.motion.rows import Rows, Step
from ctr_nlp.solvers.motion.watch import Iterate, Watch
from ctr_nlp.typing import Array

TOLERANCE = 1e-6
"""Largest stationarity (mm^2 per unit of x) and complementarity (mm^2) at a solution."""
LAST_BARRIER = 1e-7
"""mm^2."""
CLOSE, SHRINK = 20.0, 0.05
"""A barrier problem is solved to so many times its barrier, and the next has this part of it."""
MOST_ITERATIONS = 500
PUSH = 1e-3
"""How far slacks start within their bounds, rad or mm."""
DAMPING = 1e-6
"""Added to the diagonal of the Newton matrix, mm^2 per squared unit of x; more where rounding calls for it."""
MOST_DAMPING = 1e6
MOST_HALVINGS = 25
LOOSE = 2.0
"""A penalty so many times what the multipliers need is lowered: beside curved constraints it holds steps back."""
DIVERGED = 1e12
"""Multipliers grow beyond this (mm^2 per unit of a row) where no point is feasible."""
STALL, STALLED = 6, 1e-8
"""Where samples cross from tube to tube second derivatives jump, and near such a point Newton steps go to and fro:
a barrier problem is left when so many iterations lower the merit by less than this part."""


class BandedSolver:
    """Solves chains whose frames have inequality constraints only; surest from a feasible start."""

    def __init__(self, chain: Chain) -> None:
        """Prepare for a chain; raises OptionError where a frame has equations, or nothing can be compiled."""
        low, high = chain.frame.g_bounds
        if (low == high).any():
            raise OptionError(
                f"solver is 'banded' and {chain.frame.name} has equations; it takes inequalities only"
            )
        self.chain = chain
        self._rows = Rows(chain)

    def __call__(
        self, x0: Array, watch: Watch, barrier: float = WIDE, multipliers: Array | None = None
    ) -> Solution:
        """Solve from x0 (T n,), and from multipliers of all rows where a neighbouring chain's are known."""
        rows, low, high = self._rows, self.chain.lower.ravel(), self.chain.upper.ravel()
        rows.start(np.clip(x0, low, high), barrier, PUSH, multipliers)
        penalty, status, merits = 1.0, "Maximum_Iterations_Exceeded", list[float]()
        for number in range(MOST_ITERATIONS + 1):
            at, hessian = rows.expand()
            if watch(Iterate(number, at.objective, at.violation, at.error(0.0), rows.x.copy())):
                status = "Interrupted"
                break
            if at.error(0.0) <= TOLERANCE:
                status = "Solve_Succeeded"
                break
            stalled = at.gap <= FEASIBLE and len(merits) > STALL
            stalled = stalled and merits[-STALL] - merits[-1] < STALLED * (1 + abs(merits[-1]))
            if stalled and barrier == LAST_BARRIER:
                status = "Solved_To_Acceptable_Level"
                break
            while barrier > LAST_BARRIER and (stalled or at.error(barrier) < CLOSE * barrier):
                barrier, merits, stalled = max(LAST_BARRIER, SHRINK * barrier), [], False
            step = self._newton(hessian, barrier)
            needed = np.inf if step is None else 1.1 * step.multiplier
            if step is None or needed > DIVERGED:
                status = "Infeasible_Problem_Detected"
                break
            if not needed <= penalty <= LOOSE * needed:
                penalty, merits = needed, []
            merits = merits or [rows.merit(barrier, penalty)]
            merit = self._search(step, barrier, penalty, merits[-1])
            if merit is None:
                status = "Search_Direction_Becomes_Too_Small"
                break
            merits.append(merit)
        return judged(self.chain, np.clip(rows.x, low, high), rows.multipliers, status, number)

    def _newton(self, hessian: Array, barrier: float) -> Step | None:
        """A step downhill: with exact Hessians, else convex ones, more and more damped where rounding asks."""
        step, damping = self._rows.newton(hessian, barrier, DAMPING), DAMPING
        if step is None:
            hessian = self._rows.convex(hessian)
        while step is None and damping <= MOST_DAMPING:
            step = self._rows.newton(hessian, barrier, damping)
            damping *= 1e3
        return step

    def _search(self, step: Step, barrier: float, penalty: float, merit: float) -> float | None:
        """Go as far along a step as the l1 merit function falls enough; its value, or None where it never does."""
        primal, slope = step.primal, step.slope - penalty * step.gap
        for _ in range(MOST_HALVINGS):
            found = self._rows.advance(primal, step.dual, barrier, penalty)
            if found <= merit + 1e-4 * primal * slope + 1e-12 * abs(merit):
                self._rows.accept()
                return found
            primal /= 2
        return None
