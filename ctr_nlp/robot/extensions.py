"""Extensions beta that nested tubes can have together: limits (3), order (2) and the gap between carriages."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.tube import TUBE_LENGTH_RANGE_MM, Tube
from ctr_nlp.robot.units import between, did_you_mean, suggest_length
from ctr_nlp.support.value_checks import frozen
from ctr_nlp.typing import Array


def check_extensions(
    tubes: Sequence[Tube], lower: Sequence[float], upper: Sequence[float], gap: float | None
) -> None:
    """Check that some extensions satisfy limits, order and carriage gap together, eqs. (2) and (3).

    Parameters
    ----------
    tubes : sequence of Tube
        The d tubes, outermost first.
    lower, upper : sequence of float
        Limits (d,) of beta, mm.
    gap : float or None
        Least distance between neighbouring carriages, mm; None for no such limit.

    Raises
    ------
    RobotError
        No extensions satisfy all of these, or a limit lies beyond its tube or is likely not in mm.
    """
    # [low, high] is the interval of beta_i that the tubes outside leave. Each tube narrows it by its own limits,
    # by the order beta_i <= beta_{i+1}, and by the gap: (L_{i+1} - beta_{i+1}) - (L_i - beta_i) >= gap.
    low = 0.0
    high = math.inf
    for i, (tube, least, most) in enumerate(zip(tubes, lower, upper, strict=True)):
        name = f"beta_{i + 1}"
        _check_ends(name, tube, least, most)
        longer = tube.length - tubes[i - 1].length if i and gap is not None else math.inf
        if gap is not None and gap > longer:
            raise RobotError(
                f"carriage_gap is {gap:g} mm; it must be at most {longer:g} mm, by which tube {i + 1} is longer "
                f"than tube {i}"
            )
        # Greedy from the outermost tube inwards: what is left of the interval is exactly what some extensions of
        # the tubes outside allow, so that it is empty only if no extensions exist.
        low = max(low, least)
        high = min(high + longer - (gap or 0.0), most)
        if low > high:
            raise RobotError(
                f"limits of {name} leave no room: it must be at least {low:g} mm (order, lower limits) "
                f"and at most {high:g} mm (upper limits and carriage gap)"
            )


def compute_max_extensions(tubes: Sequence[Tube], upper: Array, gap: float | None) -> Array:
    """Return the largest extensions that limits, order and carriage gap allow.

    Parameters
    ----------
    tubes : sequence of Tube
        The d tubes, outermost first.
    upper : ndarray
        Upper limits (d,) of beta, mm.
    gap : float or None
        Least distance between neighbouring carriages, mm.

    Returns
    -------
    ndarray
        Largest beta (d,), mm, read-only.
    """
    beta = upper.copy()
    for i in range(1, len(tubes)):
        if gap is not None:
            # Outermost first, since the gap bounds an inner tube by the one around it: beta_{i+1} <= beta_i +
            # L_{i+1} - L_i - gap.
            beta[i] = min(beta[i], beta[i - 1] + tubes[i].length - tubes[i - 1].length - gap)
    # No outer tube may be out further than an inner one, eq. (2): the minimum over all tubes within it.
    return frozen(np.minimum.accumulate(beta[::-1])[::-1])


def _check_ends(name: str, tube: Tube, least: float, most: float) -> None:
    """Raise RobotError unless the limits `least` and `most` of one beta lie along its tube and are
    likely in mm.
    """
    if least < 0 or most > tube.length:
        raise RobotError(
            f"limits of {name} are [{least:g}, {most:g}] mm; they must lie in [0, {tube.length:g}], "
            "the tube's length"
        )
    # A limit of 0.05 is far more likely 50 mm in metres than a tube that moves by a twentieth of a mm.
    if 0 < most < TUBE_LENGTH_RANGE_MM[0]:
        meant = did_you_mean(suggest_length(most, between(TUBE_LENGTH_RANGE_MM[0], tube.length)))
        raise RobotError(
            f"the upper limit of {name} is {most:g} mm; it must be 0, or at least {TUBE_LENGTH_RANGE_MM[0]:g} "
            f"mm{meant}"
        )
