"""What a user would call degenerate about a designed robot: tubes that are not used, or that nobody sells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ctr_nlp.formulations.shared.manufacture import SOLD_RATIO
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

USED = 5.0
"""mm that a tube is pushed out by, or matters over, in some frame if it is of use."""
MATTERS = 0.02
"""Least part of the bending stiffness of all tubes at a place with which a tube is felt there."""


def doubts(robot: Robot, plans: Sequence[Plan], sold: bool) -> tuple[str, ...]:
    """Sentences on tubes that the plans on a robot do not need, and, unless all are sold, on unusual diameters."""
    beta = np.concatenate([plan.beta for plan in plans])
    return (*_unused(robot, beta), *(() if sold else _unsold(robot)))


def _unused(robot: Robot, beta: Array) -> Iterator[str]:
    out, felt = beta.max(axis=0), _felt(robot, beta).max(axis=0)
    for i in range(robot.d):
        if out[i] <= USED:
            yield (
                f"Tube {i + 1} is never pushed out by more than {out[i]:.1f} mm: these tasks need a robot of "
                f"{robot.d - 1} tubes"
            )
        elif felt[i] <= USED:
            yield (
                f"Tube {i + 1} is hardly felt: where it lies, other tubes have more than {1 - MATTERS:.0%} of the "
                f"stiffness, but for {felt[i]:.1f} mm at most"
            )


def _felt(robot: Robot, beta: Array) -> Array:
    """Lengths (T, d) in mm over which each tube, pushed out to beta (T, d), has its part of the stiffness."""
    stiffness, found = np.array([tube.bending_stiffness for tube in robot.tubes]), np.zeros_like(beta)
    edges = np.sort(np.concatenate([np.zeros((len(beta), 1)), beta], axis=1), axis=1)
    for start, end in zip(edges.T[:-1], edges.T[1:], strict=True):
        there = (beta > start[:, None] + 1e-9) * stiffness
        part = there / np.maximum(there.sum(axis=1, keepdims=True), 1e-300)
        found += np.where(part >= MATTERS, (end - start)[:, None], 0.0)
    return found


def _unsold(robot: Robot) -> Iterator[str]:
    low, high = SOLD_RATIO
    for i, tube in enumerate(robot.tubes, 1):
        ratio = tube.outer_diameter / tube.inner_diameter
        if not low <= ratio <= high:
            yield (
                f"Tube {i} is {ratio:.2f} times as thick outside as inside; Nitinol tubing is usually sold from "
                f"{low:g} to {high:g} times. Round to a stock, or ask a supplier"
            )
