"""Colours of live numbers: along the robot, in a legend, and behind the numbers themselves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb

from ctr_nlp.figures.parts.palette import CONTACT, ERROR, ORANGE, SKY, VERMILLION, tube_colour
from ctr_nlp.live.steered.session import Seen
from ctr_nlp.plan.verdicts import NOT_CHECKED
from ctr_nlp.robot import Robot
from ctr_nlp.target.lumen import outermost
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

Colours = npt.NDArray[np.uint8]
"""(n, 3), red, green and blue."""
MIDDLES = (SIGMA[1:] + SIGMA[:-1]) / 2
"""Normalised arc lengths (100,) of the pieces that a robot is drawn of."""
LARGE_ERROR, MUCH_ROOM = 5.0, 3.0
"""mm at the far ends of the scales of error and clearance."""
BY_ERROR, BY_CLEARANCE, BY_TUBE = "error", "clearance", "tube"
"""Quantities that the robot may be coloured by."""
STEPS = 9
"""Colours that a legend is made of."""


def pieces(robot: Robot, seen: Seen, by: str) -> Colours:
    """Return a colour for each of the 100 pieces of the robot, by error, clearance or tube."""
    if by == BY_ERROR:
        return _shades(_between(seen.error) / LARGE_ERROR)
    if by == BY_CLEARANCE and seen.clearance is not None:
        room = _between(seen.clearance)
        return np.where(room[:, None] < 0, _bytes(CONTACT), _shades(1 - room / MUCH_ROOM))
    beta = robot.split(seen.q)[1]
    return np.array([_bytes(tube_colour(i)) for i in range(robot.d)])[outermost(beta[None], MIDDLES)[0]]


def legend(robot: Robot, by: str) -> str:
    """Return the legend of the colours as a piece of HTML; `by` is `BY_ERROR`, `BY_CLEARANCE` or `BY_TUBE`."""
    if by == BY_TUBE:
        return " ".join(_patch(tube_colour(i), f"tube {i + 1}") for i in range(robot.d))
    part = np.linspace(0.0, 1.0, STEPS)
    colours = ", ".join(to_hex(colour / 255) for colour in _shades(part if by == BY_ERROR else 1 - part))
    bar = f'<div style="height:10px;background:linear-gradient(to right, {colours})"></div>'
    most = LARGE_ERROR if by == BY_ERROR else MUCH_ROOM
    told = "distance from the target at equal arc length" if by == BY_ERROR else "room between tubes and wall"
    contact = f" {_patch(CONTACT, 'contact')}" if by == BY_CLEARANCE else ""
    return f"{bar}<small>0 to {most:g} mm: {told}{contact}</small>"


class Judged(NamedTuple):
    """A number as it is shown: its name, the number with its unit, a word on it, and a colour behind the word."""

    name: str
    number: str
    word: str
    colour: str


GOOD, NEAR, BAD = SKY, ORANGE, VERMILLION
CLOSE, FAR = 1.0, 3.0
"""mm of error e2 up to which the robot is called close to its target, and above which far from it."""
TIGHT = 0.5
"""mm of clearance below which it is called tight."""


def judged(seen: Seen, asked: float | None) -> list[Judged]:
    """Return the numbers of a moment with words on them; `asked` is the least stability margin that steering
    keeps, None for any.
    """
    e2, tip = seen.e2, float(seen.error[-1])
    how = ("close", GOOD) if e2 <= CLOSE else ("near", NEAR) if e2 <= FAR else ("far", BAD)
    found = [Judged("shape error e2", f"{e2:.2f} mm", *how), Judged("tip error", f"{tip:.2f} mm", "", "")]
    if np.isfinite(seen.e3):
        found.append(Judged("recorded, e3", f"{seen.e3:.2f} mm", "", ""))
    found.append(_margin(seen, asked or 0.0))
    if seen.clearance is not None:
        least = float(seen.clearance.min())
        room = ("free", GOOD) if least > TIGHT else ("tight", NEAR) if least >= 0 else ("contact", BAD)
        found.append(Judged("least clearance", f"{least:.2f} mm", *room))
    if len(seen.lost):
        lost = int(seen.lost.sum())
        all_kept = ("none lost", GOOD) if not lost else ("some lost", BAD)
        found.append(Judged("sampled robots lost", f"{lost} of {len(seen.lost)}", *all_kept))
    return found


def _margin(seen: Seen, asked: float) -> Judged:
    if not np.isfinite(seen.margin):
        return Judged("stability margin", "", f"{NOT_CHECKED}: this model cannot predict snapping", NEAR)
    how = (
        ("stable", GOOD) if seen.margin > 2 * asked else ("little", NEAR) if seen.margin > 0 else ("unstable", BAD)
    )
    return Judged("stability margin", f"{seen.margin:.3f}", *how)


FIGURES = "text-align:right;font-variant-numeric:tabular-nums"
"""How numbers stand below each other."""


def table(rows: list[Judged]) -> str:
    """Judged numbers as a piece of HTML."""
    lines = [
        f'<tr><td>{row.name}</td><td style="{FIGURES}"><b>{row.number}</b></td>'
        f"<td>{_patch(row.colour, row.word) if row.colour else row.word}</td></tr>"
        for row in rows
    ]
    return f'<table style="width:100%;font-size:0.85em">{"".join(lines)}</table>'


def _patch(colour: str, word: str) -> str:
    """A word on a colour, black or white as can be read better."""
    red, green, blue = to_rgb(colour)
    ink = "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.45 else "white"
    return f'<span style="background:{colour};color:{ink};padding:0 5px;border-radius:3px">{word}</span>'


def _between(values: Array) -> Array:
    """Interpolate values at the samples (101,) along the robot to the middles (100,) of its pieces."""
    return np.asarray((values[1:] + values[:-1]) / 2)


_TABLE = np.round(255 * colormaps[ERROR](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)


def _shades(part: Array) -> Colours:
    """Return colours for numbers (n,) from 0, good, to 1, bad; NaN counts as bad."""
    return np.asarray(_TABLE[np.clip(255 * np.nan_to_num(part, nan=1.0), 0, 255).astype(int)])


def _bytes(colour: str) -> Colours:
    return np.round(255 * np.array(to_rgb(colour))).astype(np.uint8)
