"""Motors switched off when they stand still: the load moves them then, and the firmware does not see it."""

from __future__ import annotations

import numpy as np

from ctr_nlp.typing import Array

ALWAYS = 255
"""The idle delay that never ends."""
RELAXATION = 0.5
"""How far the load pushes a motor that goes limp, in mm or deg."""


def pushed(delay: float, kept: int, before: float, still: float) -> Array:
    """(6,) mm and deg by which axes move as they stand still for longer: `still` s instead of `before`.

    delay: ms after which motors are switched off, ALWAYS for never. kept: a bit for each axis that stays on.
    """
    if delay == ALWAYS or not before <= delay / 1000 < still:
        return np.zeros(6)
    return np.array([0.0 if kept >> i & 1 else RELAXATION for i in range(6)])
