"""Plots of errors, clearance, stability, configuration and speeds over time, as paths that browsers draw
themselves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import MaxNLocator

from ctr_nlp.plan.metrics import SAMPLE_E2_COLUMNS, by_frame
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import Robustness
from ctr_nlp.support.flag_runs import find_flag_runs
from ctr_nlp.typing import Array, Index
from ctr_nlp.view.figures.parts.page import AT_FRAME, BETWEEN_FRAMES
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, ORANGE, SKY, TILT_COLOURS, VERMILLION, tube_colour
from ctr_nlp.view.report.legible import darken_for_white
from ctr_nlp.view.report.places import arrival_tolerance, way_to_go

TIP_PANEL_NAME, ANGLE_PANEL_NAME = "tip to the target's end (mm)", "tip to the target's end (degrees)"
ERROR_PANEL_NAME, SAMPLE_ERROR_PANEL_NAME, CLEARANCE_PANEL_NAME, STABILITY_PANEL_NAME = (
    "error (mm)",
    "e2 of sampled robots (mm)",
    "least clearance from the wall (mm)",
    "stability margin",
)
CONFIGURATION_PANEL_NAMES = ("α (rad)", "β (mm)", "θ (rad)")
SPEED_PANEL_NAMES = ("dα/dt (rad/s)", "dβ/dt (mm/s)", "dθ/dt (rad/s)")
PANEL_NAME_ORDER = (
    TIP_PANEL_NAME,
    ANGLE_PANEL_NAME,
    ERROR_PANEL_NAME,
    SAMPLE_ERROR_PANEL_NAME,
    CLEARANCE_PANEL_NAME,
    STABILITY_PANEL_NAME,
    *CONFIGURATION_PANEL_NAMES,
    *SPEED_PANEL_NAMES,
)
"""Names of panels from top to bottom."""

EXTENT = 1000
"""Length of both axes in units of the drawing; the page stretches it to the space that there is."""
DASHES = ("", "6 4", "8 3 2 3", "2 3")
"""Dash patterns, pixels drawn and left out in turn; "" is a solid line."""
LIMIT = "#777777"
"""Colour of limits."""
MOST_TICKS = 5
PANEL_MARGIN_FRACTION = 0.06
"""Margin above and below what is shown, as a part of it."""
MIN_PANEL_SPAN = 0.1
"""Least span of an axis: less is rounding noise."""


@dataclass(frozen=True)
class PlotLine:
    """A named line of a plot over time: y (T,), colour, and how it is dashed (one of DASHES)."""

    name: str
    y: Array
    colour: str
    dash: str = ""


@dataclass(frozen=True)
class PlotPanel:
    """Lines on one vertical axis, named with its unit.

    least: values that the axis always includes. limits: of the robot, drawn where they lie within the axis. band:
    its name, and lower and upper ends (T,) of the area that is filled behind the lines. marks: a name, and the
    frames (n,), from 1, that are marked at 0.
    """

    name: str
    lines: tuple[PlotLine, ...]
    least: tuple[float, ...] = ()
    limits: tuple[float, ...] = ()
    band: tuple[str, Array, Array] | None = None
    marks: tuple[str, Index] | None = None


def panels(plan: Plan) -> Iterator[PlotPanel]:
    """Yield the panels of a plan's plots, from top to bottom."""
    columns = by_frame(plan)
    to_go = way_to_go(plan)
    limits = (arrival_tolerance(plan),)
    yield PlotPanel(TIP_PANEL_NAME, (PlotLine("distance", to_go.distance, BLUE),), (0.0,), limits=limits)
    yield PlotPanel(ANGLE_PANEL_NAME, (PlotLine("angle", to_go.angle_deg, BLUE),), (0.0,))
    errors = (
        PlotLine("RMSE e2", columns["e2"], BLUE),
        PlotLine("maximum of e1", columns["max"], VERMILLION, DASHES[1]),
    )
    yield PlotPanel(ERROR_PANEL_NAME, errors, (0.0,))
    if plan.drawn is not None:
        yield _sample_error_panel(plan, plan.drawn, columns)
    if "clearance" in columns:
        yield _clearance_panel(plan, columns)
    if "stability" in columns:
        margins = (
            PlotLine(AT_FRAME, columns["stability"], BLUE),
            PlotLine(BETWEEN_FRAMES, columns["stability_between"], ORANGE, DASHES[1]),
        )
        yield PlotPanel(STABILITY_PANEL_NAME, margins, (0.0, 1.0))
    robot = plan.robot
    yield from _motion(plan, plan.q, CONFIGURATION_PANEL_NAMES, (robot.lower, robot.upper))
    speed = np.diff(plan.q, axis=0, prepend=np.nan) / plan.dt
    yield from _motion(plan, speed, SPEED_PANEL_NAMES, (-robot.speed, robot.speed))


