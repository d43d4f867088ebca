"""A frame's functions as machine code, where a C compiler is at hand, and interpreted by CasADi elsewhere.

The code of a program depends on the program and on the modules that derive it; both are part of the key under
which a library is cached.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable

import casadi as ca

from ctr_nlp.codegen import cache, vector
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.batch_evaluator import load_tape_function
from ctr_nlp.ocp import expressions, partition, sample_derivatives, sample_groups
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.nlp import Nlp

MAX_CACHED_LIBRARIES = 64
"""Number of programs whose libraries a process remembers."""


def compile_functions(nlp: Nlp, lanes: int | None = None) -> FrameFunctions:
    """Return the functions of the program `nlp` for `lanes` frames together, or for any number of them (None).

    Waits for the compiler. Raises OptionError where nothing can be compiled.
    """
    return _load_functions(str(library(nlp, lanes).wait_for_path()), lanes)


@functools.lru_cache(maxsize=MAX_CACHED_LIBRARIES)
def library(nlp: Nlp, lanes: int | None) -> Library:
    """Return the shared library of the functions of `nlp` for `lanes` frames together, or for any
    number (None).
    """
    # A tape (any number of frames) is made of the plain functions, straight code for one frame of the
    # functions in parts, with sample points evaluated together (ocp/partition.py).
    derived = (
        nlp.expressions.functions_to_compile
        if lanes is None
        else functools.partial(partition.partition_program, nlp.expressions)
    )
    return Library(f"{_derivation_source()}\n{nlp.expressions.function.serialize()}", derived, lanes)


@functools.cache
def _derivation_source() -> str:
    """Return the source of the modules that turn a program into functions: a change to them changes what is
    compiled.
    """
    return "".join(map(inspect.getsource, (expressions, sample_groups, sample_derivatives, partition)))


def fastest_functions(nlp: Nlp) -> Callable[[], FrameFunctions]:
    """Return a function that returns the functions of the program `nlp`.

    They are interpreted until the background process has compiled them.
    """
    return (lambda: nlp.functions) if cache.unavailable_reason() else _FastestFunctions(nlp)


class _FastestFunctions:
    """Returns interpreted functions until the library, which is made in the background, can be loaded."""

    def __init__(self, nlp: Nlp) -> None:
        self._nlp = nlp
        self._library = library(nlp, None)
        self._found: FrameFunctions | None = None

    def __call__(self) -> FrameFunctions:
        # Once found, the compiled functions stay; until then each call looks again.
        if self._found is None and (path := self._library.path_if_ready()) is not None:
            self._found = _load_functions(str(path), None)
        return self._found or self._nlp.functions


@functools.lru_cache(maxsize=MAX_CACHED_LIBRARIES)
def _load_functions(path: str, lanes: int | None) -> FrameFunctions:
    """Return the three functions of a library, loaded once a process."""
    # Libraries for any number of frames are tapes, whose row-wise entry point BatchEvaluator needs as well.
    load = load_tape_function if lanes is None else ca.external
    value, slopes, expansion = (load(name, path) for name in FrameFunctions._fields[:3])
    return FrameFunctions(value, slopes, expansion, lanes or vector.VECTOR_LANES)
