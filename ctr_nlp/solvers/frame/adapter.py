"""What solves one Nlp after another: the call that all solvers share, and IPOPT behind it."""

from __future__ import annotations

import functools
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.nlp.nlp import Nlp, kkt_residual
from ctr_nlp.typing import Array

FEASIBLE = 1e-6
"""A point that leaves bounds or constraints by more than this (rad, mm) is no solution, whatever a solver says."""
OPTIMAL = 1e-2
"""Nor is one with a larger KKT residual (mm^2 per rad or mm); most solves reach 1e-6."""

KEPT = 16
"""Programs for which a process keeps IPOPT."""


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


class Reach(NamedTuple):
    """Limits of a configuration (k,), and by how much its entries may change from frame to frame."""

    low: Array
    high: Array
    most: Array


class Surroundings(NamedTuple):
    """What gives the parameters of a program that hold near a robot only, where a slack is its last unknown.

    call, of: addresses of a function of C and of what it is given first, then x, then the parameter named load
    where the program has it, then room for the parameter named described and, after it, the slack needed there,
    mm. Slack costs the parameter named weight a mm, mm^2, hard times as much beyond the parameter named allowed,
    mm, where that sets in over rounded mm, and firm a mm^2. A frame is solved again around its solution until that
    needs the same slack within settled mm, or rounds times.
    """

    call: int
    of: int
    load: str
    described: str
    weight: str
    allowed: str
    firm: float
    hard: float
    rounded: float
    settled: float
    rounds: int


class Timed(NamedTuple):
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

        lower, upper: bounds of the configuration, where they are not the program's own. warm: the solution of a
        neighbouring problem, whose multipliers to start from.
        """

    def follow(
        self,
        x0: Array,
        p: Array,
        reach: Reach,
        here: Array,
        warm: Solution | None,
        near: Surroundings | None = None,
    ) -> list[Timed]:
        """Solutions for parameters p (frames, n_p), each from the one before, up to the first that is not found.

        Those named previous are the configuration here (k,) before the first, then the last that was found. near:
        what gives parameters that hold near a robot only. A solver that takes one program at a time finds none.
        """
        return []

    def each(self, x0: Array, p: Array, reach: Reach) -> list[Solution]:
        """The solutions for parameters p (n_p,) from starts x0 (starts, n), without those that are not found."""
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
        """As NlpSolver."""
        n, (low, high) = len(x0), self.nlp.row_bounds(lower, upper)
        arguments: dict[str, Any] = {
            "p": p,
            "lbx": low[:n],
            "ubx": high[:n],
            "lbg": low[n:],
            "ubg": high[n:],
        }
        if warm is not None:
            arguments |= {"lam_x0": warm.lam_x, "lam_g0": warm.lam_g}
        result = self._solve(x0=np.clip(x0, low[:n], high[:n]), **arguments)
        status, iterations = outcome(self._solve)
        x, lam_x, lam_g = (result[key].full().ravel() for key in ("x", "lam_x", "lam_g"))
        g = result["g"].full().ravel()
        rows = np.concatenate([x, g])
        violation = np.maximum(low - rows, rows - high).max()
        x = np.clip(x, low[:n], high[:n])
        kkt = kkt_residual(self.nlp, x, p, lower, upper, lam_x, lam_g)
        success = bool(violation <= FEASIBLE) and kkt <= OPTIMAL
        q = np.concatenate([x, g])[self.nlp.configuration]
        return Solution(x, float(result["f"]), kkt, success, status, iterations, lam_x, lam_g, q)


@functools.lru_cache(maxsize=KEPT)
def _ipopt(nlp: Nlp, thread: int) -> ca.Function:
    """IPOPT for a program; two threads must not share one."""
    problem = {"x": nlp.x, "p": nlp.p, "f": nlp.objective, "g": nlp.g}
    return ca.nlpsol("ipopt", "ipopt", problem, COMMON | {"ipopt": OPTIONS})


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
