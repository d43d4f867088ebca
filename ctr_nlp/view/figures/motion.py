"""Draw the configuration over time, its error where the true one is known, as Fig. 8, and how a device
tracked it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.simulation import equivalent_configurations
from ctr_nlp.typing import Array, Flags
from ctr_nlp.view.figures.parts.page import (
    STYLE,
    add_heading,
    add_title,
    at_least,
    curve,
    frame_axis,
    legend_of,
    shade,
    shade_failures,
)
from ctr_nlp.view.figures.parts.palette import AMBIGUOUS, TILT_COLOURS, tube_colour, tube_width

CONFIGURATION_AXIS_LABELS = ("α (rad)", "β (mm)", "θ (rad)")
MIN_CONFIGURATION_SPANS = (0.1, 1.0, 0.1)
"""Least vertical ranges of alpha, beta and theta: rad, mm, rad."""
MIN_CONFIGURATION_ERROR_SPANS = (1e-3, 1e-3, 1e-3)


@matplotlib.rc_context(STYLE)
def configuration(plan: Plan) -> Figure:
    """Draw alpha, beta with its limits and theta of `plan` over time; beside them q - truth where the truth is
    known.
    """
    columns = 1 if plan.truth is None else 2
    figure = Figure(figsize=(2.2 + 4.2 * columns, 6.2), layout="constrained")
    grid = figure.subplots(3, columns, sharex=True, squeeze=False)
    _limits(grid[1, 0], plan)
    _column(grid[:, 0], plan, plan.q, MIN_CONFIGURATION_SPANS)
    if plan.truth is not None:
        _errors(grid[:, 1], plan)
    for row in grid:
        _legend(row)
    add_heading(figure, plan, "Configuration")
    return figure


@matplotlib.rc_context(STYLE)
def configuration_errors(plans: Mapping[str, Plan]) -> Figure:
    """Draw errors q - truth over time, a column for each of `plans` by name; all have a known truth."""
    figure = Figure(figsize=(1.2 + 3.4 * len(plans), 6.2), layout="constrained")
    grid = figure.subplots(3, len(plans), sharex=True, squeeze=False)
    for column, (name, plan) in zip(grid.T, plans.items(), strict=True):
        _errors(column, plan)
        column[0].set_title(name)
    for row in grid:
        _legend(row)
    return figure


def _errors(column: npt.NDArray[np.object_], plan: Plan) -> None:
    """Draw three panels of the errors of alpha, beta and theta."""
    for axes in column:
        axes.axhline(0.0, color="0.6", lw=0.9)
    _column(column, plan, error_from_truth(plan), MIN_CONFIGURATION_ERROR_SPANS)
    for axes, name in zip(column, CONFIGURATION_AXIS_LABELS, strict=True):
        axes.set_ylabel(f"error of {name}")
    for axes in column[::2]:
        shade(axes, plan.time, plan.dt, gimbal_lock_frames(plan), AMBIGUOUS, "α, θy are\none rotation")


def _column(column: npt.NDArray[np.object_], plan: Plan, values: Array, least: tuple[float, ...]) -> None:
    """Draw three panels of values (T, 2d + 2) in the order of q; least: their least vertical ranges."""
    for axes, part, name, span in zip(
        column, plan.robot.split(values), CONFIGURATION_AXIS_LABELS, least, strict=True
    ):
        shade_failures(axes, plan, plan.time, plan.dt)
        for i in range(part.shape[1]):
            curve(axes, plan.time, part[:, i], **_look(name, i, plan.robot.d))
        at_least(axes, span)
        axes.set_ylabel(name)
        axes.set_xlim(0.0, plan.time[-1] + plan.dt / 2)
    column[-1].set_xlabel("time (s)")


def _look(name: str, i: int, d: int) -> dict[str, Any]:
    if name.startswith("θ"):
        return {"label": f"θ{'xy'[i]}", "color": TILT_COLOURS[i], "lw": (2.4, 1.2)[i]}
    return {"label": f"{name[0]}{i + 1}", "color": tube_colour(i), "lw": tube_width(i, d)}


def _legend(row: npt.NDArray[np.object_]) -> None:
    """Draw one legend to the right of the row for all that its panels name."""
    handles = legend_of(*row)
    row[-1].legend(handles.values(), handles.keys(), loc="center left", bbox_to_anchor=(1.01, 0.5))


def _limits(axes: Axes, plan: Plan) -> None:
    """Draw thin dashed lines at the limits of every beta that has any, in its tube's colour."""
    robot = plan.robot
    for bound in (robot.lower, robot.upper):
        for i, value in enumerate(robot.split(bound)[1]):
            axes.axhline(value, color=tube_colour(i), lw=0.9, ls=(0, (5, 3)), zorder=1)
    axes.plot([], [], color="0.4", lw=0.9, ls=(0, (5, 3)), label="limits")


