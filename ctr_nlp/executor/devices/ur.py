"""Followers: arms that go where they are told, tick by tick, and say where they are. One is real, one is not."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import DeviceFault, HardwareError
from ctr_nlp.executor.arm import JOINTS, Arm, insertion_error, joints, tilt
from ctr_nlp.executor.extras import needed

Array = npt.NDArray[np.float64]
Clock = Callable[[], float]

LONGEST_STEP = 0.1
"""s: a longer silence between two commands does not allow a longer step."""
STALE = 0.2
"""s without news from the controller after which the connection counts as lost."""
START_TOLERANCE = 0.02
"""rad by which joints may be off what holds the insertion point when an arm is connected."""
RUNNING = 7
"""The robot mode of a UR that is powered, with its brakes released."""


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
        before, or where the way there leaves the branch of the inverse kinematics.
        """

    def hold(self) -> None:
        """Stand still, and be ready to follow from there."""

    def stop(self) -> None:
        """Stand still for good; nothing is sent afterwards, until the arm is connected again."""

    def close(self) -> None:
        """Stop, let go of the connection; raises nothing."""


def arm_follower(arm: Arm, theta: Sequence[float] = (0.0, 0.0), clock: Clock = time.monotonic) -> ArmFollower:
    """What the arm's device names; a simulated arm stands at a tilt theta (2,) rad."""
    return SimulatedArm(arm, theta, clock=clock) if arm.device == "simulated" else UrArm(arm, clock=clock)


class _Steps:
    """Joint commands from where an arm stands: on one branch, none longer than the joints' speeds allow."""

    def __init__(self, arm: Arm, start: Array, now: float) -> None:
        self.arm, self.last, self.time = arm, start, now

    def to(self, theta: Array, now: float) -> Array:
        """The joints (6,) of a tilt (2,) rad, once they are allowed; raises DeviceFault."""
        way = np.array([tilt(self.arm, self.last[None])[0], theta])
        try:
            wanted = joints(self.arm, way, self.last)[-1]
        except HardwareError as error:
            raise DeviceFault(f"the arm cannot follow: {error}") from error
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
        clock: Clock = time.monotonic,
    ) -> None:
        self._arm, self._lag, self._speed, self._clock = arm, lag, speed, clock
        self._at = joints(arm, np.array([theta], dtype=float))[0]
        self._steps: _Steps | None = None
        self._time = clock()
        self._coming: deque[tuple[float, Array]] = deque()
        self._target = self._at

    def connect(self) -> None:
        """Get ready to follow."""
        self._advance()
        self._steps = _Steps(self._arm, self._at, self._clock())

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
            self._steps = _Steps(self._arm, self._at, self._clock())

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


