"""An Nlp in C: the SQP method of sqp.c with the program's functions, compiled, or interpreted until they are.

C and Python share memory: a Program's arrays are read and written by sqp.c in place. Structures here repeat the
fields of the structs in C, in the same order.
"""

from __future__ import annotations

import ctypes
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.c_structures import check_structure
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.solvers.compiled_functions import library
from ctr_nlp.typing import Array

SQP_KKT_TOLERANCE = 1e-6
"""Largest KKT residual at a solution, mm^2 per unit of x."""
MAX_SQP_ITERATIONS = 200
"""Iterations after which a program ends without a solution; IPOPT solving it instead takes as long as a
thousand.
"""
SQP_FUNCTION_NAMES = FrameFunctions._fields[:3]
"""Names of the functions, and of the struct's fields that point to them."""

_Numbers = ctypes.POINTER(ctypes.c_double)
_Called = ctypes.CFUNCTYPE(
    ctypes.c_int,
    ctypes.POINTER(_Numbers),
    ctypes.POINTER(_Numbers),
    ctypes.c_void_p,
    ctypes.c_void_p,
    ctypes.c_int,
)
"""Signature of CasADi's functions in C: (arguments, results, integer work, real work, memory) -> 0 for success."""


class SqpProgramStruct(ctypes.Structure):
    """The struct Program of sqp.c: inputs and results of a run."""

    objective: float
    kkt: float
    violation: float
    iterations: int
    expansions: int
    evaluations: int
    status: int
    _fields_ = [
        *((name, ctypes.c_long) for name in ("n", "m")),
        *((name, ctypes.c_void_p) for name in (*SQP_FUNCTION_NAMES, "p", "lower", "upper")),
        ("tolerance", ctypes.c_double),
        ("most", ctypes.c_long),
        *((name, ctypes.c_void_p) for name in ("x", "multipliers", "rows")),
        *((name, ctypes.c_double) for name in ("objective", "kkt", "violation")),
        *((name, ctypes.c_long) for name in ("iterations", "expansions", "evaluations", "status")),
    ]


class Program:
    """A program whose arrays are filled before a run and read after it; not from two threads at once.

    x (n,): the start, then the solution. p: packed parameters. lower, upper (n + m,): bounds of x and of the
    constraints. multipliers (n + m,): of these, positive at upper bounds; rows (n + m,): their values at the
    solution. functions: their addresses, by name.
    """

    def __init__(self, nlp: Nlp, wait: bool = False, max_iterations: int = MAX_SQP_ITERATIONS) -> None:
        """Build a program in C for an Nlp.

        wait: until the functions are compiled, instead of interpreting them at first. max_iterations: largest
        number of iterations of a run. Raises OptionError where nothing can be compiled.
        """
        n = nlp.x.numel()
        m = nlp.g.numel()
        low, high = nlp.g_bounds
        self.nlp = nlp
        # x's own bounds and the constraints' in one array, as sqp.c treats both as rows.
        self.lower = np.concatenate([nlp.lower, low])
        self.upper = np.concatenate([nlp.upper, high])
        self.p = np.zeros(nlp.p.numel())
        self.x = np.zeros(n)
        self.multipliers = np.zeros(n + m)
        self.rows = np.zeros(n + m)
        given = (array.ctypes.data for array in (self.p, self.lower, self.upper))
        found = (array.ctypes.data for array in (self.x, self.multipliers, self.rows))
        # Kept, as the struct is made again when compiled functions are loaded.
        self._sizes = (n, m)
        self._places = (*given, SQP_KKT_TOLERANCE, max_iterations, *found)
        loaded = cache.load_c_files(__package__, "sqp.c", "run.c")
        check_structure(loaded, "Program", SqpProgramStruct)
        self._run = loaded.sqp
        self._keep = list[Any]()
        self._point({})
        self._library = library(nlp, 1)
        # Without `wait`, the first solves are interpreted while another process compiles.
        self.compiled = self._load(self._library.wait_for_path() if wait else self._library.path_if_ready())
        if not self.compiled:
            self._interpret()

    def _load(self, path: Any) -> bool:
        """Load the functions from the library at `path`; False where that is None, not made yet."""
        if path is None:
            return False
        loaded = ctypes.CDLL(str(path))
        # Addresses do not keep a library or a callback alive; this reference does.
        self._keep = [loaded]
        self._point({name: ctypes.cast(loaded[name], ctypes.c_void_p).value or 0 for name in SQP_FUNCTION_NAMES})
        return True

    def _interpret(self) -> None:
        """Let C call CasADi's interpreter until the compiled functions can be loaded."""
        self._keep = [_callback(function) for function in self.nlp.functions[:3]]
        addresses = (ctypes.cast(call, ctypes.c_void_p).value or 0 for call, _ in self._keep)
        self._point(dict(zip(SQP_FUNCTION_NAMES, addresses, strict=True)))

    def _point(self, addresses: dict[str, int]) -> None:
        """Point the struct to functions by their addresses; a new struct, so that nothing of the old one stays."""
        self.functions = addresses
        self._program = SqpProgramStruct(
            *self._sizes, *(addresses.get(name) for name in SQP_FUNCTION_NAMES), *self._places
        )
        self._reference = ctypes.byref(self._program)

    @property
    def address(self) -> int:
        """Address of the struct in C; it changes when compiled functions are loaded."""
        return ctypes.addressof(self._program)

    def refresh(self) -> None:
        """Load compiled functions, if they have been made meanwhile."""
        if not self.compiled:
            self.compiled = self._load(self._library.path_if_ready())

    def run(self) -> SqpProgramStruct:
        """Solve; the results beside x, multipliers and rows are overwritten by the next run."""
        self.refresh()
        self._run(self._reference)
        return self._program


def _callback(function: ca.Function) -> tuple[Any, Any]:
    """Return a CasADi function as a callback for C, and the objects that must outlive it.

    The callback has the signature of the functions that casadi.external loads.
    """
    buffer, evaluate = function.buffer()
    inputs = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
    outputs = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
    for i, array in enumerate(inputs):
        # The buffer evaluates between fixed arrays, without allocation; C's arguments are copied in and
        # out.
        buffer.set_arg(i, array.data)  # type: ignore[call-arg]
    for i, array in enumerate(outputs):
        buffer.set_res(i, array.data)  # type: ignore[call-arg]

    def called(given: Any, wanted: Any, *_: Any) -> int:
        for i, array in enumerate(inputs):
            _copy_unless_null(array, given[i], array.ctypes.data, given[i])
        evaluate()
        # By CasADi's convention, a null pointer is a result that is not wanted (or an argument of zeros, of
        # which sqp.c has none).
        for i, array in enumerate(outputs):
            _copy_unless_null(array, wanted[i], wanted[i], array.ctypes.data)
        return 0

    return _Called(called), (buffer, inputs, outputs)


def _copy_unless_null(array: Array, pointer: Any, to: Any, source: Any) -> None:
    """Copy array.nbytes bytes from source to `to`, unless C's `pointer` is null."""
    if pointer:
        ctypes.memmove(to, source, array.nbytes)
