"""Draw shapes over their targets, as in Fig. 4 of the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.spatial import ConvexHull

from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.lumen import wall_rings
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.wall_surfaces import DrawnWall, merge_vertices
from ctr_nlp.plan.measures import e1, rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.page import STYLE, TITLE_LINE_HEIGHT_IN, add_heading
from ctr_nlp.view.figures.parts.palette import (
    BLACK,
    KEEP_OUT_COLOUR,
    LUMEN_COLOUR,
    WALL_COLOUR,
    tube_colour,
    tube_width,
)

DEFAULT_SHAPE_FRAMES = 6
"""Number of frames that are drawn where the caller names none."""
MIN_VIEW_EXTENT_FRACTION = 0.05
"""Width of a view, as a part of the whole extent, below which it is left out."""
MIN_SHAPE_PANEL_FRACTION = 0.15
"""Least width of a panel as part of the whole extent."""
SHAPE_PANELS_SIZE_IN = (8.0, 5.2)
"""Largest width and height of all panels together, inches, unless they would be narrower than
MIN_SHAPE_PANEL_WIDTH_IN.
"""
MIN_SHAPE_PANEL_WIDTH_IN = 0.5
"""Least width of a panel, inches."""
SHAPES_LEFT_MARGIN_IN, SHAPES_RIGHT_MARGIN_IN, SHAPES_TOP_MARGIN_IN, SHAPES_BOTTOM_MARGIN_IN = 0.65, 0.15, 1.1, 0.9
"""Inches around the panels, for labels, title and key."""
SHAPES_TITLE_LINES = 2
"""Lines of the title for which the upper margin has room."""
MIN_SHAPES_FIGURE_WIDTH_IN, SHAPES_LEGEND_ENTRY_WIDTH_IN = 5.0, 0.95
"""Least width of the picture, inches, which the title needs, and the width of an entry of the legend."""
TARGET_LINE_STYLE: dict[str, Any] = {"color": BLACK, "lw": 0.8, "ls": (0, (4, 2))}
"""Line style of targets."""
SHAPES_COLUMN_GAP_IN, SHAPES_VIEW_GAP_IN, SHAPES_ROW_GAP_IN = 0.2, 0.55, 1.05
"""Inches between columns, between the views of a frame, and between rows of frames."""
SILHOUETTE_CELL_MM = 1.6
"""Side of the cells whose vertices are drawn as one in outlines of walls, mm."""
KEEP_OUT_OPACITY = 0.25
"""Opacity of each triangle of a body that the robot keeps away from."""
LUMEN_RING_ANGLES_RAD = np.linspace(0.0, 2 * np.pi, 32)
"""Angles of the points of a ring of the lumen's wall."""


