"""Bytes of a socket, and how long ago they arrived, as Linux reports it (socket(7), SO_TIMESTAMPNS)."""

from __future__ import annotations

import socket
import struct
import sys
import time

STAMPED = 35 if sys.platform == "linux" else None
"""SO_TIMESTAMPNS, Linux's option for times of arrival and its kind of message; None on other systems."""

ARRIVAL_TIMESTAMP_STRUCT = struct.Struct("@qq")
"""Seconds and nanoseconds of the machine's clock."""

MAX_QUEUE_TIME_S = 1.0
"""s: a longer time in the queue means that the machine's clock was set meanwhile; it is not used."""


def stamp_arrivals(link: socket.socket) -> None:
    """Let a socket report when bytes arrive, where the system can.

    link: the socket.
    """
    if STAMPED is not None:
        link.setsockopt(socket.SOL_SOCKET, STAMPED, 1)


def receive_bytes(link: socket.socket, most: int) -> tuple[bytes, float]:
    """Return at most so many bytes, and for how many s the last of them have waited; 0 where that is not reported.

    link: the socket. most: number of bytes. Raises OSError, as socket.recv does.
    """
    if STAMPED is None:
        return link.recv(most), 0.0
    data, told, *_ = link.recvmsg(most, socket.CMSG_SPACE(ARRIVAL_TIMESTAMP_STRUCT.size))
    stamps = [
        ARRIVAL_TIMESTAMP_STRUCT.unpack(value)
        for _, kind, value in told
        if kind == STAMPED and len(value) == ARRIVAL_TIMESTAMP_STRUCT.size
    ]
    # The stamps are of the machine's clock, time.time, which unlike the player's clock may be set.
    waited = max((time.time() - seconds - 1e-9 * rest for seconds, rest in stamps), default=0.0)
    return data, waited if 0.0 <= waited < MAX_QUEUE_TIME_S else 0.0