class UrArm:
    """A Universal Robots arm over RTDE, by ur_rtde's servoJ. Not yet tried on a robot.

    period: s between commands, what the controller interpolates over. lookahead_time (s, 0.03 to 0.2) and gain
    (100 to 2000) are servoj's: the arm is behind by about lookahead_time. Where commands stop coming, the
    controller keeps to the last one. The speed slider of the pendant must be at 100 %: servoj gets slower with it.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        period: float = 0.02,
        lookahead_time: float = 0.05,
        gain: float = 500.0,
        clock: Clock = time.monotonic,
    ) -> None:
        self._arm, self._clock = arm, clock
        self._servo = (period, lookahead_time, gain)
        self._receive: Any = None
        self._control: Any = None
        self._steps: _Steps | None = None
        self._news = (math.nan, 0.0)

    def connect(self) -> None:
        """Check that the arm is fit and holds the insertion point, then start the control program on it."""
        receiving, controlling = needed("rtde_receive"), needed("rtde_control")
        try:
            with self._faults("cannot be reached"):
                self._receive = receiving.RTDEReceiveInterface(self._arm.address)
            self._news = (math.nan, self._clock())
            start = self.joints()
            self._check_start(start)
            with self._faults("does not take commands"):
                self._control = controlling.RTDEControlInterface(self._arm.address)
        except DeviceFault:
            self.close()
            raise
        self._steps = _Steps(self._arm, start, self._clock())

    def joints(self) -> Array:
        """Measured joint angles now, (6,) rad; raises DeviceFault."""
        self._check()
        with self._faults("does not answer"):
            return np.array(self._receive.getActualQ(), dtype=float)

    def tilt(self) -> Array:
        """Measured tilt now, (2,) rad; raises DeviceFault."""
        return tilt(self._arm, self.joints()[None])[0]

    def follow(self, theta: Array) -> None:
        """Send the joints of a tilt (2,) rad; raises DeviceFault, and sends nothing, where they are too far."""
        if self._steps is None:
            raise DeviceFault("the arm was told to follow, but is not connected or was stopped")
        self._check()
        wanted = self._steps.to(theta, self._clock())
        with self._faults("does not take commands"):
            # servoJ has arguments for speed and acceleration and does not use them.
            taken = self._control.servoJ(wanted.tolist(), 0.5, 0.5, *self._servo)
        if not taken:
            raise DeviceFault(
                f"the arm at {self._arm.address} refused a position: its control program is not running; "
                "was it stopped at the pendant?"
            )

    def hold(self) -> None:
        """Slow down and stand still; following goes on from there. Raises DeviceFault."""
        if self._steps is not None:
            with self._faults("could not be told to hold"):
                self._control.servoStop()
            self._steps = _Steps(self._arm, self.joints(), self._clock())

    def stop(self) -> None:
        """Slow down and end the control program; raises DeviceFault where the arm cannot be told."""
        control, self._control, self._steps = self._control, None, None
        if control is None:
            return
        try:
            with self._faults("could not be told to stop; use the emergency stop"):
                try:
                    control.servoStop()
                finally:
                    control.stopScript()
        finally:
            with contextlib.suppress(RuntimeError):
                control.disconnect()

    def close(self) -> None:
        """Stop and disconnect."""
        with contextlib.suppress(DeviceFault):
            self.stop()
        if self._receive is not None:
            with contextlib.suppress(RuntimeError):
                self._receive.disconnect()
            self._receive = None

    def _check(self) -> None:
        """Raise DeviceFault unless the arm is connected, powered and not stopped by its safety functions."""
        if self._receive is None:
            raise DeviceFault(f"the arm at {self._arm.address} is not connected")
        with self._faults("does not answer"):
            connected, stamp = self._receive.isConnected(), self._receive.getTimestamp()
            protective, emergency = self._receive.isProtectiveStopped(), self._receive.isEmergencyStopped()
            mode = self._receive.getRobotMode()
        now = self._clock()
        if stamp != self._news[0]:
            self._news = (stamp, now)
        # A pulled cable leaves the socket open: the controller's clock then stands still.
        if not connected or now - self._news[1] > STALE:
            raise DeviceFault(f"the connection to the arm at {self._arm.address} is lost")
        if emergency or protective:
            kind = "an emergency" if emergency else "a protective"
            raise DeviceFault(f"the arm at {self._arm.address} is in {kind} stop; release it at the pendant")
        if mode != RUNNING:
            raise DeviceFault(
                f"the arm at {self._arm.address} is in robot mode {mode}; it must be {RUNNING} (running)"
            )

    def _check_start(self, start: Array) -> None:
        try:
            held = joints(self._arm, tilt(self._arm, start[None]), start)[0]
        except HardwareError as error:
            raise DeviceFault(f"the arm stands where it cannot begin: {error}") from error
        off, away = np.abs(held - start).max(), insertion_error(self._arm, start[None])[0]
        if off > START_TOLERANCE:
            raise DeviceFault(
                f"the arm holds the robot {away:.3g} mm from the insertion point, its joints up to "
                f"{math.degrees(off):.3g} deg off; move it to within {math.degrees(START_TOLERANCE):.3g} deg of "
                f"({', '.join(f'{value:.4g}' for value in np.degrees(held))}) deg"
            )

    @contextlib.contextmanager
    def _faults(self, what: str) -> Iterator[None]:
        """What ur_rtde raises, as DeviceFault."""
        try:
            yield
        except (RuntimeError, ValueError, OSError) as error:
            remote = " Switch it to remote control at the pendant." if "remote control" in str(error) else ""
            raise DeviceFault(f"the arm at {self._arm.address} {what}: {error}.{remote}") from error
