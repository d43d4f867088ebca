"""A whole line is obeyed, or answered with an error number that is then repeated for G-code until a blank line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctr_nlp.hardware.emulator.protocol.commands import command
from ctr_nlp.hardware.emulator.protocol.execution import execute
from ctr_nlp.hardware.emulator.protocol.gcode import Refused

if TYPE_CHECKING:
    from ctr_nlp.hardware.emulator.firmware import Firmware

LONGEST_LINE = 256
TOO_LONG = 14


def answer(firmware: Firmware, text: str) -> None:
    """Do what a line says; its answer comes now or when there is room for it."""
    try:
        if firmware.refuse is not None and text:
            number, firmware.refuse = firmware.refuse, None
            raise Refused(number)
        if not text:
            firmware.ok()
        elif len(text) > LONGEST_LINE:
            raise Refused(TOO_LONG)
        elif text.startswith("$"):
            command(firmware, text[1:].strip())
        else:
            execute(firmware, text)
    except Refused as refusal:
        firmware.error = refusal.number
        firmware.say(f"error:{refusal.number}")
