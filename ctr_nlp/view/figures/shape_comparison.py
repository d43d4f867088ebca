"""Draw plans of one target beside each other: a row a plan, a column a frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.plan.measures import rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.view.figures.overlay import draw, frames_shown, key, to_scale
from ctr_nlp.view.figures.parts.page import STYLE, add_title, printable
from ctr_nlp.view.figures.parts.palette import VERMILLION

DEFAULT_COMPARED_FRAMES = 4
"""Number of columns where the caller names no frames."""
ARROW = 0.12
"""Length of a force's arrow, as a part of a panel's height."""
SIZE = 1.9, 2.1
"""Largest width and height of a panel, inches."""


@rc_context(STYLE)
def shapes_compared(plans: Mapping[str, Plan], title: str, frames: Sequence[int] | None = None) -> Figure:
    """Draw shapes of plans over their targets in the same frames, to scale, in mm, a row a plan.

    plans: by name; all have as many frames. title: of the figure. frames: numbers from 1, by default four, evenly
    spread. Seen from the side where targets are widest, with z upwards; a tip force is an arrow. Raises
    OptionError for a frame that the plans do not have.
    """
    first = next(iter(plans.values()))
    shown = frames_shown(first, frames, DEFAULT_COMPARED_FRAMES)
    index = np.array(shown) - 1
    points = np.concatenate([np.concatenate([each.target[index], each.shape[index]]) for each in plans.values()])
    low = np.nanmin(points, axis=(0, 1))
    high = np.nanmax(points, axis=(0, 1))
    sideways = int(np.argmax(np.ptp(first.target[index], axis=(0, 1))[:2]))
    extent = high - low
    panel = np.array([max(extent[sideways], 0.5 * extent[2]), extent[2]]) * 1.2
    scale = min(SIZE[0] / panel[0], SIZE[1] / panel[1])
    width, height = panel * scale
    figure = Figure(figsize=(width * len(shown) + 1.6, (height + 0.6) * len(plans) + 1.1), layout="constrained")
    grid = figure.subplots(len(plans), len(shown), sharex=True, sharey=True, squeeze=False)
    for row, (name, plan) in zip(grid, plans.items(), strict=True):
        for axes, number in zip(row, shown, strict=True):
            draw(axes, plan, number - 1, sideways)
            _arrow(axes, plan, number - 1, sideways, ARROW * panel[1])
            to_scale(axes, (low + high) / 2, panel, sideways)
            axes.label_outer()
            axes.set_title(_frame_title(plan, number))
        row[0].set_ylabel(f"{printable(name)}\nz (mm)", parse_math=False)
    figure.legend(handles=key(first.robot.d), loc="outside lower center", ncols=first.robot.d + 1)
    add_title(figure, title)
    return figure


def _frame_title(plan: Plan, number: int) -> str:
    """Return the frame, its error, and whether it failed or the robot has snapped by then."""
    away = plan.shape[number - 1] - plan.target[number - 1]
    error = float(rms_over_sigma(np.linalg.norm(away, axis=-1)))
    told = [] if plan.success[number - 1] else ["failed"]
    if any(snap["frame"] <= number for snap in plan.meta.get("snaps", [])):
        told = ["snapped"]
    return f"frame {number}\n" + ", ".join([*told, *([f"{error:.2g} mm off"] if math.isfinite(error) else [])])


def _arrow(axes: Axes, plan: Plan, frame: int, sideways: int, length: float) -> None:
    """Draw a tip force that keeps its direction, as far as it lies in the plane of the picture; length: mm."""
    if plan.evaluated_load is None or plan.evaluated_load.has_follower_force:
        return
    force = plan.evaluated_load.numbers_at(plan.robot.d, np.array([frame / max(len(plan.time) - 1, 1)]))[0, :3]
    if not force.any():
        return
    x, z = (force[[sideways, 2]] / np.linalg.norm(force) * length).tolist()
    tip_x, tip_z = plan.shape[frame, -1, [sideways, 2]].tolist()
    how = {"arrowstyle": "-|>", "color": VERMILLION, "lw": 1.5, "shrinkA": 0.0, "shrinkB": 0.0}
    if math.hypot(x, z) > 0.1 * length:
        axes.annotate("", (tip_x + x, tip_z + z), (tip_x, tip_z), arrowprops=how, annotation_clip=False)
