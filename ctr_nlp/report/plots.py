"""Errors, clearance, stability, configuration and speeds over time, with a cursor at the frame that is shown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.figures.parts.page import alone
from ctr_nlp.figures.parts.palette import BLACK, BLUE, ORANGE, SKY, TILT, VERMILLION, tube_colour
from ctr_nlp.plan.metrics import DRAWN, by_frame
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import Robustness
from ctr_nlp.support.extras import needed
from ctr_nlp.typing import Array, Index

ERROR, DRAWS, CLEARANCE, STABILITY = "error (mm)", "e2 of draws (mm)", "clearance (mm)", "stability margin"
CONFIGURATION = ("α (rad)", "β (mm)", "θ (rad)")
SPEEDS = ("dα/dt (rad/s)", "dβ/dt (mm/s)", "dθ/dt (rad/s)")
ORDER = (ERROR, DRAWS, CLEARANCE, STABILITY, *CONFIGURATION, *SPEEDS)
"""Names of panels from top to bottom."""

HEIGHT = 190
"""Of a plot in pixels."""
LEFT = 64
"""Pixels left of all plots, so that their time axes lie below one another."""
WIDTH, LIMIT = 1.8, "#777777"
"""Of lines, and the colour of limits."""
DASHES = ("solid", "dashed", "dotdash", "dotted")
MARGIN = 0.06
"""Above and below what is shown, as a part of it."""
LEAST_SPAN = 0.1
"""Of an axis: less is rounding noise."""


@dataclass(frozen=True)
class Line:
    """A named line of a plot over time: y (T,), colour, and how it is dashed."""

    name: str
    y: Array
    colour: str
    dash: str = "solid"


@dataclass(frozen=True)
class Panel:
    """Lines on one vertical axis, named with its unit; values that it always shows, and limits of the robot.

    band: its name, and lower and upper ends (T,) of what is filled behind the lines. marks: a name, and the frames
    (n,), from 1, that are marked at 0.
    """

    name: str
    lines: tuple[Line, ...]
    least: tuple[float, ...] = ()
    limits: tuple[float, ...] = ()
    band: tuple[str, Array, Array] | None = None
    marks: tuple[str, Index] | None = None


def panels(plan: Plan) -> Iterator[Panel]:
    """What there is to plot of a plan, from top to bottom."""
    columns = by_frame(plan)
    errors = Line("RMSE e2", columns["e2"], BLUE), Line("maximum of e1", columns["max"], VERMILLION, "dashed")
    yield Panel(ERROR, errors, (0.0,))
    if plan.drawn is not None:
        yield _draws(plan, plan.drawn, columns)
    if "clearance" in columns:
        yield Panel(CLEARANCE, (Line("least clearance", columns["clearance"], BLUE),), (0.0,))
    if "stability" in columns:
        margins = (
            Line("at the frame", columns["stability"], BLUE),
            Line("on the way to it", columns["stability_between"], ORANGE, "dashed"),
        )
        yield Panel(STABILITY, margins, (0.0, 1.0))
    robot = plan.robot
    yield from _motion(plan, plan.q, CONFIGURATION, (robot.lower, robot.upper))
    speed = np.diff(plan.q, axis=0, prepend=np.nan) / plan.dt
    yield from _motion(plan, speed, SPEEDS, (-robot.speed, robot.speed))


def _draws(plan: Plan, found: Robustness, columns: Mapping[str, Array]) -> Panel:
    """e2 over the draws of a plan beside its own, and where draws are lost."""
    low, high = found.e2_quantiles(0.05, 0.95)
    lines = Line("median", columns[DRAWN[0]], BLUE), Line("the plan", columns["e2"], BLACK, "dotted")
    lost = np.array([loss.frame for loss in found.when], dtype=int)
    marks = ("lost here", lost) if len(lost) else None
    return Panel(DRAWS, lines, (0.0,), band=("5 % to 95 %", low, high), marks=marks)


def _motion(plan: Plan, values: Array, names: Sequence[str], limits: tuple[Array, Array]) -> Iterator[Panel]:
    """Three panels of values (T, 2d + 2) in the order of q, with limits (2d + 2,)."""
    split = plan.robot.split
    for name, part, *sides in zip(names, split(values), *map(split, limits), strict=True):
        columns = range(part.shape[1])
        looks = [(f"θ{'xy'[i]}", TILT[i]) if "θ" in name else (f"tube {i + 1}", tube_colour(i)) for i in columns]
        lines = tuple(
            Line(label, part[:, i], colour, DASHES[i % len(DASHES)]) for i, (label, colour) in enumerate(looks)
        )
        yield Panel(name, lines, limits=tuple(value for value in np.unique(sides).tolist() if np.isfinite(value)))


def figures(plans: Sequence[Plan]) -> list[dict[str, Any]]:
    """Bokeh figures of each plan by their names, in one order for all plans; None where a plan has no such panel.

    Panels of one name have one vertical range; each plan has its own time axis. Spans named "cursor" mark the
    frame.
    """
    models = needed("bokeh.models")
    shown = [{panel.name: panel for panel in panels(plan)} for plan in plans]
    names = sorted({name for some in shown for name in some}, key=ORDER.index)
    ranges = {name: models.Range1d(*_range([some[name] for some in shown if name in some])) for name in names}
    found = []
    for plan, some in zip(plans, shown, strict=True):
        times = models.Range1d(0.0, float(plan.time[-1] + plan.dt / 2), bounds="auto")
        drawn = {name: _figure(plan, panel, times, ranges[name]) for name, panel in some.items()}
        found.append({name: drawn.get(name) for name in names})
    return found


def _range(some: Sequence[Panel]) -> tuple[float, float]:
    values = np.concatenate(
        [
            part
            for panel in some
            for part in (panel.least, *(line.y for line in panel.lines), *(panel.band or ())[1:])
        ]
    )
    known = values[np.isfinite(values)]
    low, high = known.min(initial=np.inf), known.max(initial=-np.inf)
    if not known.size:
        return 0.0, 1.0
    margin = max(MARGIN * (high - low), (LEAST_SPAN - (high - low)) / 2)
    return float(low - margin), float(high + margin)


def _figure(plan: Plan, panel: Panel, times: Any, values: Any) -> Any:
    """One plot; a tap moves all plans to that moment."""
    models, plotting = needed("bokeh.models"), needed("bokeh.plotting")
    frames = np.arange(1, len(plan.time) + 1)
    data = {"time": plan.time, "frame": frames} | {line.name: line.y for line in panel.lines}
    source = models.ColumnDataSource(data)
    figure = plotting.figure(
        height=HEIGHT,
        min_border_left=LEFT,
        sizing_mode="stretch_width",
        x_range=times,
        y_range=values,
        x_axis_label="time (s)",
        y_axis_label=panel.name,
        tools="xbox_zoom,xpan,reset",
        active_drag=None,
        toolbar_location="right",
    )
    if panel.band is not None:
        name, low, high = panel.band
        figure.varea(plan.time, low, high, fill_color=SKY, fill_alpha=0.4, legend_label=name)
    drawn = []
    for line in panel.lines:
        look = {"color": line.colour, "legend_label": line.name}
        drawn.append(figure.line("time", line.name, source=source, line_dash=line.dash, line_width=WIDTH, **look))
        if len(single := alone(line.y)):
            figure.scatter(plan.time[single], line.y[single], **look)
    for limit in (limit for limit in panel.limits if values.start < limit < values.end):
        figure.line([0.0, plan.time[-1]], limit, color=LIMIT, line_dash="dotted", legend_label="limit")
    if panel.marks is not None:
        name, at = panel.marks
        place = plan.time[at - 1], np.zeros(len(at))
        figure.scatter(*place, marker="triangle", size=9, color=VERMILLION, legend_label=name)
    tips = [("frame", "@frame"), ("time", "@time{0.00} s")]
    tips += [(line.name, f"@{{{line.name}}}{{0.000}}") for line in panel.lines]
    figure.add_tools(models.HoverTool(tooltips=tips, mode="vline", renderers=drawn[:1]))
    begin = float(plan.time[0])
    figure.add_layout(models.Span(location=begin, dimension="height", line_color=BLACK, name="cursor"))
    figure.toolbar.update(autohide=True, logo=None)
    figure.add_layout(figure.legend[0], "above")
    figure.legend.update(orientation="horizontal", border_line_color=None, padding=0, spacing=12, margin=2)
    code = "seek(cb_obj.x / duration)"
    figure.js_on_event("tap", models.CustomJS(code=code, args={"duration": float(plan.time[-1])}))
    return figure


def cursors(some: Iterable[Any]) -> list[str]:
    """Ids of the cursors of figures."""
    models = needed("bokeh.models")
    return [span.id for figure in some for span in figure.select({"type": models.Span, "name": "cursor"})]
