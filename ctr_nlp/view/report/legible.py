"""Colours that are legible on white: their contrast (WCAG 2.2), and colours darkened until they have it."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_hex, to_rgb

MIN_LINE_CONTRAST = 3.0
"""Least contrast of lines with their ground, WCAG 2.2, criterion 1.4.11."""
DARKENING_STEP = 0.97
"""Factor by which a colour is darkened at a time."""
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Parts of red, green and blue in the relative luminance of sRGB."""


def contrast_with_white(colour: str) -> float:
    """Return the contrast of a colour with white, from 1 to 21."""
    parts = np.array(to_rgb(colour))
    # The inverse of sRGB's gamma: luminance adds up in linear light.
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(1.05 / (linear @ np.array(LUMINANCE_WEIGHTS) + 0.05))


def darken_for_white(colour: str) -> str:
    """Return a colour, darkened until its contrast with white is at least MIN_LINE_CONTRAST."""
    red, green, blue = to_rgb(colour)
    while contrast_with_white(found := str(to_hex((red, green, blue)))) < MIN_LINE_CONTRAST:
        red, green, blue = (DARKENING_STEP * part for part in (red, green, blue))
    return found
