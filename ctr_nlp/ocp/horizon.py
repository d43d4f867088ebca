"""Horizon formulation: all frames in one NLP, coupled by ||grad q||^2, eq. (9), and by the hardware's limits.

    minimise  J / dt = sum_j d_j + lambda sum_j |W (q_{j+1} - q_j)|^2 / dt^2
    subject to (2), (3), |q_{j+1} - q_j| <= v dt, |q_{j+1} - 2 q_j + q_{j-1}| <= a dt^2, and given ends

with the distance (8) of frame j as d_j in mm^2, lambda in s^2, W = 10 mm/rad for angles and 1 for beta. Frame by
frame, a half turn begins when it is needed and comes too late; here it begins in time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.frame import fill_parameters, pack_frames, program
from ctr_nlp.ocp.joint import frame_terms, tip_step_limits
from ctr_nlp.ocp.links import FrameLink, differences
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array


@dataclass(frozen=True)
class EndConfigurations:
    """The robot's configurations one frame before the first, and in the last frame; None where it is free.

    start, end: q (2d + 2,). Where accelerations are limited, the robot is at rest at given ends.
    """

    start: Array | None = None
    end: Array | None = None

    @property
    def any_given(self) -> bool:
        """Whether one of the ends is given."""
        return self.start is not None or self.end is not None

    @property
    def options(self) -> dict[str, list[float] | None]:
        """Both ends in the form of a plan's options, by name."""
        ends = (("start", self.start), ("end", self.end))
        return {name: None if q is None else q.tolist() for name, q in ends}


def interpreted_functions(nlp: Nlp) -> Callable[[], FrameFunctions]:
    """Return a function that returns the functions of nlp, evaluated by CasADi's interpreter."""
    return lambda: nlp.functions


def horizon(
    robot: Robot,
    frames: Sequence[Frame],
    dt: float,
    motion_weight: float,
    ends: EndConfigurations,
    model: Model,
    functions: Callable[[Nlp], Callable[[], FrameFunctions]] = interpreted_functions,
    margin: float | None = None,
    wall: Wall | None = None,
    extra: Sequence[Term] = (),
) -> Chain:
    """Build the motion of a robot on a model through frames, dt s apart, as a chain.

    motion_weight: lambda in s^2. ends: given configurations. functions: maps a program to a function that returns
    its functions, interpreted or compiled. margin: least stability margin on models that can snap; None for any.
    wall: of the lumen around the robot; the chain is then linearised near a motion (Chain.linearise_at). extra:
    further terms.
    """
    terms = frame_terms(robot, model, margin, extra, walled=wall is not None)
    frame = program("frame", robot.structure, model, terms)
    # Where q does not determine the equilibrium, tips are picked along with q, so that links can limit
    # their steps, too: a plan must not jump to another branch between frames.
    tips = tip_step_limits(robot, dt) if model.several_equilibria else np.zeros(0)
    # Tips are limited from frame to frame (links), not in themselves.
    free = np.full(len(tips), np.inf)
    # alpha may be a constraint and beta an unknown: limits of the configuration are split into both.
    rows = frame.row_bounds(np.append(robot.lower, -free), np.append(robot.upper, free))
    (lower, least), (upper, most) = (
        np.split(np.tile(row, (len(frames), 1)), [frame.x.numel()], axis=1) for row in rows
    )
    # Given ends are configurations; where q does not determine the equilibrium, the robot is in the one in which
    # it settles without a history.
    rest = [None if q is None or not len(tips) else model.rest(robot, q) for q in (ends.start, ends.end)]
    if ends.end is not None:
        robot_only = frame.x.numel() - frame.slacks
        # The last frame is fixed in the model's unknowns, since bounds on alpha alone would leave its
        # branch open.
        lower[-1, :robot_only] = upper[-1, :robot_only] = ends.end if rest[1] is None else rest[1]
    before, after = (
        [] if q is None else [q if x is None else np.append(q, x[: robot.d])]
        for q, x in zip((ends.start, ends.end), rest, strict=True)
    )
    return Chain(
        frame,
        (*robot.axes, *(f"phi_{i + 1}" for i in range(len(tips)))),
        np.append(robot.mm_per_unit, robot.mm_per_unit[: len(tips)]),
        # A column a frame, contiguous: functions are evaluated for all frames from these arrays.
        pack_frames(frame, [fill_parameters(robot, terms, at) for at in frames]).T.copy(),
        lower,
        upper,
        motion_links(robot, len(frames), dt, motion_weight, before, after, tips),
        functions(frame),
        None if wall is None else wall.local_parameters_during(frames),
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
) -> tuple[FrameLink, ...]:
    """Build the links between frames: steps with their cost (9) and speed limits, and limited second differences.

    robot: whose limits count. frames: their number, dt s apart. motion_weight: lambda in s^2. before, after: known
    configurations at given ends, with the tips' angles where these have limits of their own. tips: those limits
    (d,), rad, or empty.
    """
    # lambda W^2 / dt^2, for squared steps: the objective is J / dt, so that frames keep the weight 1. Tips cost
    # nothing.
    cost = np.append(motion_weight * robot.mm_per_unit**2 / dt**2, 0 * tips)
    links = [_difference_link("speed", frames, 1, (before, []), np.append(robot.speed * dt, tips), cost)]
    if np.isfinite(robot.acceleration).any():
        most = np.append(robot.acceleration * dt**2, np.full(len(tips), np.inf))
        # A robot at rest at the start was there one frame earlier, too: twice the same known configuration.
        links.append(_difference_link("acceleration", frames, 2, (before * 2, after), most, 0 * cost))
    return tuple(links)


def _difference_link(
    name: str,
    frames: int,
    order: int,
    outside_configurations: tuple[list[Array], list[Array]],
    most: Array,
    cost: Array,
) -> FrameLink:
    """Build the link of differences of the configuration (k,) within +-most (k,), at a cost (k,) per squared unit.

    order: of the difference; outside_configurations: configurations before and after.
    """
    matrix, offset, frame, axis = differences(frames, order, *outside_configurations, len(most))
    return FrameLink(name, matrix, offset, -most[axis], most[axis], cost[axis], frame, axis)
