"""A function of one frame for all frames of a motion."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import casadi as ca
import numpy as np

from ctr_nlp.codegen.language import LANES
from ctr_nlp.typing import Array

_WHOLE = ctypes.CFUNCTYPE(None)
_tapes: dict[ca.Function, ctypes._FuncPointer] = {}
"""What evaluates any number of rows, of functions that were loaded as tapes."""


def external(name: str, path: str) -> ca.Function:
    """A function from a library of tape.tape_code: that of LANES frames side by side, and of one for Mapped."""
    function = ca.external(name, path)
    _tapes[function] = ctypes.CDLL(path)[f"{name}_rows"]
    return function


_FIELDS = ctypes.c_void_p * 4, ctypes.c_void_p * 5


class InC(ctypes.Structure):
    """A mapped function for C: the struct Mapped of solvers/motion/banded.c."""

    _fields_ = [
        ("of_rows", ctypes.c_void_p),
        ("whole", _WHOLE),
        ("rows", ctypes.c_long),
        *zip(("in", "out"), _FIELDS, strict=True),
    ]


class Mapped:
    """A function of one frame evaluated for all, without copies on the way; a row a frame.

    inputs, outputs: arrays (T, entries) that the function reads and writes. What a call returns is overwritten
    by the next.
    """

    def __init__(self, function: ca.Function, frames: int) -> None:
        self._tape = _tapes.get(function)
        lanes = 1 if self._tape is None else LANES
        self.inputs = [np.zeros((frames, function.numel_in(i) // lanes)) for i in range(function.n_in())]
        self.outputs = [np.zeros((frames, function.numel_out(i) // lanes)) for i in range(function.n_out())]
        self._rows = ctypes.c_long(frames)
        self._run = self._interpreted(function.map(frames)) if self._tape is None else self._played(self._tape)

    @property
    def _arrays(self) -> tuple[list[Array], list[Array]]:
        return self.inputs, self.outputs

    def _played(self, tape: Callable[..., int]) -> Callable[[], None]:
        """What evaluates a function of all frames, by its tape."""
        places = [(ctypes.c_void_p * len(arrays))(*map(_address, arrays)) for arrays in self._arrays]

        def run() -> None:
            if tape(*places, self._rows):
                raise MemoryError

        return run

    def _interpreted(self, function: ca.Function) -> Callable[[], None]:
        """The same, by CasADi; function: mapped over them."""
        self._buffer, run = function.buffer()
        for put, arrays in zip((self._buffer.set_arg, self._buffer.set_res), self._arrays, strict=True):
            for i, array in enumerate(arrays):
                put(i, array.data)  # type: ignore[call-arg]
        return run

    def __call__(self, x: Array, *multipliers: Array) -> list[Array]:
        """Results (T, entries) at x (T n,), for a row of parameters each, and multipliers where it takes any.

        Raises MemoryError.
        """
        for array, values in zip(self.inputs[:1] + self.inputs[2:], (x, *multipliers), strict=True):
            array.ravel()[:] = values
        self._run()
        return self.outputs

    def in_c(self) -> InC:
        """The same for C, as long as this lives."""
        of_rows = None if self._tape is None else ctypes.cast(self._tape, ctypes.c_void_p)
        into, out = (kind(*map(_address, arrays)) for kind, arrays in zip(_FIELDS, self._arrays, strict=True))
        return InC(of_rows, _WHOLE(self._run) if self._tape is None else _WHOLE(), self._rows, into, out)


def _address(array: Array) -> int:
    return array.ctypes.data
