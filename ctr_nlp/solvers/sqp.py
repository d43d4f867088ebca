"""Sequential quadratic programming for one frame, compiled: the whole iteration is C.

Hessians are exact. A step is the solution of a quadratic problem by Goldfarb and Idnani's dual method (Math.
Program. 27, 1983); where the Hessian is not positive definite, curvature is added across the rows that are active
and, where that is not enough, the eigenvalues lose their signs. Steps are shortened until the l1 merit function
falls (Nocedal and Wright, Numerical Optimization, 2006, chapter 18).
"""

from __future__ import annotations

import ctypes
import functools
from importlib.resources import files

import numpy as np
import numpy.typing as npt

from ctr_nlp.nlp import Nlp
from ctr_nlp.solvers import cache, compiled

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest KKT residual at a solution, mm^2 per unit of x."""
STATUS = "Solve_Succeeded", "Maximum_Iterations_Exceeded", "Search_Direction_Becomes_Too_Small", "Infeasible_Step"


class _Problem(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_long) for name in ("n", "m")),
        *((name, ctypes.c_void_p) for name in ("value", "slopes", "expansion", "p", "lower", "upper")),
        ("tolerance", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("x", "multipliers")),
        *((name, ctypes.c_double) for name in ("objective", "kkt")),
        *((name, ctypes.c_long) for name in ("iterations", "expansions", "evaluations", "status")),
    ]


@functools.cache
def _sqp() -> ctypes.CDLL:
    code = files(__package__).joinpath("sqp.c").read_text(encoding="utf-8")
    return ctypes.CDLL(str(cache.library(code, lambda: code)))


class Sqp:
    """One Nlp in C; its arrays are filled, and read again after a run. Not for two threads at once.

    x (n,): the start, then the solution. p: packed parameters. lower, upper (n + m,): bounds of x and of the
    constraints. multipliers (n + m,): of these, positive at upper bounds.
    """

    def __init__(self, nlp: Nlp) -> None:
        """Build; raises OptionError where nothing can be compiled."""
        n, m = nlp.x.numel(), nlp.g.numel()
        self._functions = ctypes.CDLL(str(compiled.library(nlp, 1)))
        self.x, self.p, self.multipliers = np.zeros(n), np.zeros(nlp.p.numel()), np.zeros(n + m)
        low, high = nlp.g_bounds
        self.lower, self.upper = np.concatenate([nlp.lower, low]), np.concatenate([nlp.upper, high])
        value, slopes, expansion = (
            ctypes.cast(getattr(self._functions, name), ctypes.c_void_p) for name in ("value", "slopes", "expansion")
        )
        p, lower, upper, x, multipliers = (
            array.ctypes.data for array in (self.p, self.lower, self.upper, self.x, self.multipliers)
        )
        self.found = _Problem(n, m, value, slopes, expansion, p, lower, upper, TOLERANCE, x, multipliers)
        self._run = _sqp().sqp
        self._reference = ctypes.byref(self.found)

    def run(self) -> None:
        """Solve; objective, KKT residual, iterations and status are then in `found`."""
        self._run(self._reference)
