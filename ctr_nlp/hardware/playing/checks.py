"""What must be true of a plan and of its timed program before anything moves; complaints name frame and axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import HardwareError, ProgramError, RobotError
from ctr_nlp.hardware.arm.checks import check_joints
from ctr_nlp.hardware.arm.inverse import joints
from ctr_nlp.hardware.motion.program import Program
from ctr_nlp.models import MODELS, Snap
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.forward import simulated
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

SAMPLES = 10
"""Places at which a program is checked on the way from frame to frame."""

SLACK = 1e-6
"""By how much limits may be exceeded, in rad, mm and parts of a speed."""

SAME_SHAPE = 0.05
"""mm: a plan whose shapes are further from those of its configurations was changed after it was made."""


class Checked(NamedTuple):
    """What was found: largest parts of speeds and accelerations that are used, and least stability margin.

    late: s by which the last frame comes after the plan's time. margin: NaN where nothing can be unstable.
    """

    speed: float
    acceleration: float
    late: float
    margin: float


def check_plan(plan: Plan, robot: Robot) -> None:
    """Raise ProgramError unless a plan is whole, keeps this robot's limits and is as it was made."""
    _check_arrays(plan)
    unsolved = np.flatnonzero(plan.success == 0)
    if unsolved.size:
        why = plan.meta.get("failures", {}).get(str(unsolved[0] + 1), "")
        raise ProgramError(
            f"frame {unsolved[0] + 1}: the plan has no solution there, so that it is not played"
            + f" ({why})" * bool(why)
        )
    for name in ("time", "alpha", "beta", "theta"):
        bad = np.flatnonzero(~np.isfinite(getattr(plan, name).reshape(len(plan.time), -1)).all(axis=1))
        if bad.size:
            raise ProgramError(f"frame {bad[0] + 1}: {name} is {getattr(plan, name)[bad[0]]}; it must be finite")
    if not (np.diff(plan.time) > 0).all():
        late = int(np.flatnonzero(np.diff(plan.time) <= 0)[0])
        raise ProgramError(f"frame {late + 2}: time is {plan.time[late + 1]:g} s, not after the frame before")
    for j, q in enumerate(plan.q, start=1):
        _check_limits(robot, q, f"frame {j}")
    _check_steps(plan)
    _check_shapes(plan)


def _check_arrays(plan: Plan) -> None:
    """A motion has frames, and everything is known of all of them."""
    frames, d = plan.time.size, plan.robot.d
    if frames < 2:
        raise ProgramError(f"a plan of {frames} frames is no motion; give at least two")
    sizes = {"time": (), "success": (), "alpha": (d,), "beta": (d,), "theta": (2,), "shape": (len(SIGMA), 3)}
    for name, size in sizes.items():
        found, wanted = getattr(plan, name).shape, (frames, *size)
        if found != wanted:
            raise ProgramError(f"{name} of the plan has shape {found}; it must be {wanted}")


def _check_limits(robot: Robot, q: Array, name: str) -> None:
    try:
        robot.check(q, name)
    except RobotError as error:
        level = "theta" in str(error) and not (robot.lower[-2:].any() or robot.upper[-2:].any())
        hint = "; it has no arm that tilts: plan with --lock-tilt" if level else ""
        raise ProgramError(f"{error} on this hardware{hint}") from error


def _check_snaps(snaps: Sequence[Snap], frame: npt.NDArray[Any]) -> None:
    """Frame (T,): on the way to which the places lie that were followed."""
    for snap in snaps:
        raise ProgramError(f"frame {frame[snap.frame - 1]}: the robot would snap on the way, tubes {snap.tubes}")


