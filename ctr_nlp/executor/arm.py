"""The arm that tilts the robot about the insertion point: where it is mounted, and its joint angles for a tilt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import HardwareError, RobotError
from ctr_nlp.executor.extras import needed
from ctr_nlp.values import frozen, numbers

Array = npt.NDArray[np.float64]

MODELS = (
    *("ur3", "ur3e", "ur5", "ur5e", "ur7e", "ur8long", "ur10", "ur10e"),
    *("ur12e", "ur15", "ur16e", "ur18", "ur20", "ur30"),
)
"""The arms that ur-analytic-ik knows."""
DEVICES = ("simulated", "ur")
JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
JOINT_LIMIT = 2 * math.pi
"""rad: how far each joint of a UR turns either way."""
LENGTH = 100.0
"""mm that count as one radian where turning and moving are compared."""
LARGEST_GAIN = 30.0
"""Nearer to a singularity, joints would turn more than this many times as fast as the robot they hold."""
SINGULAR = "singular: joints would turn {gain:.3g} times as fast as the robot"
SUBSTEP = 0.01
"""rad of tilt from one inverse kinematics to the next, so that branches cannot be mixed up."""
JUMP = 0.5
"""rad that a joint may turn over a substep: more than LARGEST_GAIN asks for, less than lies between branches."""


@dataclass(frozen=True)
class Arm:
    """A Universal Robots arm that holds the robot and tilts it: the [arm] of a hardware file.

    model: one of MODELS. insertion_point: mm, in the arm's base frame. insertion_rotation_deg: the robot's base
    frame at zero tilt, in the arm's base frame. mount_translation (mm), mount_rotation_deg: the robot's base
    frame, which lies at the insertion point, in the arm's flange frame. A rotation is (roll, pitch, yaw) with
    R = Rz(yaw) Ry(pitch) Rx(roll): about the fixed axes, x first. start_joints_deg: base to wrist 3, roughly
    where the arm stands at zero tilt, which says the branch to be on; None for the best one of each motion.
    joint_speed_deg, joint_acceleration_deg: limits in deg/s and deg/s^2, a number or one a joint; tilt_speed_deg,
    tilt_acceleration_deg: those of the tilt, a number or one for x and one for y.
    skew_tolerance: s that the arm may be behind the tubes or ahead of them. host: address of the controller,
    None for this machine (a simulator). device: "simulated" or "ur".

    The default is a UR3e on a table that inserts at 45 degrees, downwards and away from itself, 400 mm in front of
    its base; its flange holds a carriage unit of 250 mm by the middle, 60 mm off its axis. Raises HardwareError.
    """

    model: str = "ur3e"
    insertion_point: tuple[float, ...] = (400.0, 0.0, 300.0)
    insertion_rotation_deg: tuple[float, ...] = (0.0, 135.0, 0.0)
    mount_translation: tuple[float, ...] = (125.0, 0.0, 60.0)
    mount_rotation_deg: tuple[float, ...] = (0.0, 90.0, 0.0)
    start_joints_deg: tuple[float, ...] | None = None
    joint_speed_deg: Any = 180.0
    joint_acceleration_deg: Any = 800.0
    tilt_speed_deg: Any = 30.0
    tilt_acceleration_deg: Any = 120.0
    skew_tolerance: float = 0.1
    host: str | None = None
    device: str = "simulated"

    def __post_init__(self) -> None:
        for name, value, allowed in (("model", self.model, MODELS), ("device", self.device, DEVICES)):
            if value not in allowed:
                raise HardwareError(f"{name} of the arm is {value!r}; it must be one of {', '.join(allowed)}")
        if not (self.host is None or (isinstance(self.host, str) and self.host)):
            raise HardwareError(f"host of the arm is {self.host!r}; it must be a name or an address")
        for name in ("insertion_point", "insertion_rotation_deg", "mount_translation", "mount_rotation_deg"):
            object.__setattr__(self, name, _listed(name, getattr(self, name), 3))
        if self.start_joints_deg is not None:
            start = _listed("start_joints_deg", self.start_joints_deg, 6)
            if max(map(abs, start)) > 360:
                raise HardwareError(
                    f"start_joints_deg of the arm is {list(start)}; joints turn by at most 360 deg"
                )
            object.__setattr__(self, "start_joints_deg", start)
        joints, tilts = ("joint_speed_deg", "joint_acceleration_deg"), ("tilt_speed_deg", "tilt_acceleration_deg")
        for name, size in (*((n, 6) for n in joints), *((n, 2) for n in tilts), ("skew_tolerance", 1)):
            if not (_numbers(name, getattr(self, name), size) > 0).all():
                raise HardwareError(f"{name} of the arm is {getattr(self, name)!r}; it must be positive")

    @cached_property
    def address(self) -> str:
        """Where the controller is."""
        return self.host or "127.0.0.1"

    @cached_property
    def base(self) -> Array:
        """The robot's base frame at zero tilt in the arm's base frame, (4, 4), mm."""
        return frozen(_placed(self.insertion_point, self.insertion_rotation_deg))

    @cached_property
    def mount(self) -> Array:
        """The robot's base frame in the flange's, (4, 4), mm."""
        return frozen(_placed(self.mount_translation, self.mount_rotation_deg))

    @cached_property
    def joint_speed(self) -> Array:
        """Largest joint speeds, (6,) rad/s."""
        return frozen(np.radians(_numbers("joint_speed_deg", self.joint_speed_deg, 6)))

    @cached_property
    def joint_acceleration(self) -> Array:
        """Largest joint accelerations, (6,) rad/s^2."""
        return frozen(np.radians(_numbers("joint_acceleration_deg", self.joint_acceleration_deg, 6)))


def rotations(theta: Array) -> Array:
    """R = Ry(theta_y) Rx(theta_x), (.., 3, 3), of theta (.., 2) rad."""
    (cx, cy), (sx, sy), zero = (
        np.moveaxis(np.cos(theta), -1, 0),
        np.moveaxis(np.sin(theta), -1, 0),
        0 * theta[..., 0],
    )
    rows = [[cy, sy * sx, sy * cx], [zero, cx, -sx], [-sy, cy * sx, cy * cx]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def poses(arm: Arm, theta: Array) -> Array:
    """Flange poses in the arm's base frame, (T, 4, 4) in mm, that tilt the robot by theta (T, 2) rad."""
    tilted = np.tile(np.eye(4), (len(theta), 1, 1))
    tilted[:, :3, :3] = rotations(np.asarray(theta))
    return np.asarray(arm.base @ tilted @ np.linalg.inv(arm.mount))


