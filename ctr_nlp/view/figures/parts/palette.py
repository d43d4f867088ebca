"""Colours and line widths that colour-blind readers and a greyscale print tell apart.

The hues are those of Okabe and Ito, "Color Universal Design" (2008), less the yellow that vanishes on white,
in an order in which neighbours differ in lightness too. Tubes are also drawn the thinner the further in they are,
as the tubes themselves: where two lie upon each other, both are seen.
"""

from __future__ import annotations

import numpy as np
from matplotlib.colors import ListedColormap

BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
BLACK, SKY, VERMILLION = "#000000", "#56B4E9", "#D55E00"

TUBE_COLOURS = (BLUE, ORANGE, GREEN, SKY, VERMILLION, BLACK, PURPLE)
TILT_COLOURS = (BLACK, VERMILLION)
FAILED_FRAME_COLOUR, UNREACHED_FRAME_COLOUR = "0.80", "0.93"
AMBIGUOUS = "#CBE6F6"
LUMEN_COLOUR, WALL_COLOUR = "#F3E4DC", "0.55"
"""The inside of a lumen, light enough for all tubes to stand out from it, and its wall."""
KEEP_OUT_COLOUR, WALL_GLASS_COLOUR = PURPLE, "#999999"
"""Bodies that a robot keeps away from, and walls that are looked through, in three dimensions."""

CONTACT = "#A33400"
"""A darker vermillion, which stands out from the blues in grey too."""
CLEARANCE_COLOUR_MAP = ListedColormap(np.linspace((0.47, 0.71, 0.92), (0.97, 0.97, 0.97), 256)).with_extremes(
    under=CONTACT
)
"""Colours from no room, blue, to the most there is."""
ERROR_COLOUR_MAP = "cividis"
"""Colour map from no error, dark, to the largest, light: one of matplotlib's that is the same for colour-blind
eyes.
"""


def tube_colour(i: int) -> str:
    """Colour of tube i = 0 .. d - 1, outermost first; they repeat after seven."""
    return TUBE_COLOURS[i % len(TUBE_COLOURS)]


def tube_width(i: int, d: int) -> float:
    """Line width in points of tube i = 0 .. d - 1 of d, outermost first: 3.6 down to 1.4."""
    return 3.6 - 2.2 * i / max(d - 1, 1)