def _clearance_panel(plan: Plan, columns: Mapping[str, Array]) -> PlotPanel:
    """Plot the least clearances of a plan, mm, and beside them what is known of its simulated robots."""
    lines = [PlotLine(AT_FRAME, columns["clearance"], BLUE)]
    if "clearance_between" in columns:
        lines.append(PlotLine(BETWEEN_FRAMES, columns["clearance_between"], ORANGE, DASHES[1]))
    samples = None if plan.drawn is None else plan.drawn.clearances
    if samples is not None:
        # A plan keeps the least clearance of a simulated robot over its whole motion only, hence a level line.
        level = np.full(len(plan.time), samples.most)
        lines.append(PlotLine("95 % of samples, whole motion", level, VERMILLION, DASHES[2]))
    return PlotPanel(CLEARANCE_PANEL_NAME, tuple(lines), (0.0,))


def _sample_error_panel(plan: Plan, found: Robustness, columns: Mapping[str, Array]) -> PlotPanel:
    """Plot e2 over the simulated robots of a plan beside its own, and where robots snap or leave their branch."""
    low, high = found.e2_quantiles(0.05, 0.95)
    lines = (
        PlotLine("median", columns[SAMPLE_E2_COLUMNS[0]], BLUE),
        PlotLine("the plan", columns["e2"], BLACK, DASHES[3]),
    )
    lost = np.array([loss.frame for loss in found.losses_by_frame], dtype=int)
    marks = ("fails here", lost) if len(lost) else None
    return PlotPanel(SAMPLE_ERROR_PANEL_NAME, lines, (0.0,), band=("5 % to 95 %", low, high), marks=marks)


def _motion(plan: Plan, values: Array, names: Sequence[str], limits: tuple[Array, Array]) -> Iterator[PlotPanel]:
    """Yield three panels of values (T, 2d + 2) in the order of q, with limits (2d + 2,)."""
    split = plan.robot.split
    for name, part, *sides in zip(names, split(values), *map(split, limits), strict=True):
        columns = range(part.shape[1])
        looks = [
            (f"θ{'xy'[i]}", TILT_COLOURS[i]) if "θ" in name else (f"tube {i + 1}", tube_colour(i)) for i in columns
        ]
        lines = tuple(
            PlotLine(label, part[:, i], colour, DASHES[i % len(DASHES)]) for i, (label, colour) in enumerate(looks)
        )
        yield PlotPanel(
            name, lines, limits=tuple(value for value in np.unique(sides).tolist() if np.isfinite(value))
        )


@dataclass(frozen=True)
class Mark:
    """Named part of a drawing: a path in units of EXTENT, y downward, its colour, and how it is dashed.

    kind: "line", "limit", "band" or "dots", by which the page styles it.
    """

    name: str
    path: str
    colour: str
    kind: str = "line"
    dash: str = ""


@dataclass(frozen=True)
class Plot:
    """A panel as the page draws it: its marks from the back to the front, and ticks (percent, text) of both axes.

    values: of each mark of kind "line" over the frames, (T,). end: the time in s at the right edge.
    """

    name: str
    marks: tuple[Mark, ...]
    across: tuple[tuple[float, str], ...]
    up: tuple[tuple[float, str], ...]
    values: tuple[Array, ...]
    end: float


