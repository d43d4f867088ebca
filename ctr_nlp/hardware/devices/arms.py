"""Followers: arms that go where they are told, tick by tick, and say where they are; and one that is not real."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.arm.description import JOINTS, Arm
from ctr_nlp.hardware.arm.kinematics import joints, tilt
from ctr_nlp.typing import Array

Now = Callable[[], float]

LONGEST_STEP = 0.1
"""s: a longer silence between two commands does not allow a longer step."""


class ArmFollower(Protocol):
    """An arm that tilts the robot. Every method raises DeviceFault where the arm does not do what it should."""

    def connect(self) -> None:
        """Get ready to follow from where the arm stands; nothing moves."""

    def joints(self) -> Array:
        """Measured joint angles now, (6,) rad."""

    def tilt(self) -> Array:
        """Measured tilt now, (2,) rad."""

    def follow(self, theta: Array) -> None:
        """Go to a tilt (2,) rad, now; called at a regular rate.

        Nothing is sent where a joint would have to step further than its largest speed allows since the command
        before, or where the path there leaves the joint solution.
        """

    def hold(self) -> None:
        """Stand still, and be ready to follow from there."""

    def stop(self) -> None:
        """Stand still for good; nothing is sent afterwards, until the arm is connected again."""

    def close(self) -> None:
        """Stop, let go of the connection; raises nothing."""


class Steps:
    """Joint commands from where an arm stands: of one joint solution, none longer than joint speeds allow."""

    def __init__(self, arm: Arm, start: Array, now: float) -> None:
        self.arm, self.last, self.time = arm, start, now

    def to(self, theta: Array, now: float) -> Array:
        """The joints (6,) of a tilt (2,) rad, once they are allowed; raises DeviceFault."""
        path = np.array([tilt(self.arm, self.last[None])[0], theta])
        try:
            wanted = joints(self.arm, path, self.last)[-1]
        except HardwareError as exception:
            raise DeviceFault(f"the arm cannot follow: {exception}") from exception
        elapsed = min(now - self.time, LONGEST_STEP)
        step = np.abs(wanted - self.last)
        over = step - self.arm.joint_speed * elapsed
        joint = int(over.argmax())
        if over[joint] > 1e-9:
            raise DeviceFault(
                f"joint {joint + 1} ({JOINTS[joint]}) of the arm was to turn {math.degrees(step[joint]):.3g} deg "
                f"in {elapsed:.3g} s; its largest speed is {math.degrees(self.arm.joint_speed[joint]):.4g} deg/s"
            )
        self.last, self.time = wanted, now
        return wanted


class SimulatedArm:
    """An arm that is not there: it moves exactly on command, or with a lag, or no faster than it can.

    theta: (2,) rad, where it stands. lag: s until a command takes effect. speed: rad/s that its joints manage,
    whatever they are told; both make it fall behind.
    """

    def __init__(
        self,
        arm: Arm,
        theta: Sequence[float] = (0.0, 0.0),
        *,
        lag: float = 0.0,
        speed: float = math.inf,
        clock: Now = time.monotonic,
    ) -> None:
        self._arm, self._lag, self._speed, self._clock = arm, lag, speed, clock
        self._at = joints(arm, np.array([theta], dtype=float))[0]
        self._steps: Steps | None = None
        self._time = clock()
        self._coming: deque[tuple[float, Array]] = deque()
        self._target = self._at

    def connect(self) -> None:
        """Get ready to follow."""
        self._advance()
        self._steps = Steps(self._arm, self._at, self._clock())

    def joints(self) -> Array:
        """Joint angles now, (6,) rad."""
        self._advance()
        return self._at.copy()

    def tilt(self) -> Array:
        """Tilt now, (2,) rad."""
        return tilt(self._arm, self.joints()[None])[0]

    def follow(self, theta: Array) -> None:
        """Go to a tilt (2,) rad; raises DeviceFault."""
        if self._steps is None:
            raise DeviceFault("the arm was told to follow, but is not connected or was stopped")
        self._advance()
        now = self._clock()
        self._coming.append((now + self._lag, self._steps.to(theta, now)))

    def hold(self) -> None:
        """Stand still."""
        self._advance()
        self._coming.clear()
        self._target = self._at
        if self._steps is not None:
            self._steps = Steps(self._arm, self._at, self._clock())

    def stop(self) -> None:
        """Stand still for good."""
        self.hold()
        self._steps = None

    def close(self) -> None:
        """Stop."""
        self.stop()

    def _advance(self) -> None:
        now = self._clock()
        while self._coming and self._coming[0][0] <= now:
            when, target = self._coming.popleft()
            self._move(when)
            self._target = target
        self._move(now)

    def _move(self, now: float) -> None:
        if math.isinf(self._speed):
            self._at = self._target
        else:
            reach = self._speed * max(now - self._time, 0.0)
            self._at = self._at + np.clip(self._target - self._at, -reach, reach)
        self._time = now
