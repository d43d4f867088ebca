"""Colours of live numbers: along the robot, in a legend, and behind the numbers themselves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb

from ctr_nlp.anatomy.branch import transform_points
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.lumen import outermost_tube_index
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.verdicts import NOT_CHECKED
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.palette import CONTACT, ERROR_COLOUR_MAP, ORANGE, SKY, VERMILLION, tube_colour
from ctr_nlp.view.live.steered.session import SessionState

Colours = npt.NDArray[np.uint8]
"""(n, 3), red, green and blue."""
MIDDLES = (SIGMA_GRID[1:] + SIGMA_GRID[:-1]) / 2
"""Normalised arc lengths (100,) of the middles of the pieces that a robot is drawn of."""
LARGE_ERROR_MM, LARGE_CLEARANCE_MM = 5.0, 3.0
"""Values at the far ends of the scales of error and clearance."""
COLOUR_BY_ERROR, COLOUR_BY_CLEARANCE, COLOUR_BY_TUBE = "error", "clearance", "tube"
"""Quantities that the robot may be coloured by."""
LEGEND_COLOUR_COUNT = 9
"""Number of colours of a legend's gradient."""


def linear_light(colours: Colours) -> Colours:
    """Return colours (n, 3) of sRGB in linear light, in which viser takes the colours of batched meshes."""
    parts = colours / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)


def piece_colours(robot: Robot, seen: SessionState, by: str) -> Colours:
    """Return a colour (100, 3) for each piece of the robot.

    robot: the robot. seen: the state of the session. by: COLOUR_BY_ERROR, COLOUR_BY_CLEARANCE or COLOUR_BY_TUBE.
    """
    if by == COLOUR_BY_ERROR:
        return _shades(_between(seen.error) / LARGE_ERROR_MM)
    if by == COLOUR_BY_CLEARANCE and seen.clearance is not None:
        room = _between(seen.clearance)
        return np.where(room[:, None] < 0, _bytes(CONTACT), _shades(1 - room / LARGE_CLEARANCE_MM))
    beta = robot.split(seen.q)[1]
    return np.array([_bytes(tube_colour(i)) for i in range(robot.d)])[outermost_tube_index(beta[None], MIDDLES)[0]]


def legend(robot: Robot, by: str) -> str:
    """Return the legend of a robot's colours as HTML; by: COLOUR_BY_ERROR, COLOUR_BY_CLEARANCE or
    COLOUR_BY_TUBE.
    """
    if by == COLOUR_BY_TUBE:
        return " ".join(_patch(tube_colour(i), f"tube {i + 1}") for i in range(robot.d))
    part = np.linspace(0.0, 1.0, LEGEND_COLOUR_COUNT)
    colours = ", ".join(to_hex(colour / 255) for colour in _shades(part if by == COLOUR_BY_ERROR else 1 - part))
    bar = f'<div style="height:10px;background:linear-gradient(to right, {colours})"></div>'
    most = LARGE_ERROR_MM if by == COLOUR_BY_ERROR else LARGE_CLEARANCE_MM
    told = (
        "distance from the target at equal arc length" if by == COLOUR_BY_ERROR else "room between tubes and wall"
    )
    contact = f" {_patch(CONTACT, 'contact')}" if by == COLOUR_BY_CLEARANCE else ""
    return f'{bar}<div style="padding:0 0.6em"><small>0 to {most:g} mm: {told}{contact}</small></div>'


class RatedNumber(NamedTuple):
    """Number as it is shown: its name, the number with its unit, a word that rates it, and a colour behind the
    word.
    """

    name: str
    number: str
    word: str
    colour: str


GOOD_COLOUR, CAUTION_COLOUR, BAD_COLOUR = SKY, ORANGE, VERMILLION
CLOSE_ERROR_MM, FAR_ERROR_MM = 1.0, 3.0
"""Error e2 up to which the robot is called close to its target, and above which far from it."""
TIGHT_CLEARANCE_MM = 0.5
"""Clearance below which it is called tight."""