def tilt(arm: Arm, joints: Array) -> Array:
    """Tilt (T, 2) rad, within +-pi, of joints (T, 6) rad, by forward kinematics."""
    turned = arm.base[:3, :3].T @ _held(arm, joints)[:, :3, :3]
    theta_x = np.arctan2(-turned[:, 1, 2], turned[:, 1, 1])
    return np.stack([theta_x, np.arctan2(-turned[:, 2, 0], turned[:, 0, 0])], axis=1)


def insertion_error(arm: Arm, joints: Array) -> Array:
    """Distance (T,) in mm of what joints (T, 6) rad hold at the insertion point from there."""
    return np.asarray(np.linalg.norm(_held(arm, joints)[:, :3, 3] - arm.base[:3, 3], axis=1))


def insertion_error_between(arm: Arm, joints: Array, substeps: int = 8) -> Array:
    """Largest insertion_error (T - 1,) in mm on the way between samples (T, 6), joints interpolated linearly.

    A fourth of it is left where samples are twice as dense.
    """
    part = np.linspace(0, 1, substeps + 1)[:, None]
    way = joints[:-1, None] * (1 - part) + joints[1:, None] * part
    return insertion_error(arm, way.reshape(-1, 6)).reshape(-1, substeps + 1).max(axis=1)


def gains(arm: Arm, joints: Array) -> Array:
    """How many times as fast (T,) joints (T, 6) rad may have to turn as the robot they hold.

    1 / the smallest singular value of the Jacobian at the insertion point, LENGTH counting as a radian; infinite
    at a singularity.
    """
    screws, at = _screws(arm, joints), arm.base[:3, 3]
    turning, moving = screws[:, :3], screws[:, 3:] + np.cross(screws[:, :3], at, axisa=1, axisb=0, axisc=1)
    with np.errstate(divide="ignore"):
        smallest = np.linalg.svd(np.concatenate([turning, moving / LENGTH], axis=1), compute_uv=False)[:, -1]
        return np.asarray(1 / smallest)


class _Branch(NamedTuple):
    """One way to hold the arm, as far as it goes; margin: to singularities and joint limits, 0 at them."""

    joints: Array
    margin: float
    frame: int
    complaint: str


