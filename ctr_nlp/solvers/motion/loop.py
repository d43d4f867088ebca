"""The iterations of a barrier method in C: the struct Loop of banded.c, and the iterate that it reports.

C runs several iterations before it returns to Python. The method is described in banded.py; barriers and
objectives are in mm^2.
"""

from __future__ import annotations

import ctypes

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.batch_evaluator import BatchStruct
from ctr_nlp.codegen.c_structures import check_structure
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.solvers.motion.rows import ChainRows
from ctr_nlp.solvers.motion.watch import Iterate
from ctr_nlp.typing import Array

LOOP_REAL_SETTINGS = (
    *("feasible", "last_barrier", "close", "shrink", "damping", "most_damping", "diverged"),
    *("loose", "stalled"),
)
"""Names of the real-valued settings, in the order of the struct's fields."""
LOOP_INTEGER_SETTINGS = "most_iterations", "most_halvings", "stall"
"""Names of the integer settings, in the order of the struct's fields."""


class _Loop(ctypes.Structure):
    """The struct Loop of banded.c, field by field."""

    tolerance: float
    barrier: float
    penalty: float
    number: int
    expanded: int
    merits: int
    known: int
    told_number: int
    told_objective: float
    told_violation: float
    told_error: float
    _fields_ = [
        ("chain", ctypes.c_void_p),
        *((name, ctypes.POINTER(BatchStruct)) for name in ("values", "expansion")),
        *((name, ctypes.c_void_p) for name in ("x_of_values", "x_of_expansion", "multipliers")),
        *((name, ctypes.c_void_p) for name in ("hessian", "convexified", "merit", "told_x")),
        ("tolerance", ctypes.c_double),
        *((name, ctypes.c_double) for name in LOOP_REAL_SETTINGS),
        *((name, ctypes.c_long) for name in LOOP_INTEGER_SETTINGS),
        *((name, ctypes.c_double) for name in ("barrier", "penalty")),
        *((name, ctypes.c_long) for name in ("number", "expanded", "merits")),
        ("measures", ctypes.c_double * 6),
        *((name, ctypes.c_long) for name in ("known", "told_number")),
        *((name, ctypes.c_double) for name in ("told_objective", "told_violation", "told_error")),
    ]

    def start(self, barrier: float, tolerance: float) -> None:
        """Reset the counters, with a barrier in mm^2 and the KKT residual at which the method ends."""
        self.barrier = barrier
        self.tolerance = tolerance
        self.penalty = 1.0
        self.number = 0
        self.expanded = 0
        self.merits = 0


class Loop:
    """A barrier method on a chain, a number of iterations at a time; not from two threads at once."""

    def __init__(self, chain: Chain, numbers: dict[str, float], counts: dict[str, int]) -> None:
        """Prepare for a chain; numbers and counts by the names in LOOP_REAL_SETTINGS and LOOP_INTEGER_SETTINGS.
        Raises OptionError as ChainRows does.

        Functions of the chain that are compiled later are left to the next loop: C keeps addresses of arrays.
        """
        self._chain = chain = chain.with_fixed_functions()
        self.rows = ChainRows(chain)
        self._told = np.zeros(chain.lower.size)
        values, expansion = chain.evaluators()
        self._mapped = [each.as_struct() for each in (values, expansion)]
        # x of the values, x and the constraints' multipliers of the expansion: C writes these before it
        # evaluates.
        inputs = values.inputs[0], expansion.inputs[0], expansion.inputs[3]
        # Fifth result of the expansion, after objective, gradient, constraints and their Jacobian.
        hessian = expansion.outputs[4]
        # Room for the convexified Hessians, and for the merit of every iteration, by which stalling is
        # seen.
        self._room = np.empty_like(hessian), np.zeros(counts["most_iterations"] + 2)
        self._loop = _Loop(
            self.rows.address,
            *map(ctypes.pointer, self._mapped),
            *(array.ctypes.data for array in (*inputs, hessian, *self._room, self._told)),
            0.0,  # tolerance: each start has its own
            *(numbers[name] for name in LOOP_REAL_SETTINGS),
            *(counts[name] for name in LOOP_INTEGER_SETTINGS),
        )
        library = cache.load_c_files(__package__, "rows.c", "banded.c")
        check_structure(library, "Loop", _Loop)
        check_structure(library, "Mapped", BatchStruct)
        self._iterate = library.iterate
        self._reference = ctypes.byref(self._loop)

    def start(
        self, x: Array, barrier: float, push: float, tolerance: float, multipliers: Array | None = None
    ) -> None:
        """Put the point at x (T n,) with a barrier in mm^2; push and multipliers as in ChainRows.start.

        tolerance: largest stationarity (mm^2 per unit of x) and complementarity (mm^2) at a solution.
        """
        self.rows.start(x, barrier, push, multipliers)
        self._loop.start(barrier, tolerance)

    def iterate(self, points: int) -> int:
        """Run up to `points` further iterations; return why the solve ended, as numbered in banded.c, or 0."""
        status = int(self._iterate(self._reference, ctypes.c_long(points)))
        # C swaps the point with the trial by exchanging pointers; Python's views follow.
        self.rows.sync_swapped_points()
        return status

    @property
    def number(self) -> int:
        """Iterations done."""
        return self._loop.number

    @property
    def reported_iterate(self) -> Iterate | None:
        """The best feasible point of the last call, else its last point; None if there was none."""
        loop = self._loop
        numbers = loop.told_number, loop.told_objective, loop.told_violation, loop.told_error
        return Iterate(*numbers, self._told.copy()) if loop.known else None
