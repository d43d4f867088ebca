"""Draw errors over time, as Figs. 5 and 6 of the paper: their spread over the shape, and one value a frame."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import zip_longest
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ctr_nlp.plan import metrics
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.page import (
    STYLE,
    add_heading,
    by_frames,
    curve,
    frame_axis,
    label_text,
    panels,
    root_scale,
)
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

CURVES: dict[str, dict[str, Any]] = {
    "max": {"label": "maximum of e1", "color": VERMILLION, "lw": 1.6, "ls": "--"},
    "e2": {"label": "RMSE, e2", "color": BLUE, "lw": 2.2, "ls": "-"},
    "tip": {"label": "tip", "color": GREEN, "lw": 0.9, "ls": "-."},
    "nearest": {"label": "nearest point, RMS", "color": PURPLE, "lw": 0.9, "ls": "-"},
}
"""Columns of errors.csv that are drawn, and their styles: the paper's two are strong, the others thin."""

COMPARED: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "lw": 2.2},
    {"color": ORANGE, "lw": 1.6},
    {"color": BLACK, "lw": 0.9},
)
"""Styles of the first, second and third plan in one panel."""
LINES: tuple[tuple[Any, str], ...] = (("-", "RMSE, e2"), ((0, (3, 1.5)), "maximum of e1"))
"""Line styles of the two errors, with their names."""


@matplotlib.rc_context(STYLE)
def by_frame(plan: Plan) -> Figure:
    """Draw maximum of e1, e2, tip error and distance to the nearest target point by frame, in mm.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    Figure
        One panel; failed frames are marked.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.view.figures import by_frame
    >>> from ctr_nlp.problems import named_problem
    >>> figure = by_frame(ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant"))
    >>> figure.axes[0].get_ylabel()
    'distance (mm)'
    """
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    columns = metrics.by_frame(plan)
    frames = by_frames(axes, plan)
    for name, look in CURVES.items():
        curve(axes, frames, columns[name], **look)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("distance (mm)")
    figure.legend(loc="outside lower center", ncols=4)
    add_heading(figure, plan, "Error by frame")
    return figure


@matplotlib.rc_context(STYLE)
def by_frame_compared(plans: Mapping[str, Mapping[str, Plan]]) -> Figure:
    """Draw e2 (solid) and the maximum of e1 (dashed) of up to three plans a problem, in mm, on a square-root
    scale.

    Parameters
    ----------
    plans : mapping of str to mapping of str to Plan
        Plans by the name of the problem, then by what the plan is called.

    Returns
    -------
    Figure
        One panel a problem.
    """
    figure, grid = panels(list(plans), 2, (3.6, 2.6))
    for axes, some in zip(grid, plans.values(), strict=True):
        for (name, plan), look in zip(some.items(), COMPARED, strict=False):
            columns = metrics.by_frame(plan)
            curve(axes, columns["frame"], columns["e2"], label=label_text(name), **look)
            curve(axes, columns["frame"], columns["max"], ls=LINES[1][0], **look | {"lw": 0.6 * look["lw"]})
        frame_axis(axes, len(plan.time))
        root_scale(axes)
        axes.set_ylabel("distance (mm), square-root scale")
    handles = grid[0].get_legend_handles_labels()[0]
    styles = [Line2D([], [], color="0.4", ls=ls, label=name) for ls, name in LINES]
    entries = [handle for pair in zip_longest(handles, styles) for handle in pair if handle is not None]
    figure.legend(handles=entries, loc="outside lower center", ncols=len(handles))
    return figure


GROUPS = 10
"""Violins in the picture; fewer where there are fewer frames."""
VIOLIN_COLOURS = SKY, VERMILLION
"""Colours of two violins side by side."""


@matplotlib.rc_context(STYLE)
def errors(plan: Plan) -> Figure:
    """Draw violins of e1 over the shape in mm, one for each tenth of the motion, with medians and middle halves.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    Figure
        One panel over time.
    """
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    groups = _groups(plan)
    for values, begin, end in spread(plan):
        _violin(axes, values, (begin + end) / 2, 0.85 * (end - begin), SKY)
    sizes = sorted({len(group) for group in groups})
    count = " or ".join(map(str, sizes)) + (" frame" if sizes == [1] else " frames")
    _over_time(axes, plan, f"time (s)\n{count} a violin; bar and dot: middle half and median")
    axes.set_ylim(bottom=0.0)
    add_heading(figure, plan, "Distance from robot to target")
    return figure


@matplotlib.rc_context(STYLE)
def errors_compared(plans: Mapping[str, Mapping[str, Plan]]) -> Figure:
    """Draw violins of e1 of two plans a problem, side by side, on a square-root scale.

    Parameters
    ----------
    plans : mapping of str to mapping of str to Plan
        Plans by the name of the problem, then by what the plan is called.

    Returns
    -------
    Figure
        One panel a problem.
    """
    figure, grid = panels(list(plans), 2, (3.6, 2.3))
    for axes, pair in zip(grid, plans.values(), strict=True):
        for k, (plan, colour) in enumerate(zip(pair.values(), VIOLIN_COLOURS, strict=True)):
            for values, begin, end in spread(plan):
                half = (end - begin) / 2
                _violin(axes, values, begin + (k + 0.5) * half, 0.85 * half, colour)
        _over_time(axes, plan, "time (s)")
        root_scale(axes)
    look: dict[str, Any] = {"edgecolor": BLACK, "lw": 0.6}
    handles = [
        Patch(facecolor=c, label=label_text(name), **look) for name, c in zip(pair, VIOLIN_COLOURS, strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def spread(plan: Plan) -> list[tuple[Array, float, float]]:
    """Return e1 at all samples, for each tenth of a motion.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    list of (ndarray, float, float)
        For each tenth e1 (n,), mm, and when it begins and ends, s. Tenths without a known shape are left out.
    """
    distance = metrics.e1(plan)
    found = []
    for group in _groups(plan):
        known = distance[group][np.isfinite(distance[group]).all(axis=1)]
        if known.size:
            found.append((known.ravel(), float(plan.time[group[0]] - plan.dt), float(plan.time[group[-1]])))
    return found


def _groups(plan: Plan) -> list[npt.NDArray[np.int_]]:
    """Return the numbers of the frames of each tenth, from 0."""
    return np.array_split(np.arange(len(plan.time)), min(GROUPS, len(plan.time)))


def _violin(axes: Axes, values: Array, centre: float, width: float, colour: str) -> None:
    """Draw a violin of `values`, mm, at time `centre`, s, with its median and middle half."""
    # A density needs a spread: once rounded, values that differ by noise alone are equal, and drawn flat.
    parts: Any = axes.violinplot([np.round(values, 9)], [centre], widths=width, showextrema=False, points=200)
    for body in parts["bodies"]:
        body.set(facecolor=colour, edgecolor=BLACK, linewidth=0.6, alpha=1.0)
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    axes.vlines(centre, low, high, color=BLACK, lw=3.0)
    axes.plot([centre], [median], marker="o", ms=4, mfc="white", mec=BLACK, mew=0.8)


def _over_time(axes: Axes, plan: Plan, label: str) -> None:
    """Label the axes of a panel over time."""
    axes.set_xlim(0.0, plan.time[-1])
    axes.grid(visible=False, axis="x")
    axes.set_xlabel(label)
    axes.set_ylabel("e1 (mm)")
