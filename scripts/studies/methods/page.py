"""Page of Markdown with every method on every problem: an overview, and a table for each problem."""

from __future__ import annotations

import math
import os
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from reference import REFERENCE_METHODS

from ctr_nlp.ocp import FORMULATIONS
from ctr_nlp.ocp.horizon import horizon
from ctr_nlp.plan.summary_text import format_cell
from ctr_nlp.support.tables import markdown
from methods.comparison import LUMEN_PATH_VARIANTS, ROBUST_VARIANTS, WARM_STARTED_VARIANTS, Comparison

Row = Mapping[str, Any]
OUR_VARIANT_PREFIXES: Mapping[str, Callable[..., Any]] = {
    "horizon": horizon,
    **dict.fromkeys(WARM_STARTED_VARIANTS, horizon),
    **FORMULATIONS,
    **ROBUST_VARIANTS,
}
"""Our own methods: the part of their name before a colon, and the function that implements it."""


class Column(NamedTuple):
    """A column of the tables, in which less is better.

    title: of the column. key: of a row. show: writes the value. planned: key of the value on the model planned on.
    """

    title: str
    key: str
    show: Callable[[float], str] = format_cell
    planned: str | None = None


METHOD_PAGE_COLUMNS = (
    Column("e3 mm", "e3", planned="planned_e3"),
    Column("largest mm", "e_max", planned="planned_e_max"),
    Column("tip mm", "tip_max", planned="planned_tip_max"),
    Column("off own path mm", "own_path"),
    Column("roughness mm²/s", "roughness"),
    Column("failed samples", "lost", lambda value: f"{value:.1%}"),
    Column("e3 over samples mm", "draws_e3"),
    Column("contact mm", "depth", planned="planned_depth"),
    Column("ms a frame", "frame_ms"),
)
OVERVIEWS = {
    "e3 in mm on the elastic model": METHOD_PAGE_COLUMNS[0],
    "Share of failed samples": METHOD_PAGE_COLUMNS[5],
}
METHOD_PAGE_EXPLANATION = """\
# Methods beside each other

This page compares our methods with the paper's and with methods of other groups. Every method plans every
problem that it can solve, with the paper's robot. **Judge each method by its purpose**: methods for the tip
by the tip error, follow-the-leader methods by the distance from their own path, methods for a lumen by the
contact, and robust methods by the failed samples. `:elastic` after a name means that the method plans on the
elastic model; the others use the dominant model.

{methods}

**What is measured.** All motions are evaluated on the elastic model, which stands for the real robot,
whatever model they were planned on. If a cell has two numbers, the first is on the model of the plan.

- *e3*: root mean square distance from the target over frames and arc length. *Largest* and *tip*: the largest
  distance at any point of the shape, and at the tip, in any frame.
- *Off own path*: the largest distance of any frame's shape from the last frame's shape. It is 0 where the
  body follows the path of the tip exactly, whatever the target.
- *Roughness*: sum of the squared steps of all motors, divided by the time step.
- *Failed samples*: share of {draws} simulated robots within the tolerances (the paper's robot: 2 % of
  curvature and stiffness, 0.02 rad of each motor's zero) that snap or end on another branch of equilibria.
  *e3 over samples*: mean of e3 over all samples. All methods are tested on the same samples.
- *Contact*: largest depth of the robot beyond the lumen's wall. `horizon`, `joint`, the robust methods and
  `rrt-connect` regard the wall, the others do not. e3 may grow by a tenth for clearance (robust methods: by
  70 %).
- *ms a frame*: time of search and solution divided by the number of frames, without what is built or compiled
  once.
- *Solved*: frames that are solved by the method's own criterion; for tip methods, a tip error within 1 mm.

**Bold** marks the least value of a column among methods that solved all frames, and also values of the other
methods that are less than the least of ours. Below each table stand the methods that do not apply to the
problem, and the reason.
"""
METHOD_PAGE_REPRODUCTION = """
## How to make this page again

    {command}

This command writes the page as `comparison.md` into its folder, and all rows as `comparison.csv` and `.json`.
The page was made with {frames} frames on {machine}, one method after the other. Times depend on
the machine and on what else runs there.
"""


