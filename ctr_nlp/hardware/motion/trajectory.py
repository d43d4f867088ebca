"""A plan as commands: a path through its frames, timed for hardware, as positions of axes and tilts of the arm."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicHermiteSpline

from ctr_nlp.exceptions import OptionError, TrajectoryError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.motion.lookahead import MAX_PIECE_DURATION_S, Commands
from ctr_nlp.hardware.motion.path import backlash_compensation, path_through
from ctr_nlp.hardware.motion.timing import TimedPath, compute_time_scaling
from ctr_nlp.plan.backlash import BACKLASH_PARAMETER_NAMES as LAG_PARTS
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

AT_FRAME_STEP_FRACTION = 1e-4
"""Part of the path between two frames within which a robot before a frame counts as standing at it."""


class Digests(NamedTuple):
    """SHA-256 of a plan and of the hardware that it is played on."""

    plan: str
    hardware: str


class Patch(NamedTuple):
    """Points q (K, 2d + 2) and slopes (K, 2d + 2) of a path at its breakpoints from the one numbered first on."""

    first: int
    q: Array
    slopes: Array

    def to_record(self) -> dict[str, Any]:
        """Return the patch as a record of a journal."""
        return {"first": self.first, "q": self.q.tolist(), "slopes": self.slopes.tolist()}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Patch:
        """Return the patch that to_record has written.

        record: of a journal.
        """
        return cls(int(record["first"]), np.array(record["q"]), np.array(record["slopes"]))


@dataclass(frozen=True)
class Trajectory:
    """A motion of a robot through numbered frames, at rest at both ends, on some hardware.

    robot: with the limits of the hardware. knots (T,): parameters of the path (the plan's time) where frames are
    passed, the first of which may be a place between frames; frames (T,): their numbers. lash: what is added to
    the axes' positions (.., m) for play in the drives and lag of the tubes, a function of that parameter. digests:
    of the plan and the hardware. share: of the largest speeds and accelerations that it was timed with; the rest
    is left for corrections.
    """

    robot: Robot
    hardware: Hardware
    motion: TimedPath
    lash: CubicHermiteSpline
    knots: Array
    frames: npt.NDArray[np.int64]
    digests: Digests
    share: float = 1.0

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return self.motion.duration

    @cached_property
    def frame_time(self) -> Array:
        """Times at which the frames are passed, (T,) s."""
        return self.motion.when(self.knots)

    def at(self, time: Any) -> tuple[Array, Array, Array]:
        """Return configurations q, velocities and accelerations (.., 2d + 2); time: (..,) s."""
        return self.motion.at(time)

    def positions(self, time: Any) -> Array:
        """Return positions (.., m) of the axes, in their units; time: (..,) s."""
        joints = self.hardware.positions(self.robot, self.at(time)[0])
        return np.asarray(joints + self.lash(self.motion.parameter(time)))

    def joints(self, time: Array, positions: Array) -> Array:
        """Return the configurations (N, 2d + 2) of axes measured at some times.

        time: (N,) s. positions: (N, m) in the axes' units. The tilt is the commanded one; what is added to the
        axes for play and lag is subtracted.
        """
        lengths = positions - self.lash(self.motion.parameter(time))
        return self.hardware.joints(self.robot, lengths, self.tilt(time))

    def tilt(self, time: Any) -> Array:
        """Return tilts (.., 2) rad; time: (..,) s."""
        return self.at(time)[0][..., -2:]

    def last_frame_passed(self, time: float) -> int:
        """Return the last frame that is passed by a time in s, 0 before the first."""
        return int(self.frames[self.frame_time <= time].max(initial=0))

    def apply_patch(self, patch: Patch) -> Trajectory:
        """Return the trajectory with some breakpoints of its path replaced, at the same pace.

        patch: the new points and slopes.
        """
        if not len(patch.q):
            return self
        path = self.motion.path
        rows = slice(patch.first, patch.first + len(patch.q))
        q = path(path.x)
        slopes = path(path.x, 1)
        q[rows], slopes[rows] = patch.q, patch.slopes
        return replace(self, motion=replace(self.motion, path=CubicHermiteSpline(path.x, q, slopes)))

    def continues(self, other: Trajectory | None) -> bool:
        """Return whether another trajectory is this motion before or after patches.

        other: None for none.
        """
        return other is not None and self.knots is other.knots

    def commands(self, longest: float = MAX_PIECE_DURATION_S) -> Commands:
        """Return the motion in straight pieces, with frames among their ends.

        longest: longest duration of a piece, s.
        """
        counts = np.maximum(1, np.ceil(np.diff(self.frame_time) / longest - 1e-6)).astype(int)
        pieces = [
            np.linspace(start, end, count + 1)[1:]
            for start, end, count in zip(self.frame_time[:-1], self.frame_time[1:], counts, strict=True)
        ]
        time = np.concatenate(pieces)
        return Commands(time, np.repeat(self.frames[1:], counts), self.positions(time))


def trajectory_of(
    plan: Plan, hardware: Hardware, tempo: float = 1.0, standing: Array | None = None, share: float = 1.0
) -> Trajectory:
    """Return a plan's motion from its first frame on, at its own pace times tempo, slower where it has to be.

    standing (m,): positions from which axes come to the first frame. hardware: on which it is played. share: of
    the largest speeds and accelerations. Raises HardwareError, OptionError, TrajectoryError. A trajectory must be
    checked before it is played (checks.check_trajectory).
    """
    if isinstance(tempo, bool) or not 0 < tempo <= 1:
        raise OptionError(f"tempo is {tempo!r}; it must lie in (0, 1]")
    robot = hardware.apply_limits(plan.robot)
    ahead = hardware.lag_compensation(robot, plan.q, plan.time / tempo)
    positions = hardware.positions(robot, plan.q) + ahead
    before = np.zeros(len(hardware.axes))
    if standing is not None:
        # An axis that comes down to the first frame lies against the other side of its play.
        before = np.where(standing > positions[0] + 0.01 * hardware.backlash, -hardware.backlash, 0.0)
    added = ahead + backlash_compensation(plan.time, positions, hardware.backlash, before)(plan.time)
    lash = CubicHermiteSpline(plan.time, added, np.zeros_like(added))
    path = path_through(robot, plan.time, plan.q)
    frames = np.arange(1, len(plan.time) + 1)
    return trajectory_along(robot, hardware, path, lash, plan.time, frames, digests(plan, hardware), tempo, share)


def remaining_trajectory(trajectory: Trajectory, s: float, tempo: float = 1.0) -> Trajectory:
    """Return the rest of a trajectory, for a robot that stands on its path.

    trajectory: the whole. s: parameter of the path, the plan's time, where the robot stands. tempo: part of the
    plan's pace. Raises TrajectoryError where nothing is left.
    """
    ahead = trajectory.knots > s + AT_FRAME_STEP_FRACTION * np.diff(trajectory.knots, prepend=s)
    if not ahead.any():
        raise TrajectoryError("nothing is left of this trajectory: it has reached its last frame")
    knots = np.append(s, trajectory.knots[ahead])
    frames = np.append(trajectory.frames[ahead][0] - 1, trajectory.frames[ahead])
    robot = trajectory.robot
    hardware = trajectory.hardware
    path = trajectory.motion.path
    lash = trajectory.lash
    return trajectory_along(
        robot, hardware, path, lash, knots, frames, trajectory.digests, tempo, trajectory.share
    )


def approach_to(trajectory: Trajectory, standing: Array, theta: Array) -> Trajectory:
    """Return the straight and slow approach to the start of a trajectory.

    trajectory: whose start is approached. standing: positions (m,) of the axes now, in their units. theta: tilt
    (2,) rad now.
    """
    robot = trajectory.robot
    hardware = trajectory.hardware
    start = trajectory.knots[:1]
    q = np.stack([hardware.joints(robot, standing, theta), trajectory.motion.path(start[0])])
    added = np.vstack([np.zeros(len(hardware.axes)), trajectory.lash(start)])
    first = trajectory.frames[0]
    frames = np.array([first - (trajectory.knots[0] == trajectory.motion.path.x[0]), first])
    return trajectory_through(robot, hardware, q, trajectory.digests, added, frames)


def trajectory_through(
    robot: Robot,
    hardware: Hardware,
    q: Array,
    names: Digests,
    added: Array | None = None,
    frames: npt.NDArray[np.int64] | None = None,
) -> Trajectory:
    """Return the trajectory through configurations q (K, 2d + 2), as slow as an approach.

    robot: with the limits of the hardware. hardware: which is moved. names: digests of what is played. added (K,
    m): to the axes' positions there, for play in the drives, None for nothing. frames (K,): the numbers of these
    places, None to count from 0.
    """
    robot = scale_robot_speeds(robot, hardware.approach)
    added = np.zeros((len(q), len(hardware.axes))) if added is None else added
    seconds = np.maximum(1e-3, (abs(np.diff(q, axis=0)) / robot.speed).max(axis=1))
    knots = np.append(0.0, np.cumsum(seconds))
    lash = CubicHermiteSpline(knots, added, np.zeros_like(added))
    path = path_through(robot, knots, q)
    return trajectory_along(
        robot, hardware, path, lash, knots, np.arange(len(q)) if frames is None else frames, names, 1.0
    )


def scale_robot_speeds(robot: Robot, part: float) -> Robot:
    """Return a robot that may move at a part of its largest speeds."""
    parts = zip(("alpha", "beta", "theta"), robot.split(part * robot.speed), strict=True)
    return robot.with_limits(**{f"{name}_speed": speed.tolist() for name, speed in parts})


def trajectory_along(
    robot: Robot,
    hardware: Hardware,
    path: CubicHermiteSpline,
    lash: CubicHermiteSpline,
    knots: Array,
    frames: npt.NDArray[np.int64],
    names: Digests,
    tempo: float,
    share: float = 1.0,
) -> Trajectory:
    """Return the trajectory along a path, timed within the limits of the robot.

    robot: with the limits of the hardware. hardware: which is moved. path: q over the parameter. lash: what is
    added to the axes' positions, over the parameter. knots: (T,) parameters of the frames; frames: (T,) their
    numbers. names: digests of what is played. tempo: part of the path's own pace. share: of the largest speeds and
    accelerations.
    """

    # Drives also move by what is added for play and lag, and their limits hold for the sum; tubes move along the
    # path alone.
    def driven(s: Array, order: int = 0) -> Array:
        return np.asarray(path(s, order) + hardware.in_joints(robot, lash(s, order)))

    motion = compute_time_scaling(path, driven, knots, share * robot.speed, share * robot.acceleration, tempo)
    return Trajectory(robot, hardware, motion, lash, knots, frames, names, share)


def digests(plan: Plan, hardware: Hardware) -> Digests:
    """Return digests of a plan and some hardware, which change with every number, word or limit in either."""
    known = hashlib.sha256(json.dumps(plan.meta, sort_keys=True).encode())
    for field in fields(plan):
        array = getattr(plan, field.name)
        if isinstance(array, np.ndarray):
            known.update(
                f"{field.name} {array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes()
            )
    # Without the commissioned settings, which are compared with the controller's whenever it is connected.
    described = repr(replace(hardware, commissioned=None))
    if hardware.robot is not None:
        # A robot's repr is a summary; its parts have every number.
        robot = hardware.robot
        every = f"Robot(tubes={robot.tubes!r}, limits={robot.limits!r}, tolerances={robot.tolerances!r})"
        described = described.replace(repr(robot), every)
    if hardware.lag is not None:
        described += repr([getattr(hardware.lag, name).tolist() for name in LAG_PARTS])
    return Digests(known.hexdigest(), hashlib.sha256(described.encode()).hexdigest())
