"""Figure of contact forces; a module of its own, since the numbers need no matplotlib."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.loads.wall import WallForces
from ctr_nlp.view.figures.parts.page import STYLE, add_title
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, SKY, VERMILLION


@rc_context(STYLE)
def draw_wall_forces(found: WallForces, problem: str) -> Figure:
    """Draw where along the robot the wall pushes in every frame, the total force, and how deep the robot is.

    Parameters
    ----------
    found : WallForces
        The forces.
    problem : str
        Name of the problem, for the title.

    Returns
    -------
    Figure
        Three panels over frames.
    """
    figure = Figure(figsize=(6.6, 6.2), layout="constrained")
    where, total, depth = figure.subplots(3, sharex=True, height_ratios=(1.6, 1, 1))
    _where(where, found, figure)
    frames = np.arange(len(found.total)) + 1
    total.fill_between(frames, found.total, color=SKY, alpha=0.4, lw=0)
    total.plot(frames, found.total, color=VERMILLION, label="of the wall on the whole robot")
    total.plot(frames, found.avoidable, color=BLACK, ls="--", label="where the lumen is wider than the robot")
    total.set_ylabel("force (N)")
    total.legend()
    depth.plot(frames, found.depth_alone, color=BLACK, ls=":", label="without the wall's forces")
    depth.plot(frames, found.depth.max(axis=1), color=BLUE, label="with the wall's forces")
    depth.set_ylabel("depth in the\nwall (mm)")
    depth.set_xlabel("frame")
    depth.legend()
    for axes in (total, depth):
        axes.set_ylim(bottom=0)
    title = f"The wall's forces on the plan: {problem} ({found.stiffness:g} N/mm per mm)"
    add_title(figure, title)
    return figure


def _where(axes: Axes, found: WallForces, figure: Figure) -> None:
    """Draw the forces found per length, N/mm, over frames and along the robot."""
    per_length = np.divide(found.force, found.length, out=np.zeros_like(found.force), where=found.length > 0)
    frames = np.broadcast_to(np.arange(len(found.force))[:, None] + 1.0, found.along.shape)
    busy = np.isfinite(per_length) & (per_length > 0)
    axes.plot(frames[:, -1], (found.along + found.length / 2).max(axis=1), color=BLACK, lw=0.8, label="the tip")
    if busy.any():
        shown = axes.scatter(
            frames[busy], found.along[busy], c=per_length[busy], s=9, cmap="viridis_r", marker="s"
        )
        figure.colorbar(shown, ax=axes, label="N/mm")
    axes.set_ylabel("along the robot (mm)")
    axes.legend()
