"""Checks of a plan and of its trajectory before anything moves; errors name frame and axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import HardwareError, RobotError, TrajectoryError
from ctr_nlp.hardware.arm.description import check_joints
from ctr_nlp.hardware.arm.kinematics import inverse_kinematics
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.models import Model, Snap, model_named
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.simulation import simulate_motion
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

TRAJECTORY_SAMPLES_PER_FRAME = 10
"""Places between two frames at which a trajectory is checked."""

WHOLE_TRAJECTORY = slice(None)
"""All of a trajectory."""

TRAJECTORY_LIMIT_SLACK = 1e-6
"""Excess over limits that is rounding, in rad, mm and parts of a speed."""

SAME_SHAPE = 0.05
"""mm from the shapes of its configurations beyond which a plan's shapes were changed after planning."""


class TrajectoryCheck(NamedTuple):
    """Result of a check.

    speed, acceleration: the largest used, in parts of the limits. late: s by which the last frame comes after the
    plan's time. margin: least stability margin, NaN where nothing can be unstable.
    """

    speed: float
    acceleration: float
    late: float
    margin: float


def check_plan(plan: Plan, robot: Robot) -> None:
    """Raise TrajectoryError unless a plan is complete, satisfies this robot's limits and is as it was planned."""
    _check_arrays(plan)
    unsolved = np.flatnonzero(plan.success == 0)
    if unsolved.size:
        why = plan.meta.get("failures", {}).get(str(unsolved[0] + 1), "")
        raise TrajectoryError(
            f"frame {unsolved[0] + 1}: the plan has no solution; all frames must be solved before it is played"
            + f" ({why})" * bool(why)
        )
    for name in ("time", "alpha", "beta", "theta"):
        bad = np.flatnonzero(~np.isfinite(getattr(plan, name).reshape(len(plan.time), -1)).all(axis=1))
        if bad.size:
            raise TrajectoryError(
                f"frame {bad[0] + 1}: {name} is {getattr(plan, name)[bad[0]]}; it must be finite"
            )
    if not (np.diff(plan.time) > 0).all():
        late = int(np.flatnonzero(np.diff(plan.time) <= 0)[0])
        raise TrajectoryError(f"frame {late + 2}: time is {plan.time[late + 1]:g} s, not after the frame before")
    for j, q in enumerate(plan.q, start=1):
        _check_limits(robot, q, f"frame {j}")
    _check_steps(plan)
    _check_shapes(plan)


def _check_arrays(plan: Plan) -> None:
    """Raise TrajectoryError unless a plan has two frames, and all its arrays have their shapes."""
    frames = plan.time.size
    d = plan.robot.d
    if frames < 2:
        raise TrajectoryError(f"a plan of {frames} frames is no motion; give at least two")
    sizes = {"time": (), "success": (), "alpha": (d,), "beta": (d,), "theta": (2,), "shape": (len(SIGMA_GRID), 3)}
    for name, size in sizes.items():
        found = getattr(plan, name).shape
        wanted = (frames, *size)
        if found != wanted:
            raise TrajectoryError(f"{name} of the plan has shape {found}; it must be {wanted}")


def _check_limits(robot: Robot, q: Array, name: str) -> None:
    """Raise TrajectoryError unless q (2d + 2,) satisfies the robot's limits; name: of the place in messages."""
    try:
        robot.check(q, name)
    except RobotError as exception:
        raise TrajectoryError(
            f"{exception} on this hardware{_hint_at_limits(robot, str(exception))}"
        ) from exception


def _hint_at_limits(robot: Robot, message: str) -> str:
    """Return what may be wrong where a configuration violates a limit, to be added to the message of that.

    robot: with the limits of the hardware. message: begins with the joint where a single limit is violated.
    """
    joint, _, limit = message.partition(" of ")
    if "must lie in" not in limit:
        return ""
    if joint.startswith("theta"):
        level = not (robot.lower[-2:].any() or robot.upper[-2:].any())
        return "; it has no arm that tilts: plan with --lock-tilt" if level else ""
    return (
        f'; the `range` of the axis with joint = "{joint}" in the hardware file, and the limits of the robot, '
        "bound it. Is the hardware file for the robot that was planned for?"
    )


def _check_snaps(snaps: Sequence[Snap], frame: npt.NDArray[Any]) -> None:
    """Raise TrajectoryError for the first snap; frame (T,): number of the next frame at each simulated place."""
    for snap in snaps:
        raise TrajectoryError(
            f"frame {frame[snap.frame - 1]}: the robot would snap on the path, tubes {snap.tubes}"
        )


def _check_steps(plan: Plan) -> None:
    """Raise TrajectoryError where a plan is faster than its own robot may be: that was not planned."""
    made = plan.robot
    excess = abs(np.diff(plan.q, axis=0)) / np.diff(plan.time)[:, None] / made.speed
    j, i = np.unravel_index(excess.argmax(), excess.shape)
    if excess[j, i] > 1 + 1e-4:
        raise TrajectoryError(
            f"frame {j + 2}: {made.axes[i]} changes by {plan.q[j + 1, i] - plan.q[j, i]:.4g} from the frame "
            f"before, {excess[j, i]:.3g} times the speed limit of the plan's own robot ({made.speed[i]:g}/s)"
        )


