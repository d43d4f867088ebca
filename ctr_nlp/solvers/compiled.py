"""A frame's functions as machine code, by a C compiler where there is one."""

from __future__ import annotations

import ctypes
import functools
import inspect
from collections.abc import Callable

import casadi as ca

from ctr_nlp.codegen import cache, vector
from ctr_nlp.codegen.background import Library
from ctr_nlp.nlp import alike, at_place, parted, written
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.nlp.written import FrameFunctions

KEPT = 64
"""Programs whose libraries a process remembers."""


def compiled(nlp: Nlp, lanes: int = vector.LANES) -> FrameFunctions:
    """A program's functions for so many frames at once; raises OptionError where nothing can be compiled."""
    return _external(str(library(nlp, lanes).now()), lanes)


@functools.lru_cache(maxsize=KEPT)
def library(nlp: Nlp, lanes: int) -> Library:
    """The shared library of a program's functions, which depend on the program and on what derives it."""
    derived = nlp.written.derived if lanes > 1 else functools.partial(parted.parted, nlp.written)
    return Library(f"{_deriver()}\n{nlp.written.function.serialize()}", derived, lanes)


@functools.cache
def _deriver() -> str:
    return "".join(map(inspect.getsource, (written, alike, at_place, parted)))


def fastest(nlp: Nlp) -> Callable[[], FrameFunctions]:
    """What gives a program's functions: compiled as soon as that has been done, and interpreted until then."""
    return (lambda: nlp.functions) if cache.missing() else _Fastest(nlp)


class _Fastest:
    def __init__(self, nlp: Nlp) -> None:
        self._nlp, self._library = nlp, library(nlp, vector.LANES)
        self._found: FrameFunctions | None = None

    def __call__(self) -> FrameFunctions:
        if self._found is None and (path := self._library.soon()) is not None:
            self._found = _external(str(path), vector.LANES)
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
