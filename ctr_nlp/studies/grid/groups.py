"""Rows of a study by a column: what is printed and drawn of them, read a part and a few columns at a time."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.verdicts import NO, Verdicts
from ctr_nlp.studies.grid.case import DONE
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.typing import Array

ERROR = "e3"
"""The column by which plans are good or bad."""
ALWAYS = "digest", "status", "reason", "problem", "robot_name", "complete", ERROR
"""Columns that are read whatever is asked for."""
WORST = 5
"""Plans of the largest error that are told."""


class Bad(NamedTuple):
    """One of the plans of the largest e3, mm."""

    error: float
    digest: str
    problem: str
    robot: str


class Failure(NamedTuple):
    """Why plans failed, how many did, and the digest of one of them."""

    reason: str
    plans: int
    digest: str


@dataclass
class Group:
    """Plans with one value of a column; values: of other columns, those that are numbers, row after row."""

    name: str
    plans: int = 0
    failed: int = 0
    values: dict[str, list[Any]] = field(default_factory=dict)

    def grow(self, rows: Any, shown: Sequence[str]) -> None:
        """Take rows, a pandas frame, with their values of some columns."""
        self.plans += len(rows)
        self.failed += int((rows["status"] != DONE).sum())
        for name in shown:
            values = np.asarray(rows[name], dtype=np.float32)
            self.values.setdefault(name, []).append(values[np.isfinite(values)])

    def of(self, column: str) -> Array:
        """All values of a column in float32, (n,)."""
        found: Array = np.concatenate([np.zeros(0, np.float32), *self.values.get(column, [])])
        return found

    def quantile(self, column: str, share: float) -> float:
        """NaN where there is no value."""
        values = self.of(column)
        return float(np.quantile(values, share)) if len(values) else float("nan")


@dataclass(frozen=True)
class Groups:
    """Rows of a study by a column.

    Attributes
    ----------
    column : str
        By which rows are grouped.
    groups, failures, worst : sequence
        The groups; why plans could not be made; the plans of the largest error.
    complete : bool
        Whether every frame of every plan was solved.
    verdicts : mapping
        For each verdict, how many plans have which word.
    """

    column: str
    groups: Sequence[Group]
    failures: Sequence[Failure]
    worst: Sequence[Bad]
    complete: bool
    verdicts: Mapping[str, Counter[str]]

    @property
    def passed(self) -> bool:
        """Whether no plan was left unsolved and no verdict is *no*."""
        return self.complete and not any(words[NO] for words in self.verdicts.values())


def grouped(results: Results, digests: Collection[str], column: str, shown: Sequence[str]) -> Groups:
    """The rows of some cases by a column, with the values of others.

    Of the rows only these columns are read, and of their values four bytes each are kept. Raises OptionError for
    a column that no row has, and where there is no row of those cases.
    """
    known = results.columns
    if missing := [name for name in (column, *shown) if name not in known]:
        raise OptionError(f"{missing[0]} is no column of the study; those are {', '.join(sorted(known))}")
    groups, failures, worst = dict[Any, Group](), dict[str, Failure](), list[Bad]()
    complete, own = True, set(digests)
    named = {f"verdict_{name}": name for name in Verdicts._fields}
    words = {name: Counter[str]() for key, name in named.items() if key in known}
    for frame in results.parts([*dict.fromkeys([*ALWAYS, column, *shown, *named])]):
        part = frame[frame["digest"].isin(own)]
        done = part[part["status"] == DONE]
        complete &= len(done) == len(part) and bool(done["complete"].all())
        for value, rows in part.groupby(column, dropna=False):
            groups.setdefault(str(value), Group(str(value))).grow(rows, shown)
        for reason, rows in part[part["status"] != DONE].groupby("reason"):
            before = failures.get(str(reason), Failure(str(reason), 0, rows["digest"].iloc[0]))
            failures[str(reason)] = before._replace(plans=before.plans + len(rows))
        for name, counted in words.items():
            counted.update(done[f"verdict_{name}"].dropna())
        if ERROR in done:
            told = done[[ERROR, "digest", "problem", "robot_name"]].dropna().itertuples(index=False)
            worst = heapq.nlargest(WORST, [*worst, *(Bad(*row) for row in told)])
    if not groups:
        raise OptionError(
            f"{results.folder} holds no rows of this study, as its file and the versions of what plans are now"
        )
    ordered = [groups[name] for name in sorted(groups, key=_order)]
    return Groups(column, ordered, [*failures.values()], worst, complete, words)


def _order(name: str) -> tuple[float, str]:
    """Numbers by their size, before words."""
    try:
        return float(name), name
    except ValueError:
        return float("inf"), name
