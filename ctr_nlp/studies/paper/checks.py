"""What the paper says, what this run finds, and whether the two agree; decided by numbers alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.typing import Array

PRINTED = 2
"""Decimals of the paper's tables: closer numbers are the same."""


@dataclass(frozen=True)
class Check:
    """A statement, what is found here, and in how many of the cases it is about it holds.

    about = 0: nothing was published that could be compared. asked: it is not the paper's, but asked here.
    """

    says: str
    finds: str
    holds: int
    about: int
    asked: bool = False

    @property
    def verdict(self) -> str:
        """In a word or two."""
        if not self.about:
            return "not comparable"
        if not self.holds:
            return "does not hold" if self.asked else "does not agree"
        word = "holds" if self.asked else "agrees"
        return word if self.holds == self.about else f"{word} in {self.holds} of {self.about}"

    @property
    def whose(self) -> str:
        """Who says so."""
        return "Asked here" if self.asked else "The paper"


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence; "none" for none."""
    if not names:
        return "none"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def named(holds: Mapping[str, bool]) -> str:
    """On which it holds and on which not, in words."""
    yes, no = ([name for name, value in holds.items() if value is wanted] for wanted in (True, False))
    if not no:
        return "on all"
    return f"on {listed(yes)}, not on {listed(no)}" if yes else "on none"


def order(ours: float, published: float) -> str:
    """Whether a number is lower than, higher than or the same as a published one, as far as that was printed."""
    rounded = round(ours, PRINTED)
    return "the same" if rounded == published else "lower" if rounded < published else "higher"


def orders(pairs: Mapping[str, tuple[float, float]]) -> str:
    """By name, which of ours are lower, higher and the same; nothing for what does not occur."""
    found = {name: order(*pair) for name, pair in pairs.items()}
    parts = [
        f"{word} on {listed([name for name, its in found.items() if its == word])}"
        for word in ("lower", "the same", "higher")
        if word in found.values()
    ]
    return ", ".join(parts)


def number(value: Any) -> float:
    """A number of a row; infinite where none exists since no frame was reached."""
    return math.inf if value is None else float(value)


def part(e2: Array, begin: float, end: float) -> float:
    """RMS in mm of the errors e2 (T,) of frames between two parts, 0 to 1, of a motion; of one frame at least."""
    first = min(round(begin * len(e2)), len(e2) - 1)
    return float(np.sqrt(np.mean(e2[first : max(first + 1, round(end * len(e2)))] ** 2)))
