"""Horizon formulation: all frames in one NLP, coupled by ||grad q||^2, eq. (9), and by the hardware's limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctr_nlp.formulations.frame import filled, packed, program
from ctr_nlp.formulations.joint import terms_of, tip_steps
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.wall import Wall
from ctr_nlp.models import Model
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.nlp.links import Link, differences
from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.nlp.written import FrameFunctions
from ctr_nlp.robot import Robot
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array


@dataclass(frozen=True)
class Ends:
    """Where the robot stands one frame before the first, and where in the last; None where it is free.

    start, end: q (2d + 2,). Where accelerations are limited, the robot rests at given ends.
    """

    start: Array | None = None
    end: Array | None = None

    @property
    def options(self) -> dict[str, list[float] | None]:
        """Both as the options of a plan hold them."""
        ends = (("start", self.start), ("end", self.end))
        return {name: None if q is None else q.tolist() for name, q in ends}


def interpreted(nlp: Nlp) -> Callable[[], FrameFunctions]:
    """A frame's functions as they are."""
    return lambda: nlp.functions


def horizon(
    robot: Robot,
    frames: Sequence[Frame],
    dt: float,
    motion_weight: float,
    ends: Ends,
    model: Model,
    functions: Callable[[Nlp], Callable[[], FrameFunctions]] = interpreted,
    margin: float | None = None,
    wall: Wall | None = None,
    extra: Sequence[Term] = (),
) -> Chain:
    """The motion through frames, dt s apart, as a chain; functions: gives how a frame is evaluated.

    The objective is J / dt = sum_j shape_j + lambda sum_j |W (q_{j+1} - q_j)|^2 / dt^2 in mm^2, with shape_j the
    distance (8) of frame j and lambda = motion_weight in s^2. margin: least stability margin on models that can
    snap. wall: of the lumen that the robot is kept in; a chain holds near a motion then (Chain.around). extra:
    further terms.
    """
    terms = terms_of(robot, model, margin, extra, walled=wall is not None)
    frame = program("frame", robot.structure, model, terms)
    tips = tip_steps(robot, dt) if model.several_equilibria else np.zeros(0)
    free = np.full(len(tips), np.inf)
    rows = frame.row_bounds(np.append(robot.lower, -free), np.append(robot.upper, free))
    (lower, least), (upper, most) = (
        np.split(np.tile(row, (len(frames), 1)), [frame.x.numel()], axis=1) for row in rows
    )
    rest = [None if q is None or not len(tips) else model.rest(robot, q) for q in (ends.start, ends.end)]
    if ends.end is not None:
        robot_only = frame.x.numel() - frame.slacks
        lower[-1, :robot_only] = upper[-1, :robot_only] = ends.end if rest[1] is None else rest[1]
    before, after = (
        [] if q is None else [q if x is None else np.append(q, x[: robot.d])]
        for q, x in zip((ends.start, ends.end), rest, strict=True)
    )
    return Chain(
        frame,
        (*robot.axes, *(f"phi_{i + 1}" for i in range(len(tips)))),
        np.append(robot.mm_per_unit, robot.mm_per_unit[: len(tips)]),
        packed(frame, [filled(robot, terms, at) for at in frames]).T.copy(),
        lower,
        upper,
        motion_links(robot, len(frames), dt, motion_weight, before, after, tips),
        functions(frame),
        None if wall is None else wall.during(frames),
        (least, most),
    )


def motion_links(
    robot: Robot,
    frames: int,
    dt: float,
    motion_weight: float,
    before: list[Array],
    after: list[Array],
    tips: Array,
) -> tuple[Link, ...]:
    """The steps from frame to frame, with their cost (9) and limits; the steps' steps, where those are limited.

    before, after: where the robot stands at given ends, with its tips where these have limits of their own, tips.
    """
    cost = np.append(motion_weight * robot.mm_per_unit**2 / dt**2, 0 * tips)
    links = [_link("speed", frames, 1, (before, []), np.append(robot.speed * dt, tips), cost)]
    if np.isfinite(robot.acceleration).any():
        most = np.append(robot.acceleration * dt**2, np.full(len(tips), np.inf))
        links.append(_link("acceleration", frames, 2, (before * 2, after), most, 0 * cost))
    return tuple(links)


def _link(
    name: str, frames: int, order: int, known: tuple[list[Array], list[Array]], most: Array, cost: Array
) -> Link:
    """Differences of the configuration (k,) within +-most (k,), at a cost (k,) per squared unit."""
    matrix, offset, frame, axis = differences(frames, order, *known, len(most))
    return Link(name, matrix, offset, -most[axis], most[axis], cost[axis], frame, axis)
