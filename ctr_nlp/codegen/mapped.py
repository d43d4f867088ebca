"""A function of one frame, or of a few side by side, for all frames of a motion."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np

from ctr_nlp.typing import Array

_WHOLE = ctypes.CFUNCTYPE(None)


class InC(ctypes.Structure):
    """A mapped function for C: the struct Mapped of solvers/motion/banded.c."""

    _fields_ = [
        ("function", ctypes.c_void_p),
        ("whole", _WHOLE),
        *((name, ctypes.c_long) for name in ("calls", "inputs", "outputs")),
        ("in", ctypes.c_void_p * 4),
        ("out", ctypes.c_void_p * 5),
        ("in_steps", ctypes.c_long * 4),
        ("out_steps", ctypes.c_long * 5),
    ]


class Mapped:
    """A function of `lanes` frames at once evaluated for all, without copies on the way; a row a frame.

    inputs, outputs: arrays (T, entries) that the function reads and writes. What a call returns is overwritten
    by the next. function: of a few frames.
    """

    def __init__(self, function: ca.Function, frames: int, lanes: int) -> None:
        calls = -(-frames // lanes)
        self.function, self._calls = function, calls
        self._function = function.map(calls)
        self._buffer, self._run = self._function.buffer()
        sizes_in, sizes_out = self._function.numel_in, self._function.numel_out
        whole_in = [np.zeros((calls * lanes, sizes_in(i) // (calls * lanes))) for i in range(function.n_in())]
        whole_out = [np.zeros((calls * lanes, sizes_out(i) // (calls * lanes))) for i in range(function.n_out())]
        for i, array in enumerate(whole_in):
            self._buffer.set_arg(i, array.data)  # type: ignore[call-arg]
        for i, array in enumerate(whole_out):
            self._buffer.set_res(i, array.data)  # type: ignore[call-arg]
        self.inputs = [array[:frames] for array in whole_in]
        self.outputs = [array[:frames] for array in whole_out]

    def __call__(self, x: Array, *multipliers: Array) -> list[Array]:
        """Results (T, entries) at x (T n,), for a row of parameters each, and multipliers where it takes any."""
        for array, values in zip(self.inputs[:1] + self.inputs[2:], (x, *multipliers), strict=True):
            array.ravel()[:] = values
        self._run()
        return self.outputs

    def in_c(self, address: int | None) -> InC:
        """The same for C, as long as this lives; address: of the function in memory, None where it has none."""
        sizes_in = [self.function.numel_in(i) for i in range(len(self.inputs))]
        sizes_out = [self.function.numel_out(i) for i in range(len(self.outputs))]
        places = ([array.ctypes.data for array in arrays] for arrays in (self.inputs, self.outputs))
        whole = _WHOLE(self._run) if address is None else _WHOLE()
        into, out = (
            kind(*values) for kind, values in zip((ctypes.c_void_p * 4, ctypes.c_void_p * 5), places, strict=True)
        )
        steps = (ctypes.c_long * 4)(*sizes_in), (ctypes.c_long * 5)(*sizes_out)
        return InC(address, whole, self._calls, len(sizes_in), len(sizes_out), into, out, *steps)
