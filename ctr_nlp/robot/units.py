"""Mistakes of units: guesses of the value that a user meant by a number that is out of range."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

Plausible = Callable[[float], bool]

THOUSANDS = (1e3, 1e6, 1e9)
"""Factors by which a number in another metric unit is off."""
UNIT_MISTAKE_FACTOR = 5.0
"""Ratios within this factor of one of THOUSANDS are taken for a mistake of units."""


def between(low: float, high: float) -> Plausible:
    """Return a function that returns whether a number lies in [low, high]."""
    return lambda value: low <= value <= high


def did_you_mean(meant: Iterable[str]) -> str:
    """Return the end of a message that offers likely values; an empty text where `meant` is empty."""
    offers = list(meant)
    return f"; did you mean {' or '.join(offers)}?" if offers else ""


def suggest_length(value: float, plausible: Plausible) -> list[str]:
    """Return the plausible lengths in mm that `value`, in metres or micrometres, was likely meant to
    be, as texts.
    """
    offers = ((1e3 * value, f"{value:g} m"), (value / 1e3, f"{value:g} µm"))
    return [f"{mm:g} mm ({written})" for mm, written in offers if plausible(mm)]


def suggest_curvature(value: float, plausible: Plausible) -> list[str]:
    """Return the plausible curvatures in 1/mm that `value`, a radius in mm or a curvature per metre, was meant to
    be.
    """
    offers = (
        (1 / value, f"1/{value:g} (a radius of {value:g} mm)"),
        (value / 1e3, f"{value / 1e3:g} ({value:g} per metre)"),
    )
    return [written for curvature, written in offers if plausible(curvature)]


def suggest_angle(value: float, plausible: Plausible) -> list[str]:
    """Return the plausible angle in rad that `value`, in degrees, was meant to be.

    Up to two turns (4 pi) no number is taken for degrees: it may well be in rad.
    """
    radians = math.radians(value)
    return [f"{radians:.4g} rad ({value:g} degrees)"] if abs(value) > 4 * math.pi and plausible(radians) else []


def unit_mismatch_factor(first: float, second: float) -> float | None:
    """Return the factor (1e3, 1e6 or 1e9) by which `first` and `second`, both positive, likely differ, or None."""
    # Moduli of real tubes differ by far less than 200, the least ratio that is taken for a wrong prefix.
    ratio = max(first / second, second / first)
    return next(
        (step for step in THOUSANDS if step / UNIT_MISTAKE_FACTOR <= ratio <= step * UNIT_MISTAKE_FACTOR), None
    )