def joints(arm: Arm, theta: Array, start: Array | None = None) -> Array:
    """Joint angles (T, 6) rad that tilt the robot by theta (T, 2) rad, linear in theta between frames.

    All frames are on one branch of the inverse kinematics and continuous, within JOINT_LIMIT. start: (6,) rad,
    where the arm stands at the first frame. Without it the branch of start_joints_deg at zero tilt is taken, or
    if there is none, of the branches that go through all frames the one that stays furthest from singularities
    and joint limits. Raises HardwareError that names the frame, counted from 1, where no branch goes on.
    """
    theta = _tilts(theta)
    near, lead = start, 0
    if start is None and arm.start_joints_deg is not None:
        near, lead = np.radians(arm.start_joints_deg), 1
        theta = np.concatenate([np.zeros((1, 2)), theta])
    path, frames = _subdivided(theta)
    solutions = [_solutions(arm.model, pose) for pose in poses(arm, path)]
    first = solutions[0]
    if near is not None and len(first):
        first = first[[np.abs(_wrapped(first - near)).sum(axis=1).argmin()]]
        first = near + _wrapped(first - near)
    branches = [_followed(arm, q, solutions, frames, wound=near is not None) for q in first]
    if not branches:
        branches = [_Branch(first, 0.0, 0, "out of the arm's reach")]
    best = max(branches, key=lambda b: (b.frame, b.margin))
    if best.complaint:
        frame = max(best.frame - lead, 0)
        where = "zero tilt" if best.frame < lead else f"frame {frame + 1} of {len(theta) - lead}"
        at = ", ".join(f"{value:.4g}" for value in theta[best.frame])
        which = "the branch of the start" if near is not None else "every branch"
        raise HardwareError(f"{arm.model} at {where}, theta = ({at}) rad: {which} ends: {best.complaint}")
    return best.joints[frames][lead:]


def check_joints(arm: Arm, time: Array, joints: Array) -> None:
    """Raise HardwareError, which names frame, joint and value, unless joints (T, 6) rad keep the arm's limits.

    time: (T,) s. Speeds are means from frame to frame; accelerations are between those means, with the arm at
    rest before and after. Give frames for these: between samples of a motion that is linear from frame to frame,
    they show corners that the arm's controller rounds.
    """
    time, joints = np.asarray(time, dtype=float), np.asarray(joints, dtype=float)
    if joints.shape != (len(time), 6) or not (np.isfinite(time).all() and np.isfinite(joints).all()):
        raise HardwareError(f"joints have shape {joints.shape}, times {time.shape}; give finite (T, 6) and (T,)")
    step = np.diff(time)
    if not (step > 0).all():
        raise HardwareError(f"time of frame {int(np.argmin(step)) + 2} does not come after the one before")
    if not len(step):
        return
    speed = np.diff(joints, axis=0) / step[:, None]
    around = np.concatenate([step[:1], (step[1:] + step[:-1]) / 2, step[-1:]])
    acceleration = np.diff(speed, axis=0, prepend=0.0, append=0.0) / around[:, None]
    for name, unit, value, limit, lead in (
        ("speed", "deg/s", speed, arm.joint_speed, 2),
        ("acceleration", "deg/s^2", acceleration, arm.joint_acceleration, 1),
    ):
        over = np.abs(value) / limit
        frame, joint = np.unravel_index(over.argmax(), over.shape)
        if over[frame, joint] > 1 + 1e-9:
            raise HardwareError(
                f"{name} of joint {joint + 1} ({JOINTS[joint]}) to frame {frame + lead} of {len(time)} "
                f"({time[min(frame + lead, len(time)) - 1]:.4g} s) is "
                f"{math.degrees(abs(value[frame, joint])):.4g} {unit}; it must be at most "
                f"{math.degrees(limit[joint]):.4g}"
            )


def _followed(arm: Arm, q: Array, solutions: list[Array], frames: list[int], wound: bool) -> _Branch:
    """The branch that begins with q (6,), over solutions [(n, 6)]; wound: q's whole turns are those of the arm."""
    way, complaint = [q], ""
    for found in solutions[1:]:
        if not len(found):
            complaint = "out of the arm's reach"
            break
        steps = _wrapped(found - way[-1])
        step = steps[np.abs(steps).max(axis=1).argmin()]
        if np.abs(step).max() > JUMP:
            joint, gain = int(np.abs(step).argmax()), gains(arm, (way[-1] + step)[None])[0]
            complaint = f"joint {joint + 1} ({JOINTS[joint]}) would jump by {abs(step[joint]):.3g} rad"
            complaint = SINGULAR.format(gain=gain) if gain > LARGEST_GAIN else complaint
            break
        way.append(way[-1] + step)
    path = np.array(way)
    if not wound:
        middle = (path.max(axis=0) + path.min(axis=0)) / 2
        path = path - 2 * np.pi * np.round(middle / (2 * np.pi))
    gain = gains(arm, path)
    reached = len(path)
    for bad, said in (
        (gain > LARGEST_GAIN, SINGULAR),
        (np.abs(path).max(axis=1) > JOINT_LIMIT + 1e-9, "joint {joint} would turn beyond 360 deg"),
    ):
        if bad[:reached].any():
            reached = int(bad.argmax())
            joint = int(np.abs(path[reached]).argmax())
            complaint = said.format(gain=gain[reached], joint=f"{joint + 1} ({JOINTS[joint]})")
    frame = len(frames) if not complaint else int(np.searchsorted(frames, reached))
    margin = min(1 / gain.max(), 1 - np.abs(path).max() / JOINT_LIMIT)
    return _Branch(path, float(margin), frame, complaint)


