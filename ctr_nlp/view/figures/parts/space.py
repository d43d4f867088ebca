"""Robots in three dimensions: axes to scale, the lumen's wall, and shapes that move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ctr_nlp.paths.lumen import wall_rings
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.typing import Array
from ctr_nlp.view.figures import overlay
from ctr_nlp.view.figures.overlay import parts
from ctr_nlp.view.figures.parts.palette import BLACK, tube_colour, tube_width

MIN_BOX_SIDE_FRACTION = 0.3
"""Least side of the box as part of its longest."""
BOX_MARGIN_FACTOR = 1.06
"""The box by what it shows."""
MAX_BOX_AXIS_INTERVALS = 6
"""Most intervals along the longest side; shorter ones have fewer."""
BOX_VIEW_ELEVATION_DEG, BOX_VIEW_AZIMUTH_OFFSET_DEG = 14.0, 25.0
"""Degrees by which a motion is seen from above, and by which it is turned from facing the reader."""
ZOOM = 0.92
"""With room for numbers along the axes."""
FIGURE_WALL_RING_SPACING_MM, FIGURE_WALL_RING_POINTS, FIGURE_WALL_LINE_COUNT = 4.0, 25, 8
"""mm between rings of the wall, points of each, and lines along it."""
GREY = "0.72"
FIGURE_WALL_STYLE: dict[str, Any] = {"color": GREY, "lw": 0.5}
INSERTION: dict[str, Any] = {"marker": "o", "ls": "", "ms": 5, "mfc": "white", "mec": BLACK}


def add_space_axes(figure: Figure, place: tuple[float, float, float, float], lumen: Array | None) -> Any:
    """Axes in space at a place of a figure, with the insertion point and, where known, the wall of a lumen."""
    axes: Any = figure.add_axes(place, projection="3d")
    if lumen is not None:
        wall(axes, lumen)
    axes.plot([0.0], [0.0], [0.0], zorder=6, **INSERTION)
    return axes


def span(points: Array) -> Array:
    """The sides (3,) in mm of a box that holds points (.., 3) and the insertion point; NaN is left out."""
    low, high = _corners(points)
    side = BOX_MARGIN_FACTOR * (high - low)
    return np.asarray(np.maximum(side, MIN_BOX_SIDE_FRACTION * max(side.max(), 1.0)))


def _corners(points: Array) -> tuple[Array, Array]:
    known = points.reshape(-1, 3)
    known = np.vstack([known[np.isfinite(known).all(axis=1)], np.zeros(3)])
    return known.min(axis=0), known.max(axis=0)


def fit_box(axes: Any, points: Array, side: Array | None = None) -> None:
    """A box around points (.., 3) mm, to scale, seen so that a planar motion is seen as such.

    side: (3,) mm, by default what holds the points. Call it when everything that changes limits has been drawn.
    """
    (low, high), side = _corners(points), span(points) if side is None else side
    for name, middle, extent in zip("xyz", (low + high) / 2, side, strict=True):
        getattr(axes, f"set_{name}lim")(middle - extent / 2, middle + extent / 2)
        getattr(axes, f"set_{name}label")(f"{name} (mm)")
        axes.locator_params(axis=name, nbins=max(2, round(MAX_BOX_AXIS_INTERVALS * extent / side.max())))
    axes.zaxis.labelpad = 9
    axes.set_box_aspect(tuple(side), zoom=ZOOM)
    axes.set_proj_type("ortho")
    axes.computed_zorder = False
    axes.view_init(BOX_VIEW_ELEVATION_DEG, _facing(points) + BOX_VIEW_AZIMUTH_OFFSET_DEG)


def _facing(points: Array) -> float:
    """The azimuth in degrees from which points (.., 3) are at their widest."""
    flat = points.reshape(-1, 3)[:, :2]
    flat = flat[np.isfinite(flat).all(axis=1)]
    across, up = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][0]
    return float((np.degrees(np.arctan2(up, across)) + 90.0) % 180.0 - 180.0)


def wall(axes: Any, lumen: Array) -> None:
    """The wall of a lumen (N, 4): x, y, z and radius in mm, as rings and lines along it."""
    surface = wall_rings(lumen, np.linspace(0.0, 2 * np.pi, FIGURE_WALL_RING_POINTS))
    along = cumulative_arc_length(lumen[:, :3])
    chosen = np.searchsorted(along, np.append(np.arange(0.0, along[-1], FIGURE_WALL_RING_SPACING_MM), along[-1]))
    lines = [
        *surface[chosen],
        *surface.swapaxes(0, 1)[:: (FIGURE_WALL_RING_POINTS - 1) // FIGURE_WALL_LINE_COUNT][:-1],
    ]
    apart = np.full((1, 3), np.nan)
    axes.plot(*np.concatenate([part for line in lines for part in (line, apart)]).T, zorder=1, **FIGURE_WALL_STYLE)


class RobotLines:
    """A robot's tubes as lines in space, each where it is the outermost one; look: changes how they are drawn."""

    def __init__(self, axes: Any, d: int, **look: Any) -> None:
        common: dict[str, Any] = {"solid_capstyle": "butt", "zorder": 4}
        looks = [{"color": tube_colour(i), "lw": tube_width(i, d)} | common | look for i in range(d)]
        self.lines = [axes.plot([], [], [], **look)[0] for look in looks]

    def show(self, shape: Array, beta: Array) -> None:
        """Draw a shape (101, 3) mm of a robot with tubes beta (d,) mm long; nothing where it is not known."""
        for line, part in zip(self.lines, parts(shape, beta), strict=True):
            line.set_data_3d(*part.T)


def key(d: int, walled: bool) -> list[Line2D]:
    """Return entries of a legend for a robot of d tubes, the insertion point and, where `walled`, the lumen's
    wall.
    """
    known = [Line2D([], [], label="lumen's wall", color=GREY, lw=1.0)] if walled else []
    return [*overlay.key(d), *known, Line2D([], [], label="insertion point", **INSERTION)]


def points_of_all(shapes: Sequence[Array], lumen: Array | None) -> Array:
    """All points (n, 3) mm of shapes (.., 3), and a box's worth of a lumen's wall (N, 4) where there is one."""
    found = [shape.reshape(-1, 3) for shape in shapes]
    if lumen is not None:
        found += [lumen[:, :3] - lumen[:, 3:], lumen[:, :3] + lumen[:, 3:]]
    return np.concatenate(found)
