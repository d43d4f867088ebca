"""The error of every frame, as Fig. 6 of the seed."""

from __future__ import annotations

from typing import Any

import matplotlib
from matplotlib.figure import Figure

from ctr_nlp import metrics
from ctr_nlp.figures.page import STYLE, curve, frame_axis, head, shade_failures
from ctr_nlp.figures.palette import BLUE, GREEN, PURPLE, VERMILLION
from ctr_nlp.plan import Plan

CURVES: dict[str, dict[str, Any]] = {
    "max": {"label": "maximum of e1", "color": VERMILLION, "lw": 1.6, "ls": "--"},
    "e2": {"label": "RMSE, e2", "color": BLUE, "lw": 2.2, "ls": "-"},
    "tip": {"label": "tip", "color": GREEN, "lw": 0.9, "ls": "-."},
    "nearest": {"label": "nearest point, RMS", "color": PURPLE, "lw": 0.9, "ls": "-"},
}
"""Columns of errors.csv in the picture and how they are drawn: the seed's two strong, the others thin."""


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
