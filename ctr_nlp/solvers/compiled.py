"""A frame's functions as machine code, by a C compiler where there is one."""

from __future__ import annotations

import functools
import inspect
from pathlib import Path

import casadi as ca

from ctr_nlp.codegen import cache, vector
from ctr_nlp.nlp import nlp as problems
from ctr_nlp.nlp.nlp import FrameFunctions, Nlp


def compiled(nlp: Nlp, lanes: int = vector.LANES) -> FrameFunctions:
    """An Nlp's functions for so many frames at once; raises OptionError where nothing can be compiled."""
    path = str(library(nlp, lanes))
    value, slopes, expansion = (ca.external(name, path) for name in FrameFunctions._fields[:3])
    return FrameFunctions(value, slopes, expansion, lanes)


def library(nlp: Nlp, lanes: int) -> Path:
    """The shared library of an Nlp's functions; raises OptionError."""
    return cache.library(
        f"{lanes} lanes\n{_key(nlp)}", lambda: vector.vector_code(tuple(nlp.functions[:3]), lanes)
    )


def fastest(nlp: Nlp) -> FrameFunctions:
    """An Nlp's functions, compiled where that is possible."""
    return nlp.functions if cache.missing() else compiled(nlp)


def _key(nlp: Nlp) -> str:
    """What the code depends on: the problem itself, and what derives it and writes it."""
    problem = ca.Function("problem", [nlp.x, nlp.p], [nlp.objective, nlp.g]).serialize()
    return "\n".join([ca.CasadiMeta.version(), _makers(), problem])


@functools.cache
def _makers() -> str:
    return inspect.getsource(problems) + inspect.getsource(vector)
