"""Draw the branches of a file of anatomy from the front, from the left and from below."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.page import STYLE, add_title, label_text
from ctr_nlp.view.figures.parts.palette import BLACK, tube_colour, tube_width

TREE_PANELS_SIZE_IN = 6.5
"""Largest width and height of all panels together, inches."""
MIN_TREE_PANEL_FRACTION = 0.2
"""Least side of a panel as a part of the largest one."""
TREE_PANEL_MARGIN_FACTOR = 1.22
"""Side of a panel over that of its contents, with room for numbers at the tips."""
TREE_PANEL_GAP_IN, TREE_LEFT_MARGIN_IN, TREE_RIGHT_MARGIN_IN, TREE_TOP_MARGIN_IN, TREE_BOTTOM_MARGIN_IN = (
    0.75,
    0.75,
    0.25,
    0.8,
    0.6,
)
"""Inches between and around panels."""
TREE_LABEL_DISTANCES_PT, POINTS_PER_INCH = (8.0, 13.0, 18.0, 24.0, 32.0, 42.0), 72.0
"""Distances, in points, at which a number may stand from its tip."""
TREE_LABEL_TURNS_DEG = (0.0, 35.0, -35.0, 70.0, -70.0, 105.0, -105.0)
"""Angles by which the direction from a tip to its number may be turned from that of the branch."""
TREE_LABEL_GAP_PT = np.array([13.0, 10.0])
"""Least distances across and up, in points, between the middles of two numbers of two digits."""
TREE_KEY_WIDTH_IN, TREE_KEY_LINE_HEIGHT_IN = 2.6, 0.17
"""Width of the key, and height of each of its lines, inches."""
PATIENT_LEFT_RIGHT_LETTERS, REVERSED_AXIS_LETTERS = "LR", "RAI"
"""Directions of a patient's first axis, and directions in which any axis is drawn reversed."""
TREE_LABEL_TIP_LENGTH_MM = 8.0
"""Length of the end of a branch, mm, along whose direction its number is placed."""


class Projection(NamedTuple):
    """View along an axis: indices of the axes drawn across and up, and the side from which a patient is seen."""

    across: int
    up: int
    title: str


VIEW_FROM_FRONT, VIEW_FROM_LEFT, VIEW_FROM_BELOW = (
    Projection(0, 2, "from the front"),
    Projection(1, 2, "from the left"),
    Projection(0, 1, "from below"),
)


class BranchGroup(NamedTuple):
    """Branches drawn in one colour: their label in the key, the colour, and their indices from 0."""

    label: str
    colour: str
    members: Sequence[int]


@matplotlib.rc_context(STYLE)
def tree(
    paths: Sequence[Array],
    names: Sequence[str],
    title: str,
    directions: str = "xyz",
    groups: Sequence[BranchGroup] = (),
) -> Figure:
    """Draw branches to scale in three views, numbered at their tips.

    paths: points (n, 3) of each branch, mm. names: of the branches, for the key. title: may have several lines.
    directions: letters in which x, y, z grow, such as LPS or RAS; they name the axes, and these are reversed as
    radiologists have them, with the patient's left on the right of the picture. Other letters reverse none.
    groups: where given, branches have the colours of their groups, and the key lists these; what branches share is
    drawn in the colour of the first group.
    """
    every = np.concatenate(paths)
    low = every.min(axis=0)
    high = every.max(axis=0)
    side = np.maximum(high - low, MIN_TREE_PANEL_FRACTION * (high - low).max()) * TREE_PANEL_MARGIN_FACTOR
    columns = 0 if groups else _key_columns(side, len(paths))
    figure, panels = _panels(side, columns)
    for view, axes in zip((VIEW_FROM_FRONT, VIEW_FROM_LEFT, VIEW_FROM_BELOW), panels, strict=True):
        _frame(axes, view, (low + high) / 2, side, directions)
        if groups:
            _draw_groups(axes, view, paths, groups)
        else:
            _draw(axes, view, paths)
        _draw_numbers(axes, view, paths, figure.dpi)
    if groups:
        _group_key(figure, panels, groups)
    else:
        _key(figure, panels, columns, paths, names)
    add_title(figure, *title.splitlines())
    return figure


def _panel_sides(side: Array) -> Array:
    """Return the sides (3,) in inches of what panels show of a box of sides (3,) mm, all to one scale."""
    return side * TREE_PANELS_SIZE_IN / max(side[0] + side[1], side[2] + side[1])


