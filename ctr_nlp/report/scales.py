"""What a robot may be coloured by, and the colours: the same for all plans of a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex

from ctr_nlp.figures.parts.palette import CONTACT, ERROR
from ctr_nlp.plan.metrics import e1
from ctr_nlp.plan.plan import Plan
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

SHADES = np.linspace(0.0, 1.0, 17)
BELOW = 1 / 8
"""What is shown of a scale below 0, as a part of what is above."""
LEAST_SPAN = 0.1
"""Of a scale: less is rounding noise."""


@dataclass(frozen=True)
class Scale:
    """A quantity along the robot: its key, its name with unit, the values at both ends, and colours between them.

    stops: (position in [0, 1], colour), in order; two at one position are a jump.
    """

    key: str
    name: str
    low: float
    high: float
    stops: tuple[tuple[float, str], ...]


def quantities(plan: Plan) -> dict[str, Array]:
    """Values (T, 101) at uniform sigma of what is known of a plan: error and clearance in mm, stability margin."""
    found = {"error": e1(plan), "stability": np.repeat(plan.stability[:, None], len(SIGMA), axis=1)}
    if plan.clearance is not None:
        found["clearance"] = plan.clearance
    return {key: values for key, values in found.items() if np.isfinite(values).any()}


def scales(plans: Sequence[Plan]) -> list[Scale]:
    """One for each quantity that is known of any plan."""
    known = [quantities(plan) for plan in plans]
    most = {
        key: max(LEAST_SPAN, *(float(np.nanmax(some[key])) for some in known if key in some))
        for key in dict.fromkeys(key for some in known for key in some)
    }
    errors = tuple(zip(SHADES.tolist(), _colours(SHADES), strict=True))
    every = [
        Scale("error", "error at equal arc length (mm)", 0.0, most.get("error", 0.0), errors),
        _room("clearance", "clearance from the wall (mm), contact below 0", most.get("clearance", 0.0)),
        _room("stability", "stability margin, unstable below 0", 1.0),
    ]
    return [scale for scale in every if scale.key in most]


def _room(key: str, name: str, high: float) -> Scale:
    """The colour of contact below 0, then as errors, the other way round, with more shades near to 0."""
    zero = BELOW / (1 + BELOW)
    roomy = zip(zero + (1 - zero) * SHADES, _colours(1.0 - np.sqrt(SHADES)), strict=True)
    stops = ((0.0, CONTACT), (zero, CONTACT), *((float(at), colour) for at, colour in roomy))
    return Scale(key, name, -BELOW * high, high, stops)


def _colours(bad: Array) -> list[str]:
    """From good, dark, to bad, light."""
    return [to_hex(colour) for colour in colormaps[ERROR](bad)]
