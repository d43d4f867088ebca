"""The commands that begin with `$`: settings, queries, unlocking, check mode, homing and jogging."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from ctr_nlp.hardware.emulator.controller.execution import Execution
from ctr_nlp.hardware.emulator.protocol.gcode import Refused, read
from ctr_nlp.hardware.emulator.protocol.reports import HELP, VERSION, modes, offsets

NOT_UNDERSTOOD, HOMING_OFF, NOT_IDLE, TRAVEL, CRITICAL = 3, 5, 8, 15, 79


class Commands(Execution):
    """A controller that can be asked and set."""

    def command(self, text: str) -> None:
        """Obey what follows a `$`; raises Refused."""
        upper = text.upper()
        if self.critical and upper not in QUERIES:
            raise Refused(CRITICAL)
        if upper.startswith("J="):
            self._jog(text[2:])
        elif upper in ACTIONS:
            ACTIONS[upper](self)
        elif "=" in text:
            self._change(text)
        elif upper in QUERIES:
            self._tell(QUERIES[upper](self))
        elif text.isdecimal() and int(text) in self.settings:
            self._tell([self.settings.shown(int(text))])
        else:
            raise Refused(NOT_UNDERSTOOD)

    def _tell(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.say(line)
        self.ok()

    def _check_state(self, *states: str) -> None:
        if self.state not in states:
            raise Refused(NOT_IDLE)

    def _change(self, text: str) -> None:
        """Apply `n=value`."""
        if not text.partition("=")[0].strip().isdecimal():
            raise Refused(NOT_UNDERSTOOD)
        self._check_state("Idle", "Alarm")
        number = self.settings.change(text)
        self.motion.keep(self.settings.limits)
        if 100 <= number < 110:
            self.status.tell("homed")
        self.ok()

    def all_settings(self) -> list[str]:
        """The answer to `$$`."""
        self._check_state("Idle", "Alarm")
        return [self.settings.shown(number) for number in sorted(self.settings)]

    def home(self) -> None:
        """Begin the homing cycle, where it is on."""
        self._check_state("Idle", "Alarm")
        if not self.settings[22]:
            raise Refused(HOMING_OFF)
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
            raise Refused(TRAVEL)
        self.pending = lambda: self.planned(line, target, jog=True)


ACTIONS: dict[str, Callable[[Commands], None]] = {
    "H": Commands.home,
    "X": Commands.unlock,
    "C": Commands.toggle_check,
}

QUERIES: dict[str, Callable[[Commands], Iterable[str]]] = {
    "$": Commands.all_settings,
    "I": lambda controller: VERSION,
    "G": lambda controller: modes(controller.modal),
    "#": lambda controller: offsets(controller.settings, controller.homed),
    "N": lambda controller: ("$N0=", "$N1="),
    "": lambda controller: (HELP,),
}
