"""Fig. 3: the error of the fit over the number of points that it is asked at."""

from __future__ import annotations

import itertools
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from ctr_nlp.figures.parts.page import STYLE
from ctr_nlp.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION
from ctr_nlp.studies.paper.checks import Check, named
from ctr_nlp.studies.paper.runs import ALONG, JOINT, NAMES, ON_SEGMENT, SEED, Fit, Fitting, Found
from ctr_nlp.studies.paper.section import ALL, Section, Table, mm

LEVEL, ENOUGH = 0.01, 0.1
"""Parts of e3: more points raise it by less than the first; fewer are enough within the second."""
SEEDS, OURS = 2, 10
"""Points on a segment that the paper finds sufficient; points along the robot that are asked for here."""
LEAST = 0.01
"""mm below which nothing is drawn."""
LOOKS = dict(zip(ALL, zip((BLUE, ORANGE, GREEN, PURPLE, BLACK, VERMILLION), "os^vDX", strict=True), strict=True))


def tables(found: Found) -> list[Table]:
    """e3 by problem and number of points, a table for each method."""
    what = {SEED: "on a segment, the paper's method", JOINT: "along the whole robot, ours (`joint`)"}
    return [
        Table(
            f"e3 in mm by the number of points {text}",
            ["problem", *map(str, ON_SEGMENT if method == SEED else ALONG)],
            [[f"`{p}`", *(mm(fit.e3) for fit in found.fitted[Fitting(p, method)])] for p in ALL],
        )
        for method, text in what.items()
    ]


def checks(found: Found) -> list[Check]:
    """Whether the error falls with the number of points, and how few are enough."""
    seeds = {p: found.fitted[Fitting(p, SEED)] for p in ALL}
    ours = {p: found.fitted[Fitting(p, JOINT)] for p in ALL}
    falls, enough = {p: falling(some) for p, some in seeds.items()}, {p: near(s, SEEDS) for p, s in seeds.items()}
    gains = [(1 - some[1].e3 / some[0].e3, 1 - some[-1].e3 / some[1].e3) for some in seeds.values()]
    first, rest = (sorted(column) for column in zip(*gains, strict=True))
    return [
        Check(
            "the fitting error decreases with the number of sample points",
            f"for the paper's method no step to more points raises e3 by more than {LEVEL:.0%} {named(falls)}",
            sum(falls.values()),
            len(falls),
        ),
        Check(
            "two points on a segment, its middle and its end, are sufficient",
            f"a second point lowers e3 by {first[0]:.0%} to {first[-1]:.0%}, all further ones up to "
            f"{ON_SEGMENT[-1]} by another {rest[0]:.0%} to {rest[-1]:.0%}; two come within {ENOUGH:.0%} of "
            f"{ON_SEGMENT[-1]} {named(enough)}. Ours, with {OURS} points along the whole robot, comes within "
            f"{ENOUGH:.0%} of {ALONG[-1]} {named({p: near(some, OURS) for p, some in ours.items()})}",
            sum(enough.values()),
            len(enough),
        ),
    ]


def falling(some: tuple[Fit, ...]) -> bool:
    """Whether more points never raise e3 by more than LEVEL."""
    return all(after.e3 <= before.e3 * (1 + LEVEL) for before, after in itertools.pairwise(some))


def near(some: tuple[Fit, ...], points: int) -> bool:
    """Whether e3 with so many points is within ENOUGH of that with the most; both may be nothing."""
    e3 = {fit.points: fit.e3 for fit in some}
    return e3[points] <= max(e3[some[-1].points] * (1 + ENOUGH), LEAST)


def rows(found: Found) -> list[dict[str, Any]]:
    """A line for each problem, method and number of points."""
    return [
        {"problem": task.problem, "method": task.method, **fit._asdict()}
        for method in (SEED, JOINT)
        for task in (Fitting(p, method) for p in ALL)
        for fit in found.fitted[task]
    ]


@matplotlib.rc_context(STYLE)
def draw(found: Found) -> Figure:
    """e3 over points on a segment for the paper's method, and over points along the robot for ours."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, method, points in ((left, SEED, ON_SEGMENT), (right, JOINT, ALONG)):
        for problem, (colour, marker) in LOOKS.items():
            fits = [fit for fit in found.fitted[Fitting(problem, method)] if fit.e3 >= LEAST]
            look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 5, "lw": 1.2, "label": problem}
            axes.plot([fit.points for fit in fits], [fit.e3 for fit in fits], **look)
        _scales(axes, points)
        axes.set_title(NAMES[method])
    left.set_xlabel("points on a segment")
    right.set_xlabel("points along the whole robot")
    left.set_ylabel("e3 (mm)")
    left.axvline(SEEDS, color="0.5", lw=0.9, ls=(0, (4, 2)), zorder=1)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(LOOKS))
    return figure


def _scales(axes: Axes, points: tuple[int, ...]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(bottom=LEAST)
    axes.xaxis.set_major_locator(FixedLocator(points))
    axes.xaxis.set_minor_locator(NullLocator())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")


SECTION = Section(
    "fig3",
    "Fig. 3: error of the fit over the number of sample points",
    tuple(Fitting(problem, method) for problem in ALL for method in (SEED, JOINT)),
    "Each frame is fitted again by itself, without a motion term and from where the method's own motion has it, "
    "so that only the number of points makes a difference. Left: the paper's method; points are spread evenly on "
    "each tube's segment, the last at its end, and the dashed line marks the two that the paper takes. Right: "
    "ours, which usually takes 20 along the whole robot. Errors are taken at 101 samples throughout. Curves end "
    f"where e3 falls below {LEAST:g} mm.",
    "Which target and which frames the paper's Fig. 3 shows, and any of its numbers: only its caption is known.",
    tables,
    checks,
    rows,
    draw,
)
