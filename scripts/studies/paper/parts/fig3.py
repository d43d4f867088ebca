"""Fig. 3: error of the fit over the number of sample points."""

from __future__ import annotations

import itertools
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from ctr_nlp.view.figures.parts.page import STYLE
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION
from paper.checks import Check, where_it_holds
from paper.runs import (
    OUR_JOINT,
    PAPER_METHOD_LABELS,
    PAPER_TWO_STAGE,
    POINTS_ALONG_ROBOT,
    POINTS_ON_SEGMENT,
    FittingTask,
    PaperResults,
    PointCountFit,
)
from paper.section import TABLE_II_PROBLEMS, CaptionedTable, PaperSection, format_mm

DECREASING_E3_TOLERANCE, SUFFICIENT_E3_TOLERANCE = 0.01, 0.1
"""Relative tolerances of e3: more points may raise it by the first; fewer points suffice within the second."""
PAPER_POINTS_PER_SEGMENT, OUR_POINT_COUNT = 2, 10
"""Points on a segment that the paper finds sufficient; points along the robot that are checked here."""
MIN_DRAWN_E3_MM = 0.01
"""Least e3 that is drawn, mm."""
PROBLEM_LINE_STYLES = dict(
    zip(
        TABLE_II_PROBLEMS,
        zip((BLUE, ORANGE, GREEN, PURPLE, BLACK, VERMILLION), "os^vDX", strict=True),
        strict=True,
    )
)


def tables(found: PaperResults) -> list[CaptionedTable]:
    """Return tables of e3 by problem and number of points, one for each method; found: results of the run."""
    what = {
        PAPER_TWO_STAGE: "on a segment, the paper's method",
        OUR_JOINT: "along the whole robot, ours (`joint`)",
    }
    return [
        CaptionedTable(
            f"e3 in mm by the number of points {text}",
            ["problem", *map(str, POINTS_ON_SEGMENT if method == PAPER_TWO_STAGE else POINTS_ALONG_ROBOT)],
            [
                [f"`{p}`", *(format_mm(fit.e3) for fit in found.fit_results[FittingTask(p, method)])]
                for p in TABLE_II_PROBLEMS
            ],
        )
        for method, text in what.items()
    ]


def checks(found: PaperResults) -> list[Check]:
    """Return checks that the error falls with the number of points, and how few suffice; found: results."""
    seeds = {p: found.fit_results[FittingTask(p, PAPER_TWO_STAGE)] for p in TABLE_II_PROBLEMS}
    ours = {p: found.fit_results[FittingTask(p, OUR_JOINT)] for p in TABLE_II_PROBLEMS}
    falls = {p: is_decreasing(some) for p, some in seeds.items()}
    enough = {p: is_sufficient(s, PAPER_POINTS_PER_SEGMENT) for p, s in seeds.items()}
    gains = [(1 - some[1].e3 / some[0].e3, 1 - some[-1].e3 / some[1].e3) for some in seeds.values()]
    first, rest = (sorted(column) for column in zip(*gains, strict=True))
    percent = f"{SUFFICIENT_E3_TOLERANCE:.0%}"
    ours_sufficient = where_it_holds({p: is_sufficient(some, OUR_POINT_COUNT) for p, some in ours.items()})
    return [
        Check(
            "the fitting error decreases with the number of sample points",
            f"for the paper's method no step to more points raises e3 by more than {DECREASING_E3_TOLERANCE:.0%} "
            f"{where_it_holds(falls)}",
            sum(falls.values()),
            len(falls),
        ),
        Check(
            "two points on a segment, its middle and its end, are sufficient",
            f"a second point lowers e3 by {first[0]:.0%} to {first[-1]:.0%}, all further ones up to "
            f"{POINTS_ON_SEGMENT[-1]} by another {rest[0]:.0%} to {rest[-1]:.0%}; two come within {percent} of "
            f"{POINTS_ON_SEGMENT[-1]} {where_it_holds(enough)}. Ours, with {OUR_POINT_COUNT} points along the "
            f"whole robot, comes within {percent} of {POINTS_ALONG_ROBOT[-1]} {ours_sufficient}",
            sum(enough.values()),
            len(enough),
        ),
    ]


