"""Draw robots in three dimensions: axes to scale, the lumen's wall, and shapes that move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ctr_nlp.paths.lumen import wall_rings
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.paths.wall_surfaces import DrawnWall, wall_sections
from ctr_nlp.typing import Array
from ctr_nlp.view.figures import overlay
from ctr_nlp.view.figures.overlay import parts
from ctr_nlp.view.figures.parts.orientation import matplotlib_view
from ctr_nlp.view.figures.parts.palette import BLACK, KEEP_OUT_COLOUR, tube_colour, tube_width

MIN_BOX_SIDE_FRACTION = 0.3
"""Least side of the box as a part of its longest one."""
BOX_MARGIN_FACTOR = 1.06
"""Side of the box over that of its contents."""
MAX_BOX_AXIS_INTERVALS = 6
"""Most intervals along the longest side; shorter ones have fewer."""
BOX_VIEW_ELEVATION_DEG, BOX_VIEW_AZIMUTH_OFFSET_DEG = 14.0, 25.0
"""Elevation of the view, and its azimuth from the direction that faces the motion."""
ZOOM = 0.92
"""Below 1, for room for numbers along the axes."""
FIGURE_WALL_RING_SPACING_MM, FIGURE_WALL_RING_POINTS, FIGURE_WALL_LINE_COUNT = 4.0, 25, 8
"""Distance between rings of the wall, points of each, and number of lines along it."""
GREY = "0.72"
FIGURE_WALL_STYLE: dict[str, Any] = {"color": GREY, "lw": 0.5}
INSERTION: dict[str, Any] = {"marker": "o", "ls": "", "ms": 5, "mfc": "white", "mec": BLACK}


def add_space_axes(figure: Figure, place: tuple[float, float, float, float], lumen: Array | None) -> Any:
    """Add axes in space at `place` (left, bottom, width, height) of a figure, with the insertion point and the
    lumen (N, 4) mm.
    """
    axes: Any = figure.add_axes(place, projection="3d")
    if lumen is not None:
        wall(axes, lumen)
    axes.plot([0.0], [0.0], [0.0], zorder=6, **INSERTION)
    return axes


def span(points: Array) -> Array:
    """Return the sides (3,), mm, of a box around points (.., 3) and the insertion point; NaN is left out."""
    low, high = _corners(points)
    side = BOX_MARGIN_FACTOR * (high - low)
    return np.asarray(np.maximum(side, MIN_BOX_SIDE_FRACTION * max(side.max(), 1.0)))


def _corners(points: Array) -> tuple[Array, Array]:
    """Return the lowest and the highest corner (3,) of points (.., 3) and the insertion point; NaN is left out."""
    known = points.reshape(-1, 3)
    known = np.vstack([known[np.isfinite(known).all(axis=1)], np.zeros(3)])
    return known.min(axis=0), known.max(axis=0)


def fit_box(axes: Any, points: Array, side: Array | None = None, upright: Array | None = None) -> None:
    """Set the limits of `axes` to a box around points (.., 3) mm, to scale, seen so that a planar motion faces the
    reader.

    side: (3,) mm, by default what contains the points. upright: rotation (3, 3) of picture_axes; by default z is
    up. Call it when everything that changes limits has been drawn.
    """
    (low, high), side = _corners(points), span(points) if side is None else side
    for name, middle, extent in zip("xyz", (low + high) / 2, side, strict=True):
        getattr(axes, f"set_{name}lim")(middle - extent / 2, middle + extent / 2)
        getattr(axes, f"set_{name}label")(f"{name} (mm)")
        axes.locator_params(axis=name, nbins=max(2, round(MAX_BOX_AXIS_INTERVALS * extent / side.max())))
    axes.zaxis.labelpad = 9
    axes.set_box_aspect(tuple(side), zoom=ZOOM)
    axes.set_proj_type("ortho")
    # matplotlib would order artists by their mean depth, and hide thin tubes behind the wall.
    axes.computed_zorder = False
    rotation = np.eye(3) if upright is None else upright
    azimuth = _facing(points.reshape(-1, 3) @ rotation.T) + BOX_VIEW_AZIMUTH_OFFSET_DEG
    axes.view_init(*matplotlib_view(rotation, BOX_VIEW_ELEVATION_DEG, azimuth))


def _facing(points: Array) -> float:
    """Return the azimuth, degrees, from which points (.., 3) are at their widest."""
    flat = points.reshape(-1, 3)[:, :2]
    flat = flat[np.isfinite(flat).all(axis=1)]
    # The first right singular vector is the direction of largest spread; the view is at right angles to it. Of its
    # two sides the one with an azimuth in [-180, 0) is taken, so that similar motions look alike.
    across, up = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][0]
    return float((np.degrees(np.arctan2(up, across)) + 90.0) % 180.0 - 180.0)


def wall(axes: Any, lumen: Array) -> None:
    """Draw the wall of `lumen` (N, 4), x, y, z and radius in mm, on `axes` as rings and lines along it."""
    surface = wall_rings(lumen, np.linspace(0.0, 2 * np.pi, FIGURE_WALL_RING_POINTS))
    along = cumulative_arc_length(lumen[:, :3])
    chosen = np.searchsorted(along, np.append(np.arange(0.0, along[-1], FIGURE_WALL_RING_SPACING_MM), along[-1]))
    lines = [
        *surface[chosen],
        *surface.swapaxes(0, 1)[:: (FIGURE_WALL_RING_POINTS - 1) // FIGURE_WALL_LINE_COUNT][:-1],
    ]
    # One line with gaps of NaN instead of an artist for each: a film draws them hundreds of times.
    apart = np.full((1, 3), np.nan)
    axes.plot(*np.concatenate([part for line in lines for part in (line, apart)]).T, zorder=1, **FIGURE_WALL_STYLE)


def add_wall_sections(axes: Any, walls: Sequence[DrawnWall], path: Array) -> None:
    """Draw the sections of walls at right angles to a path (n, 3), mm: what a round tube would hide."""
    for wall in walls:
        pieces = wall_sections(wall, path, FIGURE_WALL_RING_SPACING_MM)
        # One line with gaps of NaN, as in `wall`.
        gaps = np.full((len(pieces), 1, 3), np.nan)
        style = FIGURE_WALL_STYLE | ({"color": KEEP_OUT_COLOUR} if wall.keep_out else {})
        axes.plot(*np.concatenate([pieces, gaps], axis=1).reshape(-1, 3).T, zorder=1, **style)


class RobotLines:
    """A robot's tubes as lines in space, each where it is the outermost one; look: changes of their style."""

    def __init__(self, axes: Any, d: int, **look: Any) -> None:
        common: dict[str, Any] = {"solid_capstyle": "butt", "zorder": 4}
        looks = [{"color": tube_colour(i), "lw": tube_width(i, d)} | common | look for i in range(d)]
        self.lines = [axes.plot([], [], [], **look)[0] for look in looks]

    def show(self, shape: Array, beta: Array) -> None:
        """Draw a shape (101, 3) mm of a robot with tubes beta (d,) mm long; nothing where it is not known."""
        for line, part in zip(self.lines, parts(shape, beta), strict=True):
            line.set_data_3d(*part.T)


def key(d: int, walled: bool) -> list[Line2D]:
    """Return the entries of a legend for a robot of d tubes, the insertion point and, where `walled`, the lumen's
    wall.
    """
    known = [Line2D([], [], label="lumen's wall", color=GREY, lw=1.0)] if walled else []
    return [*overlay.key(d), *known, Line2D([], [], label="insertion point", **INSERTION)]


def points_of_all(shapes: Sequence[Array], lumen: Array | None) -> Array:
    """Return all points (n, 3) mm of shapes (.., 3), and corners of boxes around the spheres of a lumen (N, 4), if
    any.
    """
    found = [shape.reshape(-1, 3) for shape in shapes]
    if lumen is not None:
        found += [lumen[:, :3] - lumen[:, 3:], lumen[:, :3] + lumen[:, 3:]]
    return np.concatenate(found)
