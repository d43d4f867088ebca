"""One adapter for CasADi's NLP solvers; what differs between them is a dictionary of options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from ctr_nlp.nlp import Constraint, Nlp, kkt_residual
from ctr_nlp.settings import check_choice

Array = npt.NDArray[np.float64]

FEASIBLE = 1e-6
"""A point that leaves bounds or constraints by more than this (rad, mm) is no solution, whatever a solver says."""
OPTIMAL = 1e-2
"""Nor is one with a larger KKT residual (mm^2 per rad or mm); IPOPT reaches 1e-6, and so do most SQP solves."""


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    x (n,); objective mm^2; kkt: residual computed from the Nlp alone; success: the point is finite, feasible and a
    KKT point, whatever the solver says; status: the solver's own word; lam_x, lam_g: multipliers to warm-start
    from.
    """

    x: Array
    objective: float
    kkt: float
    success: bool
    status: str
    iterations: int
    lam_x: Array
    lam_g: Array


class NlpSolver:
    """A solver built for one Nlp, called for any start, parameters and bounds; not from two threads at once."""

    def __init__(self, nlp: Nlp, solver: str) -> None:
        """Build; raises OptionError where the solver is unknown or does not suit the problem."""
        check_choice("solver", solver, SOLVERS)
        self.nlp = _with_a_row(nlp) if solver == "sqp" else nlp
        self._solve = SOLVERS[solver](self.nlp)

    def __call__(
        self,
        x0: Array,
        p: Array,
        lower: Array | None = None,
        upper: Array | None = None,
        warm: Solution | None = None,
    ) -> Solution:
        """Solve from x0 (n,) for packed parameters p, with bounds that default to the Nlp's own."""
        low = self.nlp.lower if lower is None else lower
        high = self.nlp.upper if upper is None else upper
        g_low, g_high = self.nlp.g_bounds
        arguments: dict[str, Any] = {"p": p, "lbx": low, "ubx": high, "lbg": g_low, "ubg": g_high}
        if warm is not None:
            arguments |= {"lam_x0": warm.lam_x, "lam_g0": warm.lam_g}
        result = self._solve(x0=np.clip(x0, low, high), **arguments)
        status, iterations = outcome(self._solve)
        x, lam_x, lam_g = (result[key].full().ravel() for key in ("x", "lam_x", "lam_g"))
        g = result["g"].full().ravel()
        violation = np.concatenate([low - x, x - high, g_low - g, g - g_high]).max()
        x = np.clip(x, low, high)
        kkt = kkt_residual(self.nlp, x, p, low, high, lam_x, lam_g)
        success = bool(violation <= FEASIBLE) and kkt <= OPTIMAL
        return Solution(x, float(result["f"]), kkt, success, status, iterations, lam_x, lam_g)


def outcome(solve: ca.Function) -> tuple[str, int]:
    """Status and iterations of the last call; sqpmethod's stats() throws when it never set a status."""
    try:
        stats = solve.stats()
    except RuntimeError:
        return "No_Status", 0
    return str(stats["return_status"]), int(stats["iter_count"])


def _problem(nlp: Nlp) -> dict[str, ca.SX]:
    return {"x": nlp.x, "p": nlp.p, "f": nlp.objective, "g": nlp.g}


COMMON: dict[str, Any] = {
    "print_time": False,
    "calc_lam_p": False,
    "show_eval_warnings": False,
    "error_on_fail": False,
}


def _ipopt(nlp: Nlp) -> ca.Function:
    """IPOPT with exact Hessians, warm-started in primal and dual.

    mu_init 1e-4 with mu_min 1e-9: smaller values end in maximum iterations on bounds where samples cross
    from tube to tube and second derivatives jump.
    """
    options = {
        "sb": "yes",
        "print_level": 0,
        "max_iter": 300,
        "tol": 1e-8,
        "bound_relax_factor": 1e-10,
        "warm_start_init_point": "yes",
        "mu_strategy": "adaptive",
        "mu_init": 1e-4,
        "mu_min": 1e-9,
        "warm_start_bound_push": 1e-9,
        "warm_start_bound_frac": 1e-9,
        "warm_start_slack_bound_push": 1e-9,
        "warm_start_slack_bound_frac": 1e-9,
        "warm_start_mult_bound_push": 1e-9,
    }
    return ca.nlpsol("ipopt", "ipopt", _problem(nlp), COMMON | {"ipopt": options})


def _sqp(nlp: Nlp) -> ca.Function:
    """CasADi's sqpmethod over qrqp: damped Gauss-Newton, or BFGS where the objective has other terms.

    An indefinite Hessian makes it report success at poor points, and with its default of 3 line-search
    steps it cycles where second derivatives jump.
    """
    options: dict[str, Any] = {
        "qpsol": "qrqp",
        "qpsol_options": {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False},
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "max_iter": 200,
        "max_iter_ls": 20,
        "beta": 0.5,
    }
    if nlp.costs:
        options["hessian_approximation"] = "limited-memory"
    else:
        options["hess_lag"] = _gauss_newton(nlp)
    return ca.nlpsol("sqp", "sqpmethod", _problem(nlp), COMMON | options)


def _with_a_row(nlp: Nlp) -> Nlp:
    """The same problem with at least one constraint, if need be a free one.

    Without any row, qrqp (casadi 3.8.2) reads and writes past its memory.
    """
    free = Constraint("free", nlp.x[0], np.array([-np.inf]), np.array([np.inf]))
    return nlp if nlp.constraints else replace(nlp, constraints=(free,))


def _gauss_newton(nlp: Nlp) -> ca.Function:
    jacobian = ca.jacobian(nlp.residual, nlp.x)
    lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", nlp.g.numel())
    hessian = 2 * lam_f * (jacobian.T @ jacobian + DAMPING * ca.SX.eye(nlp.x.numel()))
    names = ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"]
    return ca.Function("nlp_hess_l", [nlp.x, nlp.p, lam_f, lam_g], [hessian], *names, {"cse": True})


DAMPING = 1e-3
"""Added to the diagonal of the Gauss-Newton Hessian, mm^2 per squared unit of x."""

SOLVERS: dict[str, Callable[[Nlp], ca.Function]] = {"ipopt": _ipopt, "sqp": _sqp}
"""Every solver by the name that options use."""