def _check_shapes(plan: Plan) -> None:
    """Raise TrajectoryError unless the plan's shapes are those of its motion on the model that evaluates it."""
    moved = simulate_motion(plan.robot, plan.q, plan.evaluated_model)
    _check_snaps(moved.snaps, np.arange(1, len(plan.time) + 1))
    # A shape that could not be simulated is infinitely far off, so that it is refused.
    away = np.nan_to_num(np.linalg.norm(moved.shape - plan.shape, axis=-1).max(axis=1), nan=np.inf)
    if away.max() > SAME_SHAPE:
        j = int(away.argmax())
        raise TrajectoryError(
            f"frame {j + 1}: the plan's shape is {away[j]:.3g} mm from that of its configuration; it must be "
            f"within {SAME_SHAPE} mm: the file was changed after planning"
        )


def check_trajectory(
    trajectory: Trajectory, model: str | Model | None = None, stretch: slice = WHOLE_TRAJECTORY
) -> TrajectoryCheck:
    """Return the used parts of the hardware's limits; raises TrajectoryError where one exceeds 1.

    trajectory: to be checked. model: on which it must be stable all along its path, where a robot can snap on it;
    None for no model. stretch: the frames, counted from 0, between which it is checked.
    """
    ends = trajectory.frame_time[stretch]
    frames = trajectory.frames[stretch]
    time = np.append(
        np.linspace(ends[:-1], ends[1:], TRAJECTORY_SAMPLES_PER_FRAME, endpoint=False).T.ravel(), ends[-1]
    )
    frame = np.append(np.repeat(frames[1:], TRAJECTORY_SAMPLES_PER_FRAME), frames[-1])
    q, velocity, acceleration = trajectory.at(time)
    for j, place in zip(frame, q, strict=True):
        _check_limits(trajectory.robot, place, f"the path to frame {j}")
    _check_ranges(trajectory, time, frame)
    used = [
        _most(name, abs(rate) / limit, trajectory, frame)
        for name, rate, limit in (
            ("speed", velocity, trajectory.robot.speed),
            ("acceleration", acceleration, trajectory.robot.acceleration),
        )
    ]
    if trajectory.hardware.arm is not None:
        try:
            check_joints(trajectory.hardware.arm, time, inverse_kinematics(trajectory.hardware.arm, q[:, -2:]))
        except HardwareError as exception:
            raise TrajectoryError(
                f"the tilt, at {TRAJECTORY_SAMPLES_PER_FRAME} places a frame: {exception}"
            ) from exception
    late = trajectory.duration - float(trajectory.knots[-1] - trajectory.knots[0])
    margin = math.nan
    if model is not None and (moving := model_named(model)).can_snap:
        margin = _least_margin(trajectory, moving, frame, q)
    return TrajectoryCheck(used[0], used[1], late, margin)


def _check_ranges(trajectory: Trajectory, time: Array, frame: Array) -> None:
    """Raise TrajectoryError where an axis would leave its range at times (N,) s; frame (N,): for messages."""
    positions = trajectory.positions(time)
    for k, axis in enumerate(trajectory.hardware.axes):
        lower, upper = axis.range
        out = np.flatnonzero(
            (positions[:, k] < lower - TRAJECTORY_LIMIT_SLACK) | (positions[:, k] > upper + TRAJECTORY_LIMIT_SLACK)
        )
        if out.size:
            raise TrajectoryError(
                f"frame {frame[out[0]]}: axis {axis.letter} ({axis.joint}) would go to {positions[out[0], k]:.4g} "
                f"{axis.unit}, backlash included; it must stay in [{lower:g}, {upper:g}]"
            )


def _most(name: str, used: Array, trajectory: Trajectory, frame: Array) -> float:
    """Return the largest of used (N, n), parts of limits, or raise TrajectoryError where it exceeds 1."""
    j, i = np.unravel_index(used.argmax(), used.shape)
    if not used[j, i] <= 1 + TRAJECTORY_LIMIT_SLACK:
        raise TrajectoryError(
            f"frame {frame[j]}: {name} of {trajectory.robot.axes[i]} would be {used[j, i]:.3g} times the largest"
        )
    return float(used[j, i])


def _least_margin(trajectory: Trajectory, model: Model, frame: Array, q: Array) -> float:
    """Return the least stability margin of the robot moved through q (N, 2d + 2), which must be positive."""
    found = model.follow(trajectory.robot, q, substeps=1)
    _check_snaps(found.snaps, frame)
    least = np.nan_to_num(found.stability_between, nan=-np.inf)
    if not least.min() > 0:
        raise TrajectoryError(f"frame {frame[least.argmin()]}: the robot would be unstable on the path there")
    return float(least.min())
