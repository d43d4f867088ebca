"""A device without hardware: its axes are exactly where they should be, when they should."""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.devices import Asked, MotionProgress, Standing
from ctr_nlp.hardware.motion.lookahead import MAX_MOTION_IN_HAND_S, Commands
from ctr_nlp.typing import Array

SIMULATED_HOLD_TIME_S = 0.1
"""s in which a hold takes its pace to nothing, and resuming back."""


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
        """Nothing is opened."""
        self._open = True

    @property
    def identity(self) -> str:
        """There is nothing that could be told from another."""
        return ""

    def standing(self) -> Standing:
        """Where the axes are; their position is always known."""
        return Standing(self._position, homed=True)

    @property
    def resolution(self) -> Array:
        """The digits of a number."""
        return np.full(len(self._position), 1e-6)

    def home(self, stop: Asked) -> None:
        """Nothing needs to be found."""

    def start(self, commands: Commands) -> Simulated:
        """Begin to play commands from where it stands."""
        self._check_open()
        self._ends = np.append(0.0, commands.time)
        self._path = np.vstack([self._position, commands.positions])
        self._time, self._pace, self._goal, self._seen = 0.0, 1.0, 1.0, self._clock.now()
        return self

    def update(self) -> MotionProgress:
        """Move on by the time that has passed."""
        self._check_open()
        now = self._clock.now()
        passed = now - self._seen
        self._seen = now
        change = float(
            np.clip(self._goal - self._pace, -passed / SIMULATED_HOLD_TIME_S, passed / SIMULATED_HOLD_TIME_S)
        )
        turning = abs(change) * SIMULATED_HOLD_TIME_S
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
        """It has been given everything."""

    @property
    def committed_time(self) -> float:
        """As far ahead as a controller has motion in hand."""
        return self._time + MAX_MOTION_IN_HAND_S

    def amend(self, commands: Commands) -> None:
        """Follow other commands from there."""
        self._path = np.vstack([self._path[:1], commands.positions])

    def hold(self) -> None:
        """Slow down."""
        self.update()
        self._goal = 0.0

    def resume(self) -> None:
        """Go on."""
        self.update()
        self._goal = 1.0

    def abort(self) -> Standing:
        """Slow down, and forget the rest."""
        if self._open:
            self.hold()
        while self._open and self.update().state == "holding":
            self._clock.sleep(0.01)
        self._ends = np.zeros(1)
        self._path = self._position[None]
        return self.standing()

    def close(self) -> None:
        """Nothing was opened."""
        self._open = False

    def _check_open(self) -> None:
        if not self._open:
            raise DeviceFault("the simulated device is not connected")
