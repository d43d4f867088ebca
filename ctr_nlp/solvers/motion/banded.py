"""A primal-dual interior-point method for chains, whose Newton systems are banded.

Every row r(x) of a chain gets a slack s = r(x), and a logarithmic barrier mu keeps slacks within their bounds:

    minimise  f(x) - mu sum log(s - l) - mu sum log(u - s)     subject to  r(x) = s

for mu falling to BANDED_LAST_BARRIER_MM2 (mm^2). Slacks and multipliers are eliminated from a Newton step, which
leaves H + A' diag(sigma) A over x alone, with A the rows' Jacobian and sigma = z_l / (s - l) + z_u / (u - s).
Frames meet only in links between neighbours, so that the matrix is a band: time and memory are linear in the
number of frames.

Hessians are exact; where the whole is not positive definite, the eigenvalues of each frame's own lose their signs
(Dauphin et al., Identifying and attacking the saddle point problem, 2014). After Nocedal and Wright, Numerical
Optimization (2006), chapter 19, and Waechter and Biegler, Math. Program. 106 (2006); where constraints are curved,
slacks follow their values along a step.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.solvers.barrier import (
    BARRIER_RESIDUAL_FACTOR,
    BARRIER_SHRINK_FACTOR,
    MAX_STEP_HALVINGS,
    STALL_ITERATIONS,
)
from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE, Solution
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2, evaluate_chain_solution
from ctr_nlp.solvers.motion.loop import Loop
from ctr_nlp.solvers.motion.watch import Watch
from ctr_nlp.typing import Array

BANDED_KKT_TOLERANCE = 1e-6
"""Largest stationarity (mm^2 per unit of x) and complementarity (mm^2) at a solution."""
BANDED_LAST_BARRIER_MM2 = 1e-7
"""Barrier at which the method ends, mm^2."""
MAX_BANDED_ITERATIONS = 500
"""Iterations after which a solve ends without a solution."""
BANDED_LEAST_SLACK_PUSH, BANDED_SLACK_PUSH_PER_MM2 = 1e-3, 0.1
"""How far slacks start within their bounds, rad or mm: at least, and for each mm^2 of the first barrier."""
BANDED_FIRST_DAMPING = 1e-6
"""Added to the diagonal of the Newton matrix, mm^2 per squared unit of x; more where rounding calls for it."""
MAX_BANDED_DAMPING = 1e6
"""Largest damping that is tried, mm^2 per squared unit of x."""
LOOSE_PENALTY_FACTOR = 2.0
"""A penalty this many times larger than the multipliers need is lowered: beside curved constraints it shortens
steps.
"""
DIVERGED_MULTIPLIER_SIZE = 1e12
"""Multipliers grow beyond this (mm^2 per unit of a row) where no point is feasible."""
BANDED_ITERATIONS_PER_CALL = 16
"""Iterations in one call of C; between calls Ctrl-C is handled, and progress reported."""
BANDED_STATUS_TEXTS = (
    "",
    "Solve_Succeeded",
    "Solved_To_Acceptable_Level",
    "Infeasible_Problem_Detected",
    "Search_Direction_Becomes_Too_Small",
    "Maximum_Iterations_Exceeded",
)
"""Status texts, in the order in which banded.c numbers them; the first means that the solve has not ended."""
BANDED_STALL_DECREASE = 1e-8
"""Where samples cross from tube to tube second derivatives jump, and near such a point Newton steps oscillate:
a barrier problem is left when STALL_ITERATIONS iterations lower the merit by less than this part."""


class BandedSolver:
    """Solver of chains whose frames have inequality constraints only; most reliable from a feasible start."""

    def __init__(self, chain: Chain) -> None:
        """Prepare for a chain; raises OptionError where a frame has equations, or nothing can be compiled."""
        low, high = chain.frame.g_bounds
        # A slack between bounds that meet has hardly any interior (BOUND_RELAXATION). Bounds of x that meet
        # are no such case: ChainRows takes those unknowns out of the system.
        if (low == high).any():
            raise OptionError(
                f"solver is 'banded' and {chain.frame.name} has equations; it takes inequalities only"
            )
        self.chain = chain
        self._loop = Loop(chain, _real_settings(), _integer_settings())

    def __call__(
        self,
        x0: Array,
        watch: Watch,
        barrier: float = COLD_START_BARRIER_MM2,
        multipliers: Array | None = None,
        tolerance: float | None = None,
    ) -> Solution:
        """Solve from x0 (T n,), and from multipliers of all rows where a neighbouring chain's are known.

        tolerance: largest stationarity (mm^2 per unit of x) and complementarity (mm^2) at a solution; None for
        BANDED_KKT_TOLERANCE.
        """
        loop = self._loop
        low = self.chain.lower.ravel()
        high = self.chain.upper.ravel()
        # A slack s at distance p from its bound has the multiplier mu / p: with a large barrier mu and a small p,
        # multipliers begin far too large, and the first steps serve to lower them.
        push = max(BANDED_LEAST_SLACK_PUSH, BANDED_SLACK_PUSH_PER_MM2 * barrier)
        enough = BANDED_KKT_TOLERANCE if tolerance is None else tolerance
        # Fixed unknowns take their values here, as they never move.
        loop.start(np.clip(x0, low, high), barrier, push, enough, multipliers)
        # Only a caller that wants every iterate needs C to come back after each.
        status = ""
        points = BANDED_ITERATIONS_PER_CALL if isinstance(watch, Watch) and not watch.reports_every_iterate else 1
        while not status:
            status = BANDED_STATUS_TEXTS[loop.iterate(points)]
            told = loop.reported_iterate
            if told is not None and watch(told):
                status = status or "Interrupted"
        # Slacks are inside relaxed bounds; clipping takes rounding off bounds of x.
        return evaluate_chain_solution(
            self.chain, np.clip(loop.rows.x, low, high), loop.rows.multipliers, status, loop.number
        )


def _real_settings() -> dict[str, float]:
    """Return the real-valued settings by the names of LOOP_REAL_SETTINGS."""
    return {
        "feasible": FEASIBILITY_TOLERANCE,
        "last_barrier": BANDED_LAST_BARRIER_MM2,
        "close": BARRIER_RESIDUAL_FACTOR,
        "shrink": BARRIER_SHRINK_FACTOR,
        "damping": BANDED_FIRST_DAMPING,
        "most_damping": MAX_BANDED_DAMPING,
        "diverged": DIVERGED_MULTIPLIER_SIZE,
        "loose": LOOSE_PENALTY_FACTOR,
        "stalled": BANDED_STALL_DECREASE,
    }


def _integer_settings() -> dict[str, int]:
    """Return the integer settings by the names of LOOP_INTEGER_SETTINGS."""
    return {
        "most_iterations": MAX_BANDED_ITERATIONS,
        "most_halvings": MAX_STEP_HALVINGS,
        "stall": STALL_ITERATIONS,
    }
