"""What a number that cannot be was perhaps meant to be: the unit that it was likely written in."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

Plausible = Callable[[float], bool]

THOUSANDS = (1e3, 1e6, 1e9)
"""By what numbers are off whose unit is another one of the metric system."""
NEAR = 5.0
"""A ratio within this factor of a thousand, a million or a milliard is taken for a mistake of units."""


def between(low: float, high: float) -> Plausible:
    """Whether a number lies in [low, high]."""
    return lambda value: low <= value <= high


def did_you_mean(meant: Iterable[str]) -> str:
    """The end of a message that offers what was perhaps meant; nothing where there is nothing to offer."""
    offers = list(meant)
    return f"; did you mean {' or '.join(offers)}?" if offers else ""


def length_meant(value: float, plausible: Plausible) -> list[str]:
    """The lengths in mm that one in metres or in micrometres was meant to be, where they are plausible."""
    offers = ((1e3 * value, f"{value:g} m"), (value / 1e3, f"{value:g} µm"))
    return [f"{mm:g} mm ({written})" for mm, written in offers if plausible(mm)]


def curvature_meant(value: float, plausible: Plausible) -> list[str]:
    """The curvatures in 1/mm that a radius in mm, or a curvature per metre, was meant to be."""
    offers = (
        (1 / value, f"1/{value:g} (a radius of {value:g} mm)"),
        (value / 1e3, f"{value / 1e3:g} ({value:g} per metre)"),
    )
    return [written for curvature, written in offers if plausible(curvature)]


def angle_meant(value: float, plausible: Plausible) -> list[str]:
    """The angle in rad that one in degrees was meant to be; within two turns none is taken for degrees."""
    radians = math.radians(value)
    return [f"{radians:.4g} rad ({value:g} degrees)"] if abs(value) > 4 * math.pi and plausible(radians) else []


def in_other_units(first: float, second: float) -> float | None:
    """By how many thousands two positive numbers differ whose units are likely not the same, else None."""
    ratio = max(first / second, second / first)
    return next((step for step in THOUSANDS if step / NEAR <= ratio <= step * NEAR), None)
