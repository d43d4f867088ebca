"""Commands as G-code: inverse time (G93), absolute millimetres and degrees, one straight piece a numbered line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.typing import Array

MEANING = "G21 G90 G93"
"""Millimetres, absolute positions, and F as 1 / (minutes that a line takes)."""

MODES = f"{MEANING} G54"
"""What a program begins with: also the first work offset, which is 0."""

DECIMALS = 4

LEAST_FEED = 1.0 / 60.0
"""Units/s: Grbl goes no slower, and a line in which nothing moves takes no time there."""


def line(number: int, letters: Sequence[str], position: Array, seconds: float, meaning: str = "") -> str:
    """The line that goes straight to a position (m,) within so many s; every axis and F are on it.

    meaning: words that it says besides, lest it means something else after another client's word.
    """
    rounded = np.round(position, DECIMALS) + 0.0
    words = " ".join(f"{letter}{value:.{DECIMALS}f}" for letter, value in zip(letters, rounded, strict=True))
    return f"N{number} {meaning}{' ' * bool(meaning)}G1 {words} F{60.0 / seconds:.{DECIMALS}f}"


def lines(letters: Sequence[str], start: Array, positions: Array, time: Array, meaning: str = "") -> list[str]:
    """The lines, numbered from 1, from start (m,) to positions (N, m) that are reached at time (N,) s.

    Where less would move than Grbl's least feed it waits (G4), and the next line makes up for it.
    """
    durations, there, found = np.diff(time, prepend=0.0), start, []
    for n, (position, seconds) in enumerate(zip(positions, durations, strict=True), start=1):
        if n < len(positions) and np.linalg.norm(position - there) < LEAST_FEED * seconds:
            found.append(f"N{n} G4 P{seconds:.{DECIMALS}f}")
        else:
            found.append(line(n, letters, position, seconds, meaning))
            there = position
    return found
