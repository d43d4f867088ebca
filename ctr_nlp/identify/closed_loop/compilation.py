"""Functions that loops evaluate: compiled and waited for, and interpreted where that cannot be."""

from __future__ import annotations

import functools

import casadi as ca

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.vector import SHARED_INPUT_PREFIX


def compile_function(function: ca.Function, lanes: int = 1) -> ca.Function:
    """Return a function of dense numbers as compiled code, built once and cached; interpreted where nothing can be
    compiled.

    lanes: number of columns that are computed side by side, except of inputs whose names begin with
    SHARED_INPUT_PREFIX (vector.vector_code).
    """
    if cache.unavailable_reason():
        shared = [name for name in function.name_in() if name.startswith(SHARED_INPUT_PREFIX)]
        return function.map(function.name(), "serial", lanes, shared, []) if lanes > 1 else function
    made = Library(function.serialize(), functools.partial(tuple, (function,)), lanes)
    return ca.external(function.name(), str(made.wait_for_path()))
