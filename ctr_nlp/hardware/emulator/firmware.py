"""The firmware itself: bytes in, bytes out, and time that is let pass; no threads, sockets or clock of its own.

It answers as the 6-axis grblHAL of a recorded session does, oddities included: feed hold stops the reading of
lines, an error is repeated for G-code until a blank line, and a reset in motion has three possible endings.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.hardware.emulator.mechanics import homing
from ctr_nlp.hardware.emulator.mechanics.limp import pushed
from ctr_nlp.hardware.emulator.mechanics.motion import Motion
from ctr_nlp.hardware.emulator.mechanics.overrides import Overrides
from ctr_nlp.hardware.emulator.mechanics.planner import Vector
from ctr_nlp.hardware.emulator.protocol import realtime, stops
from ctr_nlp.hardware.emulator.protocol.answers import answer
from ctr_nlp.hardware.emulator.protocol.gcode import Modal
from ctr_nlp.hardware.emulator.protocol.lines import Lines
from ctr_nlp.hardware.emulator.protocol.reports import BUTTONS, Status
from ctr_nlp.hardware.emulator.protocol.settings import Settings

SLICE_S = 0.01
"""How often lines that wait for room are tried again; the planner makes room a block at a time."""


class Firmware:
    """A controller that has just been switched on.

    settings: changes to those of a configured machine, by number. homed: start homed, at the pull-off.
    """

    def __init__(self, settings: Mapping[int, float] | None = None, homed: bool = False) -> None:
        self.settings: Settings = Settings(settings)
        self.motion = Motion(self.settings.limits)
        self.state = "Idle"
        """Idle, Run, Hold, Jog, Alarm, Home or Check."""
        self.time = 0.0
        """Seconds since it was switched on."""
        self.bytes_received = 0
        self.bytes_lost = 0
        """Bytes that came when the receive buffer was full."""
        self.homed: set[int] = set()
        """Axes, by index, that know where they are."""
        self.slip = np.zeros(6)
        """(6,) where the mechanics are minus where the firmware thinks they are, mm and deg."""
        self.on_reset = "both"
        """How a reset in motion ends; with the real one each way was seen: "both" drops the plan, with ALARM:3 and
        the banner; "alarm" sends ALARM:3 alone and carries on once unlocked; "banner" gives no alarm."""
        self.estop_alarms = False
        """Whether the emergency stop raises ALARM:10, as on a board; the recorded firmware only shows its pin."""
        self.refuse: int | None = None
        """An error number with which the next line is refused."""
        self.pressed: set[str] = set()
        self.lines = Lines()
        self.modal: Modal = Modal()
        self.pending: Callable[[], bool] | None = None
        """What is left to do for the last line, tried until it says True; the next line waits for it."""
        self.error: int | None = None
        """The error number that is repeated for G-code."""
        self.critical = False
        """Whether an alarm was raised that only a reset ends."""
        self.when_stopped: Callable[[], None] | None = None
        """What is done at the next standstill; until then no line is read."""
        self.homing: deque[homing.Move] = deque()
        """What is left of the homing cycle."""
        self.timers: list[tuple[float, Callable[[], None]]] = []
        """When something is done, and what, soonest first."""
        self.status = Status()
        self.report_due = False
        """Whether a report was asked for during homing."""
        self._still = math.inf
        """Seconds since motors last turned."""
        self._sent = bytearray()
        self._stalled_until = self._silent_until = 0.0
        self._deferred: deque[int] = deque()
        if homed:
            self.settings[22] = 1
            homing.place_at_pull_off(self)

    @property
    def position(self) -> npt.NDArray[np.float64]:
        """(6,) machine position in mm and deg, to whole steps, as the firmware reports it."""
        steps = np.array(self.settings.axes(100))
        return np.asarray(np.round(np.array(self.motion.position) * steps) / steps)

    @property
    def executed(self) -> list[tuple[int | None, Vector]]:
        """(line number or None, target (6,)) of each block, in the order in which they were finished."""
        return self.motion.finished

    @property
    def extremes(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Lowest and highest position that each axis has ever had, (6,) each."""
        return np.array(self.motion.lowest), np.array(self.motion.highest)

    @property
    def moving(self) -> bool:
        """Whether motors turn."""
        return (self.motion.running and self.state != "Alarm") or self.state == "Home"

    @property
    def backlog(self) -> int:
        """Bytes received that no answer was given to yet."""
        return self.lines.waiting + self.lines.begun + bool(self.pending)

    def take(self) -> bytes:
        """What it has sent since this was last called."""
        sent = bytes(self._sent)
        self._sent.clear()
        return sent

    def receive(self, data: bytes) -> None:
        """Bytes arrive now. Realtime characters act at once; those beyond a full buffer are lost."""
        self.bytes_received += len(data)
        for byte in data:
            if realtime.is_realtime(byte):
                if self.time < self._stalled_until:
                    self._deferred.append(byte)
                else:
                    realtime.act(self, byte)
            else:
                self.bytes_lost += not self.lines.put(byte)
            if byte == 0x0A:
                self._work()
        self._work()

    def advance(self, seconds: float) -> None:
        """Let time pass, in s."""
        end = self.time + seconds
        while self.time < end - 1e-12:
            if self.time < self._stalled_until:
                self.time = min(end, self._stalled_until)
                if self.time >= self._stalled_until:
                    while self._deferred:
                        realtime.act(self, self._deferred.popleft())
                    self._work()
                continue
            step = end - self.time
            if self.timers:
                step = min(step, max(self.timers[0][0] - self.time, 0.0))
            if self.pending or self.lines.waiting or self.when_stopped:
                step = min(step, SLICE_S)
            if self.state == "Home":
                homing.advance(self, step)
            elif self.state in ("Run", "Jog", "Hold"):
                self.motion.advance(step)
            self.time += step
            self._rest(step)
            while self.timers and self.timers[0][0] <= self.time + 1e-12:
                self.timers.pop(0)[1]()
            self._settled()
            self._work()

    def press(self, button: str) -> None:
        """Push a button and keep it down: estop, reset or limit_x .. limit_c."""
        self._known(button)
        self.pressed.add(button)
        if button == "reset":
            stops.reset(self)
        elif button == "estop" and self.estop_alarms:
            stops.alarm(self, stops.ESTOP)
        elif button.startswith("limit") and self.settings[21] and self.state != "Home":
            self.hard_limit()

    def release(self, button: str) -> None:
        """Let a button go."""
        self._known(button)
        self.pressed.discard(button)

    @staticmethod
    def _known(button: str) -> None:
        if button not in BUTTONS:
            raise OptionError(f"no button {button!r}; there are {', '.join(BUTTONS)}")

    def hard_limit(self) -> None:
        """A limit switch is met in motion: ALARM:1, everything stops where it is."""
        stops.alarm(self, stops.HARD_LIMIT)

    def stall(self, seconds: float) -> None:
        """Do nothing at all for so many seconds: no motion, no reading of lines, no replies."""
        self._stalled_until = max(self._stalled_until, self.time + seconds)

    def silence(self, seconds: float) -> None:
        """Go on, but let nothing out for so many seconds."""
        self._silent_until = max(self._silent_until, self.time + seconds)

    def reboot(self, loses_position: bool = False) -> None:
        """Power fails for a moment: motion stops at once, buffers are empty, the banner is sent."""
        if loses_position:
            self.slip = self.slip + np.array(self.motion.position)
            self.motion.place((0.0,) * 6)
            self.homed.clear()
        stops.restart(self, locked=False)

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
        shown = self.state
        if shown == "Hold":
            shown = "Hold:0" if self.motion.halted else "Hold:1"
        feed = 0.0 if self.state == "Alarm" else self.motion.speed * 60
        buffers, homed = (self.motion.free, self.lines.free), bool(self.homed)
        self.say(
            self.status.report(
                shown, self.position, buffers, self.motion.line, feed, self.motion.overrides, self.pressed, homed
            )
        )

    def override(self, overrides: Overrides) -> None:
        """Move faster or slower than programmed from now on; the next report says so."""
        if overrides != self.motion.overrides:
            self.motion.override(overrides)
            self.status.overridden = True

    def forget_lines(self) -> None:
        """Drop what was received and not read, the line that has begun, and the error that is repeated."""
        self.lines.clear()
        self.error = None

    def carry_on(self) -> None:
        """Do what a change of state has made possible."""
        self._settled()
        self._work()

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something after so many seconds."""
        self.timers.append((self.time + seconds, action))
        self.timers.sort(key=lambda timer: timer[0])

    def _rest(self, seconds: float) -> None:
        before, self._still = self._still, 0.0 if self.moving else self._still + seconds
        self.slip = self.slip + pushed(self.settings, before, self._still)

    def _settled(self) -> None:
        """Change state where motion has come to its end."""
        if self.motion.running:
            return
        if self.when_stopped is not None:
            action, self.when_stopped = self.when_stopped, None
            action()
        elif self.state in ("Run", "Jog") and not self.motion.blocks:
            self.state = "Idle"

    def _work(self) -> None:
        """Obey lines of the receive buffer as long as nothing stands in the way."""
        while not self._blocked():
            if self.pending:
                attempt = self.pending
                if not attempt():
                    break
                self.pending = None
                continue
            text = self.lines.take()
            if text is None:
                break
            answer(self, text)
        if self.state in ("Idle", "Run", "Jog") and self.motion.blocks and self.when_stopped is None:
            if self.state == "Idle":
                self.state = "Jog" if self.motion.blocks[0].jog else "Run"
            self.motion.start()

    def _blocked(self) -> bool:
        return self.state in ("Hold", "Home") or self.time < self._stalled_until or self.when_stopped is not None
