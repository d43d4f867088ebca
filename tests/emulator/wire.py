"""An in-process connection to the firmware, in virtual time."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

from emulator.firmware import Firmware

BYTE_S = 10 / 115200
"""What a byte takes: ten bits at 115200 baud."""
STEP_S = 0.001


@dataclass(frozen=True)
class WireFault:
    """A fault that strikes once either moment has come.

    name: its entry in FAULTS (faults.py). at: s since the firmware was switched on. after_bytes: sent by the host
    on this connection. seconds: how long it lasts or delays, inf for good. seed: of what is drawn at random.
    choice: what varies from kind to kind; see there. data: what is sent or said, drawn where it is empty.
    """

    name: str
    strike_line: Callable[[SerialLine, WireFault], None]
    at: float = math.inf
    after_bytes: float = math.inf
    seconds: float = math.inf
    seed: int = 0
    choice: float = 0.3
    data: bytes = b""

    def strike(self, line: SerialLine) -> None:
        """Do what it does to a line or the firmware at its end."""
        self.strike_line(line, self)


class VirtualClock:
    """Time that passes only when somebody sleeps; the firmware on its lines moves along. Seconds."""

    def __init__(self) -> None:
        self._now = 0.0
        self.lines: dict[Firmware, SerialLine] = {}
        """The latest line to each firmware."""

    def now(self) -> float:
        """Seconds since the clock was made."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """Let so many seconds pass, in steps of a millisecond for what is attached."""
        end = self._now + max(seconds, 0.0)
        while self._now < end:
            later = end if end - self._now <= STEP_S else self._now + STEP_S
            step, self._now = later - self._now, later
            for line in list(self.lines.values()):
                line.advance(step)


class SerialLine:
    """The two directions of a serial line between a host and the firmware, with the faults on it.

    Bytes take their time. Whoever owns it calls advance() and moves bytes in and out.
    """

    def __init__(self, firmware: Firmware, faults: tuple[WireFault, ...] = ()) -> None:
        self.firmware = firmware
        self.time = 0.0
        self.sent_bytes = 0
        self.cut = False
        self.outward: list[Callable[[bytes], bytes]] = []
        """What faults do to bytes under way to the firmware."""
        self.inward: list[Callable[[bytes], list[tuple[float, bytes]]]] = []
        """What faults do to each whole reply line: (delay in s, bytes) for what arrives in its place."""
        self._waiting = list(faults)
        self._to_device: list[tuple[float, int]] = []
        self._to_host: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()
        self._outbound_free = self._inbound_free = 0.0
        self._part = b""

    @property
    def outbound(self) -> int:
        """Bytes under way to the firmware."""
        return len(self._to_device)

    def put(self, data: bytes) -> None:
        """Bytes from the host are sent off."""
        self._check()
        self.sent_bytes += len(data)
        self._trigger()
        self._check()
        for alter in list(self.outward):
            data = alter(data)
        start = max(self.time, self._outbound_free)
        for i, byte in enumerate(data):
            self._to_device.append((start + (i + 1) * BYTE_S, byte))
        self._outbound_free = start + len(data) * BYTE_S

    def get(self) -> bytes:
        """Bytes that have arrived at the host."""
        self._check()
        data = b""
        while self._to_host and self._to_host[0][0] <= self.time + 1e-12:
            data += heapq.heappop(self._to_host)[2]
        return data

    def advance(self, seconds: float) -> None:
        """Let time pass for the firmware and the bytes under way."""
        self.time += seconds
        arrived = 0
        while arrived < len(self._to_device) and self._to_device[arrived][0] <= self.time + 1e-12:
            arrived += 1
        if arrived:
            data = bytes(byte for _, byte in self._to_device[:arrived])
            del self._to_device[:arrived]
            self.firmware.receive(data)
        self.firmware.advance(seconds)
        self._trigger()
        self._collect()

    def insert(self, line: bytes) -> None:
        """A line that the firmware never sent is sent to the host, between its own."""
        if not self.cut:
            self._send(0.0, line)

    def drop(self) -> None:
        """The link is lost, with whatever was under way; the firmware does not notice."""
        self.cut = True
        self._to_device.clear()
        self._to_host.clear()

    def _check(self) -> None:
        if self.cut:
            raise ConnectionError("the link to the controller is lost")

    def _trigger(self) -> None:
        now, sent = self.firmware.time, self.sent_bytes
        for fault in [fault for fault in self._waiting if now >= fault.at or sent >= fault.after_bytes]:
            self._waiting.remove(fault)
            fault.strike(self)

    def _collect(self) -> None:
        if self.cut:
            self.firmware.take()
            self._part = b""
            return
        *lines, self._part = (self._part + self.firmware.take()).split(b"\n")
        for line in lines:
            pieces = [(0.0, line + b"\n")]
            for alter in self.inward:
                pieces = [(wait + more, new) for wait, old in pieces for more, new in alter(old)]
            for wait, piece in pieces:
                self._send(wait, piece)

    def _send(self, wait: float, piece: bytes) -> None:
        self._inbound_free = max(self.time, self._inbound_free) + len(piece) * BYTE_S
        heapq.heappush(self._to_host, (self._inbound_free + wait, next(self._order), piece))


class Wire:
    """A host's connection to the firmware. Opening one ends the one before; motion goes on without any.

    faults: struck on this connection at their moments.
    """

    def __init__(self, firmware: Firmware, clock: VirtualClock, faults: tuple[WireFault, ...] = ()) -> None:
        before = clock.lines.get(firmware)
        if before is not None:
            before.drop()
            firmware.take()
        self.line = clock.lines[firmware] = SerialLine(firmware, faults)
        self.clock = clock

    def write(self, data: bytes) -> None:
        """Send bytes; they arrive one after the other. Raises ConnectionError where the link is lost."""
        self.line.put(data)

    def read(self, timeout: float) -> bytes:
        """What has arrived, waiting for it up to timeout seconds of virtual time; b"" where nothing came.

        Raises ConnectionError where the link is lost.
        """
        end = self.clock.now() + timeout
        data = self.line.get()
        while not data and self.clock.now() < end:
            self.clock.sleep(min(STEP_S, end - self.clock.now()))
            data = self.line.get()
        return data

    def close(self) -> None:
        """End the connection; the firmware does not notice."""
        self.line.drop()
