"""The commands that begin with `$`: settings, queries, unlocking, check mode, homing and jogging."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from ctr_nlp.hardware.emulator.mechanics import homing
from ctr_nlp.hardware.emulator.protocol.execution import outside, planned, target_of
from ctr_nlp.hardware.emulator.protocol.gcode import Refused, read
from ctr_nlp.hardware.emulator.protocol.reports import HELP, VERSION, modes, offsets
from ctr_nlp.hardware.emulator.protocol.stops import restart

if TYPE_CHECKING:
    from ctr_nlp.hardware.emulator.firmware import Firmware

NOT_UNDERSTOOD, HOMING_OFF, NOT_IDLE, TRAVEL, CRITICAL = 3, 5, 8, 15, 79


def command(firmware: Firmware, text: str) -> None:
    """Obey what follows a `$`; raises Refused."""
    upper = text.upper()
    if firmware.critical and upper not in QUERIES:
        raise Refused(CRITICAL)
    if upper.startswith("J="):
        _jog(firmware, text[2:])
    elif upper in ACTIONS:
        ACTIONS[upper](firmware)
    elif "=" in text:
        _change(firmware, text)
        firmware.ok()
    elif upper in QUERIES:
        for line in QUERIES[upper](firmware):
            firmware.say(line)
        firmware.ok()
    elif text.isdigit() and int(text) in firmware.settings:
        firmware.say(firmware.settings.shown(int(text)))
        firmware.ok()
    else:
        raise Refused(NOT_UNDERSTOOD)


def _check_idle(firmware: Firmware) -> None:
    if firmware.state not in ("Idle", "Alarm"):
        raise Refused(NOT_IDLE)


def _change(firmware: Firmware, text: str) -> None:
    """Apply `n=value`."""
    settings = firmware.settings
    if not text.partition("=")[0].strip().isdigit():
        raise Refused(NOT_UNDERSTOOD)
    _check_idle(firmware)
    number = settings.change(text, bool(settings[22]))
    firmware.motion.limits = settings.limits
    if 100 <= number < 110:
        firmware.status.homed = True
    if number == 22 and not settings[22]:
        settings[20] = 0


def _all_settings(firmware: Firmware) -> list[str]:
    _check_idle(firmware)
    return [firmware.settings.shown(number) for number in sorted(firmware.settings)]


def _home(firmware: Firmware) -> None:
    _check_idle(firmware)
    if not firmware.settings[22]:
        raise Refused(HOMING_OFF)
    homing.start(firmware)


def _unlock(firmware: Firmware) -> None:
    if firmware.state == "Alarm":
        firmware.state = "Idle"
        firmware.say("[MSG:Caution: Unlocked]")
    firmware.ok()


def _toggle_check(firmware: Firmware) -> None:
    """Check mode, in which lines are read and nothing moves, goes on or off."""
    if firmware.state == "Check":
        firmware.say("[MSG:Disabled]")
        firmware.ok()
        restart(firmware, locked=False)
    elif firmware.state == "Idle":
        firmware.state = "Check"
        firmware.say("[MSG:Enabled]")
        firmware.ok()
    else:
        raise Refused(NOT_IDLE)


def _jog(firmware: Firmware, text: str) -> None:
    if firmware.state not in ("Idle", "Jog"):
        raise Refused(NOT_IDLE)
    line = read(text, firmware.modal, jog=True)
    target = target_of(firmware, line)
    if outside(firmware, target):
        raise Refused(TRAVEL)
    firmware.pending = lambda: planned(firmware, line, target, jog=True)


ACTIONS: dict[str, Callable[[Firmware], None]] = {"H": _home, "X": _unlock, "C": _toggle_check}

QUERIES: dict[str, Callable[[Firmware], Iterable[str]]] = {
    "$": _all_settings,
    "I": lambda firmware: VERSION,
    "G": lambda firmware: modes(firmware.modal),
    "#": lambda firmware: offsets(firmware.settings, firmware.homed),
    "N": lambda firmware: ("$N0=", "$N1="),
    "": lambda firmware: (HELP,),
}
