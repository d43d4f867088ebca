"""How far nested tubes can be out together: their limits, their order and the gap between their carriages."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import LENGTHS, Tube
from ctr_nlp.robot.units import between, did_you_mean, length_meant
from ctr_nlp.support.values import frozen
from ctr_nlp.typing import Array


def check_extensions(
    tubes: Sequence[Tube], lower: Sequence[float], upper: Sequence[float], gap: float | None
) -> None:
    """Raise RobotError unless some beta (d,) mm keeps limits, order and carriage gap."""
    low, high = 0.0, math.inf
    for i, (tube, least, most) in enumerate(zip(tubes, lower, upper, strict=True)):
        name = f"beta_{i + 1}"
        _check_ends(name, tube, least, most)
        longer = tube.length - tubes[i - 1].length if i and gap is not None else math.inf
        if gap is not None and gap > longer:
            raise RobotError(
                f"carriage_gap is {gap:g} mm and tube {i + 1} only {longer:g} mm longer than tube {i}: with "
                f"beta_{i} <= {name}, it must be at most that"
            )
        low, high = max(low, least), min(high + longer - (gap or 0.0), most)
        if low > high:
            raise RobotError(
                f"limits of {name} leave no room: it must be at least {low:g} mm (order, lower limits) "
                f"and at most {high:g} mm (upper limits and carriage gap)"
            )


def furthest(tubes: Sequence[Tube], upper: Array, gap: float | None) -> Array:
    """The largest beta (d,) mm within upper limits (d,), order and carriage gap."""
    beta = upper.copy()
    for i in range(1, len(tubes)):
        if gap is not None:
            beta[i] = min(beta[i], beta[i - 1] + tubes[i].length - tubes[i - 1].length - gap)
    return frozen(np.minimum.accumulate(beta[::-1])[::-1])


def _check_ends(name: str, tube: Tube, least: float, most: float) -> None:
    """Raise RobotError unless limits in mm lie along a tube and are likely in mm."""
    if least < 0 or most > tube.length:
        raise RobotError(
            f"limits of {name} are [{least:g}, {most:g}] mm; they must lie in [0, {tube.length:g}], "
            "the tube's length"
        )
    if 0 < most < LENGTHS[0]:
        meant = did_you_mean(length_meant(most, between(LENGTHS[0], tube.length)))
        raise RobotError(
            f"the upper limit of {name} is {most:g} mm; it must be 0, or at least {LENGTHS[0]:g} mm{meant}"
        )