def _key_columns(side: Array, branches: int) -> int:
    """Return in how many columns beside the panels the key of branches stands; 0 where it fits into the corner."""
    _, deep, tall = _panel_sides(side)
    if branches <= _key_lines(TREE_BOTTOM_MARGIN_IN + deep):
        return 0
    return math.ceil(branches / _key_lines(TREE_BOTTOM_MARGIN_IN + deep + TREE_PANEL_GAP_IN + tall))


def _key_lines(height: float) -> int:
    """Return the number of branches in a column of the key, beside a line for the start, on some inches."""
    return max(1, int(height / TREE_KEY_LINE_HEIGHT_IN) - 2)


def _panels(side: Array, columns: int) -> tuple[Figure, list[Axes]]:
    """Make three panels of one scale for a box of sides (3,) mm: front, to its right the side, beneath it from
    below; columns: of the key, to the right of them, 0 for one in the free corner.
    """
    across, deep, tall = _panel_sides(side)
    key = columns * TREE_KEY_WIDTH_IN if columns else max(0.0, TREE_KEY_WIDTH_IN - deep)
    size = (
        TREE_LEFT_MARGIN_IN + across + TREE_PANEL_GAP_IN + deep + TREE_RIGHT_MARGIN_IN + key,
        TREE_BOTTOM_MARGIN_IN + deep + TREE_PANEL_GAP_IN + tall + TREE_TOP_MARGIN_IN,
    )
    figure = Figure(figsize=size)

    def panel(left: float, bottom: float, width: float, height: float) -> Axes:
        return figure.add_axes((left / size[0], bottom / size[1], width / size[0], height / size[1]))

    upper = TREE_BOTTOM_MARGIN_IN + deep + TREE_PANEL_GAP_IN
    right = TREE_LEFT_MARGIN_IN + across + TREE_PANEL_GAP_IN
    return figure, [
        panel(TREE_LEFT_MARGIN_IN, upper, across, tall),
        panel(right, upper, deep, tall),
        panel(TREE_LEFT_MARGIN_IN, TREE_BOTTOM_MARGIN_IN, across, deep),
    ]


def _frame(axes: Axes, view: Projection, middle: Array, side: Array, directions: str) -> None:
    across = view.across
    up = view.up
    low = middle - side / 2
    high = middle + side / 2
    axes.set_xlim(low[across], high[across])
    axes.set_ylim(low[up], high[up])
    if directions[across] in REVERSED_AXIS_LETTERS:
        axes.invert_xaxis()
    named = directions[0] in PATIENT_LEFT_RIGHT_LETTERS
    # From below, as axial slices are shown: the patient's front is up, so that an axis that grows to the back (P)
    # is reversed and one that grows to the front (A) is not.
    if (directions[up] in REVERSED_AXIS_LETTERS) != (view is VIEW_FROM_BELOW and named):
        axes.invert_yaxis()
    axes.set_xlabel(f"{directions[across]} (mm)")
    axes.set_ylabel(f"{directions[up]} (mm)")
    axes.set_title(view.title if named else "")
    axes.locator_params(nbins=5)


def _draw(axes: Axes, view: Projection, paths: Sequence[Array]) -> None:
    """Draw the branches, later ones thinner, so that all are seen where they share a trunk."""
    for k, path in enumerate(paths):
        across, up = path[:, [view.across, view.up]].T
        axes.plot(across, up, color=tube_colour(k), lw=tube_width(k, len(paths)), solid_capstyle="round")


def _draw_groups(axes: Axes, view: Projection, paths: Sequence[Array], groups: Sequence[BranchGroup]) -> None:
    """Draw the branches in the colours of their groups, those of the first group on top, and mark their ends."""
    for order, group in enumerate(reversed(groups)):
        for k in group.members:
            across, up = paths[k][:, [view.across, view.up]].T
            look: dict[str, Any] = {"color": group.colour, "zorder": 2 + 0.1 * order}
            axes.plot(across, up, lw=2.0, solid_capstyle="round", **look)
            axes.plot(across[-1], up[-1], "o", ms=3.5, **look)


