"""Draw a plan on robots sampled within the tolerances: a cloud of shapes, and errors with their band."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ctr_nlp.plan.measures import e1, rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import Robustness
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.overlay import TARGET_LINE_STYLE
from ctr_nlp.view.figures.parts.page import STYLE, add_heading, by_frames, curve, legend_of, root_scale
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, ORANGE, SKY, VERMILLION

CLOUD: dict[str, Any] = {"lw": 0.6, "alpha": 0.7}
"""Style of the lines of single simulated robots."""


@matplotlib.rc_context(STYLE)
def robustness(plan: Plan) -> Figure:
    """Draw shapes of all simulated robots in a few frames, failed ones in another colour; below them e2 over
    frames.

    plan: a plan with simulated robots. Shapes are seen from the side on which the motion is widest, to scale, in
    mm. e2 is drawn for the plan, and over robots as median and 5 % to 95 % band, on a square-root scale; marks
    show where robots snap or leave their branch.
    """
    assert plan.drawn is not None
    figure = Figure(figsize=(7.0, 6.6), layout="constrained")
    count = len(plan.drawn.cloud_frames)
    axes = figure.subplot_mosaic(
        [[f"cloud {k}" for k in range(count)], ["errors"] * count], height_ratios=(1.3, 1.0)
    )
    _clouds([axes[f"cloud {k}"] for k in range(count)], plan, plan.drawn)
    _errors(axes["errors"], plan, plan.drawn)
    names = {"simulated robot": (SKY, "-"), "after it failed": (VERMILLION, "-"), "the plan": (BLACK, "-")}
    handles = {label: Line2D([], [], color=colour, ls=ls, lw=1.2) for label, (colour, ls) in names.items()}
    handles |= {"target": Line2D([], [], **TARGET_LINE_STYLE)} | legend_of(axes["errors"])
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    add_heading(figure, plan, f"Robustness, {plan.drawn.lost_count} of {len(plan.drawn)} simulated robots snap")
    return figure


def _clouds(panels: list[Axes], plan: Plan, found: Robustness) -> None:
    """Draw the simulated robots, the plan and its target, a panel a frame."""
    points = np.concatenate([found.cloud.reshape(-1, 3), plan.target.reshape(-1, 3)])
    low = np.nanmin(points, axis=0)
    high = np.nanmax(points, axis=0)
    sideways = int(high[1] - low[1] > high[0] - low[0])
    margin = 0.05 * (high - low).max()
    for axes, frame, shapes in zip(panels, found.cloud_frames, found.cloud, strict=True):
        gone = (found.lost > 0) & (found.lost <= frame)
        for some, colour in ((shapes[~gone], SKY), (shapes[gone], VERMILLION)):
            axes.add_collection(LineCollection(list(_project_sideways(some, sideways)), colors=colour, **CLOUD))
        axes.plot(*_project_sideways(plan.shape[frame - 1], sideways).T, color=BLACK, lw=1.2)
        axes.plot(*_project_sideways(plan.target[frame - 1], sideways).T, **TARGET_LINE_STYLE)
        axes.set_xlim(low[sideways] - margin, high[sideways] + margin)
        axes.set_ylim(low[2] - margin, high[2] + margin)
        axes.set_aspect("equal")
        axes.set_title(f"frame {frame}")
        axes.set_xlabel(f"{'xy'[sideways]} (mm)")
        axes.locator_params(axis="x", nbins=2)
    panels[0].set_ylabel("z (mm)")


def _project_sideways(points: Array, sideways: int) -> Array:
    """Project points (.., 3) to one side, (.., 2); sideways: 0 for x, 1 for y."""
    return points[..., [sideways, 2]]


def _errors(axes: Axes, plan: Plan, found: Robustness) -> None:
    """Draw e2 of the plan and its distribution over the simulated robots, mm."""
    frames = by_frames(axes, plan)
    low, middle, high = found.e2_quantiles(0.05, 0.5, 0.95)
    axes.fill_between(frames, low, high, color=SKY, alpha=0.5, lw=0, label="5 % to 95 % of simulated robots")
    curve(axes, frames, middle, color=BLUE, lw=1.6, label="median of simulated robots")
    curve(axes, frames, rms_over_sigma(e1(plan)), color=BLACK, lw=1.2)
    axes.set_ylabel("e2 (mm), square-root scale")
    root_scale(axes)
    if found.losses_by_frame:
        at, counts = np.array([(loss.frame, loss.draws) for loss in found.losses_by_frame]).T
        look: dict[str, Any] = {
            "color": ORANGE,
            "edgecolor": BLACK,
            "linewidth": 0.4,
            "zorder": 5,
            "clip_on": False,
        }
        axes.scatter(at, 0.0 * at, s=14 + 4 * counts, marker="^", label="robots snap here", **look)
