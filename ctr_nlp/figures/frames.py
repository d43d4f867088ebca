"""The error of every frame, as Fig. 6 of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import zip_longest
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ctr_nlp.figures.parts.page import STYLE, curve, frame_axis, head, shade_failures
from ctr_nlp.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION
from ctr_nlp.figures.parts.panels import panels, root_scale
from ctr_nlp.plan import metrics
from ctr_nlp.plan.plan import Plan

CURVES: dict[str, dict[str, Any]] = {
    "max": {"label": "maximum of e1", "color": VERMILLION, "lw": 1.6, "ls": "--"},
    "e2": {"label": "RMSE, e2", "color": BLUE, "lw": 2.2, "ls": "-"},
    "tip": {"label": "tip", "color": GREEN, "lw": 0.9, "ls": "-."},
    "nearest": {"label": "nearest point, RMS", "color": PURPLE, "lw": 0.9, "ls": "-"},
}
"""Columns of errors.csv in the picture and how they are drawn: the paper's two strong, the others thin."""

COMPARED: tuple[dict[str, Any], ...] = (
    {"color": BLUE, "lw": 2.2},
    {"color": ORANGE, "lw": 1.6},
    {"color": BLACK, "lw": 0.9},
)
"""How plans are drawn in one panel."""
LINES: tuple[tuple[Any, str], ...] = (("-", "RMSE, e2"), ((0, (3, 1.5)), "maximum of e1"))


@matplotlib.rc_context(STYLE)
def by_frame(plan: Plan) -> Figure:
    """Maximum of e1, e2, tip distance and distance to the nearest target point by frame, in mm."""
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    columns = metrics.by_frame(plan)
    shade_failures(axes, plan, columns["frame"], 1.0)
    for name, look in CURVES.items():
        curve(axes, columns["frame"], columns[name], **look)
    axes.set_ylim(bottom=0.0)
    frame_axis(axes, len(plan.time))
    axes.set_ylabel("distance (mm)")
    figure.legend(loc="outside lower center", ncols=4)
    head(figure, plan, "Error by frame")
    return figure


@matplotlib.rc_context(STYLE)
def by_frame_compared(plans: Mapping[str, Mapping[str, Plan]]) -> Figure:
    """A panel for each problem with e2, solid, and the maximum of e1, dashed, of up to three plans, in mm.

    plans: by problem, then by what the plan is called. The scale is that of square roots.
    """
    figure, grid = panels(list(plans), 2, (3.6, 2.6))
    for axes, some in zip(grid, plans.values(), strict=True):
        for (name, plan), look in zip(some.items(), COMPARED, strict=False):
            columns = metrics.by_frame(plan)
            curve(axes, columns["frame"], columns["e2"], label=name, **look)
            curve(axes, columns["frame"], columns["max"], ls=LINES[1][0], **look | {"lw": 0.6 * look["lw"]})
        frame_axis(axes, len(plan.time))
        root_scale(axes)
        axes.set_ylabel("distance (mm)")
    handles = grid[0].get_legend_handles_labels()[0]
    styles = [Line2D([], [], color="0.4", ls=ls, label=name) for ls, name in LINES]
    entries = [handle for pair in zip_longest(handles, styles) for handle in pair if handle is not None]
    figure.legend(handles=entries, loc="outside lower center", ncols=len(handles))
    return figure