def _check_steps(plan: Plan) -> None:
    """The plan's robot was promised speeds; what is faster was not planned."""
    made = plan.robot
    excess = abs(np.diff(plan.q, axis=0)) / np.diff(plan.time)[:, None] / made.speed
    j, i = np.unravel_index(excess.argmax(), excess.shape)
    if excess[j, i] > 1 + 1e-4:
        raise ProgramError(
            f"frame {j + 2}: {made.axes[i]} steps by {plan.q[j + 1, i] - plan.q[j, i]:.4g} from the frame before, "
            f"{excess[j, i]:.3g} times what the plan's own robot may ({made.speed[i]:g}/s)"
        )


def _check_shapes(plan: Plan) -> None:
    """Shapes belong to configurations; on the elastic model where the motion leads to them."""
    moved = simulated(plan.robot, plan.q, plan.evaluated)
    _check_snaps(moved.snaps, np.arange(1, len(plan.time) + 1))
    away = np.nan_to_num(np.linalg.norm(moved.shape - plan.shape, axis=-1).max(axis=1), nan=np.inf)
    if away.max() > SAME_SHAPE:
        j = int(away.argmax())
        raise ProgramError(
            f"frame {j + 1}: the plan's shape is {away[j]:.3g} mm from that of its configuration; it must be "
            f"within {SAME_SHAPE} mm: the file was changed after planning"
        )


def checked(program: Program, elastic: bool = False) -> Checked:
    """What a program uses of its hardware; raises ProgramError where that is more than all of it.

    elastic: whether it must be stable on the elastic model, all along its way.
    """
    ends = program.frame_time
    time = np.append(np.linspace(ends[:-1], ends[1:], SAMPLES, endpoint=False).T.ravel(), ends[-1])
    frame = np.append(np.repeat(program.frames[1:], SAMPLES), program.frames[-1])
    q, velocity, acceleration = program.at(time)
    for j, place in zip(frame, q, strict=True):
        _check_limits(program.robot, place, f"the way to frame {j}")
    _check_ranges(program, time, frame)
    used = [
        _most(name, abs(rate) / limit, program, frame)
        for name, rate, limit in (
            ("speed", velocity, program.robot.speed),
            ("acceleration", acceleration, program.robot.acceleration),
        )
    ]
    if program.hardware.arm is not None:
        try:
            check_joints(program.hardware.arm, time, joints(program.hardware.arm, q[:, -2:]))
        except HardwareError as error:
            raise ProgramError(f"the tilt, at {SAMPLES} places a frame: {error}") from error
    late = program.duration - float(program.knots[-1] - program.knots[0])
    return Checked(used[0], used[1], late, _least_margin(program, frame, q) if elastic else float("nan"))


def _check_ranges(program: Program, time: Array, frame: Array) -> None:
    positions = program.positions(time)
    for k, axis in enumerate(program.hardware.axes):
        lower, upper = axis.range
        out = np.flatnonzero((positions[:, k] < lower - SLACK) | (positions[:, k] > upper + SLACK))
        if out.size:
            raise ProgramError(
                f"frame {frame[out[0]]}: axis {axis.letter} ({axis.joint}) would go to {positions[out[0], k]:.4g} "
                f"{axis.unit}, backlash included; it must stay in [{lower:g}, {upper:g}]"
            )


def _most(name: str, used: Array, program: Program, frame: Array) -> float:
    j, i = np.unravel_index(used.argmax(), used.shape)
    if not used[j, i] <= 1 + SLACK:
        raise ProgramError(
            f"frame {frame[j]}: {name} of {program.robot.axes[i]} would be {used[j, i]:.3g} times the largest"
        )
    return float(used[j, i])


def _least_margin(program: Program, frame: Array, q: Array) -> float:
    """The least margin of the robot moved through q, which must be stable everywhere."""
    found = MODELS["elastic"].follow(program.robot, q, substeps=1)
    _check_snaps(found.snaps, frame)
    least = np.nan_to_num(found.stability_between, nan=-np.inf)
    if not least.min() > 0:
        raise ProgramError(f"frame {frame[least.argmin()]}: on the way the robot would be unstable")
    return float(least.min())