def _draw_numbers(axes: Axes, view: Projection, paths: Sequence[Array], dpi: float) -> None:
    """Draw the numbers of the branches at their tips, and the points where trees begin."""
    for root in {tuple(np.round(path[0], 3)) for path in paths}:
        axes.plot(root[view.across], root[view.up], "o", ms=5, mfc="white", mec=BLACK, zorder=5)
    edge = [withStroke(linewidth=2, foreground="white")]
    look: dict[str, Any] = {"color": BLACK, "fontsize": 8, "path_effects": edge, "zorder": 6}
    for number, (tip, place) in enumerate(_places(axes, view, paths, dpi), start=1):
        if np.linalg.norm(place - tip) > 1.5 * TREE_LABEL_DISTANCES_PT[0]:
            line = {"arrowstyle": "-", "color": "0.5", "lw": 0.5, "shrinkA": 0.0, "shrinkB": 4.0}
            ends: dict[str, Any] = {"xycoords": "figure points", "textcoords": "figure points"}
            axes.annotate("", tuple(place), tuple(tip), arrowprops=line, **ends)
        axes.annotate(
            str(number),
            (float(place[0]), float(place[1])),
            xycoords="figure points",
            ha="center",
            va="center",
            **look,
        )


def _places(axes: Axes, view: Projection, paths: Sequence[Array], dpi: float) -> list[tuple[Array, Array]]:
    """Return for each branch its tip (2,) and the position (2,) of its number, points on the page.

    Numbers stand ahead of the tips, and further off or to the side where tips are close.
    """
    places: list[tuple[Array, Array]] = []
    for path in paths:
        before = np.flatnonzero(np.linalg.norm(path - path[-1], axis=1) > TREE_LABEL_TIP_LENGTH_MM)
        ends = path[[before[-1] if before.size else 0, -1]][:, [view.across, view.up]]
        behind, tip = axes.transData.transform(ends) * POINTS_PER_INCH / dpi
        ahead = (tip - behind) / max(np.linalg.norm(tip - behind), 1e-9)
        tried = [
            tip + distance * _turn(ahead, degrees)
            for distance in TREE_LABEL_DISTANCES_PT
            for degrees in TREE_LABEL_TURNS_DEG
        ]
        # A gap of 1 or more keeps two numbers apart; the first position that has it is taken.
        gaps = [
            min((float(np.max(abs(place - other) / TREE_LABEL_GAP_PT)) for _, other in places), default=1.0)
            for place in tried
        ]
        places.append((tip, tried[int(np.argmax(np.minimum(gaps, 1.0)))]))
    return places


def _turn(direction: Array, degrees: float) -> Array:
    """Return a direction (2,) turned anticlockwise."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([cos * direction[0] - sin * direction[1], sin * direction[0] + cos * direction[1]])


def _group_key(figure: Figure, panels: list[Axes], groups: Sequence[BranchGroup]) -> None:
    """Draw the key of the groups, with the number of branches in each, in the free corner."""
    corner = panels[1].get_position().x0, panels[2].get_position().y1
    entries = []
    for group in groups:
        # printable() would show line breaks as text.
        label = "\n".join(map(label_text, f"{len(group.members)}  {group.label}".splitlines()))
        entries.append(Line2D([], [], color=group.colour, lw=2.5, label=label))
    entries.append(Line2D([], [], ls="", marker="o", mfc="white", mec=BLACK, ms=5, label="start of the tree"))
    figure.legend(handles=entries, loc="upper left", bbox_to_anchor=corner, borderaxespad=0)


def _key(figure: Figure, panels: list[Axes], columns: int, paths: Sequence[Array], names: Sequence[str]) -> None:
    """Draw the key with names and lengths of all branches, in columns beside the panels or, for 0 of them, in the
    free corner.
    """
    front, left, below = (panel.get_position() for panel in panels)
    corner = (left.x1 + 0.3 / figure.get_figwidth(), front.y1) if columns else (left.x0, below.y1)
    entries = []
    for k, (path, name) in enumerate(zip(paths, names, strict=True)):
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        label = label_text(f"{k + 1}  {name[:24]}, {length:.0f} mm")
        entries.append(Line2D([], [], color=tube_colour(k), lw=2.5, label=label))
    entries.append(Line2D([], [], ls="", marker="o", mfc="white", mec=BLACK, ms=5, label="start"))
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": corner, "borderaxespad": 0}
    legend = figure.legend(handles=entries, ncols=max(columns, 1), **place)
    for text in legend.get_texts():
        text.set_parse_math(False)
