"""Warnings about a designed robot: tubes that are not used, and tubes that are rarely sold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ctr_nlp.ocp.shared.manufacture import TUBING_DIAMETER_RATIOS
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

MIN_USEFUL_LENGTH_MM = 5.0
"""Extension, mm, or length over which a tube matters, mm, above which it is of use in some frame."""
MIN_STIFFNESS_SHARE = 0.02
"""Least part of the bending stiffness of all tubes at a place with which a tube matters there."""


def find_design_warnings(robot: Robot, plans: Sequence[Plan], sold: bool) -> tuple[str, ...]:
    """Return sentences on tubes that plans do not need and on unusual diameters.

    Parameters
    ----------
    robot : Robot
        The designed robot.
    plans : sequence of Plan
        Plans on it.
    sold : bool
        Whether all tubes are of a stock, so that their diameters need no warning.

    Returns
    -------
    tuple of str
        One sentence a warning; empty where there is none.
    """
    beta = np.concatenate([plan.beta for plan in plans])
    return (*_unused_tube_warnings(robot, beta), *(() if sold else _unsold_tube_warnings(robot)))


def _unused_tube_warnings(robot: Robot, beta: Array) -> Iterator[str]:
    """Yield a sentence for each tube that is hardly pushed out, or that hardly bends the robot; beta
    (T, d) in mm.
    """
    out = beta.max(axis=0)
    felt = _effective_lengths(robot, beta).max(axis=0)
    for i in range(robot.d):
        if out[i] <= MIN_USEFUL_LENGTH_MM:
            yield (
                f"Tube {i + 1} never extends by more than {out[i]:.1f} mm: {robot.d - 1} tubes suffice for these "
                "tasks"
            )
        elif felt[i] <= MIN_USEFUL_LENGTH_MM:
            yield (
                f"Tube {i + 1} has little effect: it has at least {MIN_STIFFNESS_SHARE:.0%} of the stiffness on "
                f"{felt[i]:.1f} mm at most"
            )


def _effective_lengths(robot: Robot, beta: Array) -> Array:
    """Return the lengths (T, d), mm, over which each tube has at least MIN_STIFFNESS_SHARE of the stiffness, with
    beta (T, d) mm.
    """
    stiffness = np.array([tube.bending_stiffness for tube in robot.tubes])
    found = np.zeros_like(beta)
    # Between two neighbouring tips, or the insertion point and the first tip, the same tubes are present.
    edges = np.sort(np.concatenate([np.zeros((len(beta), 1)), beta], axis=1), axis=1)
    for start, end in zip(edges.T[:-1], edges.T[1:], strict=True):
        # Tubes that reach beyond the start of a piece carry all of it, since pieces end where tubes do.
        there = (beta > start[:, None] + 1e-9) * stiffness
        part = there / np.maximum(there.sum(axis=1, keepdims=True), 1e-300)
        found += np.where(part >= MIN_STIFFNESS_SHARE, (end - start)[:, None], 0.0)
    return found


def _unsold_tube_warnings(robot: Robot) -> Iterator[str]:
    """Yield a sentence for each tube whose ratio of diameters is rarely sold."""
    low, high = TUBING_DIAMETER_RATIOS
    for i, tube in enumerate(robot.tubes, 1):
        ratio = tube.outer_diameter / tube.inner_diameter
        if not low <= ratio <= high:
            yield (
                f"The outer diameter of tube {i} is {ratio:.2f} times the inner; Nitinol tubing is usually sold "
                f"with ratios of {low:g} to {high:g}. Round to a stock, or ask a supplier"
            )
