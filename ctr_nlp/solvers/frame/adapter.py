"""The interface of all solvers of a frame's program, and IPOPT behind it.

A solution is checked against the problem itself (ocp.nlp.kkt_residual): residuals of stationarity, complementarity
in mm^2 per rad or mm, violations in rad or mm. IPOPT: Waechter and Biegler, Math. Program. 106 (2006).
"""

from __future__ import annotations

import functools
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.ocp.local_parameters import LocalParameterSource
from ctr_nlp.ocp.nlp import Nlp, kkt_residual
from ctr_nlp.typing import Array

FEASIBILITY_TOLERANCE = 1e-6
"""Largest violation of bounds and constraints at a solution, rad or mm, whatever a solver reports."""
KKT_TOLERANCE = 1e-2
"""Largest KKT residual at a solution, mm^2 per rad or mm; most solves reach 1e-6."""

MAX_CACHED_IPOPT_INSTANCES = 16
"""Number of programs for which a process keeps an IPOPT instance."""


@dataclass(frozen=True)
class Solution:
    """The point that a solver ended at, and whether it is a solution.

    x (n,): the point; objective: mm^2; kkt: residual computed from the Nlp alone; success: the point is finite,
    feasible and a KKT point, whatever the solver reports; status: the solver's report; lam_x, lam_g: multipliers
    to warm-start from; q: the configuration at x.
    """

    x: Array
    objective: float
    kkt: float
    success: bool
    status: str
    iterations: int
    lam_x: Array
    lam_g: Array
    q: Array


class ConfigurationLimits(NamedTuple):
    """Limits low, high (k,) of a configuration, and the largest change `most` of its entries from frame to
    frame.
    """

    low: Array
    high: Array
    most: Array


class TimedSolution(NamedTuple):
    """A solution, and the seconds that it took."""

    solution: Solution
    seconds: float


class NlpSolver(ABC):
    """A solver built for one Nlp, called for any start, parameters and bounds; not from two threads at once."""

    def __init__(self, nlp: Nlp) -> None:
        """Build."""
        self.nlp = nlp

    @abstractmethod
    def __call__(
        self,
        x0: Array,
        p: Array,
        lower: Array | None = None,
        upper: Array | None = None,
        warm: Solution | None = None,
    ) -> Solution:
        """Solve from x0 (n,), which may lie outside the bounds, for packed parameters p (len(nlp.p),).

        lower, upper (k,): bounds of the configuration, where they are not the program's own. warm: the solution of
        a neighbouring problem, whose multipliers to start from.
        """

    def solve_sequence(
        self,
        x0: Array,
        p: Array,
        reach: ConfigurationLimits,
        here: Array,
        warm: Solution | None,
        local_parameters: LocalParameterSource | None = None,
    ) -> list[TimedSolution]:
        """Solve for parameters p (frames, n_p), each frame from the one before, until one is not solved.

        x0 (n,): start of the first frame. reach: limits, and steps from frame to frame. here (k,): the
        configuration before the first frame; the parameter named `previous` is set to it, and then to that of the
        last solved frame. warm: a solution to take multipliers from. local_parameters: source of parameters that
        hold near a robot only. A solver that takes one program at a time returns an empty list.
        """
        return []

    def solve_from_starts(self, x0: Array, p: Array, reach: ConfigurationLimits) -> list[Solution]:
        """Solve from every start and return the solutions found.

        x0 (starts, n): the starts. p (n_p,): packed parameters. reach: limits of the configuration.
        """
        found = (self(x, p, reach.low, reach.high) for x in x0)
        return [solution for solution in found if solution.success]


