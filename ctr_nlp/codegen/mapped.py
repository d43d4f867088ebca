"""A function of one frame, or of a few side by side, for all frames of a motion."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctr_nlp.typing import Array


class Mapped:
    """A function of `lanes` frames at once evaluated for all, without copies on the way; a row a frame.

    inputs, outputs: arrays (T, entries) that the function reads and writes. What a call returns is overwritten
    by the next.
    """

    def __init__(self, function: ca.Function, frames: int, lanes: int) -> None:
        calls = -(-frames // lanes)
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
        self._outputs = [array[:frames] for array in whole_out]

    def __call__(self, x: Array, *multipliers: Array) -> list[Array]:
        """Results (T, entries) at x (T n,), for a row of parameters each, and multipliers where it takes any."""
        for array, values in zip(self.inputs[:1] + self.inputs[2:], (x, *multipliers), strict=True):
            array.ravel()[:] = values
        self._run()
        return self._outputs
