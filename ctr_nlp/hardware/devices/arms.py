"""Arms that follow commanded tilts, one command every few ms, and report where they are; and a simulated one."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.arm.description import JOINTS, Arm
from ctr_nlp.hardware.arm.kinematics import inverse_kinematics, tilt_of_joints
from ctr_nlp.typing import Array

Now = Callable[[], float]

LONGEST_STEP = 0.1
"""s: a longer silence between two commands does not allow a longer step."""


class OutOfStep(DeviceFault):
    """The arm is not where the device's progress requires it, or cannot get there in time."""


class ArmFollower(ABC):
    """An arm that tilts the robot. Every method raises DeviceFault where the arm does not do what it should.

    All commands are of one joint solution, the one in which the arm stands at first, and none is further from the
    one before than the largest joint speeds allow. A kind of arm implements how its state is read, joints are sent
    and motion is halted.
    """

    def __init__(self, arm: Arm, clock: Now) -> None:
        self._arm = arm
        self._clock = clock
        self._last: tuple[Array, float] | None = None
        """The last command (6,) rad and its time, s of the clock; None where the arm does not follow."""

    @abstractmethod
    def connect(self) -> None:
        """Prepare to follow from where the arm stands; nothing moves."""

    @abstractmethod
    def _look(self) -> None:
        """Read the arm's state."""

    @abstractmethod
    def _read_joints(self) -> Array:
        """Return the joint angles (6,) rad of the last state."""

    @abstractmethod
    def _send(self, wanted: Array) -> None:
        """Command joint angles (6,) rad."""

    @abstractmethod
    def _halt(self) -> None:
        """Stop the commanded motion."""

    def joints(self) -> Array:
        """Return the measured joint angles, (6,) rad."""
        self._look()
        return self._read_joints()

    def tilt(self) -> Array:
        """Return the measured tilt, (2,) rad."""
        return tilt_of_joints(self._arm, self.joints()[None])[0]

    def follow(self, theta: Array) -> None:
        """Command a tilt, now; called at a regular rate.

        theta: (2,) rad. Nothing is sent where a joint would have to step further than its largest speed allows
        since the command before, or where the path there leaves the joint solution.
        """
        if self._last is None:
            raise DeviceFault("the arm was ordered to follow, but is not connected or was stopped")
        self._look()
        now = self._clock()
        wanted = self._step(*self._last, theta, now)
        self._last = wanted, now
        self._send(wanted)

    def _step(self, last: Array, since: float, theta: Array, now: float) -> Array:
        """Return the joints (6,) rad of a tilt, if they can be reached in the time since the last command.

        last: joints (6,) rad of that command, given at since, s. theta: (2,) rad. now: s. Raises DeviceFault.
        """
        # From the tilt of the last command, not from the measured one: the steps of commands are bounded, and the
        # servo's lag does not count as a step.
        path = np.array([tilt_of_joints(self._arm, last[None])[0], theta])
        try:
            wanted = inverse_kinematics(self._arm, path, last)[-1]
        except HardwareError as exception:
            raise DeviceFault(f"the arm cannot follow: {exception}") from exception
        elapsed = min(now - since, LONGEST_STEP)
        step = np.abs(wanted - last)
        over = step - self._arm.joint_speed * elapsed
        joint = int(over.argmax())
        if over[joint] > 1e-9:
            raise OutOfStep(
                f"joint {joint + 1} ({JOINTS[joint]}) of the arm was to turn {math.degrees(step[joint]):.3g} deg "
                f"in {elapsed:.3g} s; its largest speed is {math.degrees(self._arm.joint_speed[joint]):.4g} deg/s"
            )
        return wanted

    def hold(self) -> None:
        """Stand still, ready to follow from there."""
        if self._last is not None:
            self._halt()
            self._last = self.joints(), self._clock()

    def stop(self) -> None:
        """Stand still for good; nothing is sent until the arm is connected again."""
        self.hold()
        self._last = None

    def close(self) -> None:
        """Stop and close the connection; raises nothing."""
        self.stop()


class SimulatedArm(ArmFollower):
    """A simulated arm, which moves exactly on command, or with a lag, or at a limited speed.

    theta: (2,) rad, where it stands. lag: s until a command takes effect. speed: rad/s that its joints reach,
    whatever is commanded. Both make it fall behind. clock: returns the time, s.
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
        super().__init__(arm, clock)
        self._lag = lag
        self._speed = speed
        self._at = self._target = inverse_kinematics(arm, np.array([theta], dtype=float))[0]
        self._time = clock()
        self._coming: deque[tuple[float, Array]] = deque()

    def connect(self) -> None:
        """Prepare to follow."""
        self._last = self.joints(), self._clock()

    def _look(self) -> None:
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

    def _read_joints(self) -> Array:
        return self._at.copy()

    def _send(self, wanted: Array) -> None:
        self._coming.append((self._clock() + self._lag, wanted))

    def _halt(self) -> None:
        self._look()
        self._coming.clear()
        self._target = self._at
