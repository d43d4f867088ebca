"""How the error spreads over the shape as time passes, as Fig. 5 of the seed."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp import metrics
from ctr_nlp.figures.page import STYLE, head
from ctr_nlp.figures.palette import BLACK, SKY
from ctr_nlp.plan import Plan

Array = npt.NDArray[np.float64]

GROUPS = 10
"""Violins in the picture; fewer where there are fewer frames."""


@matplotlib.rc_context(STYLE)
def errors(plan: Plan) -> Figure:
    """Violins of e1 over the shape in mm, one for each tenth of the motion, with medians and middle halves."""
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    distance = metrics.e1(plan)
    groups = np.array_split(np.arange(len(plan.time)), min(GROUPS, len(plan.time)))
    for group in groups:
        known = distance[group][np.isfinite(distance[group]).all(axis=1)]
        if known.size:
            begin, end = plan.time[group[0]] - plan.dt, plan.time[group[-1]]
            _violin(axes, known.ravel(), (begin + end) / 2, 0.85 * (end - begin))
    _label(axes, plan, sorted({len(group) for group in groups}))
    head(figure, plan, "Distance from robot to target")
    return figure


def _violin(axes: Axes, values: Array, centre: float, width: float) -> None:
    # A density needs a spread: once rounded, values that differ by noise alone are equal, and drawn flat.
    parts: Any = axes.violinplot([np.round(values, 9)], [centre], widths=width, showextrema=False, points=200)
    for body in parts["bodies"]:
        body.set(facecolor=SKY, edgecolor=BLACK, linewidth=0.6, alpha=1.0)
    low, median, high = np.quantile(values, [0.25, 0.5, 0.75])
    axes.vlines(centre, low, high, color=BLACK, lw=3.0)
    axes.plot([centre], [median], marker="o", ms=4, mfc="white", mec=BLACK, mew=0.8)


def _label(axes: Axes, plan: Plan, sizes: list[int]) -> None:
    axes.set_xlim(0.0, plan.time[-1])
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=False, axis="x")
    count = " or ".join(str(size) for size in sizes) + (" frame" if sizes == [1] else " frames")
    axes.set_xlabel(f"time (s)\n{count} a violin; bar and dot: middle half and median")
    axes.set_ylabel("e1 (mm)")
