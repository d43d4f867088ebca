"""A device without hardware, whose axes are exactly where they should be."""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.devices import Asked, MotionProgress, Standing
from ctr_nlp.hardware.motion.lookahead import MAX_MOTION_IN_HAND_S, Commands
from ctr_nlp.typing import Array

SIMULATED_HOLD_TIME_S = 0.1
"""s in which a hold lowers the pace from 1 to 0, and a resume raises it again."""


class Simulated:
    """Axes that follow commands in straight lines; position (m,): where they stand at first, in their units."""

    def __init__(self, position: Array, clock: Clock) -> None:
        self._clock = clock
        self._position = np.array(position, dtype=float)
        self._ends = np.zeros(1)
        self._path = self._position[None]
        self._time = self._pace = self._goal = self._seen = 0.0
        self._open = False

    def connect(self, stop: Asked = lambda: False) -> None:
        """Connect; nothing is opened, and stop is not called."""
        self._open = True

    @property
    def identity(self) -> str:
        """Empty, since nothing distinguishes one simulated device from another."""
        return ""

    def standing(self) -> Standing:
        """Return where the axes are; their position is always known."""
        return Standing(self._position, homed=True)

    @property
    def resolution(self) -> Array:
        """1e-6 for every axis (m,), in its unit, for rounding."""
        return np.full(len(self._position), 1e-6)

    def home(self, stop: Asked) -> None:
        """Do nothing, since the position is known; stop is not called."""

    def start(self, commands: Commands) -> Simulated:
        """Begin to play commands from where the axes stand."""
        self._check_open()
        self._ends = np.append(0.0, commands.time)
        self._path = np.vstack([self._position, commands.positions])
        self._time, self._pace, self._goal, self._seen = 0.0, 1.0, 1.0, self._clock.now()
        return self

    def update(self) -> MotionProgress:
        """Advance by the time that has passed."""
        self._check_open()
        now = self._clock.now()
        passed = now - self._seen
        self._seen = now
        change = float(
            np.clip(self._goal - self._pace, -passed / SIMULATED_HOLD_TIME_S, passed / SIMULATED_HOLD_TIME_S)
        )
        turning = abs(change) * SIMULATED_HOLD_TIME_S
        # The pace ds/dt changes linearly for `turning` s, which passes the mean of both paces, and is constant for
        # the rest.
        self._time += turning * (self._pace + 0.5 * change) + (passed - turning) * (self._pace + change)
        self._pace += change
        self._time = min(self._time, float(self._ends[-1]))
        self._position = np.array([np.interp(self._time, self._ends, axis) for axis in self._path.T])
        return MotionProgress(self._state(), self._time, self._position, now, 0.0)

    def _state(self) -> str:
        if self._time >= self._ends[-1]:
            return "done"
        if self._goal == 0.0:
            return "held" if self._pace == 0.0 else "holding"
        return "running"

    def feed(self) -> None:
        """Do nothing, since all commands are there."""

    @property
    def committed_time(self) -> float:
        """Time of the motion, s, that a controller would have been given: MAX_MOTION_IN_HAND_S ahead."""
        return self._time + MAX_MOTION_IN_HAND_S

    def amend(self, commands: Commands) -> None:
        """Follow other commands from now on."""
        self._path = np.vstack([self._path[:1], commands.positions])

    def hold(self) -> None:
        """Slow down to rest."""
        self.update()
        self._goal = 0.0

    def resume(self) -> None:
        """Continue after a hold."""
        self.update()
        self._goal = 1.0

    def abort(self) -> Standing:
        """Slow down to rest, and forget the remaining commands."""
        if self._open:
            self.hold()
        while self._open and self.update().state == "holding":
            self._clock.sleep(0.01)
        self._ends = np.zeros(1)
        self._path = self._position[None]
        return self.standing()

    def close(self) -> None:
        """Disconnect; nothing was opened."""
        self._open = False

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceFault("the simulated device is not connected")
