"""Checks of the paper's statements against the numbers of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.typing import Array

PUBLISHED_DECIMALS = 2
"""Decimals of the paper's tables; numbers that round to the same value count as equal."""


@dataclass(frozen=True)
class Check:
    """A statement and what a run finds about it.

    holds: number of cases in which it holds, of case_count; case_count = 0: nothing was published that could be
    compared. own_question: the statement is ours, not the paper's.
    """

    statement: str
    finding: str
    holds: int
    case_count: int
    own_question: bool = False

    @property
    def verdict(self) -> str:
        """Verdict in a few words."""
        if not self.case_count:
            return "not comparable"
        if not self.holds:
            return "does not hold" if self.own_question else "does not agree"
        word = "holds" if self.own_question else "agrees"
        return word if self.holds == self.case_count else f"{word} in {self.holds} of {self.case_count}"

    @property
    def source(self) -> str:
        """Author of the statement."""
        return "Asked here" if self.own_question else "The paper"


def join_names(names: Sequence[str]) -> str:
    """Join names as in a sentence, "a, b and c"; "none" for none."""
    if not names:
        return "none"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def where_it_holds(holds: Mapping[str, bool]) -> str:
    """Describe on which problems a statement holds and on which not; holds: by the name of the problem."""
    yes, no = ([name for name, value in holds.items() if value is wanted] for wanted in (True, False))
    if not no:
        return "on all"
    return f"on {join_names(yes)}, not on {join_names(no)}" if yes else "on none"


def compare_with_published(ours: float, published: float) -> str:
    """Return "lower", "the same" or "higher": `ours` against the published number, at its printed precision."""
    rounded = round(ours, PUBLISHED_DECIMALS)
    return "the same" if rounded == published else "lower" if rounded < published else "higher"


def summarise_comparison(pairs: Mapping[str, tuple[float, float]]) -> str:
    """Describe which of our numbers are lower, the same and higher; pairs: name -> (ours, published)."""
    found = {name: compare_with_published(*pair) for name, pair in pairs.items()}
    parts = [
        f"{word} on {join_names([name for name, its in found.items() if its == word])}"
        for word in ("lower", "the same", "higher")
        if word in found.values()
    ]
    return ", ".join(parts)


def number(value: Any) -> float:
    """Return the value of a row as a number; infinite for None, where no frame was reached."""
    return math.inf if value is None else float(value)


def rms_between(e2: Array, begin: float, end: float) -> float:
    """Return the RMS in mm of the errors e2 (T,) of part of a motion; of one frame at least.

    begin, end: of the part, as fractions of the motion in [0, 1].
    """
    first = min(round(begin * len(e2)), len(e2) - 1)
    return float(np.sqrt(np.mean(e2[first : max(first + 1, round(end * len(e2)))] ** 2)))