def is_decreasing(some: tuple[PointCountFit, ...]) -> bool:
    """Return whether more points never raise e3 by more than DECREASING_E3_TOLERANCE; some: fits by points."""
    return all(after.e3 <= before.e3 * (1 + DECREASING_E3_TOLERANCE) for before, after in itertools.pairwise(some))


def is_sufficient(some: tuple[PointCountFit, ...], points: int) -> bool:
    """Return whether e3 with so many points is within SUFFICIENT_E3_TOLERANCE of that with the most.

    some: fits, of which the last has the most points.
    """
    e3 = {fit.points: fit.e3 for fit in some}
    # Errors too small to be drawn count as zero: their ratio would be that of rounding.
    return e3[points] <= max(e3[some[-1].points] * (1 + SUFFICIENT_E3_TOLERANCE), MIN_DRAWN_E3_MM)


def rows(found: PaperResults) -> list[dict[str, Any]]:
    """Return a row for each problem, method and number of points in the results `found`."""
    return [
        {"problem": task.problem, "method": task.method, **fit._asdict()}
        for method in (PAPER_TWO_STAGE, OUR_JOINT)
        for task in (FittingTask(p, method) for p in TABLE_II_PROBLEMS)
        for fit in found.fit_results[task]
    ]


@matplotlib.rc_context(STYLE)
def draw(found: PaperResults) -> Figure:
    """Draw e3 of the results `found` over points on a segment, the paper's method, and along the robot, ours."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, method, points in (
        (left, PAPER_TWO_STAGE, POINTS_ON_SEGMENT),
        (right, OUR_JOINT, POINTS_ALONG_ROBOT),
    ):
        for problem, (colour, marker) in PROBLEM_LINE_STYLES.items():
            fits = [fit for fit in found.fit_results[FittingTask(problem, method)] if fit.e3 >= MIN_DRAWN_E3_MM]
            look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 5, "lw": 1.2, "label": problem}
            axes.plot([fit.points for fit in fits], [fit.e3 for fit in fits], **look)
        _scales(axes, points)
        axes.set_title(PAPER_METHOD_LABELS[method])
    left.set_xlabel("points on a segment")
    right.set_xlabel("points along the whole robot")
    left.set_ylabel("e3 (mm)")
    left.axvline(PAPER_POINTS_PER_SEGMENT, color="0.5", lw=0.9, ls=(0, (4, 2)), zorder=1)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(PROBLEM_LINE_STYLES))
    return figure


def _scales(axes: Axes, points: tuple[int, ...]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=MIN_DRAWN_E3_MM)
    axes.xaxis.set_major_locator(FixedLocator(points))
    axes.xaxis.set_minor_locator(NullLocator())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")


FIG3 = PaperSection(
    "fig3",
    "Fig. 3: error of the fit over the number of sample points",
    tuple(
        FittingTask(problem, method) for problem in TABLE_II_PROBLEMS for method in (PAPER_TWO_STAGE, OUR_JOINT)
    ),
    "Each frame is fitted again by itself, without a motion term and from where the method's own motion has it, "
    "so that only the number of points makes a difference. Left: the paper's method; points are spread evenly on "
    "each tube's segment, the last at its end, and the dashed line marks the two that the paper takes. Right: "
    "ours, which usually takes 20 along the whole robot. Errors are taken at 101 samples throughout. Curves end "
    f"where e3 falls below {MIN_DRAWN_E3_MM:g} mm.",
    "Which target and which frames the paper's Fig. 3 shows, and any of its numbers: only its caption is known.",
    tables,
    checks,
    rows,
    draw,
)
