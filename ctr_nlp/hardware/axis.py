"""Motors: the joint that each moves, how far and how fast, and which robots a set of them can move."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ctr_nlp.exceptions import HardwareError, RobotError
from ctr_nlp.hardware.arm.description import Arm, all_numbers, some_numbers
from ctr_nlp.hardware.motion.lookahead import steady_speed
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

LETTERS = "XYZABCUVW"
"""Letters of axes, in the order in which Grbl numbers their settings."""

MOTOR_AXIS_UNITS = {"beta": {"mm": 1.0}, "alpha": {"deg": math.degrees(1.0), "rad": 1.0}}
"""Units of an axis by the kind of joint that it moves, and how many of them a mm or a rad is."""


@dataclass(frozen=True)
class Axis:
    """One motor and the joint that it moves: position = zero + sign * (joint in the axis' unit).

    joint: "alpha_i" or "beta_i". letter: in G-code. unit: "mm" for beta, "deg" or "rad" for alpha. range: (lower,
    upper) position; speed, acceleration: largest, in unit/s and unit/s^2. backlash: play of the drive, compensated
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
        if kind not in MOTOR_AXIS_UNITS or not number.isdecimal() or int(number) < 1:
            raise HardwareError(f"joint of an axis is {self.joint!r}; it must be alpha_i or beta_i, with i from 1")
        if self.unit not in MOTOR_AXIS_UNITS[kind]:
            raise HardwareError(
                f"unit of {self.joint} is {self.unit!r}; it must be {' or '.join(MOTOR_AXIS_UNITS[kind])}"
            )
        if not (isinstance(self.letter, str) and len(self.letter) == 1 and self.letter in LETTERS):
            raise HardwareError(f"letter of {self.joint} is {self.letter!r}; it must be one of X Y Z A B C U V W")
        if isinstance(self.sign, bool) or self.sign not in (-1, 1):
            raise HardwareError(f"sign of {self.joint} is {self.sign!r}; it must be 1 or -1")
        for name in ("speed", "acceleration", "zero", "backlash", "tolerance"):
            value = float(some_numbers(f"{name} of {self.joint}", getattr(self, name), 1)[0])
            if name != "zero" and (value < 0 or (value == 0 and name != "backlash")):
                raise HardwareError(
                    f"{name} of {self.joint} is {value:g}; it must be positive{' or 0' * (name == 'backlash')}"
                )
            object.__setattr__(self, name, value)
        lower, upper = all_numbers(f"range of {self.joint}", self.range, 2)
        if lower >= upper:
            raise HardwareError(f"range of {self.joint} is [{lower:g}, {upper:g}]; the lower must be less")
        object.__setattr__(self, "range", (lower, upper))

    @property
    def scale(self) -> float:
        """Position per mm or rad of the joint."""
        return self.sign * MOTOR_AXIS_UNITS[self.joint.partition("_")[0]][self.unit]


def check_fit(robot: Robot, axes: tuple[Axis, ...], mounted: Robot | None) -> None:
    """Raise HardwareError unless axes move all tubes of a robot, and these tubes are mounted.

    mounted: the robot whose tubes are on the hardware; None takes any.
    """
    wanted = set(robot.axes[: 2 * robot.d])
    moved = {axis.joint for axis in axes}
    faults = [f"no axis moves {name} of the robot" for name in sorted(wanted - moved)[:1]]
    faults += [f"an axis moves {name}, which the robot does not have" for name in sorted(moved - wanted)[:1]]
    if faults:
        raise HardwareError(f"{', and '.join(faults)}; `joint` of the axes must be {', '.join(sorted(wanted))}")
    tubes = robot.tubes if mounted is None else mounted.tubes
    if len(tubes) != robot.d:
        raise HardwareError(f"the plan's robot has {robot.d} tubes, {len(tubes)} are mounted")
    for i, (tube, there) in enumerate(zip(robot.tubes, tubes, strict=True), start=1):
        for f in fields(tube):
            planned = getattr(tube, f.name)
            real = getattr(there, f.name)
            # A strain limit decides which robots are refused, and moves none.
            if f.name != "max_strain" and not np.allclose(planned, real, rtol=1e-9):
                raise HardwareError(
                    f"tube {i} of the plan's robot has {f.name} {planned}, the one that is mounted {real}: "
                    "the plan is for another robot"
                )


def apply_axis_limits(robot: Robot, axes: tuple[Axis, ...], arm: Arm | None, looks_ahead: bool) -> Robot:
    """Return the robot with limits that the axes and the arm satisfy, too; raises HardwareError.

    arm: None where nothing tilts the robot. looks_ahead: whether the controller plans to stand still at the end of
    the short motion that it has been given, as Grbl does.
    """
    lower, upper, speed, acceleration = (
        np.array(part) for part in (robot.lower, robot.upper, robot.speed, robot.acceleration)
    )
    for axis in axes:
        i = robot.axes.index(axis.joint)
        ends = sorted((end - axis.zero) / axis.scale for end in axis.range)
        fastest = axis.speed
        # Grbl is never faster than it can brake within the motion that it was given, so that a higher speed in the
        # plan would only make it late.
        if looks_ahead:
            fastest = min(fastest, steady_speed(axis.acceleration, axis.unit == "mm"))
        lower[i], upper[i] = max(lower[i], ends[0]), min(upper[i], ends[1])
        speed[i] = min(speed[i], fastest / abs(axis.scale))
        acceleration[i] = min(acceleration[i], axis.acceleration / abs(axis.scale))
    _check_ranges(robot, axes, lower, upper)
    if arm is None:
        # Without an arm the tilt is 0. Where the robot's limits exclude 0, lower ends above upper and with_limits
        # refuses the robot.
        lower[-2:], upper[-2:] = np.maximum(lower[-2:], 0.0), np.minimum(upper[-2:], 0.0)
    else:
        speed[-2:] = np.minimum(speed[-2:], np.radians(arm.tilt_speed_deg))
        acceleration[-2:] = np.minimum(acceleration[-2:], np.radians(arm.tilt_acceleration_deg))
    limits: dict[str, Any] = {}
    pairs, speeds, rates = (robot.split(part) for part in (np.stack([lower, upper]), speed, acceleration))
    for k, name in enumerate(("alpha", "beta", "theta")):
        limits[name] = pairs[k].T.tolist()
        limits[f"{name}_speed"] = speeds[k].tolist()
        limits[f"{name}_acceleration"] = rates[k].tolist()
    try:
        return robot.with_limits(**limits)
    except RobotError as exception:
        raise HardwareError(f"this hardware cannot move the robot: {exception}") from exception


def _check_ranges(robot: Robot, axes: tuple[Axis, ...], lower: Array, upper: Array) -> None:
    """Raise HardwareError unless every axis can move its joint within the robot's limits, tubes in order."""
    for axis in axes:
        i = robot.axes.index(axis.joint)
        if lower[i] > upper[i] or (lower[i] == upper[i] and robot.lower[i] < robot.upper[i]):
            raise HardwareError(
                f"this hardware cannot move the robot: limits of {axis.joint} are [{lower[i]:g}, {upper[i]:g}]"
                f", where axis {axis.letter} has the range [{axis.range[0]:g}, {axis.range[1]:g}] {axis.unit}"
                f", zero {axis.zero:g} and sign {axis.sign}, and the robot allows [{robot.lower[i]:g}, "
                f"{robot.upper[i]:g}]"
            )
    letters = {axis.joint: axis.letter for axis in axes}
    least, most = (robot.split(ends)[1] for ends in (lower, upper))
    for i in range(1, robot.d):
        if most[i] < least[:i].max():
            k = int(least[:i].argmax())
            raise HardwareError(
                f"this hardware cannot hold the robot: axis {letters[f'beta_{i + 1}']} takes beta_{i + 1} to "
                f"at most {most[i]:g} mm, and axis {letters[f'beta_{k + 1}']} beta_{k + 1} to at least "
                f"{least[k]:g} mm, which must be less"
            )
