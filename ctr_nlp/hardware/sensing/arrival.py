"""Bytes of a socket, and how long ago they reached this machine, as Linux tells it (socket(7), SO_TIMESTAMPNS)."""

from __future__ import annotations

import socket
import struct
import sys
import time

STAMPED = 35 if sys.platform == "linux" else None
"""The option, and the kind of message, by which Linux tells of arrivals; other systems tell nothing."""

ARRIVAL_TIMESTAMP_STRUCT = struct.Struct("@qq")
"""Seconds and nanoseconds of the machine's clock."""

MAX_QUEUE_TIME_S = 1.0
"""s: a longer time in the queue says that the machine's clock was set meanwhile, and nothing of the arrival."""


def stamp_arrivals(link: socket.socket) -> None:
    """Have a socket tell when bytes arrive, where the system can."""
    if STAMPED is not None:
        link.setsockopt(socket.SOL_SOCKET, STAMPED, 1)


def receive_bytes(link: socket.socket, most: int) -> tuple[bytes, float]:
    """At most so many bytes, and for how many s the last of them have waited; 0 where the system does not tell.

    Raises OSError, as socket.recv does.
    """
    if STAMPED is None:
        return link.recv(most), 0.0
    data, told, *_ = link.recvmsg(most, socket.CMSG_SPACE(ARRIVAL_TIMESTAMP_STRUCT.size))
    stamps = [
        ARRIVAL_TIMESTAMP_STRUCT.unpack(value)
        for _, kind, value in told
        if kind == STAMPED and len(value) == ARRIVAL_TIMESTAMP_STRUCT.size
    ]
    waited = max((time.time() - seconds - 1e-9 * rest for seconds, rest in stamps), default=0.0)
    return data, waited if 0.0 <= waited < MAX_QUEUE_TIME_S else 0.0
