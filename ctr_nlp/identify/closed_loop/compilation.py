"""Functions evaluated in closed loops: compiled, which is waited for, or interpreted without a compiler."""

from __future__ import annotations

import functools

import casadi as ca

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.vector import SHARED_INPUT_PREFIX


def compile_function(function: ca.Function, lanes: int = 1) -> ca.Function:
    """Return a function of dense numbers as compiled code, built once and cached; interpreted without a compiler.

    function: the CasADi function. lanes: number of columns that are computed in parallel; inputs whose names begin
    with SHARED_INPUT_PREFIX are the same in all (codegen/vector.py).
    """
    if cache.unavailable_reason():
        shared = [name for name in function.name_in() if name.startswith(SHARED_INPUT_PREFIX)]
        return function.map(function.name(), "serial", lanes, shared, []) if lanes > 1 else function
    made = Library(function.serialize(), functools.partial(tuple, (function,)), lanes)
    return ca.external(function.name(), str(made.wait_for_path()))