class Ipopt(NlpSolver):
    """IPOPT with exact Hessians, warm-started in primal and dual.

    mu_init 1e-4 with mu_min 1e-9: smaller values end in maximum iterations on bounds where samples cross
    from tube to tube and second derivatives jump.
    """

    def __init__(self, nlp: Nlp) -> None:
        """Build."""
        super().__init__(nlp)
        self._solve = _ipopt(nlp, threading.get_ident())

    def __call__(
        self,
        x0: Array,
        p: Array,
        lower: Array | None = None,
        upper: Array | None = None,
        warm: Solution | None = None,
    ) -> Solution:
        """Solve by IPOPT; arguments as in NlpSolver.__call__."""
        n, (low, high) = len(x0), self.nlp.row_bounds(lower, upper)
        arguments: dict[str, Any] = {
            "p": p,
            "lbx": low[:n],
            "ubx": high[:n],
            "lbg": low[n:],
            "ubg": high[n:],
        }
        # A neighbouring frame has nearly the same active limits: its multipliers are a good guess.
        if warm is not None:
            # Without these, CasADi starts from multipliers 0; warm_start_init_point makes IPOPT use what it
            # is given.
            arguments |= {"lam_x0": warm.lam_x, "lam_g0": warm.lam_g}
        # The nearest point within the bounds, where FRAME_IPOPT_OPTIONS let IPOPT leave it.
        result = self._solve(x0=np.clip(x0, low[:n], high[:n]), **arguments)
        status, iterations = status_and_iterations(self._solve)
        x, *multipliers = (result[key].full().ravel() for key in ("x", "lam_x", "lam_g"))
        return evaluate_frame_solution(
            self.nlp, x, p, np.concatenate(multipliers), (lower, upper), status=status, iterations=iterations
        )


def evaluate_frame_solution(
    nlp: Nlp,
    x: Array,
    p: Array,
    multipliers: Array,
    bounds: tuple[Array | None, Array | None] = (None, None),
    *,
    status: str,
    iterations: int,
) -> Solution:
    """Return a point x (n,) as a Solution; success depends on the program itself, whatever the solver reports.

    p (n_p,): packed parameters. multipliers (n + m,): of the bounds of x and then of the constraints, positive at
    upper bounds. bounds: lower and upper ones (k,) of the configuration, where they are not the program's own.
    status, iterations: the solver's.
    """
    n = len(x)
    low, high = nlp.row_bounds(*bounds)
    objective, g = (value.full().ravel() for value in nlp.value_function(x, p))
    rows = np.concatenate([x, g])
    # Before x is clipped: clipping hides what a solver's relaxed bounds let through.
    violation = np.maximum(low - rows, rows - high).max()
    # What is left after relaxed bounds, so that motors' limits are kept exactly.
    x = np.clip(x, low[:n], high[:n])
    lam_x, lam_g = np.split(multipliers, [n])
    # From the problem alone: a solver's own tolerances may refer to a scaled problem.
    kkt = kkt_residual(nlp, x, p, *bounds, lam_x, lam_g)
    success = bool(violation <= FEASIBILITY_TOLERANCE) and kkt <= KKT_TOLERANCE
    # On models whose unknowns are not q, some of q's entries are values of constraints.
    q = np.concatenate([x, g])[nlp.configuration]
    return Solution(x, float(objective[0]), kkt, success, status, iterations, lam_x, lam_g, q)


@functools.lru_cache(maxsize=MAX_CACHED_IPOPT_INSTANCES)
def _ipopt(nlp: Nlp, thread: int) -> ca.Function:
    """Return the IPOPT instance of a program and a thread; two threads must not share one."""
    problem = {"x": nlp.x, "p": nlp.p, "f": nlp.objective, "g": nlp.g}
    return ca.nlpsol("ipopt", "ipopt", problem, CASADI_SOLVER_OPTIONS | {"ipopt": FRAME_IPOPT_OPTIONS})


def status_and_iterations(solve: ca.Function) -> tuple[str, int]:
    """Return status and number of iterations of the last call of `solve`."""
    stats = solve.stats()
    return str(stats["return_status"]), int(stats["iter_count"])


CASADI_SOLVER_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "calc_lam_p": False,
    "show_eval_warnings": False,
    "error_on_fail": False,
}
"""Options of CasADi's interface, for frames and for chains."""


FRAME_IPOPT_OPTIONS: dict[str, Any] = {
    "sb": "yes",
    "print_level": 0,
    "max_iter": 300,
    # Tighter than KKT_TOLERANCE: what IPOPT accepts is judged again in units of the problem.
    "tol": 1e-8,
    "bound_relax_factor": 1e-10,
    "warm_start_init_point": "yes",
    # A warm start is near the solution: a large first barrier would lead away from it (see Ipopt for
    # mu_min).
    "mu_strategy": "adaptive",
    "mu_init": 1e-4,
    "mu_min": 1e-9,
    "warm_start_bound_push": 1e-9,
    "warm_start_bound_frac": 1e-9,
    "warm_start_slack_bound_push": 1e-9,
    "warm_start_slack_bound_frac": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
}
"""Options of IPOPT for a frame. Bounds are kept (relaxed by 1e-10 only), since motors have hard limits. Pushes of
1e-9 leave a warm start where it is, instead of moving it into the interior.
"""
