"""Lines that were never true: what noise, a replayed buffer or another device makes a host hear."""

from __future__ import annotations

import random
from collections.abc import Callable

from ctr_nlp.hardware.emulator.firmware import Firmware
from ctr_nlp.hardware.emulator.mechanics.planner import Vector
from ctr_nlp.hardware.emulator.protocol.reports import BANNER, Status

Lie = Callable[[Firmware, random.Random], str]

ALARMS = (1, 2, 3, 10)
ERRORS = (1, 9, 20, 79)
STATES = ("Idle", "Run", "Hold:0", "Hold:1", "Jog", "Alarm", "Home", "Check")
PRINTABLE = "".join(chr(code) for code in range(32, 127))


def _report(firmware: Firmware, state: str, position: Vector, line: int | None) -> str:
    """A status report without any of the rarer fields."""
    status, speed = Status(until_offset=9, until_overrides=9, changed=frozenset()), firmware.motion.speed * 60
    buffers, overrides = (firmware.motion.free, firmware.lines.free), firmware.motion.overrides
    return status.report(state, position, buffers, line, speed, overrides, (), bool(firmware.homed))


def _past(firmware: Firmware, draw: random.Random) -> str:
    """Idle where a line that is done with ended, or at zero."""
    line, position = draw.choice(firmware.executed or [(None, (0.0,) * 6)])
    return _report(firmware, "Idle", position, line)


def _future(firmware: Firmware, draw: random.Random) -> str:
    """Idle where all that is planned will end."""
    return _report(firmware, "Idle", firmware.motion.target, firmware.motion.line)


def _wrong_state(firmware: Firmware, draw: random.Random) -> str:
    """Where it is, in a state in which it is not."""
    states = [state for state in STATES if not state.startswith(firmware.state)]
    return _report(firmware, draw.choice(states), firmware.motion.position, firmware.motion.line)


def _noise(firmware: Firmware, draw: random.Random) -> str:
    """Printable characters without sense."""
    return "".join(draw.choice(PRINTABLE) for _ in range(draw.randint(1, 40)))


LIES: dict[str, Lie] = {
    "false_alarm": lambda firmware, draw: f"ALARM:{draw.choice(ALARMS)}",
    "false_banner": lambda firmware, draw: BANNER,
    "false_ok": lambda firmware, draw: "ok",
    "false_error": lambda firmware, draw: f"error:{draw.choice(ERRORS)}",
    "false_past": _past,
    "false_future": _future,
    "false_state": _wrong_state,
    "noise": _noise,
}
"""Name of a fault -> the line that is inserted."""
