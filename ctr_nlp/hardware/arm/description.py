"""Where an arm is mounted, where it inserts, and how fast it may move: the [arm] of a hardware file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import HardwareError, RobotError
from ctr_nlp.support.value_checks import frozen, numbers, plain_floats
from ctr_nlp.typing import Array

ARM_MODELS = (
    *("ur3", "ur3e", "ur5", "ur5e", "ur7e", "ur8long", "ur10", "ur10e"),
    *("ur12e", "ur15", "ur16e", "ur18", "ur20", "ur30"),
)
"""The arms that ur-analytic-ik knows."""
ARM_DEVICES = ("simulated", "ur")
JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
JOINT_LIMIT = 2 * math.pi
"""rad: how far each joint of a UR turns in either direction."""


@dataclass(frozen=True)
class Arm:
    """A Universal Robots arm that holds the robot and tilts it: the [arm] of a hardware file.

    model: one of ARM_MODELS. insertion_point: mm, in the arm's base frame. insertion_rotation_deg: the robot's
    base frame at zero tilt, in the arm's base frame. mount_translation (mm), mount_rotation_deg: the robot's base
    frame, which lies at the insertion point, in the arm's flange frame. A rotation is (roll, pitch, yaw) with R =
    Rz(yaw) Ry(pitch) Rx(roll): about the fixed axes, x first. start_joints_deg: base to wrist 3, roughly where the
    arm stands at zero tilt, which says what joint solution to take; None for the best of each motion.
    joint_speed_deg, joint_acceleration_deg: limits in deg/s and deg/s^2, a number or one a joint; tilt_speed_deg,
    tilt_acceleration_deg: those of the tilt, a number or one for x and one for y. skew_tolerance: s that the arm
    may be behind the tubes or ahead of them. host: address of the controller, None for this machine (a simulator).
    device: "simulated" or "ur".

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
        for name, value, allowed in (("model", self.model, ARM_MODELS), ("device", self.device, ARM_DEVICES)):
            if value not in allowed:
                raise HardwareError(f"{name} of the arm is {value!r}; it must be one of {', '.join(allowed)}")
        if not (self.host is None or (isinstance(self.host, str) and self.host)):
            raise HardwareError(f"host of the arm is {self.host!r}; it must be a name or an address")
        for name in ("insertion_point", "insertion_rotation_deg", "mount_translation", "mount_rotation_deg"):
            object.__setattr__(self, name, all_numbers(f"{name} of the arm", getattr(self, name), 3))
        if self.start_joints_deg is not None:
            start = all_numbers("start_joints_deg of the arm", self.start_joints_deg, 6)
            if max(map(abs, start)) > 360:
                raise HardwareError(
                    f"start_joints_deg of the arm is {list(start)}; joints turn by at most 360 deg"
                )
            object.__setattr__(self, "start_joints_deg", start)
        positive = {"joint_speed_deg": 6, "joint_acceleration_deg": 6, "skew_tolerance": 1}
        for name, size in {**positive, "tilt_speed_deg": 2, "tilt_acceleration_deg": 2}.items():
            if not (some_numbers(f"{name} of the arm", getattr(self, name), size) > 0).all():
                raise HardwareError(f"{name} of the arm is {getattr(self, name)!r}; it must be positive")

    @cached_property
    def address(self) -> str:
        """Name or IP address of the controller."""
        return self.host or "127.0.0.1"

    @cached_property
    def base(self) -> Array:
        """The robot's base frame at zero tilt in the arm's base frame, (4, 4), mm."""
        return frame_of(self.insertion_point, self.insertion_rotation_deg)

    @cached_property
    def mount(self) -> Array:
        """The robot's base frame in the flange's, (4, 4), mm."""
        return frame_of(self.mount_translation, self.mount_rotation_deg)

    @cached_property
    def joint_speed(self) -> Array:
        """Largest joint speeds, (6,) rad/s."""
        return frozen(np.radians(some_numbers("joint_speed_deg", self.joint_speed_deg, 6)))

    @cached_property
    def joint_acceleration(self) -> Array:
        """Largest joint accelerations, (6,) rad/s^2."""
        return frozen(np.radians(some_numbers("joint_acceleration_deg", self.joint_acceleration_deg, 6)))


def frame_of(translation: Any, rotation_deg: Any) -> Array:
    """Return a read-only homogeneous frame (4, 4).

    translation: (3,) in mm. rotation_deg: (roll, pitch, yaw) in degrees about the fixed axes, x first.
    """
    frame = np.eye(4)
    # Lower-case letters turn about fixed axes: R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF. It is not the rotation
    # vector that a UR shows on its pendant.
    frame[:3, :3] = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    frame[:3, 3] = translation
    return frozen(frame)


def some_numbers(what: str, value: Any, size: int) -> Array:
    """Return numbers (size,), where a single one stands for all; raises HardwareError.

    what: name of the quantity in the message. value: as read from TOML, a number or a list. size: how many.
    """
    try:
        return numbers(what, value, size)
    except RobotError as exception:
        raise HardwareError(str(exception)) from exception


def all_numbers(what: str, value: Any, size: int) -> tuple[float, ...]:
    """Return exactly `size` numbers, since here a single one does not stand for all; raises HardwareError.

    what: name of the quantity in the message. value: as read from TOML. size: how many.
    """
    try:
        found = plain_floats(value)
    except (TypeError, ValueError, OverflowError):  # ValueError: also lists of several lengths
        found = np.empty(0)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise HardwareError(f"{what} is {value!r:.80}; it must be {size} numbers, all finite")
    return tuple(found.tolist())


def check_joints(arm: Arm, time: Array, joints: Array) -> None:
    """Raise HardwareError, which names frame, joint and value, unless joints (T, 6) rad keep the arm's limits.

    time: (T,) s. Speeds are means from frame to frame; accelerations are between those means, with the arm at
    rest before and after. Give frames for these: between samples of a motion that is linear from frame to frame,
    they show corners that the arm's controller rounds.
    """
    time = np.asarray(time, dtype=float)
    joints = np.asarray(joints, dtype=float)
    if joints.shape != (len(time), 6) or not (np.isfinite(time).all() and np.isfinite(joints).all()):
        raise HardwareError(f"joints have shape {joints.shape}, times {time.shape}; give finite (T, 6) and (T,)")
    step = np.diff(time)
    if not (step > 0).all():
        raise HardwareError(f"time of frame {int(np.argmin(step)) + 2} does not come after the one before")
    if not len(step):
        return
    speed = np.diff(joints, axis=0) / step[:, None]
    # Means over steps belong to the middles of the steps, so accelerations divide by the distance of these. Before
    # the first and after the last step, a step of rest of the same length is assumed.
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