def error_from_truth(plan: Plan) -> Array:
    """Return the error q - truth (T, 2d + 2) in rad and mm of a plan whose truth is known; NaN for frames never
    reached.

    Two differences that leave every shape as it is do not count: whole turns of any angle, and the two ways to
    write one rotation, R(theta_x, theta_y) Rz(alpha) = R(pi - theta_x, theta_y + pi) Rz(alpha + pi). The truth is
    written in the way that is nearer to the plan, the same for the whole motion.
    """
    assert plan.truth is not None
    q = plan.q
    d = plan.robot.d
    angles = np.r_[:d, 2 * d : 2 * d + 2]
    errors = []
    for truth in (plan.truth, equivalent_configurations(plan.robot, plan.truth)):
        error = q - truth
        error[:, angles] = without_whole_turns(error[:, angles])
        errors.append(error)
    # Both writings have the same beta, so that angles alone decide.
    return min(errors, key=lambda error: float(np.nansum(np.abs(error[:, angles]))))


def without_whole_turns(angle: Array) -> Array:
    """Return the angles `angle` (T, n), rad, without jumps of whole turns between frames, each column nearest to
    0.
    """
    result = np.array(angle, dtype=float)
    known = np.isfinite(result).all(axis=1)
    if known.any():
        smooth = np.unwrap(result[known], axis=0)
        # One whole number of turns for a column; its median ignores a few frames that are far off.
        result[known] = smooth - 2 * np.pi * np.round(np.median(smooth, axis=0) / (2 * np.pi))
    return result


def gimbal_lock_frames(plan: Plan) -> Flags:
    """Flag the frames (T,) of `plan` whose true theta_x is within 0.05 rad of +-pi/2: alpha and theta_y are one
    rotation.
    """
    assert plan.truth is not None
    # By the cosine, so that whole turns do not matter: |cos theta_x| = sin of the distance from +-pi/2.
    return np.abs(np.cos(plan.truth[:, -2])) < np.sin(0.05)


@matplotlib.rc_context(STYLE)
def tracking(
    title: str, frame: npt.NDArray[Any], error: npt.NDArray[Any], late: npt.NDArray[Any], names: Sequence[str]
) -> Figure:
    """Draw errors of sliding axes (mm), of turning ones, and lateness (ms) over frames.

    title: of the figure. frame (T,): numbers, from 1. error (T, m): measured less commanded. late (T,): s. names
    (m,): of the axes, each with what it moves and its unit, "X, tube 1 out (mm)".
    """
    figure = Figure(figsize=(6.4, 6.2), layout="constrained")
    rows = figure.subplots(3, 1, sharex=True)
    slides = [k for k, name in enumerate(names) if name.endswith("(mm)")]
    turns = [k for k in range(len(names)) if k not in slides]
    for axes, some in ((rows[0], slides), (rows[1], turns)):
        units = dict.fromkeys(names[k].rpartition("(")[2].rstrip(")") for k in some)
        axes.set_ylabel(f"error when due ({', '.join(units)})")
        axes.axhline(0.0, color="0.6", lw=0.9)
        for i, k in enumerate(some):
            axes.plot(frame, error[:, k], color=tube_colour(i), lw=tube_width(i, len(some)), label=names[k])
        at_least(axes, 0.02)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    rows[2].plot(frame, 1e3 * late, color="0.2", lw=1.2)
    at_least(rows[2], 20.0)
    rows[2].set_ylabel("late (ms)")
    frame_axis(rows[2], int(frame[-1]))
    add_title(figure, title)
    return figure
