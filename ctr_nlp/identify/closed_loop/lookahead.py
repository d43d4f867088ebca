"""Look-ahead before a command: the stability margin of the estimated robot, and of a less stable one, on the path.

A snap cannot be undone, so it must be predicted. Two robots are simulated along the commanded motion in
LOOKAHEAD_SUBSTEPS steps: the estimated one, whose margin must not fall below the least margin, and one that is
SNAP_SAFETY_DEVIATIONS standard deviations of the margin less stable, which must not snap. The second one is
simulated instead of extrapolated: towards a fold the margin mu falls as the square root of the remaining distance
x, mu ~ sqrt(x), so that the line through margin and slope reaches 0 only after mu / mu' = 2 x.
"""

from __future__ import annotations

import math

import numpy as np

from ctr_nlp.identify.closed_loop.observer import Observer
from ctr_nlp.typing import Array

LEAST_MARGIN = 0.05
"""Stability margin of the estimated robot below which it is not moved; half of the planned one where that is less.
"""
SNAP_SAFETY_DEVIATIONS = 3.0
"""Standard deviations of the margin by which a robot may be less stable than the estimated one and must not snap.
"""
LOOKAHEAD_SUBSTEPS = 4
"""Sub-steps to a configuration after which the margin is computed."""


def objection(observer: Observer, weaker: Observer | None, motors: Array, least_margin: float) -> str:
    """Say why the estimated robot must not be moved to a configuration.

    Parameters
    ----------
    observer : Observer
        The estimated robot at its present configuration.
    weaker : Observer, optional
        The less stable robot, of :meth:`~ctr_nlp.identify.closed_loop.observer.Observer.weaker_robot`; None where
        that has snapped already, which rules out every motion.
    motors : Array
        Commanded configuration (2d + 2,) of the motors, rad and mm, to which they move linearly.
    least_margin : float
        Least stability margin of the estimated robot.

    Returns
    -------
    str
        The reason in words, empty where the robot may be moved.
    """
    margin = _least_margin(observer, motors)
    if margin == -math.inf:
        return "the robot as it is estimated would snap"
    if margin < least_margin:
        return f"the stability margin of the estimated robot would fall to {margin:.3f}, below {least_margin:.3f}"
    if weaker is None or _least_margin(weaker, motors) == -math.inf:
        return (
            f"the margin of the estimated robot is {margin:.3f}, and a robot {SNAP_SAFETY_DEVIATIONS:g} "
            f"standard deviations "
            "less stable would snap"
        )
    return ""


def _least_margin(observer: Observer, motors: Array) -> float:
    """Return the least stability margin on the path to motors (2d + 2,); -inf where the robot snaps."""
    there = observer.independent_copy()
    start = observer.q
    least = math.inf
    for part in np.arange(1, LOOKAHEAD_SUBSTEPS + 1) / LOOKAHEAD_SUBSTEPS:
        if there.move_and_check_snap(start + part * (motors - start)):
            return -math.inf
        least = min(least, there.walker.margin())
    return least
