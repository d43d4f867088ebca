"""A frame's functions as machine code, by a C compiler where there is one."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable

import casadi as ca

from ctr_nlp.codegen import cache, vector
from ctr_nlp.codegen.background import Library
from ctr_nlp.codegen.mapped import external
from ctr_nlp.nlp import alike, at_place, parted, written
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.nlp.written import FrameFunctions

KEPT = 64
"""Programs whose libraries a process remembers."""


def compiled(nlp: Nlp, lanes: int | None = None) -> FrameFunctions:
    """A program's functions for one frame, or for any number (None) of them at once, as Library.

    Raises OptionError where nothing can be compiled.
    """
    return _external(str(library(nlp, lanes).now()), lanes)


@functools.lru_cache(maxsize=KEPT)
def library(nlp: Nlp, lanes: int | None) -> Library:
    """The shared library of a program's functions, which depend on the program and on what derives it."""
    derived = nlp.written.derived if lanes is None else functools.partial(parted.parted, nlp.written)
    return Library(f"{_deriver()}\n{nlp.written.function.serialize()}", derived, lanes)


@functools.cache
def _deriver() -> str:
    return "".join(map(inspect.getsource, (written, alike, at_place, parted)))


def fastest(nlp: Nlp) -> Callable[[], FrameFunctions]:
    """What gives a program's functions: compiled as soon as that has been done, and interpreted until then."""
    return (lambda: nlp.functions) if cache.missing() else _Fastest(nlp)


class _Fastest:
    def __init__(self, nlp: Nlp) -> None:
        self._nlp, self._library = nlp, library(nlp, None)
        self._found: FrameFunctions | None = None

    def __call__(self) -> FrameFunctions:
        if self._found is None and (path := self._library.soon()) is not None:
            self._found = _external(str(path), None)
        return self._found or self._nlp.functions


@functools.lru_cache(maxsize=KEPT)
def _external(path: str, lanes: int | None) -> FrameFunctions:
    load = external if lanes is None else ca.external
    value, slopes, expansion = (load(name, path) for name in FrameFunctions._fields[:3])
    return FrameFunctions(value, slopes, expansion, lanes or vector.LANES)
