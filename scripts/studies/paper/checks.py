"""What the paper says, what this run finds, and whether the two agree; decided by numbers alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.typing import Array

PUBLISHED_DECIMALS = 2
"""Decimals of the paper's tables: closer numbers are the same."""


@dataclass(frozen=True)
class Check:
    """A statement, what is found here, and in how many of the cases it is about it holds.

    about = 0: nothing was published that could be compared. own_question: it is not the paper's, but asked here.
    """

    statement: str
    finding: str
    holds: int
    case_count: int
    own_question: bool = False

    @property
    def verdict(self) -> str:
        """In a word or two."""
        if not self.case_count:
            return "not comparable"
        if not self.holds:
            return "does not hold" if self.own_question else "does not agree"
        word = "holds" if self.own_question else "agrees"
        return word if self.holds == self.case_count else f"{word} in {self.holds} of {self.case_count}"

    @property
    def source(self) -> str:
        """Who says so."""
        return "Asked here" if self.own_question else "The paper"


def join_names(names: Sequence[str]) -> str:
    """Names as in a sentence; "none" for none."""
    if not names:
        return "none"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def where_it_holds(holds: Mapping[str, bool]) -> str:
    """On which it holds and on which not, in words."""
    yes, no = ([name for name, value in holds.items() if value is wanted] for wanted in (True, False))
    if not no:
        return "on all"
    return f"on {join_names(yes)}, not on {join_names(no)}" if yes else "on none"


def compare_with_published(ours: float, published: float) -> str:
    """Whether a number is lower than, higher than or the same as a published one, as far as that was printed."""
    rounded = round(ours, PUBLISHED_DECIMALS)
    return "the same" if rounded == published else "lower" if rounded < published else "higher"


def summarise_comparison(pairs: Mapping[str, tuple[float, float]]) -> str:
    """By name, which of ours are lower, higher and the same; nothing for what does not occur."""
    found = {name: compare_with_published(*pair) for name, pair in pairs.items()}
    parts = [
        f"{word} on {join_names([name for name, its in found.items() if its == word])}"
        for word in ("lower", "the same", "higher")
        if word in found.values()
    ]
    return ", ".join(parts)


def number(value: Any) -> float:
    """A number of a row; infinite where none exists since no frame was reached."""
    return math.inf if value is None else float(value)


def rms_between(e2: Array, begin: float, end: float) -> float:
    """RMS in mm of the errors e2 (T,) of frames between two parts, 0 to 1, of a motion; of one frame at least."""
    first = min(round(begin * len(e2)), len(e2) - 1)
    return float(np.sqrt(np.mean(e2[first : max(first + 1, round(end * len(e2)))] ** 2)))
