"""Characters that act at once, whatever line is being received: queries, stops, resumption and overrides."""

from __future__ import annotations

QUERIES = (ord("?"), 0x05, 0x80, 0x87)
RESUME = (ord("~"), 0x81)
HOLD = (ord("!"), 0x82)
RESET, STOP, JOG_CANCEL = 0x18, 0x19, 0x85
IN_LINES = b"\b\n\r"
"""Control characters that belong to lines."""


def is_realtime(byte: int) -> bool:
    """Whether a character never becomes part of a line; one without a meaning is dropped."""
    return byte in b"?!~" or byte >= 0x7F or (byte < 0x20 and byte not in IN_LINES)