def rate_numbers(seen: SessionState, problem: Problem, settings: Settings) -> list[RatedNumber]:
    """Return the numbers of the state `seen` with ratings by the limits of `settings`; coordinates are those of
    the file of `problem`, if it has one.
    """
    e2 = seen.e2
    tip = float(seen.error[-1])
    how = (
        ("close", GOOD_COLOUR)
        if e2 <= CLOSE_ERROR_MM
        else ("near", CAUTION_COLOUR)
        if e2 <= FAR_ERROR_MM
        else ("far", BAD_COLOUR)
    )
    arrived = (
        ("at its goal", GOOD_COLOUR) if tip <= settings.arrival_tolerance else ("misses its goal", BAD_COLOUR)
    )
    found = [
        RatedNumber("shape error e2", f"{e2:.2f} mm", *how),
        RatedNumber("tip error", f"{tip:.2f} mm", *arrived),
        *_places(seen, problem),
    ]
    if np.isfinite(seen.e3):
        found.append(RatedNumber("recorded, e3", f"{seen.e3:.2f} mm", "", ""))
    found.append(_margin(seen, settings.stability_margin or 0.0))
    if seen.clearance is not None:
        least = float(seen.clearance.min())
        room = (
            ("free", GOOD_COLOUR)
            if least > TIGHT_CLEARANCE_MM
            else ("tight", CAUTION_COLOUR)
            if least >= 0
            else ("contact", BAD_COLOUR)
        )
        found.append(RatedNumber("least clearance", f"{least:.2f} mm", *room))
    if len(seen.lost):
        lost = int(seen.lost.sum())
        all_kept = ("none failed", GOOD_COLOUR) if not lost else ("some failed", BAD_COLOUR)
        found.append(RatedNumber("sampled robots that failed", f"{lost} of {len(seen.lost)}", *all_kept))
    return found


def _places(seen: SessionState, problem: Problem) -> list[RatedNumber]:
    """Return the coordinates of tip and goal, mm, in those of the problem's file or else of the robot's base."""
    back: Array = np.eye(4)
    name = "base frame"
    if problem.space is not None and problem.to_robot is not None:
        back = np.asarray(np.linalg.inv(problem.to_robot))
        name = "file" if problem.space == "xyz" else problem.space
    found = []
    for what, point in (("tip", seen.shape[-1]), ("goal", seen.target[-1])):
        numbers = np.round(transform_points(point, back), 1) + 0.0  # no "-0.0"
        text = ", ".join(f"{value:.1f}" for value in numbers) if np.isfinite(numbers).all() else "not known"
        found.append(RatedNumber(f"{what}, {name}", f"{text} mm", "", ""))
    return found


def _margin(seen: SessionState, required_margin: float) -> RatedNumber:
    """Return the stability margin with its rating."""
    if not np.isfinite(seen.margin):
        return RatedNumber(
            "stability margin", "", f"{NOT_CHECKED}: this model cannot predict snapping", CAUTION_COLOUR
        )
    how = (
        ("stable", GOOD_COLOUR)
        if seen.margin > 2 * required_margin
        else ("little", CAUTION_COLOUR)
        if seen.margin > 0
        else ("unstable", BAD_COLOUR)
    )
    return RatedNumber("stability margin", f"{seen.margin:.3f}", *how)


FIGURES = "text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums"
"""Style of a column of numbers."""


def table(rows: list[RatedNumber]) -> str:
    """Return the rated numbers `rows` as an HTML table."""
    lines = [f"<tr><td>{row.name}</td>{_cells(row)}</tr>" for row in rows]
    return f'<table style="width:96%;padding-left:0.6em;font-size:0.85em">{"".join(lines)}</table>'


def _cells(row: RatedNumber) -> str:
    """Return the number of a row with its word, or over both columns where it has no word, as cells in HTML."""
    if not row.word:
        return f'<td colspan="2" style="{FIGURES}"><b>{row.number}</b></td>'
    word = _patch(row.colour, row.word) if row.colour else row.word
    return f'<td style="{FIGURES}"><b>{row.number}</b></td><td>{word}</td>'


def _patch(colour: str, word: str) -> str:
    """Return a word on a coloured ground as HTML, black or white, whichever can be read better."""
    red, green, blue = to_rgb(colour)
    # Luma of Rec. 601: how bright a colour looks.
    ink = "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.45 else "white"
    return f'<span style="background:{colour};color:{ink};padding:0 5px;border-radius:3px">{word}</span>'


def _between(values: Array) -> Array:
    """Interpolate values at the samples (101,) along the robot to the middles (100,) of its pieces."""
    return np.asarray((values[1:] + values[:-1]) / 2)


_ERROR_COLOUR_TABLE = np.round(255 * colormaps[ERROR_COLOUR_MAP](np.linspace(0.0, 1.0, 256))[:, :3]).astype(
    np.uint8
)


def _shades(part: Array) -> Colours:
    """Return colours for numbers (n,) from 0, good, to 1, bad; NaN counts as bad."""
    return np.asarray(_ERROR_COLOUR_TABLE[np.clip(255 * np.nan_to_num(part, nan=1.0), 0, 255).astype(int)])


def _bytes(colour: str) -> Colours:
    return np.round(255 * np.array(to_rgb(colour))).astype(np.uint8)
