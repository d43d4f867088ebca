"""Parts of every reproduced figure or table: its tasks, tables, checks and picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from reference.published import TABLE_II_BASELINE as BASELINE_PRINTED
from reference.published import TABLE_II_PAPER_METHOD as SEED_PRINTED

from ctr_nlp.plan.metrics import by_frame
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.support.tables import columns_to_rows
from paper.checks import Check
from paper.runs import (
    EUCLIDEAN_BASELINE,
    OUR_HORIZON,
    PAPER_METHOD_LABELS,
    PAPER_TWO_STAGE,
    MotionTask,
    PaperResults,
    Task,
)

PRIMITIVE_SHAPES = "cos", "arc", "line", "line_arc"
TABLE_II_PROBLEMS = *PRIMITIVE_SHAPES, "synthesis", "bronchus"
"""Problems of Table II."""
COMPARABLE_PROBLEMS = TABLE_II_PROBLEMS[:-1]
"""Problems whose targets are the paper's own: its bronchus is not public."""


@dataclass(frozen=True)
class CaptionedTable:
    """A table with a caption."""

    caption: str
    header: Sequence[str]
    body: Sequence[Sequence[str]]


@dataclass(frozen=True)
class PaperSection:
    """A reproduced figure or table of the paper.

    name: of its files. tasks: the runs that it needs. about: what is shown and how to read it. unknown: what the
    paper leaves open. tables, checks, draw: functions of the results. rows: the numbers behind it, for its CSV
    file.
    """

    name: str
    title: str
    tasks: tuple[Task, ...]
    about: str
    unknown: str
    tables: Callable[[PaperResults], list[CaptionedTable]]
    checks: Callable[[PaperResults], list[Check]]
    rows: Callable[[PaperResults], list[dict[str, Any]]]
    draw: Callable[[PaperResults], Figure] | None = None


def motion_tasks(problems: Sequence[str], methods: Sequence[str]) -> tuple[Task, ...]:
    """Return the tasks of running all methods on all problems."""
    return tuple(MotionTask(problem, method) for problem in problems for method in methods)


def by_frames(
    problems: Sequence[str], methods: Sequence[str], keys: Sequence[str]
) -> Callable[[PaperResults], list[dict[str, Any]]]:
    """Return a function of the results that makes a row for each problem, method and frame.

    problems, methods: which of the results. keys: columns of errors.csv, in mm.
    """
    return lambda found: [
        {"problem": problem, "method": method} | line
        for problem in problems
        for method in methods
        for line in _by_frame(found.plan(problem, method), keys)
    ]


def _by_frame(plan: Plan, keys: Sequence[str]) -> list[dict[str, Any]]:
    columns = by_frame(plan)
    return columns_to_rows({"frame": columns["frame"]} | {f"{key}_mm": columns[key] for key in keys})


def format_errors(found: PaperResults, problem: str, method: str) -> str:
    """Write e3 and e4 in mm of a method on a problem, on the dominant model; with a star where frames failed.

    found: results of the run.
    """
    row = found.row(problem, method)
    numbers = " / ".join(format_mm(row[f"dominant_{key}"]) for key in ("e3", "e4"))
    return numbers + "*" * (row["failed"] > 0)


def format_mm(value: float | None) -> str:
    """Write a value in mm; "<0.001" where three decimals would show 0."""
    text = format_cell(value)
    return "<0.001" if text == "0.000" and value else text


def published_comparison_table(
    found: PaperResults,
    problems: Sequence[str],
    methods: Sequence[str] = (OUR_HORIZON, PAPER_TWO_STAGE, EUCLIDEAN_BASELINE),
) -> CaptionedTable:
    """Make a table of e3 / e4 on the dominant model: as the paper printed them, and in the results `found`.

    problems: its rows. methods: its columns beside the published ones.
    """
    published = "the paper (published)", "its baseline (published)"
    header = ["problem", *published, *(PAPER_METHOD_LABELS[method] for method in methods)]
    body = [
        [
            f"`{problem}`",
            *(format_published(each, problem) for each in (SEED_PRINTED, BASELINE_PRINTED)),
            *(format_errors(found, problem, method) for method in methods),
        ]
        for problem in problems
    ]
    return CaptionedTable("e3 / e4 in mm on the stiffness-dominant model", header, body)


def format_published(table: dict[str, Any], problem: str) -> str:
    """Write e3 and e4 as printed for a problem in a published table, mm; empty where it does not list it."""
    return " / ".join(f"{value:.2f}" for value in table[problem][:2]) if problem in table else ""
