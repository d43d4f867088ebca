"""Commands as G-code: inverse time (G93), absolute millimetres and degrees, one straight piece a numbered line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MODES = "G21 G90 G93 G54"
"""Millimetres, absolute positions, F as 1 / (minutes that a line takes), and the first work offset, which is 0."""

DECIMALS = 4


def line(number: int, letters: Sequence[str], position: Array, seconds: float) -> str:
    """The line that goes straight to a position (m,) within so many s; every axis and F are on it."""
    words = " ".join(f"{letter}{value:.{DECIMALS}f}" for letter, value in zip(letters, position, strict=True))
    return f"N{number} G1 {words} F{60.0 / seconds:.{DECIMALS}f}"


def lines(letters: Sequence[str], positions: Array, time: Array) -> list[str]:
    """The lines, numbered from 1, of commands that end at time (N,) s and at positions (N, m)."""
    durations = np.diff(time, prepend=0.0)
    return [line(n, letters, p, dt) for n, (p, dt) in enumerate(zip(positions, durations, strict=True), start=1)]
