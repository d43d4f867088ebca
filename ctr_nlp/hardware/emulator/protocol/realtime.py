"""Characters that act at once, whatever line is being received: queries, stops, resumption and overrides."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctr_nlp.hardware.emulator.protocol import stops

if TYPE_CHECKING:
    from ctr_nlp.hardware.emulator.firmware import Firmware

QUERIES = (ord("?"), 0x05, 0x80, 0x87)
RESUME = (ord("~"), 0x81)
HOLD = (ord("!"), 0x82)
RESET, STOP, JOG_CANCEL = 0x18, 0x19, 0x85
IN_LINES = b"\b\n\r"
"""Control characters that belong to lines."""


def is_realtime(byte: int) -> bool:
    """Whether a character never becomes part of a line; one without a meaning is dropped."""
    return byte in b"?!~" or byte >= 0x7F or (byte < 0x20 and byte not in IN_LINES)


def act(firmware: Firmware, byte: int) -> None:
    """Do what a realtime character asks for, where the state allows it."""
    if byte in QUERIES:
        if firmware.state == "Home":
            firmware.report_due = True
        else:
            firmware.report()
    elif byte == RESET:
        stops.reset(firmware)
    elif byte in HOLD:
        stops.hold(firmware)
    elif byte in RESUME:
        stops.resume(firmware)
    elif byte == STOP:
        stops.stop(firmware)
    elif byte == JOG_CANCEL:
        firmware.forget_lines()
        if firmware.state == "Jog":
            stops.cancel_jog(firmware)
    else:
        firmware.override(firmware.motion.overrides.after(byte))
