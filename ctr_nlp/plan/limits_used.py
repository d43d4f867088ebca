"""How much of its robot's limits a motion uses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ctr_nlp.plan.record import Record
from ctr_nlp.typing import Array

SLACK = 1e-5
"""rad or mm by which positions, and steps from frame to frame, may exceed their limits: what solvers leave."""


class Used(NamedTuple):
    """part: of a limit, 1 for all of it. exceeded: by more than SLACK. what: which limit, and in which frame."""

    part: float
    exceeded: bool
    what: str


def most_used(plan: Record) -> Used | None:
    """The limit that a motion exceeds by most, or else the speed or acceleration that uses most of its limit.

    Positions count only where they exceed limits, since tubes are meant to go all the way: as 1 and what is beyond
    as a part of the robot's reach, or of half a turn. None where the robot does not move.
    """
    found = [used for used in (*_rates(plan), *_positions(plan)) if used.part > 0]
    return max(found, key=lambda used: (used.exceeded, used.part), default=None)


def rate_parts(plan: Record, order: int) -> Array:
    """What speeds (order 1) or accelerations (2) between frames use of their limits, (T - order, 2d + 2)."""
    limit = (plan.robot.speed, plan.robot.acceleration)[order - 1]
    return np.nan_to_num(np.abs(np.diff(plan.q, n=order, axis=0)) / plan.dt**order / limit)


def _rates(plan: Record) -> Iterator[Used]:
    robot = plan.robot
    for order, name, limit in ((1, "speed", robot.speed), (2, "acceleration", robot.acceleration)):
        parts = rate_parts(plan, order)
        if parts.size:
            j, i = np.unravel_index(parts.argmax(), parts.shape)
            part = float(parts[j, i])
            exceeded = (part - 1) * float(limit[i]) * plan.dt**order > SLACK
            yield Used(part, exceeded, f"{name} of {robot.axes[i]} on the way to frame {j + 1 + order}")


def _positions(plan: Record) -> Iterator[Used]:
    robot, d, reach = plan.robot, plan.robot.d, plan.robot.reach
    scale = np.where(np.char.startswith(robot.axes, "beta"), reach, math.pi)
    growth = np.diff(plan.beta, axis=1)
    between = [f"{i} and {i + 1}" for i in range(1, d)]
    kinds = [
        (robot.lower - plan.q, scale, [f"lower limit of {axis}" for axis in robot.axes]),
        (plan.q - robot.upper, scale, [f"upper limit of {axis}" for axis in robot.axes]),
        (-growth, np.full(d - 1, reach), [f"order of tubes {pair}" for pair in between]),
    ]
    if robot.carriage_gap is not None:
        apart = np.diff([tube.length for tube in robot.tubes]) - growth
        gaps = [f"gap between carriages {pair}" for pair in between]
        kinds.append((robot.carriage_gap - apart, np.full(d - 1, reach), gaps))
    for excess, scales, names in kinds:
        beyond = np.nan_to_num(excess)
        if beyond.size and beyond.max() > SLACK:
            j, i = np.unravel_index(beyond.argmax(), beyond.shape)
            yield Used(1 + float(beyond[j, i] / scales[i]), True, f"{names[i]} in frame {j + 1}")