def plots(plans: Sequence[Plan]) -> list[dict[str, Plot | None]]:
    """Return the plots of each plan by their names, in one order for all plans; None where a plan has no such
    panel.

    Panels of one name have one vertical range; each plan has its own time axis.
    """
    shown = [{panel.name: panel for panel in panels(plan)} for plan in plans]
    names = sorted({name for some in shown for name in some}, key=PANEL_NAME_ORDER.index)
    ranges = {name: _range([some[name] for some in shown if name in some]) for name in names}
    return [
        {name: _plot(plan, some[name], *ranges[name]) if name in some else None for name in names}
        for plan, some in zip(plans, shown, strict=True)
    ]


def _range(some: Sequence[PlotPanel]) -> tuple[float, float]:
    """Return the common range of the vertical axis of panels, with a margin."""
    values = np.concatenate(
        [
            part
            for panel in some
            for part in (panel.least, *(line.y for line in panel.lines), *(panel.band or ())[1:])
        ]
    )
    known = values[np.isfinite(values)]
    low = known.min(initial=np.inf)
    high = known.max(initial=-np.inf)
    if not known.size:
        return 0.0, 1.0
    margin = max(PANEL_MARGIN_FRACTION * (high - low), (MIN_PANEL_SPAN - (high - low)) / 2)
    return float(low - margin), float(high + margin)


def _plot(plan: Plan, panel: PlotPanel, low: float, high: float) -> Plot:
    """Return a panel as the page draws it, with a vertical axis from low to high."""
    end = float(plan.time[-1] + plan.dt / 2)

    def path(x: Array, y: Array) -> str:
        return _path(EXTENT * x / end, EXTENT * (high - y) / (high - low))

    marks = []
    if panel.band is not None:
        name, *sides = panel.band
        known = np.isfinite(sides[0]) & np.isfinite(sides[1])
        around = [np.concatenate([part[known], other[known][::-1]]) for part, other in ((plan.time,) * 2, sides)]
        marks.append(Mark(name, path(*around), SKY, "band"))
    both = np.array([0.0, end])
    limits = [path(both, np.full(2, limit)) for limit in panel.limits if low < limit < high]
    marks += [Mark("limit", "".join(limits), LIMIT, "limit", DASHES[3])] if limits else []
    lines = [
        Mark(line.name, path(plan.time, line.y), darken_for_white(line.colour), dash=line.dash)
        for line in panel.lines
    ]
    marks += lines
    if panel.marks is not None:
        name, at = panel.marks
        dots = "".join(path(plan.time[j - 1 : j], np.zeros(1)) for j in at)
        marks.append(Mark(name, dots, VERMILLION, "dots"))
    values = tuple(line.y for line in panel.lines)
    return Plot(panel.name, tuple(marks), _ticks(0.0, end), _ticks(low, high), values, end)


def _path(x: Array, y: Array) -> str:
    """Write lines through points (n,) in order, broken where y is not finite; a point by itself is a dot."""
    told = []
    for first, stop in find_flag_runs(np.isfinite(y)):
        points = [f"{a:.1f} {b:.1f}" for a, b in zip(x[first:stop], y[first:stop], strict=True)]
        told.append("M" + "L".join(points) + ("h0" if len(points) == 1 else ""))
    return "".join(told)


def _ticks(low: float, high: float) -> tuple[tuple[float, str], ...]:
    """Return round numbers from low to high, with how far along they are in percent."""
    values = np.array(MaxNLocator(MOST_TICKS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    inside = values[(values >= low) & (values <= high)]
    told = [f"{value:.6g}".replace("-", "\N{MINUS SIGN}") for value in inside]
    return tuple(zip((100 * (inside - low) / (high - low)).tolist(), told, strict=True))
