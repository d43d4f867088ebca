"""What a plan is played on: which axis moves which joint, how far and how fast, and where the device is; TOML."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import HardwareError, RobotError
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.commissioned import read_commissioned
from ctr_nlp.hardware.motion.lookahead import steady_speed
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import described, numbers, read_toml
from ctr_nlp.typing import Array

UNITS = {"beta": {"mm": 1.0}, "alpha": {"deg": math.degrees(1.0), "rad": 1.0}}
"""What an axis may count in, by what it moves, and how much of that a mm or a rad is."""

DEVICES = ("simulated", "grbl", "ros2")
HOMING = ("manual", "cycle")
FLOW = ("count", "wait")
KEYS = "name, robot, axes, arm, connection, approach, late"
"""Of a hardware file."""


@dataclass(frozen=True)
class Axis:
    """One motor and the joint that it moves: position = zero + sign * (joint in the axis' unit).

    joint: "alpha_i" or "beta_i". letter: in G-code. unit: "mm" for beta, "deg" or "rad" for alpha. range: (lower,
    upper) position; speed, acceleration: largest, in unit/s and unit/s^2. backlash: play of the drive, made up for
    on every reversal; tolerance: how far from its command the axis may be found. Raises HardwareError.
    """

    joint: str
    letter: str
    unit: str
    range: tuple[float, float]
    speed: float
    acceleration: float
    sign: int = 1
    zero: float = 0.0
    backlash: float = 0.0
    tolerance: float = 0.5

    def __post_init__(self) -> None:
        kind, _, number = str(self.joint).partition("_")
        if kind not in UNITS or not number.isdecimal() or int(number) < 1:
            raise HardwareError(f"joint of an axis is {self.joint!r}; it must be alpha_i or beta_i, with i from 1")
        if self.unit not in UNITS[kind]:
            raise HardwareError(f"unit of {self.joint} is {self.unit!r}; it must be {' or '.join(UNITS[kind])}")
        if not (isinstance(self.letter, str) and len(self.letter) == 1 and self.letter in "XYZABCUVW"):
            raise HardwareError(f"letter of {self.joint} is {self.letter!r}; it must be one of X Y Z A B C U V W")
        if isinstance(self.sign, bool) or self.sign not in (-1, 1):
            raise HardwareError(f"sign of {self.joint} is {self.sign!r}; it must be 1 or -1")
        for name in ("speed", "acceleration", "zero", "backlash", "tolerance"):
            value = self._numbers(name, 1)[0]
            if name != "zero" and (value < 0 or (value == 0 and name != "backlash")):
                raise HardwareError(
                    f"{name} of {self.joint} is {value:g}; it must be positive{' or 0' * (name == 'backlash')}"
                )
            object.__setattr__(self, name, float(value))
        lower, upper = self._numbers("range", 2)
        if lower >= upper:
            raise HardwareError(f"range of {self.joint} is [{lower:g}, {upper:g}]; the lower must be less")
        object.__setattr__(self, "range", (float(lower), float(upper)))

    def _numbers(self, name: str, size: int) -> Array:
        value = getattr(self, name)
        if size > 1 and np.shape(value) != (size,):
            raise HardwareError(f"{name} of {self.joint} is {value!r}; give {size} numbers")
        try:
            return numbers(f"{name} of {self.joint}", value, size)
        except RobotError as error:
            raise HardwareError(str(error)) from error

    @property
    def scale(self) -> float:
        """Position per mm or rad of the joint."""
        return self.sign * UNITS[self.joint.partition("_")[0]][self.unit]


@dataclass(frozen=True)
class Connection:
    """Where the motors' controller is.

    device: "simulated", "grbl" or "ros2". url: a serial port, "socket://host:port", or for ros2 the controller's
    name. baud: of a serial port. homing: "cycle" lets the controller home itself and wants its soft limits,
    "manual" takes the position that it reports for true. flow: "count" sends lines as long as counted characters
    fit into the controller's buffer, "wait" sends a line when the one before was acknowledged. Raises
    HardwareError.
    """

    device: str = "simulated"
    url: str = ""
    baud: int = 115200
    homing: str = "manual"
    flow: str = "count"

    def __post_init__(self) -> None:
        for name, allowed in (("device", DEVICES), ("homing", HOMING), ("flow", FLOW)):
            if getattr(self, name) not in allowed:
                raise HardwareError(
                    f"{name} of the connection is {getattr(self, name)!r}; it must be {', '.join(allowed)}"
                )
        if self.device != "simulated" and not (isinstance(self.url, str) and self.url):
            raise HardwareError(f"url of the connection is {self.url!r}; a {self.device} device needs one")
        if isinstance(self.baud, bool) or not isinstance(self.baud, int) or self.baud <= 0:
            raise HardwareError(f"baud of the connection is {self.baud!r}; it must be a positive whole number")


@dataclass(frozen=True)
class Hardware:
    """Axes, one for every alpha and beta of a robot, an arm that tilts it or None, and the connection.

    approach: part of the largest speeds at which the first frame is gone to. robot: whose tubes are mounted; plans
    for others are refused, None takes any. late: s that a motion may be behind its schedule. commissioned: the
    controller's settings by name when the rig was commissioned, as it told them; None where that was not done.
    Raises HardwareError.
    """

    axes: tuple[Axis, ...]
    arm: Arm | None = None
    connection: Connection = field(default_factory=Connection)
    approach: float = 0.2
    robot: Robot | None = None
    late: float = 1.0
    commissioned: dict[str, str] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", tuple(self.axes))
        for name in ("joint", "letter"):
            values = [getattr(axis, name) for axis in self.axes]
            double = [value for value in values if values.count(value) > 1]
            if double:
                raise HardwareError(f"{name} {double[0]} is given to {len(double)} axes; give it to one")
        approach = self.approach
        if isinstance(approach, bool) or not isinstance(approach, int | float) or not 0 < approach <= 1:
            raise HardwareError(f"approach is {approach!r}; it must lie in (0, 1]")
        late = self.late
        if isinstance(late, bool) or not isinstance(late, int | float) or not 0 < late < math.inf:
            raise HardwareError(f"late is {late!r}; it must be a positive number of seconds")

    @cached_property
    def letters(self) -> tuple[str, ...]:
        """Of the axes, in order."""
        return tuple(axis.letter for axis in self.axes)

    @cached_property
    def backlash(self) -> Array:
        """Of the axes (m,), in their units."""
        return np.array([axis.backlash for axis in self.axes])

    @cached_property
    def tolerance(self) -> Array:
        """Of the axes (m,), in their units."""
        return np.array([axis.tolerance for axis in self.axes])

    @cached_property
    def _zero(self) -> Array:
        return np.array([axis.zero for axis in self.axes])

    @cached_property
    def _scale(self) -> Array:
        return np.array([axis.scale for axis in self.axes])

    def tightened(self, robot: Robot) -> Robot:
        """The robot with limits that these axes and the arm keep too; raises HardwareError."""
        self._check_joints(robot)
        self._check_tubes(robot)
        lower, upper, speed, acceleration = (
            np.array(part) for part in (robot.lower, robot.upper, robot.speed, robot.acceleration)
        )
        for axis in self.axes:
            i = robot.axes.index(axis.joint)
            ends = sorted((end - axis.zero) / axis.scale for end in axis.range)
            lower[i], upper[i] = max(lower[i], ends[0]), min(upper[i], ends[1])
            speed[i] = min(speed[i], self._fastest(axis) / abs(axis.scale))
            acceleration[i] = min(acceleration[i], axis.acceleration / abs(axis.scale))
        self._check_ranges(robot, lower, upper)
        if self.arm is None:
            lower[-2:], upper[-2:] = np.maximum(lower[-2:], 0.0), np.minimum(upper[-2:], 0.0)
        else:
            speed[-2:] = np.minimum(speed[-2:], np.radians(self.arm.tilt_speed_deg))
            acceleration[-2:] = np.minimum(acceleration[-2:], np.radians(self.arm.tilt_acceleration_deg))
        limits: dict[str, Any] = {}
        pairs, speeds, rates = (robot.split(part) for part in (np.stack([lower, upper]), speed, acceleration))
        for k, name in enumerate(("alpha", "beta", "theta")):
            limits[name] = pairs[k].T.tolist()
            limits[f"{name}_speed"] = speeds[k].tolist()
            limits[f"{name}_acceleration"] = rates[k].tolist()
        try:
            return robot.with_limits(**limits)
        except RobotError as error:
            raise HardwareError(f"this hardware cannot move the robot: {error}") from error

    def _fastest(self, axis: Axis) -> float:
        """The largest speed of an axis in its unit, from which its controller can still stop soon enough."""
        if self.connection.device != "grbl":
            return axis.speed
        return min(axis.speed, steady_speed(axis.acceleration, axis.unit == "mm"))

    def _check_ranges(self, robot: Robot, lower: Array, upper: Array) -> None:
        """Raise HardwareError unless every axis can move its joint within the robot's limits, tubes in order."""
        for axis in self.axes:
            i = robot.axes.index(axis.joint)
            if lower[i] > upper[i] or (lower[i] == upper[i] and robot.lower[i] < robot.upper[i]):
                raise HardwareError(
                    f"this hardware cannot move the robot: limits of {axis.joint} are [{lower[i]:g}, {upper[i]:g}]"
                    f", where axis {axis.letter} has the range [{axis.range[0]:g}, {axis.range[1]:g}] {axis.unit}"
                    f", zero {axis.zero:g} and sign {axis.sign}, and the robot allows [{robot.lower[i]:g}, "
                    f"{robot.upper[i]:g}]"
                )
        letters = {axis.joint: axis.letter for axis in self.axes}
        least, most = (robot.split(ends)[1] for ends in (lower, upper))
        for i in range(1, robot.d):
            if most[i] < least[:i].max():
                k = int(least[:i].argmax())
                raise HardwareError(
                    f"this hardware cannot hold the robot: axis {letters[f'beta_{i + 1}']} takes beta_{i + 1} to "
                    f"at most {most[i]:g} mm, and axis {letters[f'beta_{k + 1}']} beta_{k + 1} to at least "
                    f"{least[k]:g} mm, which must be less"
                )

    def _check_joints(self, robot: Robot) -> None:
        wanted, moved = set(robot.axes[: 2 * robot.d]), {axis.joint for axis in self.axes}
        for name in sorted(wanted ^ moved):
            what = f"no axis moves {name} of the robot" if name in wanted else f"an axis moves {name}"
            raise HardwareError(f"{what}; axes must move {', '.join(sorted(wanted))}")

    def _check_tubes(self, robot: Robot) -> None:
        mounted = robot.tubes if self.robot is None else self.robot.tubes
        if len(mounted) != robot.d:
            raise HardwareError(f"the plan's robot has {robot.d} tubes, {len(mounted)} are mounted")
        for i, (tube, there) in enumerate(zip(robot.tubes, mounted, strict=True), start=1):
            for f in fields(tube):
                planned, real = getattr(tube, f.name), getattr(there, f.name)
                if not np.allclose(planned, real, rtol=1e-9):
                    raise HardwareError(
                        f"tube {i} of the plan's robot has {f.name} {planned}, the one that is mounted {real}: "
                        "the plan is for another robot"
                    )

    def positions(self, robot: Robot, q: Array) -> Array:
        """Positions (.., m) of the axes, in their units, at q (.., 2d + 2)."""
        columns = [robot.axes.index(axis.joint) for axis in self.axes]
        return np.asarray(self._zero + self._scale * q[..., columns])

    def joints(self, robot: Robot, positions: Array, theta: Array) -> Array:
        """The q (.., 2d + 2) at positions (.., m) of the axes and a tilt (.., 2)."""
        q = self.in_joints(robot, positions - self._zero)
        q[..., -2:] = theta
        return q

    def in_joints(self, robot: Robot, lengths: Array) -> Array:
        """Ways (.., m) that axes go, in their units, as ways of q (.., 2d + 2); the tilt does not move."""
        q = np.zeros((*np.shape(lengths)[:-1], 2 * robot.d + 2))
        q[..., [robot.axes.index(axis.joint) for axis in self.axes]] = lengths / self._scale
        return q

    @classmethod
    def from_toml(cls, path: str | Path) -> Hardware:
        """The hardware of a TOML file; raises HardwareError, also where it cannot move the robot that it names."""
        try:
            data = read_toml(path)
            unknown = set(data) - set(KEYS.split(", "))
            if unknown:
                raise HardwareError(f"unknown key {min(unknown)!r}; use {KEYS}")
            if not isinstance(data.get("axes"), list):
                raise HardwareError("hardware needs a list of axes, [[axes]] in TOML")
            hardware = cls(
                tuple(described(Axis, axis) for axis in data["axes"]),
                described(Arm, data["arm"]) if "arm" in data else None,
                described(Connection, data.get("connection", {})),
                data.get("approach", cls.approach),
                Robot.from_toml(Path(path).parent / _file(data["robot"])) if "robot" in data else None,
                data.get("late", cls.late),
                read_commissioned(path),
            )
            if hardware.robot is not None:
                hardware.tightened(hardware.robot)
            return hardware
        except (RobotError, HardwareError) as error:
            raise HardwareError(f"hardware file {path}: {error}") from error


def _file(name: Any) -> str:
    if not isinstance(name, str):
        raise HardwareError(f"robot is {name!r}; it must be the name of a robot file")
    return name


def bench(robot: Robot) -> Hardware:
    """A simulated rig for a robot of up to three tubes: what is played on where no hardware file is given.

    50 mm/s and 200 mm/s^2, 600 deg/s and 2000 deg/s^2. Raises HardwareError.
    """
    if robot.d > 3:
        raise HardwareError(f"a robot of {robot.d} tubes needs a hardware file; there is a default for up to 3")
    numbers_of = range(1, robot.d + 1)
    slides = [Axis(f"beta_{i}", "XYZ"[i - 1], "mm", (0.0, robot.reach), 50.0, 200.0) for i in numbers_of]
    turns = [Axis(f"alpha_{i}", "ABC"[i - 1], "deg", (-1080.0, 1080.0), 600.0, 2000.0) for i in numbers_of]
    return Hardware((*slides, *turns), Arm())