@matplotlib.rc_context(STYLE)
def shapes(plan: Plan, frames: Sequence[int] | None = None) -> Figure:
    """Draw shapes, tube by tube, over their targets, to scale, within the lumen where the plan has one.

    The z-axis, along which the robot is inserted, points up. A motion near the zx- or the yz-plane is seen from
    one side, any other from two.

    Parameters
    ----------
    plan : Plan
        The plan.
    frames : sequence of int, optional
        Numbers of frames, from 1, as in errors.csv. By default six, evenly spread, the last one included, and the
        one with the largest e2.

    Returns
    -------
    Figure
        One panel a frame and view, in mm.

    Raises
    ------
    OptionError
        A frame is not one of the plan's, or `frames` is empty.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.view.figures.overlay import shapes
    >>> from ctr_nlp.problems import named_problem
    >>> figure = shapes(ctr.solve_per_frame(named_problem("arc", frames=3), model="dominant"), frames=[1, 3])
    >>> len(figure.axes) >= 2
    True
    """
    worst = _worst(plan)
    shown = sorted({*frames_shown(plan, frames), *(worst if frames is None else ())})
    index = np.array(shown) - 1
    points = np.concatenate([plan.target[index], plan.shape[index]]).reshape(-1, 3)
    if plan.lumen_wall is not None:
        points = np.concatenate([points, wall_rings(plan.lumen_wall, LUMEN_RING_ANGLES_RAD).reshape(-1, 3)])
    low = np.nanmin(points, axis=0)
    high = np.nanmax(points, axis=0)
    extent = high - low
    margin = 0.05 * (high - low).max()
    views = [axis for axis in (0, 1) if extent[axis] > MIN_VIEW_EXTENT_FRACTION * extent.max()] or [
        int(extent[1] > extent[0])
    ]
    panel = np.array([max(extent[:2].max(), MIN_SHAPE_PANEL_FRACTION * extent.max()), extent[2]]) + 2 * margin
    figure, grid = _grid(len(shown), len(views), panel)
    columns = grid.shape[1]
    for k, number in enumerate(shown):
        for view, sideways in enumerate(views):
            axes = grid[k // columns * len(views) + view, k % columns]
            draw(axes, plan, number - 1, sideways)
            to_scale(axes, (low + high) / 2, panel, sideways)
            if view == 0:
                axes.set_title(_caption(plan, number, number in worst))
    for axes in grid[:, 0]:
        axes.set_ylabel("z (mm)")
    entries: list[Artist] = [*key(plan.robot.d)]
    if plan.lumen_wall is not None or any(not wall.keep_out for wall in plan.drawn_walls):
        entries.append(Patch(facecolor=LUMEN_COLOUR, edgecolor=WALL_COLOUR, label="lumen"))
    if any(wall.keep_out for wall in plan.drawn_walls):
        entries.append(Patch(facecolor=KEEP_OUT_COLOUR, alpha=KEEP_OUT_OPACITY, label="keep out"))
    figure.legend(
        handles=entries, loc="lower center", ncols=int(figure.get_figwidth() / SHAPES_LEGEND_ENTRY_WIDTH_IN)
    )
    add_heading(figure, plan, "Shapes and targets")
    _make_room_for_title(figure)
    return figure


def _make_room_for_title(figure: Figure) -> None:
    """Make a figure of _grid higher by the lines of its title beyond those for which its margin is made."""
    lines = max(figure.get_suptitle().count("\n") + 1 - SHAPES_TITLE_LINES, 0)
    top = SHAPES_TOP_MARGIN_IN + lines * TITLE_LINE_HEIGHT_IN
    height = figure.get_figheight() + lines * TITLE_LINE_HEIGHT_IN
    figure.set_figheight(height)
    figure.subplots_adjust(bottom=SHAPES_BOTTOM_MARGIN_IN / height, top=1 - top / height)


def frames_shown(plan: Plan, frames: Sequence[int] | None, most: int = DEFAULT_SHAPE_FRAMES) -> list[int]:
    """Return the frames to draw.

    Parameters
    ----------
    plan : Plan
        The plan.
    frames : sequence of int or None
        Numbers asked for, from 1.
    most : int
        How many are shown at most where none are asked for, evenly spread.

    Returns
    -------
    list of int
        Numbers, from 1.

    Raises
    ------
    OptionError
        A frame is not one of the plan's, or `frames` is empty.
    """
    count = len(plan.time)
    if frames is None:
        return sorted({max(1, round(count * k / most)) for k in range(1, most + 1)})
    for number in frames:
        if not 1 <= number <= count:
            raise OptionError(f"frames has {number}; the plan has frames 1 to {count}")
    if not frames:
        raise OptionError("frames is empty; name at least one")
    return list(frames)


def _grid(count: int, views: int, panel: Array) -> tuple[Figure, npt.NDArray[np.object_]]:
    """Return a figure with a grid of axes for `count` frames in reading order, the views of each below one
    another.
    """

    def scale(columns: int) -> float:
        rows = math.ceil(count / columns) * views
        return float(
            min(SHAPE_PANELS_SIZE_IN[0] / (columns * panel[0]), SHAPE_PANELS_SIZE_IN[1] / (rows * panel[1]))
        )

    columns = count if views > 1 else max(range(1, count + 1), key=scale)
    rows = math.ceil(count / columns) * views
    below = SHAPES_VIEW_GAP_IN if views > 1 else SHAPES_ROW_GAP_IN
    width, height = panel * max(scale(columns), MIN_SHAPE_PANEL_WIDTH_IN / panel[0])
    across = columns * (width + SHAPES_COLUMN_GAP_IN) - SHAPES_COLUMN_GAP_IN
    down = rows * (height + below) - below
    left = max(SHAPES_LEFT_MARGIN_IN, (MIN_SHAPES_FIGURE_WIDTH_IN - across) / 2)
    right = max(SHAPES_RIGHT_MARGIN_IN, (MIN_SHAPES_FIGURE_WIDTH_IN - across) / 2)
    figure = Figure(figsize=(left + across + right, SHAPES_BOTTOM_MARGIN_IN + down + SHAPES_TOP_MARGIN_IN))
    grid = figure.subplots(rows, columns, sharex="row", sharey=True, squeeze=False)
    figure.subplots_adjust(
        left=left / figure.get_figwidth(),
        right=1 - right / figure.get_figwidth(),
        bottom=SHAPES_BOTTOM_MARGIN_IN / figure.get_figheight(),
        top=1 - SHAPES_TOP_MARGIN_IN / figure.get_figheight(),
        wspace=SHAPES_COLUMN_GAP_IN / width,
        hspace=below / height,
    )
    for spare in grid.flat[count * views :]:
        spare.remove()
    return figure, grid


def draw(axes: Axes, plan: Plan, frame: int, sideways: int) -> None:
    """Draw one frame: each tube where it is the outermost one, and the target as a thin dashed line upon it.

    Parameters
    ----------
    axes : Axes
        Where to draw, in mm.
    plan : Plan
        The plan; its walls are drawn below.
    frame : int
        Number of the frame, from 0.
    sideways : int
        Horizontal axis: 0 for x, 1 for y.
    """
    if plan.lumen_wall is not None:
        _draw_lumen(axes, plan.lumen_wall, sideways)
    for wall in plan.drawn_walls:
        _draw_wall(axes, wall, sideways)
    for i, part in enumerate(parts(plan.shape[frame], plan.beta[frame])):
        width = tube_width(i, plan.robot.d)
        axes.plot(part[:, sideways], part[:, 2], color=tube_colour(i), lw=width, solid_capstyle="butt")
    axes.plot(plan.target[frame, :, sideways], plan.target[frame, :, 2], **TARGET_LINE_STYLE)


def _draw_lumen(axes: Axes, lumen: Array, sideways: int) -> None:
    """Draw the lumen (N, 4), x, y, z and radius in mm, as a filled outline; `sideways` is 0 for x and 1 for y.

    Each stretch between two rings of the wall is the convex hull of both. The second collection covers the edges
    between hulls.
    """
    seen = wall_rings(lumen, LUMEN_RING_ANGLES_RAD)[..., [sideways, 2]]
    stretches = np.concatenate([seen[:-1], seen[1:]], axis=1)
    hulls = [stretch[ConvexHull(stretch).vertices] for stretch in stretches]
    axes.add_collection(PolyCollection(hulls, color=WALL_COLOUR, linewidth=2.0, zorder=0.6), autolim=False)
    axes.add_collection(
        PolyCollection(hulls, color=LUMEN_COLOUR, linewidth=0.3, antialiased=False, zorder=0.7), autolim=False
    )


def _draw_wall(axes: Axes, wall: DrawnWall, sideways: int) -> None:
    """Draw the outline of a surface, filled; `sideways` is 0 for x and 1 for y."""
    vertices, triangles = merge_vertices(wall.vertices, wall.triangles, SILHOUETTE_CELL_MM)
    seen = list(vertices[:, [sideways, 2]][triangles])
    if wall.keep_out:
        one: dict[str, Any] = {
            "color": KEEP_OUT_COLOUR,
            "linewidth": 0.0,
            "alpha": KEEP_OUT_OPACITY,
            "antialiased": False,
        }
        axes.add_collection(PolyCollection(seen, zorder=0.8, **one), autolim=False)
        return
    axes.add_collection(PolyCollection(seen, color=WALL_COLOUR, linewidth=2.0, zorder=0.6), autolim=False)
    axes.add_collection(
        PolyCollection(seen, color=LUMEN_COLOUR, linewidth=0.3, antialiased=False, zorder=0.7), autolim=False
    )


def parts(shape: Array, beta: Array) -> list[Array]:
    """Return the points of each tube where it is the outermost one.

    Parameters
    ----------
    shape : ndarray
        Robot (101, 3), mm, at uniform sigma.
    beta : ndarray
        Extensions (d,), mm.

    Returns
    -------
    list of ndarray
        Points (n, 3), mm, of each tube; (0, 3) where the shape is not known or no part of the tube is outermost.
    """
    ends = tube_ends(beta)
    found = []
    for start, end in zip([0.0, *ends], ends, strict=False):
        sigma = np.concatenate([[start], SIGMA_GRID[(start < SIGMA_GRID) & (end > SIGMA_GRID)], [end]])
        sigma = sigma if end > start and np.isfinite(shape).all() else sigma[:0]
        found.append(points_at(shape, sigma))
    return found


def points_at(shape: Array, sigma: Array) -> Array:
    """Return points (n, 3), mm, of a shape (101, 3) at parts sigma (n,) of its length, on straight lines between
    its samples.
    """
    return np.stack([np.interp(sigma, SIGMA_GRID, coordinate) for coordinate in shape.T], axis=1)


def tube_ends(beta: Array) -> Array:
    """Return the sigma (d,) at which each tube ends, from its extensions beta (d,), mm; the innermost one ends at
    1.
    """
    ends = np.clip(beta / max(beta[-1], 1e-9), 0.0, 1.0)
    ends[-1] = 1.0
    # Rounding of beta must not end a tube before the one outside of it.
    return np.maximum.accumulate(ends)


def to_scale(axes: Axes, middle: Array, panel: Array, sideways: int) -> None:
    """Set the limits of a panel, to scale.

    Parameters
    ----------
    axes : Axes
        The panel.
    middle : ndarray
        Its middle (3,), mm.
    panel : ndarray
        Width and height (2,), mm.
    sideways : int
        Horizontal axis: 0 for x, 1 for y.
    """
    axes.set_aspect("equal")
    axes.set_xlim(middle[sideways] - panel[0] / 2, middle[sideways] + panel[0] / 2)
    axes.set_ylim(middle[2] - panel[1] / 2, middle[2] + panel[1] / 2)
    axes.set_xlabel(f"{'xy'[sideways]} (mm)")
    axes.locator_params(axis="x", nbins=3)


def _worst(plan: Plan) -> set[int]:
    """Return the number, from 1, of the frame with the largest e2, as a set; empty where none is known."""
    distances = rms_over_sigma(e1(plan))
    return {int(np.nanargmax(distances)) + 1} if np.isfinite(distances).any() else set()


def _caption(plan: Plan, number: int, worst: bool) -> str:
    """Return the title of a frame: its number from 1, its time, and whether it is the worst or failed."""
    state = "" if plan.success[number - 1] else "\nfailed"
    if np.isnan(plan.shape[number - 1]).any():
        state = "\nnot reached"
    return f"frame {number}\n{plan.time[number - 1]:.3g} s{', worst' if worst else ''}{state}"


def key(d: int) -> list[Line2D]:
    """Return the entries of a legend for d tubes and the target."""
    tubes = [Line2D([], [], color=tube_colour(i), lw=tube_width(i, d), label=f"tube {i + 1}") for i in range(d)]
    return [*tubes, Line2D([], [], label="target", **TARGET_LINE_STYLE)]
