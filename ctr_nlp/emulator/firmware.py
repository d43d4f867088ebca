"""The firmware itself: bytes in, bytes out, and time that is let pass; no threads, sockets or clock of its own.

It answers as the 6-axis grblHAL of a recorded session does, oddities included: feed hold stops the reading of
lines, an error is repeated for G-code until a blank line, and a reset in motion has three possible endings.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ctr_nlp.emulator.gcode import Line, Modal, Refused, read
from ctr_nlp.emulator.motion import Motion, Vector
from ctr_nlp.emulator.reports import BANNER, BUTTONS, HELP, UNLOCK, VERSION, Status, modes, offsets
from ctr_nlp.emulator.settings import Settings
from ctr_nlp.errors import OptionError

RX_BYTES = 1023
LONGEST_LINE = 256
ALARM_PAUSE_S = 0.1
SLICE_S = 0.01
"""How often lines that wait for room are tried again; the planner makes room a block at a time."""
NOT_UNDERSTOOD, HOMING_OFF, NOT_IDLE, LOCKED, TOO_LONG, TRAVEL, CRITICAL = 3, 5, 8, 9, 14, 15, 79


class Firmware:
    """A controller that has just been switched on.

    settings: changes to those of a configured machine, by number. homed: start homed, at the pull-off.
    """

    def __init__(self, settings: Mapping[int, float] | None = None, homed: bool = False) -> None:
        self.settings = Settings(settings)
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
        self.modal = Modal()
        self.pressed: set[str] = set()
        self._rx: deque[int] = deque()
        self._line = bytearray()
        self._sent = bytearray()
        self._pending: Callable[[], bool] | None = None
        self._timers: list[tuple[float, Callable[[], None]]] = []
        self._stalled_until = self._silent_until = 0.0
        self._deferred: deque[int] = deque()
        self._error: int | None = None
        self._critical = False
        self._when_stopped: Callable[[], None] | None = None
        self._homing: deque[tuple[int, float, float]] = deque()
        self._after_return = False
        self._status = Status()
        self._report_due = False
        if homed:
            self.settings[22] = 1
            axes = self._homing_axes()
            self._homed_at_pull_off(axes)

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
        return len(self._rx) + len(self._line) + bool(self._pending)

    def take(self) -> bytes:
        """What it has sent since this was last called."""
        sent = bytes(self._sent)
        self._sent.clear()
        return sent

    def receive(self, data: bytes) -> None:
        """Bytes arrive now. Realtime characters act at once; those beyond a full buffer are lost."""
        self.bytes_received += len(data)
        for byte in data:
            if byte in b"?!~\x18" or byte >= 0x80:
                if self.time < self._stalled_until:
                    self._deferred.append(byte)
                else:
                    self._realtime(byte)
            elif len(self._rx) < RX_BYTES:
                self._rx.append(byte)
            else:
                self.bytes_lost += 1
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
                        self._realtime(self._deferred.popleft())
                    self._work()
                continue
            step = end - self.time
            if self._timers:
                step = min(step, max(self._timers[0][0] - self.time, 0.0))
            if self._pending or self._rx or self._when_stopped:
                step = min(step, SLICE_S)
            if self.state == "Home":
                self._home(step)
            elif self.state in ("Run", "Jog", "Hold"):
                self.motion.advance(step)
            self.time += step
            while self._timers and self._timers[0][0] <= self.time + 1e-12:
                self._timers.pop(0)[1]()
            self._settled()
            self._work()

    def press(self, button: str) -> None:
        """Push a button and keep it down: estop, reset or limit_x .. limit_c."""
        self._known(button)
        self.pressed.add(button)
        if button == "reset":
            self._reset()
        elif button == "estop" and self.estop_alarms:
            self._stop_dead(10)
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
        self._stop_dead(1)

    def soft_limit(self) -> None:
        """A target lies outside: come to a standstill, then ALARM:2."""
        if self.motion.running:
            self.state = "Hold"
            self.motion.hold()
            self._when_stopped = lambda: self._stop_dead(2)
        else:
            self._stop_dead(2)

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
        self._restart(locked=False)

    def _say(self, text: str) -> None:
        if self.time >= self._silent_until:
            self._sent += text.encode() + b"\r\n"

    def _ok(self) -> None:
        self._error = None
        self._say("ok")

    def _fail(self, refusal: Refused) -> None:
        self._error = refusal.number
        self._say(f"error:{refusal.number}")

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        self._timers.append((self.time + seconds, action))
        self._timers.sort(key=lambda timer: timer[0])

    def _realtime(self, byte: int) -> None:
        if byte == ord("?"):
            if self.state == "Home":
                self._report_due = True
            else:
                self._report()
        elif byte == ord("!"):
            self._hold()
        elif byte == ord("~") and self.state == "Hold" and self._when_stopped is None:
            self._say("[MSG:]")
            self.state = "Run"
            self.motion.resume()
            self._settled()
            self._work()
        elif byte == 0x18:
            self._reset()
        elif byte == 0x85 and self.state == "Jog":
            self._cancel_jog()

    def _hold(self) -> None:
        if self.state == "Jog":
            self._cancel_jog()
        elif self.state in ("Idle", "Run"):
            self.state = "Hold"
            self.motion.hold()

    def _cancel_jog(self) -> None:
        def over() -> None:
            self.motion.flush()
            self.state = "Idle"

        self._when_stopped = over
        self.motion.hold()

    def _reset(self) -> None:
        in_motion = self.moving
        if self.state == "Home":
            self._say("ALARM:6")
        elif in_motion and self.on_reset != "banner":
            self._say("ALARM:3")
        elif in_motion or self.state != "Alarm":
            self._restart(locked=False)
            return
        else:
            self._restart(locked=True)
            return
        homing = self.state == "Home"
        self.state = "Alarm"
        self._homing.clear()
        self._forget_lines()
        if self.on_reset == "alarm" and not homing:
            self.motion.freeze()
        else:
            self.motion.flush()
            self._later(ALARM_PAUSE_S, lambda: self._restart(locked=True))

    def _forget_lines(self) -> None:
        self._rx.clear()
        self._line.clear()
        self._pending = self._when_stopped = self._error = None

    def _restart(self, locked: bool) -> None:
        self._forget_lines()
        self._timers.clear()
        self._homing.clear()
        self.motion.flush()
        self.motion.line = None
        self.modal = Modal()
        self._critical = False
        self.state = "Alarm" if locked else "Idle"
        self._say(BANNER)
        if locked:
            self._say(UNLOCK)
        self._status = Status()
        self._report_due = False

    def _stop_dead(self, alarm: int) -> None:
        self.motion.freeze()
        self._homing.clear()
        self._when_stopped = self._pending = None
        self._timers.clear()
        self.state = "Alarm"
        self._critical = True
        self._status.accessories = True
        self._say(f"ALARM:{alarm}")
        self._later(ALARM_PAUSE_S, lambda: self._say("[MSG:Reset to continue]"))

    def _settled(self) -> None:
        """Change state where motion has come to its end."""
        if self.motion.running:
            return
        if self._when_stopped is not None:
            action, self._when_stopped = self._when_stopped, None
            action()
        elif self.state in ("Run", "Jog") and not self.motion.blocks:
            self.state = "Idle"

    def _work(self) -> None:
        """Take lines out of the receive buffer as long as nothing stands in the way."""
        while not self._blocked():
            if self._pending:
                attempt = self._pending
                if not attempt():
                    break
                self._pending = None
                continue
            if not self._rx:
                break
            byte = self._rx.popleft()
            after_return, self._after_return = self._after_return, byte == 0x0D
            if byte == 0x0A and after_return:
                continue
            if byte not in (0x0A, 0x0D):
                self._line.append(byte)
                continue
            text = self._line.decode("ascii", "replace").strip()
            self._line.clear()
            self._obey(text)
        if self.state in ("Idle", "Run", "Jog") and self.motion.blocks and self._when_stopped is None:
            if self.state == "Idle":
                self.state = "Jog" if self.motion.blocks[0].jog else "Run"
            self.motion.start()

    def _blocked(self) -> bool:
        return self.state in ("Hold", "Home") or self.time < self._stalled_until or self._when_stopped is not None

    def _obey(self, text: str) -> None:
        try:
            if self.refuse is not None and text:
                number, self.refuse = self.refuse, None
                raise Refused(number)
            if not text:
                self._ok()
            elif len(text) > LONGEST_LINE:
                raise Refused(TOO_LONG)
            elif text.startswith("$"):
                self._command(text[1:].strip())
            else:
                self._gcode(text)
        except Refused as refusal:
            self._fail(refusal)

    def _command(self, text: str) -> None:
        upper = text.upper()
        if self._critical and upper not in ("I", "G", "#", "N", "$", ""):
            raise Refused(CRITICAL)
        if upper.startswith("J="):
            self._jog(text[2:])
            return
        if upper == "H":
            self._start_homing()
            return
        head, equals, _ = text.partition("=")
        if equals:
            if not head.strip().isdigit():
                raise Refused(NOT_UNDERSTOOD)
            self._idle_or(NOT_IDLE)
            number = self.settings.change(text, bool(self.settings[22]))
            self.motion.limits = self.settings.limits
            if 100 <= number < 110:
                self._status.homed = True
            if number == 22 and not self.settings[22]:
                self.settings[20] = 0
        elif upper == "$":
            self._idle_or(NOT_IDLE)
            for number in sorted(self.settings):
                self._say(self.settings.shown(number))
        elif head.isdigit():
            if int(head) not in self.settings:
                raise Refused(NOT_UNDERSTOOD)
            self._say(self.settings.shown(int(head)))
        elif upper == "X":
            self._unlock()
            return
        elif upper == "C":
            self._check()
            return
        elif upper in QUERIES:
            for line in QUERIES[upper](self):
                self._say(line)
        else:
            raise Refused(NOT_UNDERSTOOD)
        self._ok()

    def _idle_or(self, number: int) -> None:
        if self.state not in ("Idle", "Alarm"):
            raise Refused(number)

    def _unlock(self) -> None:
        if self.state == "Alarm":
            self.state = "Idle"
            self._say("[MSG:Caution: Unlocked]")
        self._ok()

    def _check(self) -> None:
        if self.state == "Check":
            self._say("[MSG:Disabled]")
            self._ok()
            self._restart(locked=False)
        elif self.state == "Idle":
            self.state = "Check"
            self._say("[MSG:Enabled]")
            self._ok()
        else:
            raise Refused(NOT_IDLE)

    def _jog(self, text: str) -> None:
        if self.state not in ("Idle", "Jog"):
            raise Refused(NOT_IDLE)
        line = read(text, self.modal, jog=True)
        target = self._target(line)
        if self._outside(target):
            raise Refused(TRAVEL)
        self._pending = lambda: self._planned(line, target, jog=True)

    def _gcode(self, text: str) -> None:
        if self.state in ("Alarm", "Jog"):
            raise Refused(LOCKED)
        if self._error is not None:
            raise Refused(self._error)
        line = read(text, self.modal)
        target = self._target(line)
        if self.state == "Check":
            self.modal = line.modal
            self._ok()
        elif self._outside(target):
            self.soft_limit()
        elif line.dwell or line.ends:
            self._pending = lambda: self._waited(line)
        else:
            self._pending = lambda: self._planned(line, target)

    def _target(self, line: Line) -> Vector:
        start = self.motion.target
        at = list(start)
        for i, value in line.axes.items():
            at[i] = value if line.modal.absolute else start[i] + value
        return tuple(at)

    def _outside(self, target: Vector) -> bool:
        if not self.settings[20]:
            return False
        return any(not -self.settings[130 + i] <= target[i] <= 0 for i in self.homed)

    def _planned(self, line: Line, target: Vector, jog: bool = False) -> bool:
        """Put a line into the planner; False where there is no room yet. `ok` means planned, not done."""
        if line.axes and not self.motion.free:
            return False
        feed = line.modal.feed
        if line.axes:
            if line.modal.motion == 0:
                speed = float("inf")
            elif line.modal.inverse_time:
                start = self.motion.target
                speed = feed / 60 * float(np.linalg.norm(np.subtract(target, start)))
            else:
                speed = feed / 60
            self.motion.plan(target, speed, line.number or None, jog)
        if not jog:
            self.modal = line.modal
        self._ok()
        return True

    def _waited(self, line: Line) -> bool:
        """A dwell or the program's end waits for all motion; True once it is over."""
        if self.motion.running or self.motion.blocks:
            if not self.motion.running:
                self.state = "Run"
                self.motion.start()
            return False
        if line.ends:
            self.modal = Modal(inches=line.modal.inches)
            self._say("[MSG:Pgm End]")
            self._ok()
            return True
        until = self.time + line.dwell

        def over() -> bool:
            if self.time < until - 1e-12:
                return False
            self.modal = line.modal
            self._ok()
            return True

        self._pending = over
        return False

    def _homing_axes(self) -> list[int]:
        cycles = [int(self.settings[44 + i]) for i in range(3)]
        return [axis for cycle in cycles for axis in range(6) if cycle >> axis & 1]

    def _homed_at_pull_off(self, axes: list[int]) -> None:
        pull_off = self.settings[27]
        self.motion.place(tuple(-pull_off if i in axes else p for i, p in enumerate(self.motion.position)))
        self.slip[axes] = 0.0
        self.homed = set(axes)
        self._status.homed = True

    def _start_homing(self) -> None:
        self._idle_or(NOT_IDLE)
        if not self.settings[22]:
            raise Refused(HOMING_OFF)
        self.state = "Home"
        self._report()
        self._report_due = False
        seek, slow, pull = self.settings[25] / 60, self.settings[24] / 60, self.settings[27]
        pause = self.settings[26] / 1000
        for axis in self._homing_axes():
            here = self.motion.position[axis]
            switch = -float(self.slip[axis])
            travel = abs(switch - here) / seek
            for place, seconds in ((switch, travel), (switch - pull, pull / seek)):
                self._homing.append((axis, place, seconds + pause))
            for place, seconds in ((switch, pull / slow), (switch - pull, pull / seek)):
                self._homing.append((axis, place, seconds + pause))

    def _home(self, seconds: float) -> None:
        while seconds > 0 and self._homing:
            axis, place, left = self._homing[0]
            share = min(1.0, seconds / left) if left > 0 else 1.0
            at = list(self.motion.position)
            at[axis] += share * (place - at[axis])
            self.motion.place(tuple(at))
            if share < 1.0:
                self._homing[0] = (axis, place, left - seconds)
                return
            self._homing.popleft()
            seconds -= left
        if not self._homing:
            self._homed_at_pull_off(self._homing_axes())
            if self._report_due:
                self._report()
            self.state = "Idle"
            self._say("[MSG:]")
            self._ok()

    def _report(self) -> None:
        shown = self.state
        if shown == "Hold":
            shown = "Hold:0" if self.motion.halted else "Hold:1"
        feed = 0.0 if self.state == "Alarm" else self.motion.speed * 60
        buffers = self.motion.free, RX_BYTES - len(self._rx)
        homed = bool(self.homed)
        self._say(self._status.report(shown, self.position, buffers, self.motion.line, feed, self.pressed, homed))


QUERIES: dict[str, Callable[[Firmware], Sequence[str]]] = {
    "I": lambda firmware: VERSION,
    "G": lambda firmware: modes(firmware.modal),
    "#": lambda firmware: offsets(firmware.settings, firmware.homed),
    "N": lambda firmware: ("$N0=", "$N1="),
    "": lambda firmware: (HELP,),
}
