"""Rows of a study grouped by a column, for tables and figures.

Studies may have more rows than memory holds: they are read part by part, with a few columns at a time, and each
value is kept in four bytes.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.verdicts import NO, Verdicts
from ctr_nlp.studies.grid.case import CASE_DONE
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.typing import Array

STUDY_RANKING_COLUMN = "e3"
"""Column by which plans are ranked."""
ALWAYS_READ_COLUMNS = "digest", "status", "reason", "problem", "robot_name", "complete", STUDY_RANKING_COLUMN
"""Columns that are always read."""
LISTED_WORST_PLANS = 5
"""Number of plans with the largest errors that are listed."""


class WorstPlan(NamedTuple):
    """One of the plans with the largest e3: its error, mm, the case's digest, and names of problem and robot."""

    error: float
    digest: str
    problem: str
    robot: str


class Failure(NamedTuple):
    """A reason for which cases have no plan, the number of these cases, and the digest of one of them."""

    reason: str
    plans: int
    digest: str


@dataclass
class Group:
    """Plans that have one value of a column in common.

    Attributes
    ----------
    name : str
        That value.
    plans, failed : int
        Number of cases, and of those without a plan.
    values : dict
        For each other column the values that are numbers, a list of float32 arrays.
    """

    name: str
    plans: int = 0
    failed: int = 0
    values: dict[str, list[Any]] = field(default_factory=dict)

    def add_rows(self, rows: Any, shown: Sequence[str]) -> None:
        """Add rows, a pandas frame; shown: names of the columns whose values are kept."""
        self.plans += len(rows)
        self.failed += int((rows["status"] != CASE_DONE).sum())
        for name in shown:
            values = np.asarray(rows[name], dtype=np.float32)
            self.values.setdefault(name, []).append(values[np.isfinite(values)])

    def column_values(self, column: str) -> Array:
        """Return all values of a column, (n,) float32."""
        found: Array = np.concatenate([np.zeros(0, np.float32), *self.values.get(column, [])])
        return found

    def quantile(self, column: str, share: float) -> float:
        """Return a quantile of a column; share: in [0, 1], of plans with at most it. NaN without values."""
        values = self.column_values(column)
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
    worst: Sequence[WorstPlan]
    complete: bool
    verdicts: Mapping[str, Counter[str]]

    @property
    def all_passed(self) -> bool:
        """True where every frame was solved and no verdict is *no*."""
        return self.complete and not any(words[NO] for words in self.verdicts.values())


def group_rows(results: Results, digests: Collection[str], column: str, shown: Sequence[str]) -> Groups:
    """Group the rows of some cases by a column.

    Parameters
    ----------
    results : Results
        The rows of a study.
    digests : collection of str
        The cases whose rows count.
    column : str
        Column by which rows are grouped.
    shown : sequence of str
        Columns whose values are kept.

    Returns
    -------
    Groups
        In the order of the column's values.

    Raises
    ------
    OptionError
        A column is in no row, or there is no row of these cases.
    """
    known = results.columns
    if missing := [name for name in (column, *shown) if name not in known]:
        raise OptionError(f"{missing[0]} is no column of the study; those are {', '.join(sorted(known))}")
    groups = dict[Any, Group]()
    failures = dict[str, Failure]()
    worst = list[WorstPlan]()
    complete = True
    own = set(digests)
    named = {f"verdict_{name}": name for name in Verdicts._fields}
    words = {name: Counter[str]() for key, name in named.items() if key in known}
    # Rows of cases that the study's file no longer has, or of older versions, may be in the folder, too.
    for frame in results.read_parts([*dict.fromkeys([*ALWAYS_READ_COLUMNS, column, *shown, *named])]):
        part = frame[frame["digest"].isin(own)]
        done = part[part["status"] == CASE_DONE]
        complete &= len(done) == len(part) and bool(done["complete"].all())
        for value, rows in part.groupby(column, dropna=False):
            groups.setdefault(str(value), Group(str(value))).add_rows(rows, shown)
        for reason, rows in part[part["status"] != CASE_DONE].groupby("reason"):
            before = failures.get(str(reason), Failure(str(reason), 0, rows["digest"].iloc[0]))
            failures[str(reason)] = before._replace(plans=before.plans + len(rows))
        for name, counted in words.items():
            counted.update(done[f"verdict_{name}"].dropna())
        if STUDY_RANKING_COLUMN in done:
            told = done[[STUDY_RANKING_COLUMN, "digest", "problem", "robot_name"]].dropna().itertuples(index=False)
            worst = heapq.nlargest(LISTED_WORST_PLANS, [*worst, *(WorstPlan(*row) for row in told)])
    if not groups:
        raise OptionError(
            f"{results.folder} holds no rows of this study, as its file and the versions of what plans are now"
        )
    ordered = [groups[name] for name in sorted(groups, key=_sort_key)]
    return Groups(column, ordered, [*failures.values()], worst, complete, words)


def _sort_key(name: str) -> tuple[float, str]:
    """Return the sort key of a group's name: numbers by their size, before words."""
    try:
        return float(name), name
    except ValueError:
        return float("inf"), name
