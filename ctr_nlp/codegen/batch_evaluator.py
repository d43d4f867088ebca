"""A function of one frame evaluated for all frames of a motion, from arrays with a row a frame.

A library of tapes has an entry point for any number of rows, which reads and writes numpy's arrays in place.
Interpreted functions are mapped by CasADi over the same arrays: a column-major matrix (entries, T) is the same
memory as a row-major array (T, entries).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from ctr_nlp.codegen.language import VECTOR_LANES
from ctr_nlp.typing import Array

_WHOLE_BATCH_CALLBACK = ctypes.CFUNCTYPE(None)
_tapes: dict[ca.Function, ctypes._FuncPointer] = {}
"""Entry points for any number of rows, of functions that were loaded as tapes."""


def load_tape_function(name: str, path: str) -> ca.Function:
    """Load the function `name` from `path`, a library of tape.tape_code, for VECTOR_LANES frames side by side.

    BatchEvaluator finds the entry point for any number of rows, which is noted here.
    """
    function = ca.external(name, path)
    _tapes[function] = ctypes.CDLL(path)[f"{name}_rows"]
    return function


_ARRAY_POINTER_TYPES = ctypes.c_void_p * 4, ctypes.c_void_p * 5
"""Pointers to at most four inputs (x, p, lam_f, lam_g) and five outputs (ocp.expressions.FrameFunctions)."""


class BatchStruct(ctypes.Structure):
    """A mapped function as C calls it: the struct Mapped of solvers/motion/banded.c."""

    _fields_ = [
        ("of_rows", ctypes.c_void_p),
        ("whole", _WHOLE_BATCH_CALLBACK),
        ("rows", ctypes.c_long),
        *zip(("in", "out"), _ARRAY_POINTER_TYPES, strict=True),
    ]


class BatchEvaluator:
    """A function of one frame, evaluated for all frames without copies; arrays have one row a frame.

    inputs, outputs: arrays (T, entries) that the function reads and writes. The arrays that a call returns are
    overwritten by the next.
    """

    def __init__(self, function: ca.Function, frames: int) -> None:
        """Allocate arrays for so many frames of a function, interpreted or loaded by `external`."""
        self._tape = _tapes.get(function)
        # A function loaded from a tape has VECTOR_LANES frames' columns; each row needs the entries of one.
        lanes = 1 if self._tape is None else VECTOR_LANES
        self.inputs = [np.zeros((frames, function.numel_in(i) // lanes)) for i in range(function.n_in())]
        self.outputs = [np.zeros((frames, function.numel_out(i) // lanes)) for i in range(function.n_out())]
        self._rows = ctypes.c_long(frames)
        # CasADi maps over columns; `map` evaluates them one after another within one call.
        self._run = (
            self._make_interpreted_call(function.map(frames))
            if self._tape is None
            else self._make_tape_call(self._tape)
        )

    @property
    def _arrays(self) -> tuple[list[Array], list[Array]]:
        return self.inputs, self.outputs

    def _make_tape_call(self, tape: Callable[..., int]) -> Callable[[], None]:
        """Return a call that evaluates the function by its tape."""
        # Addresses are taken once: inputs and outputs must never be replaced by other arrays, only filled.
        places = [(ctypes.c_void_p * len(arrays))(*map(_address, arrays)) for arrays in self._arrays]

        def run() -> None:
            if tape(*places, self._rows):
                raise MemoryError

        return run

    def _make_interpreted_call(self, function: ca.Function) -> Callable[[], None]:
        """Return a call that evaluates the function by CasADi; function: already mapped over all frames."""
        # The buffer is stored: `run` keeps no reference to it.
        self._buffer, run = function.buffer()
        for put, arrays in zip((self._buffer.set_arg, self._buffer.set_res), self._arrays, strict=True):
            for i, array in enumerate(arrays):
                put(i, array.data)  # type: ignore[call-arg]
        return run

    def __call__(self, x: Array, *multipliers: Array) -> list[Array]:
        """Return the results (T, entries) at x (T n,), and at multipliers if the function takes any.

        Parameters are those in `inputs[1]`.

        Raises MemoryError.
        """
        # inputs[1] are the parameters, which are filled beforehand and stay from call to call.
        for array, values in zip(self.inputs[:1] + self.inputs[2:], (x, *multipliers), strict=True):
            # ravel of a contiguous array is a view: values are copied into the array that the function
            # reads.
            array.ravel()[:] = values
        self._run()
        return self.outputs

    def as_struct(self) -> BatchStruct:
        """Return the function as a struct for C, valid as long as this object lives."""
        of_rows = None if self._tape is None else ctypes.cast(self._tape, ctypes.c_void_p)
        into, out = (
            kind(*map(_address, arrays)) for kind, arrays in zip(_ARRAY_POINTER_TYPES, self._arrays, strict=True)
        )
        # C calls the tape directly, or a Python callback that evaluates the interpreted function whole.
        return BatchStruct(
            of_rows,
            _WHOLE_BATCH_CALLBACK(self._run) if self._tape is None else _WHOLE_BATCH_CALLBACK(),
            self._rows,
            into,
            out,
        )


class PythonBatchEvaluator(BatchEvaluator):
    """A function of Python in the place of one of CasADi, evaluated for all frames."""

    def __init__(
        self,
        inputs: Sequence[tuple[int, int]],
        outputs: Sequence[tuple[int, int]],
        function: Callable[[list[Array], list[Array]], None],
    ) -> None:
        """Allocate inputs and outputs of these shapes, a row a frame, which the function reads and writes."""
        self._tape = None
        self.inputs = [np.zeros(shape) for shape in inputs]
        self.outputs = [np.zeros(shape) for shape in outputs]
        self._rows = ctypes.c_long(len(self.inputs[0]))
        self._run = lambda: function(self.inputs, self.outputs)


def _address(array: Array) -> int:
    """Return the address of an array's first entry."""
    return array.ctypes.data
