"""Measurements as lines of JSON, {"values": [x, y, z], "time": s}, over UDP or TCP; null for missing values."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.sensing.arrival import receive_bytes, stamp_arrivals
from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.hardware.sensing.source import Message, Remote

TCP_SENSOR_TIMEOUT_S = 3.0
"""s within which a server must answer."""

MAX_JSON_LINE_BYTES = 65536
"""Longest line, bytes; more without an end are dropped."""

AT_ONCE = 64
"""Packets that are read at most in one call, so that a flood of them cannot hold up the player."""


def message_of(line: bytes) -> Message | str:
    """Return the message of a line, or why it is none."""
    try:
        told = json.loads(line)
        values = np.array([math.nan if value is None else value for value in told["values"]], dtype=float)
        stamp = told.get("time")
        known = None if stamp is None else float(stamp)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return f'{line[:60]!r}, which is no line as {{"values": [1.0, 2.0, 3.0], "time": 0.1}}'
    if values.ndim != 1 or np.isinf(values).any() or not (known is None or math.isfinite(known)):
        return f"{line[:60]!r}, with numbers that are not finite"
    return Message(values, known)


class JsonLineSource(Remote):
    """Lines from a socket: packets of any sender to a UDP address, or a TCP server's stream."""

    def __init__(self, sensing: Sensing) -> None:
        super().__init__(sensing)
        self._socket: socket.socket | None = None
        self._rest = b""

    def open(self) -> None:
        """Start to listen; raises DeviceFault."""
        kind, host, port, _ = self._sensing.address
        try:
            if kind == "udp":
                self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._socket.bind((host, port))
            else:
                self._socket = socket.create_connection((host, port), TCP_SENSOR_TIMEOUT_S)
            self._socket.setblocking(False)
            stamp_arrivals(self._socket)
        except OSError as exception:
            self.close()
            raise DeviceFault(
                f"the sensor at {self._sensing.url} cannot be listened to: {exception}"
            ) from exception

    def _receive_messages(self) -> list[Message]:
        found = []
        for line, waited in self._lines():
            message = message_of(line)
            if isinstance(message, str):
                self.strange = message
            else:
                found.append(message._replace(waited=waited))
        return found

    def _lines(self) -> Iterator[tuple[bytes, float]]:
        """Yield complete lines that have come, and for how many s each has waited."""
        for _ in range(AT_ONCE):
            data, waited = self._packet()
            if not data:
                break
            # A packet is a whole message, whose sender may leave out the line feed.
            whole = self._sensing.address.kind == "udp" and not data.endswith(b"\n")
            *lines, rest = (self._rest + data + b"\n" * whole).split(b"\n")
            # A sender that never ends a line must not fill the memory.
            self._rest = rest if len(rest) <= MAX_JSON_LINE_BYTES else b""
            yield from ((line, waited) for line in lines if line.strip())

    def _packet(self) -> tuple[bytes, float]:
        """Return the next bytes, empty for none, and for how many s they have waited."""
        if self._socket is None:
            return b"", 0.0
        try:
            data, waited = receive_bytes(self._socket, MAX_JSON_LINE_BYTES)
        except (BlockingIOError, InterruptedError):
            return b"", 0.0
        except OSError as exception:
            self.strange = f"no more: {exception}"
            return b"", 0.0
        if not data and self._sensing.address.kind == "tcp":
            self.strange = "no more: the server has closed the link"
            self.close()
        return data, waited

    def close(self) -> None:
        """Stop listening."""
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
        self._socket = None