def page(found: Comparison, command: str) -> str:
    """Write the page from the results `found`, without interrupted ones; `command`: which makes the page."""
    found = found._replace(rows=[row for row in found.rows if not row["interrupted"]])
    asked = [(row["problem"], row["variant"]) for row in found.rows]
    asked += [(refusal.problem, refusal.variant) for refusal in found.refusals]
    problems = list(dict.fromkeys(problem for problem, _ in asked))
    kinds = dict.fromkeys(variant.partition(":")[0] for _, variant in asked)
    methods = markdown(
        ["method", "what it is"], [[f"`{kind}`", method_description(kind).replace("|", "\\|")] for kind in kinds]
    )
    draws, frames = (max((row[key] or 0 for row in found.rows), default=0) for key in ("draws", "frames"))
    parts = [METHOD_PAGE_EXPLANATION.format(draws=draws, methods=methods.rstrip())]
    parts += [f"## {title}\n\n{_overview(found, problems, column)}" for title, column in OVERVIEWS.items()]
    parts += [f"## {problem}\n\n{table(found, problem)}" for problem in problems]
    return "\n".join(parts) + METHOD_PAGE_REPRODUCTION.format(command=command, frames=frames, machine=machine())


def table(found: Comparison, problem: str) -> str:
    """Write the table of a problem from the results `found`, a row for each method.

    Below it stands a line for each method that does not apply to the problem, with the reason.
    """
    rows = [row for row in found.rows if row["problem"] == problem]
    body = [
        [f"`{row['variant']}`", *(_cell(row, rows, column) for column in METHOD_PAGE_COLUMNS), _format_solved(row)]
        for row in rows
    ]
    refused = [f"- `{r.variant}` does not apply: {r.why}" for r in found.refusals if r.problem == problem]
    return "\n".join([markdown(["method", *_titles(), "solved"], body), *refused, *([""] if refused else [])])


def method_description(kind: str) -> str:
    """Return the first line of the docstring of the file that implements a method.

    kind: the method's name before a colon. Empty where no registry has it.
    """
    others = {**LUMEN_PATH_VARIANTS, **{name: reference.method for name, reference in REFERENCE_METHODS.items()}}
    made = {**OUR_VARIANT_PREFIXES, **others}.get(kind)
    if made is None:
        return ""
    # docs/comparison.md is made of these lines: a method's file must open with a line that can be read alone.
    file = sys.modules[getattr(made, "func", made).__module__]  # functools.partial is in functools
    return (file.__doc__ or "").partition("\n")[0]


def machine() -> str:
    """Describe the machine: number of cores and kind of the processor, without its name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{os.cpu_count()} cores of {named[0] if named else platform.machine()}"


def _titles() -> list[str]:
    return [column.title for column in METHOD_PAGE_COLUMNS]


def _overview(found: Comparison, problems: Sequence[str], column: Column) -> str:
    """Write the table of one number, a row for each method and a column for each problem; empty where refused."""
    known = {(row["variant"], row["problem"]): row for row in found.rows}
    columns = {problem: [row for row in found.rows if row["problem"] == problem] for problem in problems}
    alone = column._replace(planned=None)
    body = [
        [
            f"`{variant}`",
            *(_cell(known[variant, p], columns[p], alone) if (variant, p) in known else "" for p in problems),
        ]
        for variant in dict.fromkeys(variant for variant, _ in known)
    ]
    return markdown(["method", *problems], body)


def _cell(row: Row, rows: Sequence[Row], column: Column) -> str:
    value = row[column.key]
    if value is None:
        return ""
    told = f"**{column.show(value)}**" if _is_best(row, rows, column.key) else column.show(value)
    planned = None if column.planned is None else row[column.planned]
    return told if planned in (None, value) else f"{format_cell(planned)} / {told}"


def _is_best(row: Row, rows: Sequence[Row], key: str) -> bool:
    """Return whether a value is printed in bold: the least of all methods, or less than the least of ours.

    Only methods that solved all frames count: one that gives up on hard frames has small errors on the others.
    """
    whole = [each for each in rows if each["solved"] == each["frames"] and each[key] is not None]
    least = min((each[key] for each in whole), default=math.inf)
    ours = min((each[key] for each in whole if _is_ours(each["variant"])), default=math.inf)
    return row in whole and (row[key] <= least or (not _is_ours(row["variant"]) and row[key] < ours))


def _is_ours(variant: str) -> bool:
    return variant.partition(":")[0] in OUR_VARIANT_PREFIXES


def _format_solved(row: Row) -> str:
    return "all" if row["solved"] == row["frames"] else f"{row['solved']} of {row['frames']}"
