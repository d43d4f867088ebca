"""What solves one Nlp after another: the call that all solvers share, and IPOPT behind it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.nlp.nlp import Nlp, kkt_residual
from ctr_nlp.typing import Array

FEASIBLE = 1e-6
"""A point that leaves bounds or constraints by more than this (rad, mm) is no solution, whatever a solver says."""
OPTIMAL = 1e-2
"""Nor is one with a larger KKT residual (mm^2 per rad or mm); most solves reach 1e-6."""


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    x (n,); objective mm^2; kkt: residual computed from the Nlp alone; success: the point is finite, feasible and a
    KKT point, whatever the solver says; status: the solver's own word; lam_x, lam_g: multipliers to warm-start
    from; q: the configuration at x.
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


class NlpSolver(ABC):
    """A solver built for one Nlp, called for any start, parameters and bounds; not from two threads at once."""

    def __init__(self, nlp: Nlp) -> None:
        """Build."""
        self.nlp = nlp

    def __call__(
        self,
        x0: Array,
        p: Array,
        lower: Array | None = None,
        upper: Array | None = None,
        warm: Solution | None = None,
    ) -> Solution:
        """Solve from x0 (n,) for packed parameters p, with bounds that default to the Nlp's own.

        warm: the solution of a neighbouring problem, whose multipliers to start from.
        """
        low, high = self.nlp.limits
        return self.solve(x0, p, low if lower is None else lower, high if upper is None else upper, warm)

    @abstractmethod
    def solve(self, x0: Array, p: Array, low: Array, high: Array, warm: Solution | None) -> Solution:
        """As __call__; x0 may lie outside the bounds."""


class Ipopt(NlpSolver):
    """IPOPT with exact Hessians, warm-started in primal and dual.

    mu_init 1e-4 with mu_min 1e-9: smaller values end in maximum iterations on bounds where samples cross
    from tube to tube and second derivatives jump.
    """

    def __init__(self, nlp: Nlp) -> None:
        """Build."""
        super().__init__(nlp)
        problem = {"x": nlp.x, "p": nlp.p, "f": nlp.objective, "g": nlp.g}
        self._solve = ca.nlpsol("ipopt", "ipopt", problem, COMMON | {"ipopt": OPTIONS})

    def solve(self, x0: Array, p: Array, low: Array, high: Array, warm: Solution | None) -> Solution:
        """As NlpSolver."""
        n, (lower, upper) = len(x0), self.nlp.row_bounds(low, high)
        arguments: dict[str, Any] = {
            "p": p,
            "lbx": lower[:n],
            "ubx": upper[:n],
            "lbg": lower[n:],
            "ubg": upper[n:],
        }
        if warm is not None:
            arguments |= {"lam_x0": warm.lam_x, "lam_g0": warm.lam_g}
        result = self._solve(x0=np.clip(x0, lower[:n], upper[:n]), **arguments)
        status, iterations = outcome(self._solve)
        x, lam_x, lam_g = (result[key].full().ravel() for key in ("x", "lam_x", "lam_g"))
        g = result["g"].full().ravel()
        rows = np.concatenate([x, g])
        violation = np.maximum(lower - rows, rows - upper).max()
        x = np.clip(x, lower[:n], upper[:n])
        kkt = kkt_residual(self.nlp, x, p, low, high, lam_x, lam_g)
        success = bool(violation <= FEASIBLE) and kkt <= OPTIMAL
        q = np.concatenate([x, g])[self.nlp.configuration]
        return Solution(x, float(result["f"]), kkt, success, status, iterations, lam_x, lam_g, q)


def outcome(solve: ca.Function) -> tuple[str, int]:
    """Status and iterations of the last call."""
    stats = solve.stats()
    return str(stats["return_status"]), int(stats["iter_count"])


COMMON: dict[str, Any] = {
    "print_time": False,
    "calc_lam_p": False,
    "show_eval_warnings": False,
    "error_on_fail": False,
}


OPTIONS: dict[str, Any] = {
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
