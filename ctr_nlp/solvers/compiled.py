"""A frame's functions as machine code, by a C compiler where there is one."""

from __future__ import annotations

import ctypes
import functools
import inspect
import time
from collections.abc import Callable
from pathlib import Path

import casadi as ca

from ctr_nlp.codegen import background, cache, vector
from ctr_nlp.nlp import nlp as programs
from ctr_nlp.nlp.nlp import FrameFunctions, Nlp

POLL = 0.5
"""s between two looks at whether a program has been compiled meanwhile."""
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


def fastest(nlp: Nlp) -> Callable[[], FrameFunctions]:
    """What gives a program's functions: compiled as soon as that has been done, and interpreted until then."""
    return (lambda: nlp.functions) if cache.missing() else _Fastest(nlp)


class _Fastest:
    def __init__(self, nlp: Nlp) -> None:
        self._nlp = nlp
        self._found: FrameFunctions | None = None
        self._looked = -POLL

    def __call__(self) -> FrameFunctions:
        if self._found is None and time.monotonic() - self._looked > POLL:
            path = library_soon(self._nlp, vector.LANES)
            self._found = None if path is None else _external(str(path), vector.LANES)
            self._looked = time.monotonic()
        return self._found or self._nlp.functions


@functools.lru_cache(maxsize=KEPT)
def _external(path: str, lanes: int) -> FrameFunctions:
    names = FrameFunctions._fields[:3]
    value, slopes, expansion = functions = [ca.external(name, path) for name in names]
    library = ctypes.CDLL(path)
    for name, function in zip(names, functions, strict=True):
        _addresses[function] = ctypes.cast(library[name], ctypes.c_void_p).value or 0
    return FrameFunctions(value, slopes, expansion, lanes)


_addresses: dict[ca.Function, int] = {}
"""Of functions that have been loaded."""


def address(function: ca.Function) -> int | None:
    """Where a compiled function is in memory, to be called by C as CasADi calls it; None of an interpreted one."""
    return _addresses.get(function)


@functools.lru_cache(maxsize=KEPT)
def _key(nlp: Nlp, lanes: int) -> str:
    """What the code depends on: the program itself, and what derives it and writes it."""
    problem = ca.Function("problem", [nlp.x, nlp.p], [nlp.objective, nlp.g]).serialize()
    return "\n".join([f"{lanes} lanes", ca.CasadiMeta.version(), _makers(), problem])


@functools.cache
def _makers() -> str:
    return inspect.getsource(programs) + inspect.getsource(vector)
