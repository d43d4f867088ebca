"""A frame's functions as machine code, by a C compiler where there is one."""

from __future__ import annotations

import functools
import inspect
from pathlib import Path

import casadi as ca

from ctr_nlp.codegen import background, cache, vector
from ctr_nlp.nlp import nlp as programs
from ctr_nlp.nlp.nlp import FrameFunctions, Nlp

KEPT = 64
"""Programs whose libraries a process remembers."""


def compiled(nlp: Nlp, lanes: int = vector.LANES) -> FrameFunctions:
    """A program's functions for so many frames at once; raises OptionError where nothing can be compiled."""
    return _external(str(library(nlp, lanes)), lanes)


def library(nlp: Nlp, lanes: int) -> Path:
    """The shared library of a program's functions, made now where it is not there; raises OptionError."""
    return cache.library(_key(nlp, lanes), lambda: vector.vector_code(tuple(nlp.functions[:3]), lanes))


def library_soon(nlp: Nlp, lanes: int) -> Path | None:
    """The same, or None while it is made in the background; raises OptionError."""
    return background.library(_key(nlp, lanes), lambda: nlp.functions[:3], lanes)


def fastest(nlp: Nlp) -> FrameFunctions:
    """A program's functions, compiled where that has been done; else they are interpreted."""
    path = None if cache.missing() else library_soon(nlp, vector.LANES)
    return nlp.functions if path is None else _external(str(path), vector.LANES)


@functools.lru_cache(maxsize=KEPT)
def _external(path: str, lanes: int) -> FrameFunctions:
    value, slopes, expansion = (ca.external(name, path) for name in FrameFunctions._fields[:3])
    return FrameFunctions(value, slopes, expansion, lanes)


@functools.lru_cache(maxsize=KEPT)
def _key(nlp: Nlp, lanes: int) -> str:
    """What the code depends on: the program itself, and what derives it and writes it."""
    problem = ca.Function("problem", [nlp.x, nlp.p], [nlp.objective, nlp.g]).serialize()
    return "\n".join([f"{lanes} lanes", ca.CasadiMeta.version(), _makers(), problem])


@functools.cache
def _makers() -> str:
    return inspect.getsource(programs) + inspect.getsource(vector)
