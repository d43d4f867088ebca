"""Draw a robot's sheet: its tubes from the side and in section, their dimensions with tolerances, and its
tasks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ctr_nlp.ocp.shared.manufacture import diameter_tolerances
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot, Tube
from ctr_nlp.robot.strain import pre_curvature
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.overlay import draw, key
from ctr_nlp.view.figures.parts.page import STYLE, add_title, printable
from ctr_nlp.view.figures.parts.palette import BLACK, tube_colour

SHEET = 11.7, 8.3
"""Size in inches of a sheet without tasks: A4, landscape."""
ROW, TASKS = 3.4, 4
"""Height, inches, of a row of tasks, and the most tasks of a row."""
TUBE_DRAWING_POINTS = 200
"""Number of points along a tube's middle line."""
SHOWN_TRANSMISSION_MM = 20.0
"""Length of the straight transmission that a side view shows; the rest is broken off."""
TUBE_DIMENSION_COLUMNS = (
    "tube",
    "outer diameter",
    "inner diameter",
    "wall",
    "length",
    "curved part",
    "radius at root",
    "radius at tip",
    "strain when made",
    "curvature within",
    "diameters within",
)
LARGEST_RADIUS = 5000.0
"""Radius, mm, from which on a part is called straight."""


@rc_context(STYLE)
def sheet(robot: Robot, title: str, plans: Sequence[Plan] = ()) -> Figure:
    """Draw every tube from the side, free of the others, and in section; all nested; a table of dimensions.

    robot: the robot. title: of the sheet. plans: of the tasks that the robot was designed for, each drawn in its
    last frame with its target. Tolerances of curvature are the robot's; those of diameters are the ones with which
    tubing is sold (manufacture.py).
    """
    rows = math.ceil(len(plans) / TASKS)
    figure = Figure(figsize=(SHEET[0], SHEET[1] + ROW * rows), layout="constrained")
    parts: Any = figure.subfigures(2 + (rows > 0), 1, height_ratios=(6.2, *([ROW * rows] if rows else []), 2.1))
    above = parts[0]
    below = parts[-1]
    grid = above.subplots(2, robot.d + 1, height_ratios=(2, 1), squeeze=False)
    views = [middle_line(tube) for tube in robot.tubes]
    low = np.min([view.min(axis=0) for view in views], axis=0) - 5
    high = np.max([view.max(axis=0) for view in views], axis=0) + 5
    for i, (tube, view) in enumerate(zip(robot.tubes, views, strict=True)):
        _side(grid[0, i], i, tube, view, (low, high))
        _section(grid[1, i], [(i, tube)], robot.tubes[0].outer_diameter)
    _draw_nested_tubes(grid[0, robot.d], robot, views, (low, high))
    _section(grid[1, robot.d], list(enumerate(robot.tubes)), robot.tubes[0].outer_diameter)
    if rows:
        _tasks(parts[1], plans)
    _table(below.subplots(), robot)
    add_title(figure, title, fontsize=11)
    return figure


