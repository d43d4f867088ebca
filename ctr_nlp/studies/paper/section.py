"""What every remade figure is made of, and what it says: statements that numbers alone decide."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ctr_nlp.plan.account import shown
from ctr_nlp.plan.metrics import by_frame
from ctr_nlp.plan.plan import Plan
from ctr_nlp.reference.published import BASELINE as BASELINE_PRINTED
from ctr_nlp.reference.published import SEED as SEED_PRINTED
from ctr_nlp.studies.paper.runs import BASELINE, HORIZON, NAMES, SEED, Found, Motion, Task
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


PRIMITIVE = "cos", "arc", "line", "line_arc"
ALL = *PRIMITIVE, "synthesis", "bronchus"
"""Problems of Table II."""
COMPARABLE = ALL[:-1]
"""Those whose targets are the paper's own: its bronchus is not public."""


@dataclass(frozen=True)
class Table:
    """A table with what it shows, in a sentence."""

    caption: str
    header: Sequence[str]
    body: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A figure or table of the paper: what it takes, its picture, what is said of it.

    name: of its files. about: what is shown and how to read it. unknown: what could not be known. rows: the
    numbers behind it, for its CSV file.
    """

    name: str
    title: str
    tasks: tuple[Task, ...]
    about: str
    unknown: str
    tables: Callable[[Found], list[Table]]
    checks: Callable[[Found], list[Check]]
    rows: Callable[[Found], list[dict[str, Any]]]
    draw: Callable[[Found], Figure] | None = None


def motions(problems: Sequence[str], methods: Sequence[str]) -> tuple[Task, ...]:
    """All methods on all problems."""
    return tuple(Motion(problem, method) for problem in problems for method in methods)


def by_frames(
    problems: Sequence[str], methods: Sequence[str], keys: Sequence[str]
) -> Callable[[Found], list[dict[str, Any]]]:
    """Of what was found a line for each problem, method and frame, with columns of errors.csv, in mm."""
    return lambda found: [
        {"problem": problem, "method": method} | line
        for problem in problems
        for method in methods
        for line in _by_frame(found.plan(problem, method), keys)
    ]


def _by_frame(plan: Plan, keys: Sequence[str]) -> list[dict[str, Any]]:
    columns = by_frame(plan)
    numbers = zip(*(columns[key].tolist() for key in keys), strict=True)
    return [
        {"frame": frame} | {f"{key}_mm": value for key, value in zip(keys, line, strict=True)}
        for frame, line in enumerate(numbers, 1)
    ]


def errors(found: Found, problem: str, method: str, model: str = "dominant") -> str:
    """e3 and e4 of a run, as text; a star where frames failed."""
    row = found.row(problem, method)
    numbers = " / ".join(mm(row[f"{model}_{key}"]) for key in ("e3", "e4"))
    return numbers + "*" * (row["failed"] > 0)


def mm(value: float | None) -> str:
    """A length as text; what three decimals would show as nothing is below the last of them."""
    text = shown(value)
    return "<0.001" if text == "0.000" and value else text


def beside(found: Found, problems: Sequence[str], methods: Sequence[str] = (HORIZON, SEED, BASELINE)) -> Table:
    """What the paper printed of problems, and what methods of this run have."""
    header = [
        "problem",
        "the paper (published)",
        "its baseline (published)",
        *(NAMES[method] for method in methods),
    ]
    body = [
        [
            f"`{problem}`",
            *(printed(each, problem) for each in (SEED_PRINTED, BASELINE_PRINTED)),
            *(errors(found, problem, method) for method in methods),
        ]
        for problem in problems
    ]
    return Table("e3 / e4 in mm on the stiffness-dominant model", header, body)


def printed(table: dict[str, Any], problem: str) -> str:
    """e3 and e4 as the paper printed them; nothing where it did not."""
    return " / ".join(f"{value:.2f}" for value in table[problem][:2]) if problem in table else ""
