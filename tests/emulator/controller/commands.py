"""What lines do: G-code, and commands that begin with `$`.

Moves go to the planner as it has room, dwells and the program's end wait for motion. An `ok` means planned, not
done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from emulator.controller.stops import Stopping
from emulator.gcode import GcodeLine, Modal, Refused, read
from emulator.planner import Vector
from emulator.reports import FIRMWARE_IDENTITY_LINES, HELP, modes, offsets

(
    ERROR_NOT_UNDERSTOOD,
    ERROR_HOMING_OFF,
    ERROR_NOT_IDLE,
    ERROR_LOCKED,
    ERROR_JOG_BEYOND_TRAVEL,
    ERROR_CRITICAL_ALARM,
) = 3, 5, 8, 9, 15, 79


class CommandInterpreter(Stopping):
    """A controller that obeys G-code, and can be asked and set."""

    def execute(self, text: str) -> None:
        """Obey a line of G-code, now or as soon as there is room; raises Refused."""
        if self.state in ("Alarm", "Jog"):
            raise Refused(ERROR_LOCKED)
        if self.error is not None:
            raise Refused(self.error)
        line = read(text, self.modal)
        target = self.target_of(line)
        if self.state == "Check":
            self._accept(line.modal)
        elif self.outside(target):
            self.soft_limit()
        elif line.dwell or line.ends:
            self.pending = lambda: self._try_finish_wait(line)
        else:
            self.pending = lambda: self.plan_line(line, target)

    def target_of(self, line: GcodeLine) -> Vector:
        """Where a line leads from what is planned, (6,) mm and deg."""
        at = list(self.motion.target)
        for i, value in line.axes.items():
            at[i] = value if line.modal.absolute else at[i] + value
        return tuple(at)

    def outside(self, target: Vector) -> bool:
        """Whether soft limits, where they are on, forbid a target (6,)."""
        if not self.settings[20]:
            return False
        return any(not -self.settings[130 + i] <= target[i] <= 0 for i in self.homed)

    def plan_line(self, line: GcodeLine, target: Vector, jog: bool = False) -> bool:
        """Put a line into the planner; False where there is no room yet."""
        if line.axes and not self.motion.free:
            return False
        self.motion.begin_line(line.number)
        if line.axes:
            speed = line.modal.feed / 60
            if line.modal.motion == 0:
                speed = float("inf")
            elif line.modal.inverse_time:
                speed *= float(np.linalg.norm(np.subtract(target, self.motion.target)))
            self.motion.plan(target, speed, line.number or None, jog)
        self._accept(self.modal if jog else line.modal)
        return True

    def _accept(self, modal: Modal) -> None:
        self.modal = modal
        self.ok()

    def _try_finish_wait(self, line: GcodeLine) -> bool:
        """A dwell or the program's end waits for all motion; True once it is over."""
        if self.motion.running or self.motion.blocks:
            if not self.motion.running:
                self.state = "Run"
                self.motion.start()
            return False
        if line.ends:
            self.say("[MSG:Pgm End]")
            self._accept(Modal(inches=line.modal.inches))
            return True
        until = self.time + line.dwell

        def over() -> bool:
            if self.time < until - 1e-12:
                return False
            self._accept(line.modal)
            return True

        self.pending = over
        return False

    def command(self, text: str) -> None:
        """Obey what follows a `$`; raises Refused."""
        upper = text.upper()
        if self.critical and upper not in QUERIES:
            raise Refused(ERROR_CRITICAL_ALARM)
        if upper.startswith("J="):
            self._jog(text[2:])
        elif upper in ACTIONS:
            ACTIONS[upper](self)
        elif "=" in text:
            self._change(text)
        elif upper in QUERIES:
            self._tell(QUERIES[upper](self))
        elif text.isdecimal() and int(text) in self.settings:
            self._tell([self.settings.format_setting(int(text))])
        else:
            raise Refused(ERROR_NOT_UNDERSTOOD)

    def _tell(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.say(line)
        self.ok()

    def _check_state(self, *states: str) -> None:
        if self.state not in states:
            raise Refused(ERROR_NOT_IDLE)

    def _change(self, text: str) -> None:
        """Apply `n=value`."""
        if not text.partition("=")[0].strip().isdecimal():
            raise Refused(ERROR_NOT_UNDERSTOOD)
        self._check_state("Idle", "Alarm")
        number = self.settings.change(text)
        if 100 <= number < 110:
            self.status.tell("homed")
        self.ok()

    def all_settings(self) -> list[str]:
        """The answer to `$$`."""
        self._check_state("Idle", "Alarm")
        return [self.settings.format_setting(number) for number in sorted(self.settings)]

    def home(self) -> None:
        """Begin the homing cycle, where it is on."""
        self._check_state("Idle", "Alarm")
        if not self.settings[22]:
            raise Refused(ERROR_HOMING_OFF)
        self.start_homing()

    def unlock(self) -> None:
        """End an alarm."""
        if self.state == "Alarm":
            self.state = "Idle"
            self.say("[MSG:Caution: Unlocked]")
        self.ok()

    def toggle_check(self) -> None:
        """Check mode, in which lines are read and nothing moves, goes on or off."""
        self._check_state("Idle", "Check")
        if self.state == "Check":
            self._tell(["[MSG:Disabled]"])
            self.restart(locked=False)
        else:
            self.state = "Check"
            self._tell(["[MSG:Enabled]"])

    def _jog(self, text: str) -> None:
        self._check_state("Idle", "Jog")
        line = read(text, self.modal, jog=True)
        target = self.target_of(line)
        if self.outside(target):
            raise Refused(ERROR_JOG_BEYOND_TRAVEL)
        self.pending = lambda: self.plan_line(line, target, jog=True)


ACTIONS: dict[str, Callable[[CommandInterpreter], None]] = {
    "H": CommandInterpreter.home,
    "X": CommandInterpreter.unlock,
    "C": CommandInterpreter.toggle_check,
}

QUERIES: dict[str, Callable[[CommandInterpreter], Iterable[str]]] = {
    "$": CommandInterpreter.all_settings,
    "I": lambda controller: FIRMWARE_IDENTITY_LINES,
    "G": lambda controller: modes(controller.modal),
    "#": lambda controller: offsets(controller.settings, controller.homed),
    "N": lambda controller: ("$N0=", "$N1="),
    "": lambda controller: (HELP,),
}
