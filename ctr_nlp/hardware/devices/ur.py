"""A Universal Robots arm that tilts the robot, over the real-time data exchange (RTDE)."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.arm.kinematics import insertion_error, inverse_kinematics, tilt_of_joints
from ctr_nlp.hardware.devices.arms import ArmFollower, Now
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

STALE = 0.2
"""s without a new time stamp from the controller after which the connection counts as broken."""
START_TOLERANCE = 0.02
"""rad by which joints may differ from those that hold the insertion point when an arm is connected."""
RUNNING = 7
"""The robot mode of a UR that is powered, with its brakes released."""
SERVO = (0.02, 0.05, 500.0)
"""servoj's t, lookahead_time and gain: the s between commands, over which the controller interpolates; s by about
which the arm is behind, 0.03 to 0.2; and how stiffly it follows, 100 to 2000."""


class UrArm(ArmFollower):
    """A Universal Robots arm over RTDE, by ur_rtde's servoJ. Not yet tried on a robot.

    Where commands stop, the controller holds the last one. The speed slider of the pendant must be at 100 %:
    servoj gets slower with it.
    """

    def __init__(self, arm: Arm, clock: Now = time.monotonic) -> None:
        super().__init__(arm, clock)
        self._receive: Any = None
        self._control: Any = None
        self._news = (math.nan, 0.0)

    def connect(self) -> None:
        """Check that the arm is ready and holds the insertion point, then start the control program on it."""
        receiving = import_extra("rtde_receive")
        controlling = import_extra("rtde_control")
        try:
            with self._faults("cannot be reached"):
                # Only receiving, at first: the control interface starts a program on the arm, which must not
                # happen before the arm has passed its check.
                self._receive = receiving.RTDEReceiveInterface(self._arm.address)
            self._news = (math.nan, self._clock())
            start = self.joints()
            self._check_start(start)
            with self._faults("does not take commands"):
                self._control = controlling.RTDEControlInterface(self._arm.address)
        except DeviceFault:
            self.close()
            raise
        self._last = start, self._clock()

    def _read_joints(self) -> Array:
        with self._faults("does not answer"):
            return np.array(self._receive.getActualQ(), dtype=float)

    def _send(self, wanted: Array) -> None:
        with self._faults("does not take commands"):
            # servoJ has arguments for speed and acceleration and does not use them.
            taken = self._control.servoJ(wanted.tolist(), 0.5, 0.5, *SERVO)
        if not taken:
            raise DeviceFault(
                f"the arm at {self._arm.address} refused a position: its control program is not running; "
                "was it stopped at the pendant?"
            )

    def _halt(self) -> None:
        with self._faults("did not take the order to hold"):
            self._control.servoStop()

    def stop(self) -> None:
        """Slow down and end the control program; raises DeviceFault where the arm cannot be reached."""
        control = self._control
        self._control = None
        self._last = None
        if control is None:
            return
        try:
            with self._faults("did not take the order to stop; use the emergency stop"):
                try:
                    control.servoStop()
                finally:
                    control.stopScript()
        finally:
            with contextlib.suppress(RuntimeError):
                control.disconnect()

    def close(self) -> None:
        """Stop and disconnect; raises nothing."""
        with contextlib.suppress(DeviceFault):
            self.stop()
        if self._receive is not None:
            with contextlib.suppress(RuntimeError):
                self._receive.disconnect()
            self._receive = None

    def _look(self) -> None:
        """Raise DeviceFault unless the arm is connected, powered and not stopped by its safety functions."""
        if self._receive is None:
            raise DeviceFault(f"the arm at {self._arm.address} is not connected")
        with self._faults("does not answer"):
            connected = self._receive.isConnected()
            stamp = self._receive.getTimestamp()
            protective = self._receive.isProtectiveStopped()
            emergency = self._receive.isEmergencyStopped()
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
        """Raise DeviceFault unless joints (6,) rad, start, hold the robot at the insertion point."""
        try:
            held = inverse_kinematics(self._arm, tilt_of_joints(self._arm, start[None]), start)[0]
        except HardwareError as exception:
            raise DeviceFault(f"the arm stands where it cannot begin: {exception}") from exception
        off = np.abs(held - start).max()
        away = insertion_error(self._arm, start[None])[0]
        if off > START_TOLERANCE:
            raise DeviceFault(
                f"the arm holds the robot {away:.3g} mm from the insertion point, its joints up to "
                f"{math.degrees(off):.3g} deg off; move it to within {math.degrees(START_TOLERANCE):.3g} deg of "
                f"({', '.join(f'{value:.4g}' for value in np.degrees(held))}) deg"
            )

    @contextlib.contextmanager
    def _faults(self, what: str) -> Iterator[None]:
        """Raise the errors of ur_rtde within the block as DeviceFault; what: the rest of the sentence."""
        try:
            yield
        except (RuntimeError, ValueError, OSError) as exception:
            remote = " Switch it to remote control at the pendant." if "remote control" in str(exception) else ""
            raise DeviceFault(f"the arm at {self._arm.address} {what}: {exception}.{remote}") from exception
