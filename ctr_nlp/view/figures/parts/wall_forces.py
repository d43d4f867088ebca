"""Forces of a wall on a robot, as lines in space that end at its body."""

from __future__ import annotations

import numpy as np

from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.overlay import points_at
from ctr_nlp.view.figures.parts.palette import CONTACT

LONGEST_FORCE_LINE_MM = 15.0
"""Length of the line of the largest force in a plan; other lines are in proportion."""
WALL_FORCE_COLOUR = CONTACT
"""Colour of these lines, that of contact in all pictures."""


def wall_force_lines(plan: Plan) -> Array:
    """Return lines (T, K, 2, 3), mm, of a wall's forces on the K pieces of a robot that leans on it.

    Each line ends at the robot and comes from the side from which the wall presses. A piece without a force has a
    line of no length; one whose shape is not known is NaN. The plan must have forces (``plan.wall_force``).
    """
    assert plan.wall_force is not None
    assert plan.wall_force_along is not None
    assert plan.wall_force_direction is not None
    # Where on the body, as parts of its length, which is that of the innermost tube.
    sigma = plan.wall_force_along / plan.beta[:, -1:]
    ends = np.stack([points_at(shape, at) for shape, at in zip(plan.shape, sigma, strict=True)])
    largest = np.nanmax(plan.wall_force, initial=0.0)
    length = LONGEST_FORCE_LINE_MM * plan.wall_force / max(largest, np.finfo(float).tiny)
    return np.stack([ends - length[..., None] * plan.wall_force_direction, ends], axis=2)


def describe_force_lines(plan: Plan) -> str:
    """Return what the lines of a plan's wall forces show, for a legend; the plan must have forces."""
    assert plan.wall_force is not None
    largest = np.nanmax(plan.wall_force, initial=0.0)
    return f"force of the wall, {LONGEST_FORCE_LINE_MM:g} mm for {largest:.2g} N"
