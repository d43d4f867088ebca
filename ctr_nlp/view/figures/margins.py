"""Draw the distance of a motion from snapping, and of its tubes from the lumen's wall."""

from __future__ import annotations

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan import metrics
from ctr_nlp.plan.measures import contacts
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.page import (
    AT_FRAME,
    BETWEEN_FRAMES,
    STYLE,
    add_heading,
    by_frames,
    curve,
    legend_of,
    shade_failures,
)
from ctr_nlp.view.figures.parts.palette import (
    BLUE,
    CLEARANCE_COLOUR_MAP,
    CONTACT,
    ORANGE,
    VERMILLION,
    tube_colour,
    tube_width,
)


@matplotlib.rc_context(STYLE)
def stability(plan: Plan) -> Figure:
    """Draw the stability margin of `plan` at every frame and on the way to it, the margin asked for, and snaps."""
    figure = Figure(figsize=(7.0, 3.2), layout="constrained")
    axes = figure.subplots()
    frames = by_frames(axes, plan)
    curve(axes, frames, plan.stability_between, color=ORANGE, lw=1.2, ls="--", label=BETWEEN_FRAMES)
    curve(axes, frames, plan.stability, color=BLUE, lw=2.0, ls="-", label=AT_FRAME)
    asked = plan.meta["options"].get("stability_margin")
    if asked is not None:
        axes.axhline(asked, color="0.3", lw=0.9, ls=":", label=f"asked for, {asked:g}")
    for k, snap in enumerate(plan.meta.get("snaps", [])):
        axes.axvline(snap["frame"], color=VERMILLION, lw=1.2, label=None if k else "snap")
    axes.axhline(0.0, color="0.3", lw=0.6)
    low = float(np.nanmin(np.append(plan.stability_between[np.isfinite(plan.stability_between)], 0.0)))
    axes.set_ylim(min(1.15 * low, -0.02), 1.05)
    axes.set_ylabel("stability margin")
    figure.legend(loc="outside lower center", ncols=4)
    add_heading(figure, plan, "Stability")
    return figure


CLEARANCE_COLOUR_POWER = 0.5
"""Exponent of the colour scale: the last millimetre has more shades than others."""
TUBE_END_LINE_STYLES = ("-", (0, (6, 2)), (0, (2, 1.5)))
"""Lines at tubes' ends, which differ without their colours too; they repeat after three tubes."""
MIN_CLEARANCE_SPAN_MM = 0.1
"""Least span of clearances, and least depth that is drawn beyond the wall."""


@matplotlib.rc_context(STYLE)
def clearance(plan: Plan) -> Figure:
    """Draw clearance along the robot by frame, tubes' ends and contacts of `plan`; below, the least clearance at
    each frame and on the way to it; mm.
    """
    assert plan.clearance is not None
    figure = Figure(figsize=(7.0, 5.8), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    frames = by_frames(lower, plan)
    shade_failures(upper, plan, frames, 1.0)
    _map(figure, upper, plan, plan.clearance)
    _ends(upper, plan)
    _least(lower, frames, plan)
    handles = legend_of(lower, upper)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    add_heading(figure, plan, "Clearance from the wall")
    return figure


def _map(figure: Figure, axes: Axes, plan: Plan, found: Array) -> None:
    """Draw clearances (T, 101) mm as colours over frames and arc length: a column a frame, as long as its
    robot.
    """
    cells = np.concatenate([[0.0], (SIGMA_GRID[1:] + SIGMA_GRID[:-1]) / 2, [1.0]])
    length = np.nan_to_num(plan.beta[:, -1])
    # Robots of neighbouring frames differ in length. Columns of zero width and no value between frames let one
    # mesh have a step there.
    sides = np.repeat(np.arange(len(length) + 1) + 0.5, 2)[1:-1]
    columns = np.full((2 * len(length) - 1, len(SIGMA_GRID)), np.nan)
    columns[::2] = found
    corners = np.broadcast_to(sides, (len(cells), len(sides))), np.outer(cells, np.repeat(length, 2))
    norm = PowerNorm(
        CLEARANCE_COLOUR_POWER, 0.0, found.max(where=np.isfinite(found), initial=MIN_CLEARANCE_SPAN_MM)
    )
    drawn = axes.pcolormesh(*corners, np.ma.masked_invalid(columns.T), cmap=CLEARANCE_COLOUR_MAP, norm=norm)
    figure.colorbar(drawn, ax=axes, label="clearance (mm), contact below 0", extend="min", pad=0.01)
    axes.set_ylim(0.0, 1.04 * length.max(initial=1.0))
    axes.grid(False)
    axes.set_ylabel("along the robot (mm)")


def _ends(axes: Axes, plan: Plan) -> None:
    """Mark where tubes end, and where contacts are deepest."""
    sides = np.arange(len(plan.time) + 1) + 0.5
    for i, ends in enumerate(plan.beta.T):
        width = 0.4 + 0.5 * tube_width(i, plan.robot.d)
        line = TUBE_END_LINE_STYLES[i % len(TUBE_END_LINE_STYLES)]
        axes.stairs(
            ends, sides, baseline=None, color=tube_colour(i), lw=width, ls=line, label=f"end of tube {i + 1}"
        )
    deepest = np.array([(contact.frame, contact.arc_length) for contact in contacts(plan)])
    if len(deepest):
        axes.plot(*deepest.T, color="black", mfc="white", ls="", marker="o", ms=5, label="deepest in contact")


def _least(axes: Axes, frames: npt.NDArray[np.int_], plan: Plan) -> None:
    """Draw the least clearance of a plan, mm, at every frame and on the way to it, and shade what is beyond the
    wall.
    """
    columns = metrics.by_frame(plan)
    least = columns["clearance"]
    between = columns.get("clearance_between")
    curve(axes, frames, least, color=BLUE, lw=1.8, label=AT_FRAME)
    if between is not None:
        curve(axes, frames, between, color=ORANGE, lw=1.2, ls="--", label=BETWEEN_FRAMES)
    touching = least < 0
    if touching.any():
        axes.plot(frames[touching], least[touching], color=CONTACT, ls="", marker="s", ms=3.5, label="contact")
    known = least if between is None else np.concatenate([least, between])
    known = known[np.isfinite(known)]
    low = known.min(initial=0.0)
    high = known.max(initial=0.0)
    margin = max(0.08 * (high - low), MIN_CLEARANCE_SPAN_MM)
    axes.set_ylim(low - margin, high + margin)
    axes.axhspan(low - 2 * margin, 0.0, color=VERMILLION, alpha=0.15, lw=0, zorder=0, label="beyond the wall")
    axes.axhline(0.0, color="0.2", lw=0.9)
    axes.set_ylabel("least clearance (mm)")
