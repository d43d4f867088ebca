"""What the controller knows and says: the lowest layer of the firmware, which neither moves nor obeys."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ctr_nlp.typing import Array
from emulator.gcode import Modal, ReceiveBuffer
from emulator.motion import EmulatedMotors
from emulator.planner import Overrides, Vector
from emulator.reports import ControllerSettings, Status


class HomingMove(NamedTuple):
    """One axis, by index, goes to a place (mm or deg); seconds: how long that still takes, pauses included."""

    axis: int
    place: float
    seconds: float


class Controller:
    """A controller that has just been switched on.

    settings: changes to those of a configured machine, by number.
    """

    def __init__(self, settings: Mapping[int, float] | None = None) -> None:
        self.settings = ControllerSettings(settings)
        self.motion = EmulatedMotors(self.settings.limits)
        self.state = "Idle"
        """Idle, Run, Hold, Jog, Alarm, Home or Check."""
        self.time = 0.0
        """Seconds since it was switched on."""
        self.homed: set[int] = set()
        """Axes, by index, that know where they are."""
        self.slip = np.zeros(6)
        """(6,) where the mechanics are minus where the firmware thinks they are, mm and deg."""
        self.on_reset = "both"
        """How a reset in motion ends; all three were seen with the real one: "both" drops the plan, with ALARM:3
        and the banner; "alarm" sends ALARM:3 alone and carries on once unlocked; "banner" gives no alarm."""
        self.pressed: set[str] = set()
        self.lines = ReceiveBuffer()
        self.modal = Modal()
        self.pending: Callable[[], bool] | None = None
        """What is left to do for the last line, tried until it says True; the next line waits for it."""
        self.error: int | None = None
        """The error number that is repeated for G-code."""
        self.critical = False
        """Whether an alarm was raised that only a reset ends."""
        self.when_stopped: Callable[[], None] | None = None
        """What is done at the next standstill; until then no line is read."""
        self.homing: deque[HomingMove] = deque()
        """What is left of the homing cycle."""
        self.timers: list[tuple[float, Callable[[], None]]] = []
        """When something is done, and what, soonest first."""
        self.status = Status()
        self.report_due = False
        """Whether a report was asked for during homing."""
        self.still = math.inf
        """Seconds since motors last turned."""
        self._sent = bytearray()
        self._silent_until = 0.0

    @property
    def position(self) -> Array:
        """(6,) machine position in mm and deg, to whole steps, as the firmware reports it."""
        steps = np.array(self.settings.axes(100))
        return np.asarray(np.round(np.array(self.motion.position) * steps) / steps)

    @property
    def executed_blocks(self) -> list[tuple[int | None, Vector]]:
        """(line number or None, target (6,)) of each block, in the order in which they were finished."""
        return self.motion.finished

    @property
    def extremes(self) -> tuple[Array, Array]:
        """Lowest and highest position that each axis has ever had, (6,) each."""
        return np.array(self.motion.lowest), np.array(self.motion.highest)

    @property
    def moving(self) -> bool:
        """Whether motors turn."""
        return (self.motion.running and self.state != "Alarm") or self.state == "Home"

    @property
    def backlog(self) -> int:
        """Bytes received that no answer was given to yet."""
        return self.lines.waiting + self.lines.unfinished_bytes + bool(self.pending)

    def take(self) -> bytes:
        """What it has sent since this was last called."""
        sent = bytes(self._sent)
        self._sent.clear()
        return sent

    def silence(self, seconds: float) -> None:
        """Go on, but let nothing out for so many seconds."""
        self._silent_until = max(self._silent_until, self.time + seconds)

    def say(self, text: str) -> None:
        """Send a line."""
        if self.time >= self._silent_until:
            self._sent += text.encode() + b"\r\n"

    def ok(self) -> None:
        """Answer that a line was accepted."""
        self.error = None
        self.say("ok")

    def report(self) -> None:
        """Send a status report."""
        state = f"Hold:{not self.motion.is_halted:d}" if self.state == "Hold" else self.state
        feed = 0.0 if self.state == "Alarm" else self.motion.speed * 60
        buffers, homed = (self.motion.free, self.lines.free), bool(self.homed)
        line, overrides = self.motion.line, self.motion.overrides
        self.say(self.status.report(state, self.position, buffers, line, feed, overrides, self.pressed, homed))

    def override(self, overrides: Overrides) -> None:
        """Move faster or slower than programmed from now on; the next report says so."""
        if overrides != self.motion.overrides:
            self.motion.override(overrides)
            self.status.tell("overrides")

    def forget_lines(self) -> None:
        """Drop what was received and not read, the line that has begun, and the error that is repeated."""
        self.lines.clear()
        self.error = None

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after so many seconds."""
        self.timers.append((self.time + seconds, action))
        self.timers.sort(key=lambda timer: timer[0])
