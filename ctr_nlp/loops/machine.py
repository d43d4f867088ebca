"""Functions that loops evaluate: compiled and waited for, and interpreted where that cannot be."""

from __future__ import annotations

import functools

import casadi as ca

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.background import Library


def machine_code(function: ca.Function) -> ca.Function:
    """The same function of dense numbers, compiled once and kept."""
    if cache.missing():
        return function
    return ca.external(
        function.name(), str(Library(function.serialize(), functools.partial(tuple, (function,)), 1).now())
    )
