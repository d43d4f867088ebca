"""The firmware itself: bytes in, bytes out, and time that is let pass; no threads, sockets or clock of its own.

It answers as the 6-axis grblHAL of a recorded session does, oddities included: feed hold stops the reading of
lines, an error is repeated for G-code until a blank line, and a reset in motion has three possible endings.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from ctr_nlp.exceptions import OptionError
from emulator.controller.commands import CommandInterpreter
from emulator.gcode import Refused
from emulator.reports import BUTTONS

SLICE_S = 0.01
"""How often lines that wait for room are tried again; the planner makes room a block at a time."""

STATUS_QUERY_BYTES = (ord("?"), 0x05, 0x80, 0x87)
RESUME_BYTES = (ord("~"), 0x81)
HOLD_BYTES = (ord("!"), 0x82)
RESET_BYTE, STOP_BYTE, JOG_CANCEL_BYTE = 0x18, 0x19, 0x85
IN_LINES = b"\b\n\r"
"""Control characters that belong to lines."""

NEVER = 255
"""The delay in ms after which motors at rest are switched off, where they never are."""
RELAXATION = 0.5
"""How far the load then pushes a motor, in mm or deg; the firmware does not see it."""

LONGEST_LINE = 256
ERROR_LINE_TOO_LONG = 14


def is_realtime(byte: int) -> bool:
    """Whether a character never becomes part of a line; one without a meaning is dropped."""
    return byte in b"?!~" or byte >= 0x7F or (byte < 0x20 and byte not in IN_LINES)


class Firmware(CommandInterpreter):
    """A controller that has just been switched on.

    settings: changes to those of a configured machine, by number. homed: start homed, at the pull-off.
    """

    def __init__(self, settings: Mapping[int, float] | None = None, homed: bool = False) -> None:
        super().__init__(settings)
        self.bytes_received = 0
        self.bytes_lost = 0
        """Bytes that came when the receive buffer was full."""
        self._refusal: int | None = None
        self._stalled_until = 0.0
        self._deferred: deque[int] = deque()
        if homed:
            self.settings[22] = 1
            self.place_at_pull_off()

    def receive(self, data: bytes) -> None:
        """Bytes arrive now. Realtime characters act at once; those beyond a full buffer are lost."""
        self.bytes_received += len(data)
        for byte in data:
            if is_realtime(byte):
                if self.time < self._stalled_until:
                    self._deferred.append(byte)
                else:
                    self._act(byte)
            else:
                self.bytes_lost += not self.lines.put(byte)
            if byte == 0x0A:
                self._work()
        self._work()

    def _act(self, byte: int) -> None:
        """Do what a realtime character asks for, where the state allows it."""
        if byte in STATUS_QUERY_BYTES:
            if self.state == "Home":
                self.report_due = True
            else:
                self.report()
        elif byte == RESET_BYTE:
            self.reset()
        elif byte in HOLD_BYTES:
            self.hold()
        elif byte in RESUME_BYTES:
            self.resume()
            self._work()
        elif byte == STOP_BYTE:
            self.stop()
        elif byte == JOG_CANCEL_BYTE:
            self.cancel_jog()
        else:
            self.override(self.motion.overrides.after(byte))

    def advance(self, seconds: float) -> None:
        """Let time pass, in s."""
        end = self.time + seconds
        while self.time < end - 1e-12:
            if self.time < self._stalled_until:
                self._wait(end)
                continue
            step = end - self.time
            if self.timers:
                step = min(step, max(self.timers[0][0] - self.time, 0.0))
            if self.pending or self.lines.waiting or self.when_stopped:
                step = min(step, SLICE_S)
            if self.state == "Home":
                self.advance_homing(step)
            elif self.state in ("Run", "Jog", "Hold"):
                self.motion.advance(step)
            self.time += step
            self._rest(step)
            while self.timers and self.timers[0][0] <= self.time + 1e-12:
                self.timers.pop(0)[1]()
            self.settle()
            self._work()

    def _wait(self, end: float) -> None:
        """Let time pass to end, or until the firmware is no longer stalled and takes what has come meanwhile."""
        self.time = min(end, self._stalled_until)
        if self.time >= self._stalled_until:
            while self._deferred:
                self._act(self._deferred.popleft())
            self._work()

    def press(self, button: str) -> None:
        """Push a button and keep it down: estop, reset or limit_x .. limit_c; raises OptionError for others."""
        if button not in BUTTONS:
            raise OptionError(f"no button is called {button!r}; there are {', '.join(BUTTONS)}")
        self.pressed.add(button)
        if button == "reset":
            self.reset()
        elif button.startswith("limit") and self.settings[21] and self.state != "Home":
            self.hard_limit()

    def release(self, button: str) -> None:
        """Let a button go."""
        self.pressed.discard(button)

    def stall(self, seconds: float) -> None:
        """Do nothing at all for so many seconds: no motion, no reading of lines, no replies."""
        self._stalled_until = max(self._stalled_until, self.time + seconds)

    def refuse(self, number: int) -> None:
        """Answer the next line with an error number."""
        self._refusal = number

    def _rest(self, seconds: float) -> None:
        """Motors that have just been switched off for standing still give way to the load."""
        before, self.still = self.still, 0.0 if self.moving else self.still + seconds
        delay, kept = self.settings[1], int(self.settings[37])
        if delay != NEVER and before <= delay / 1000 < self.still:
            self.slip = self.slip + [0.0 if kept >> i & 1 else RELAXATION for i in range(6)]

    def _work(self) -> None:
        """Obey lines of the receive buffer as long as nothing stops it."""
        while not self._is_blocked():
            if self.pending:
                attempt = self.pending
                if not attempt():
                    break
                self.pending = None
                continue
            text = self.lines.take()
            if text is None:
                break
            self._answer(text)
        if self.state in ("Idle", "Run", "Jog") and self.motion.blocks and self.when_stopped is None:
            if self.state == "Idle":
                self.state = "Jog" if self.motion.blocks[0].jog else "Run"
            self.motion.start()

    def _is_blocked(self) -> bool:
        return self.state in ("Hold", "Home") or self.time < self._stalled_until or self.when_stopped is not None

    def _answer(self, text: str) -> None:
        """Do what a whole line says, now or when there is room, or answer with an error number.

        That is then repeated for G-code until a blank line comes.
        """
        try:
            if self._refusal is not None and text:
                number, self._refusal = self._refusal, None
                raise Refused(number)
            if not text:
                self.ok()
            elif len(text) > LONGEST_LINE:
                raise Refused(ERROR_LINE_TOO_LONG)
            elif text.startswith("$"):
                self.command(text[1:].strip())
            else:
                self.execute(text)
        except Refused as refusal:
            self.error = refusal.number
            self.say(f"error:{refusal.number}")