def _subdivided(theta: Array) -> tuple[Array, list[int]]:
    """Tilts (n, 2) at most SUBSTEP apart on the way through theta (T, 2), and where in them the frames are."""
    path, frames = [theta[:1]], [0]
    for a, b in pairwise(theta):
        count = max(1, math.ceil(np.abs(b - a).max() / SUBSTEP))
        path.append(a + (b - a) * np.linspace(0, 1, count + 1)[1:, None])
        frames.append(frames[-1] + count)
    return np.concatenate(path), frames


def _solutions(model: str, pose: Array) -> Array:
    """All joint angles (n, 6) rad within +-pi that hold the flange at a pose (4, 4) in mm."""
    metres = pose.copy()
    metres[:3, 3] /= 1000
    return np.array(getattr(needed("ur_analytic_ik"), model).inverse_kinematics(metres)).reshape(-1, 6)


@cache
def _turns(model: str) -> tuple[Array, Array, Array]:
    """Forward kinematics in parts, mm: the flange with all joints at 0 (4, 4), and of each joint's turn about
    where its axis then lies what goes with its cosine and with its sine, (6, 4, 4) each.

    A pose depends on a joint by these two alone: the library's poses a quarter turn to either side give both
    exactly, and serve whole arrays of joints.
    """

    def pose(*joints: float) -> Array:
        found = np.array(getattr(needed("ur_analytic_ik"), model).forward_kinematics(*joints))
        found[:3, 3] *= 1000
        return found

    home = pose(*np.zeros(6))
    back = np.linalg.inv(home)
    quarters = np.array([[pose(*(s * np.pi / 2 * e)) @ back for e in np.eye(6)] for s in (1, -1)])
    return home, np.eye(4) - quarters.mean(axis=0), (quarters[0] - quarters[1]) / 2


def _placements(arm: Arm, joints: Array) -> list[Array]:
    """What joints (T, 6) rad do to a frame fixed to each link from the base to the flange, 7 of (T, 4, 4), mm."""
    _, cosine, sine = _turns(arm.model)
    c, s = np.cos(joints)[..., None, None], np.sin(joints)[..., None, None]
    moved = [np.tile(np.eye(4), (len(joints), 1, 1))]
    for i in range(6):
        moved.append(moved[-1] @ (np.eye(4) + (c[:, i] - 1) * cosine[i] + s[:, i] * sine[i]))
    return moved


def _held(arm: Arm, joints: Array) -> Array:
    """The robot's base frame in the arm's, (T, 4, 4) mm."""
    return np.asarray(_placements(arm, np.asarray(joints))[-1] @ _turns(arm.model)[0] @ arm.mount)


def _screws(arm: Arm, joints: Array) -> Array:
    """(T, 6, 6): a column a joint, its axis above the speed that it gives a point at the origin, mm/rad."""
    columns = []
    for moved, screw in zip(_placements(arm, joints), _turns(arm.model)[2], strict=False):
        axis = moved[:, :3, :3] @ np.array([screw[2, 1], screw[0, 2], screw[1, 0]])
        speed = np.einsum("tij,j->ti", moved[:, :3, :3], screw[:3, 3]) - np.cross(axis, moved[:, :3, 3])
        columns.append(np.concatenate([axis, speed], axis=1))
    return np.stack(columns, axis=2)


def _wrapped(angles: Array) -> Array:
    """The same angles within +-pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _placed(translation: Any, rotation_deg: Any) -> Array:
    """A frame (4, 4): mm, and (roll, pitch, yaw) in degrees."""
    roll, pitch, yaw = np.radians(rotation_deg)
    c, s, frame = math.cos(yaw), math.sin(yaw), np.eye(4)
    frame[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotations(np.array([roll, pitch]))
    frame[:3, 3] = translation
    return frame


def _tilts(theta: Any) -> Array:
    theta = np.asarray(theta, dtype=float)
    if theta.ndim != 2 or theta.shape[1] != 2 or not len(theta) or not np.isfinite(theta).all():
        raise HardwareError(f"theta has shape {theta.shape}; it must be finite (T, 2), with at least one frame")
    return theta


def _numbers(name: str, value: Any, size: int) -> Array:
    try:
        return numbers(name, value, size)
    except RobotError as error:
        raise HardwareError(f"{error} (arm)") from error


def _listed(name: str, value: Any, size: int) -> tuple[float, ...]:
    """Exactly size numbers: one does not stand for all here."""
    if np.shape(value) != (size,):
        raise HardwareError(f"{name} of the arm is {value!r}; it must be {size} numbers")
    return tuple(_numbers(name, value, size).tolist())