def _tasks(page: Any, plans: Sequence[Plan]) -> None:
    """Draw the robot of each plan in its last frame, with the target, in the zx- and the yz-plane, all to one
    scale.
    """
    rows = math.ceil(len(plans) / TASKS)
    grid = page.subplots(rows, 2 * min(len(plans), TASKS), squeeze=False, sharey=True)
    points = [np.concatenate([plan.shape[-1], plan.target[-1], np.zeros((1, 3))]) for plan in plans]
    low, high = (end(np.array([end(each, axis=0) for each in points]), axis=0) for end in (np.nanmin, np.nanmax))
    side = 0.5 * float((high - low)[:2].max()) + 5
    for k, axes in enumerate(grid.flat):
        if k // 2 >= len(plans):
            axes.remove()
            continue
        plan = plans[k // 2]
        sideways = k % 2
        draw(axes, plan, len(plan.time) - 1, sideways)
        middle = (low + high)[sideways] / 2
        axes.set_xlim(middle - side, middle + side)
        axes.set_ylim(low[2] - 5, high[2] + 5)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{'xy'[sideways]} (mm)")
        if not sideways:
            numbers = summary(plan)
            told = printable(f"{numbers['problem']}, e3 {numbers['e3']:.2f} mm")
            axes.set_title(told, loc="left", parse_math=False)
    for axes in grid[:, 0]:
        axes.set_ylabel("z (mm)")
    page.legend(handles=key(plans[0].robot.d), loc="outside lower center", ncols=6)


def middle_line(tube: Tube) -> Array:
    """Return a tube's middle line free of all others, (n, 2) mm: across and along; 0 where its curved part
    begins.
    """
    s = np.linspace(0.0, tube.curved_length, TUBE_DRAWING_POINTS)
    bent = np.array([pre_curvature(tube, tube.curved_length - each) for each in s])
    # Angle by the trapezoidal rule, then steps along the mean direction of each: second order in the step.
    angle = np.concatenate([[0.0], np.cumsum((bent[1:] + bent[:-1]) / 2 * np.diff(s))])
    middle = (angle[1:] + angle[:-1]) / 2
    steps = np.diff(s)[:, None] * np.column_stack([np.sin(middle), np.cos(middle)])
    curved = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    straight = min(SHOWN_TRANSMISSION_MM, tube.length - tube.curved_length)
    return np.concatenate([[[0.0, -straight]], curved])


def _side(axes: Axes, i: int, tube: Tube, view: Array, ends: tuple[Array, Array]) -> None:
    axes.plot(view[:, 0], view[:, 1], color=tube_colour(i), lw=1.2 * tube.outer_diameter**0.7)
    axes.plot(0.0, 0.0, "|", color=BLACK, ms=12, mew=1)
    axes.set_title(f"tube {i + 1}, curved part {tube.curved_length:.1f} mm", loc="left")
    _frame(axes, ends)


def _draw_nested_tubes(axes: Axes, robot: Robot, views: list[Array], ends: tuple[Array, Array]) -> None:
    for i, (tube, view) in enumerate(zip(robot.tubes, views, strict=True)):
        axes.plot(view[:, 0], view[:, 1], color=tube_colour(i), lw=1.0 + 0.4 * tube.outer_diameter)
    axes.set_title("all, each free of the others", loc="left")
    _frame(axes, ends)


def _frame(axes: Axes, ends: tuple[Array, Array]) -> None:
    axes.set_xlim(ends[0][0], ends[1][0])
    axes.set_ylim(ends[0][1], ends[1][1])
    axes.set_aspect("equal")
    axes.set_xlabel("mm")


def _section(axes: Axes, tubes: list[tuple[int, Tube]], width: float) -> None:
    """Draw rings, outer ones first; width: largest outer diameter, mm."""
    for i, tube in tubes:
        outer = tube.outer_diameter / 2
        inner = tube.inner_diameter / 2
        axes.add_patch(Circle((0, 0), outer, facecolor=tube_colour(i), edgecolor=BLACK, lw=0.5))
        axes.add_patch(Circle((0, 0), inner, facecolor="white", edgecolor=BLACK, lw=0.5))
    one = tubes[0][1]
    told = f"⌀ {one.outer_diameter:.2f} / {one.inner_diameter:.2f} mm" if len(tubes) == 1 else "nested"
    axes.set_title(told, loc="left")
    axes.set_xlim(-0.6 * width, 0.6 * width)
    axes.set_ylim(-0.6 * width, 0.6 * width)
    axes.set_aspect("equal")
    axes.axis("off")


def _table(axes: Axes, robot: Robot) -> None:
    axes.axis("off")
    bands = robot.tolerances.bands(robot.tubes)
    rows = [_row(i, tube, float(bands[i, 0])) for i, tube in enumerate(robot.tubes)]
    table = axes.table(
        [list(row) for row in rows], colLabels=list(TUBE_DIMENSION_COLUMNS), loc="center", cellLoc="center"
    )
    table.auto_set_font_size(False)
    table.set_fontsize(7)
    axes.set_title("diameters within: outer / inner, as Nitinol tubing is usually sold", loc="right", fontsize=7)
    table.scale(1.0, 1.5)


def _row(i: int, tube: Tube, band: float) -> tuple[str, ...]:
    """Return the table's row of tube i, from 0; band: relative tolerance of its curvature."""
    outer, inner = diameter_tolerances(tube.outer_diameter)
    return (
        f"{i + 1}",
        *(f"{value:.3f} mm" for value in (tube.outer_diameter, tube.inner_diameter)),
        f"{(tube.outer_diameter - tube.inner_diameter) / 2:.3f} mm",
        *(f"{value:.1f} mm" for value in (tube.length, tube.curved_length)),
        *(_radius(value) for value in (tube.root_curvature, tube.tip_curvature)),
        f"{100 * tube.largest_curvature * tube.outer_diameter / 2:.2f} %",
        f"± {100 * band:.3g} %" if band else "exact",
        f"± {outer:g} / {inner:g} mm",
    )


def _radius(curvature: float) -> str:
    straight = abs(curvature) * LARGEST_RADIUS <= 1
    return "straight" if straight else f"{1 / curvature:.1f} mm"
