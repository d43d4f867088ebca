"""Sequential quadratic programming for one frame, compiled: the whole iteration is C.

Hessians are exact. A step is the solution of a quadratic problem by Goldfarb and Idnani's dual method (Math.
Program. 27, 1983); where the Hessian is not positive definite, curvature is added across the rows that are active
and, where that is not enough, the eigenvalues lose their signs. Steps are shortened until the l1 merit function
falls (Nocedal and Wright, Numerical Optimization, 2006, chapter 18).
"""

from __future__ import annotations

import ctypes
from dataclasses import replace

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.nlp.nlp import FrameFunctions, Nlp
from ctr_nlp.solvers import compiled
from ctr_nlp.solvers.frame.adapter import FEASIBLE, OPTIMAL, Ipopt, NlpSolver, Solution
from ctr_nlp.typing import Array

TOLERANCE = 1e-6
"""Largest KKT residual at a solution, mm^2 per unit of x."""
FALLBACK = "by IPOPT after"
"""In the status of what was left to IPOPT."""
STATUS = "Solve_Succeeded", "Maximum_Iterations_Exceeded", "Search_Direction_Becomes_Too_Small", "Infeasible_Step"


class _Program(ctypes.Structure):
    objective: float
    kkt: float
    violation: float
    iterations: int
    expansions: int
    evaluations: int
    status: int
    _fields_ = [
        *((name, ctypes.c_long) for name in ("n", "m")),
        *((name, ctypes.c_void_p) for name in ("value", "slopes", "expansion", "p", "lower", "upper")),
        ("tolerance", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("x", "multipliers", "rows")),
        *((name, ctypes.c_double) for name in ("objective", "kkt", "violation")),
        *((name, ctypes.c_long) for name in ("iterations", "expansions", "evaluations", "status")),
    ]


class Sqp(NlpSolver):
    """Solves one Nlp; what it cannot solve is left to IPOPT, and the status says so."""

    def __init__(self, nlp: Nlp) -> None:
        """Build; raises OptionError where nothing can be compiled."""
        super().__init__(nlp)
        self.program, self._picks = Program(nlp), nlp.configuration
        self._ipopt: Ipopt | None = None

    def solve(self, x0: Array, p: Array, low: Array, high: Array, warm: Solution | None) -> Solution:
        """As NlpSolver."""
        at, n = self.program, len(x0)
        at.lower[self._picks], at.upper[self._picks], at.p[:] = low, high, p
        at.x[:] = np.clip(x0, at.lower[:n], at.upper[:n])
        at.multipliers[:] = 0.0 if warm is None else np.concatenate([warm.lam_x, warm.lam_g])
        found = at.run()
        x = np.clip(at.x, at.lower[:n], at.upper[:n])
        success = found.violation <= FEASIBLE and found.kkt <= OPTIMAL
        lam_x, lam_g = np.split(at.multipliers.copy(), [n])
        status, iterations = STATUS[found.status], found.iterations
        q = np.concatenate([x, at.rows[n:]])[self._picks]
        if success:
            return Solution(x, found.objective, found.kkt, True, status, iterations, lam_x, lam_g, q)
        self._ipopt = self._ipopt or Ipopt(self.nlp)
        other = self._ipopt(x0, p, low, high, warm)
        return replace(
            other, status=f"{other.status} {FALLBACK} {status}", iterations=other.iterations + iterations
        )


class Program:
    """An Nlp in C. Its arrays are filled, and read again after a run; not from two threads at once.

    x (n,): the start, then the solution. p: packed parameters. lower, upper (n + m,): bounds of x and of the
    constraints. multipliers (n + m,): of these, positive at upper bounds; rows (n + m,): their values at the
    solution. functions: their addresses, by name.
    """

    def __init__(self, nlp: Nlp) -> None:
        """Build; raises OptionError where nothing can be compiled."""
        n, m = nlp.x.numel(), nlp.g.numel()
        low, high = nlp.g_bounds
        self.lower, self.upper = np.concatenate([nlp.lower, low]), np.concatenate([nlp.upper, high])
        self.p, self.x, self.multipliers = np.zeros(nlp.p.numel()), np.zeros(n), np.zeros(n + m)
        self.rows = np.zeros(n + m)
        self._library = ctypes.CDLL(str(compiled.library(nlp, 1)))
        names = FrameFunctions._fields[:3]
        self.functions = {name: ctypes.cast(self._library[name], ctypes.c_void_p).value or 0 for name in names}
        given = (array.ctypes.data for array in (self.p, self.lower, self.upper))
        found = (array.ctypes.data for array in (self.x, self.multipliers, self.rows))
        self._program = _Program(n, m, *self.functions.values(), *given, TOLERANCE, *found)
        self._run, self._reference = cache.loaded(__package__, "sqp.c").sqp, ctypes.byref(self._program)

    def run(self) -> _Program:
        """Solve; what was found beside x and multipliers is overwritten by the next run."""
        self._run(self._reference)
        return self._program
