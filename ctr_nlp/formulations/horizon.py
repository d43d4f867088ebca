"""Horizon formulation: all frames in one NLP, coupled by ||grad q||^2, eq. (9), and by the hardware's limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ctr_nlp.chain import Chain
from ctr_nlp.formulations.joint import alone, target_of
from ctr_nlp.links import Link, differences
from ctr_nlp.nlp import FrameFunctions, Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.target import Frame

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Ends:
    """Where the robot stands one frame before the first, and where in the last; None where it is free.

    start, end: q (2d + 2,). Where accelerations are limited, the robot rests at given ends.
    """

    start: Array | None = None
    end: Array | None = None


def horizon(
    robot: Robot,
    frames: Sequence[Frame],
    dt: float,
    motion_weight: float,
    ends: Ends,
    functions: Callable[[Nlp], FrameFunctions] = lambda nlp: nlp.functions,
) -> Chain:
    """The motion through frames, dt s apart, as a chain; functions: how a frame is evaluated.

    The objective is J / dt = sum_j shape_j + lambda sum_j |W (q_{j+1} - q_j)|^2 / dt^2 in mm^2, with shape_j the
    distance (8) of frame j and lambda = motion_weight in s^2.
    """
    frame = alone(robot)
    columns = [frame.pack(target_of(at)) for at in frames]
    lower, upper = (np.tile(bound, (len(frames), 1)) for bound in (robot.lower, robot.upper))
    if ends.end is not None:
        lower[-1] = upper[-1] = ends.end
    links = _links(robot, len(frames), dt, motion_weight, ends)
    return Chain(
        frame,
        robot.axes,
        robot.mm_per_unit,
        np.column_stack(columns),
        lower,
        upper,
        links,
        functions(frame),
    )


def _links(robot: Robot, frames: int, dt: float, motion_weight: float, ends: Ends) -> tuple[Link, ...]:
    """The steps from frame to frame, with their cost (9) and limits; the steps' steps, where those are limited."""
    before = [] if ends.start is None else [ends.start]
    after = [] if ends.end is None else [ends.end]
    cost = motion_weight * robot.mm_per_unit**2 / dt**2
    links = [_link("speed", frames, 1, (before, []), robot.speed * dt, cost)]
    if np.isfinite(robot.acceleration).any():
        links.append(_link("acceleration", frames, 2, (before * 2, after), robot.acceleration * dt**2, 0 * cost))
    return tuple(links)


def _link(
    name: str, frames: int, order: int, known: tuple[list[Array], list[Array]], most: Array, cost: Array
) -> Link:
    """Differences of q within +-most (2d + 2,), at a cost (2d + 2,) per squared unit."""
    matrix, offset, frame, axis = differences(frames, order, *known, len(most))
    return Link(name, matrix, offset, -most[axis], most[axis], cost[axis], frame, axis)
