"""Whether an estimated robot may be moved on: its stability margin there and on the way, and that of a likely one.

A snap cannot be taken back, so it must be foreseen. Two robots are moved in LOOKAHEAD_SUBSTEPS parts of the way
that motors would go: the estimated one, whose margin must not fall below the least margin, and one that is
SNAP_SAFETY_DEVIATIONS standard deviations of the margin less stable, which must not snap. The second one is moved
as a robot of its own instead of being extrapolated from slopes: towards a fold the margin falls as the square root
of the way that is left, so that a straight line through margin and slope promises twice the way that there is.
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
"""Parts of the way to a configuration at whose ends the margin is looked at."""


def objection(observer: Observer, weaker: Observer | None, motors: Array, least_margin: float) -> str:
    """Say why the estimated robot must not be moved to a configuration.

    Parameters
    ----------
    observer : Observer
        The estimated robot, where its motors are.
    weaker : Observer, optional
        The less stable robot, of :meth:`~ctr_nlp.identify.closed_loop.observer.Observer.weaker`; None where that
        has snapped already, which speaks against every motion.
    motors : Array
        Where motors are to go, evenly, (2d + 2,): rad, mm.
    least_margin : float
        Of the estimated robot.

    Returns
    -------
    str
        The reason in words, empty where nothing speaks against it.
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
    """The least stability margin on the way to motors (2d + 2,); -inf where the robot snaps."""
    there = observer.independent_copy()
    start = observer.q
    least = math.inf
    for part in np.arange(1, LOOKAHEAD_SUBSTEPS + 1) / LOOKAHEAD_SUBSTEPS:
        if there.move_and_check_snap(start + part * (motors - start)):
            return -math.inf
        least = min(least, there.walker.margin())
    return least
