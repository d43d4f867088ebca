"""Figure of a plan's critical tip forces; a module of its own, since the numbers need no matplotlib."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.loads.tip import Forces
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.page import STYLE, add_title
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, SKY, VERMILLION

FORCE_TICK_DIGITS = "125"
"""Leading digits of ticks that carry a number."""
POLAR_PLANES = (0, 1), (2, 0), (2, 1)
"""Axes of the base frame that are drawn against each other, the first to the right."""


@rc_context(STYLE)
def draw_tip_forces(found: Forces, problem: str) -> Figure:
    """Draw a plan's critical tip forces, the compliance of its tip, and the worst frame's forces in three planes.

    Parameters
    ----------
    found : Forces
        The forces.
    problem : str
        Name of the problem, for the title.

    Returns
    -------
    Figure
        Forces over frames above, and polar panels below.
    """
    figure = Figure(figsize=(6.6, 5.8), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    above, below = parts
    forces, soft = above.subplots(2, sharex=True, height_ratios=(2, 1))
    _by_frame(forces, found)
    soft.plot(found.frames, found.largest_compliance, color=BLUE)
    soft.set_ylabel("tip compliance\n(mm/N)")
    soft.set_xlabel("frame")
    worst = int(np.flatnonzero(found.critical_forces.min(axis=1) == found.critical_forces.min())[0])
    grid = below.subplots(1, len(POLAR_PLANES), subplot_kw={"projection": "polar"})
    for axes, plane in zip(grid, POLAR_PLANES, strict=True):
        _polar(axes, found, worst, plane)
    below.suptitle(f"frame {found.frames[worst]}: largest force (N), by direction", fontsize=9)
    add_title(figure, f"Largest tip forces: {problem}")
    return figure


def _by_frame(axes: Axes, found: Forces) -> None:
    """Draw the forces over frames, as a band from the worst direction to the best."""
    shown = np.minimum(found.snapping_forces, found.max_force)
    axes.fill_between(found.frames, shown.min(axis=1), shown.max(axis=1), color=SKY, alpha=0.4, lw=0)
    marker = "." if len(found.frames) < 30 else ""
    axes.plot(found.frames, shown.min(axis=1), color=VERMILLION, marker=marker, label="snaps, worst direction")
    if found.allowed_depth is not None:
        leaves = np.where(
            np.isinf(found.lumen_exit_forces.min(axis=1)), np.nan, found.lumen_exit_forces.min(axis=1)
        )
        axes.plot(
            found.frames,
            leaves,
            color=BLACK,
            ls="--",
            label=f"more than {found.allowed_depth:g} mm beyond the wall",
        )
    axes.axhline(found.max_force, color=BLACK, lw=0.8, ls=":", label=f"not looked beyond {found.max_force:g} N")
    axes.set_yscale("log")
    for ticks in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        ticks(lambda force, _: f"{force:g}" if f"{force:.0e}"[0] in FORCE_TICK_DIGITS else "")
    axes.set_ylabel("tip force (N)")
    axes.legend()


def _polar(axes: Any, found: Forces, worst: int, plane: tuple[int, int]) -> None:
    """Draw the critical forces of the frame with index `worst` in the directions that lie in a plane."""
    x, y = (found.directions[:, k] for k in plane)
    inside = np.flatnonzero(np.hypot(x, y) > 1 - 1e-9)
    angle = np.arctan2(y[inside], x[inside])
    order = np.argsort(angle)
    ends = np.append(order, order[0])
    values = np.minimum(found.critical_forces[worst], found.max_force)[inside]
    axes.plot(angle[ends], values[ends], color=VERMILLION, marker=".", ms=4)
    axes.set_rscale("symlog", linthresh=_nice(values))
    axes.set_ylim(0, 1.2 * values.max())
    axes.set_xticks(np.arange(4) * math.pi / 2, [f"{sign}{'xyz'[k]}" for sign in "+-" for k in plane])
    axes.set_yticks([_nice(values), values.max()], [f"{_nice(values):.2g}", f"{values.max():.2g}"])
    axes.tick_params(labelsize=7)


def _nice(values: Array) -> float:
    """Return the least of values, N, from which on the radial scale is logarithmic."""
    return float(max(values.min(), 1e-4))
