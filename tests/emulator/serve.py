"""The firmware in real time behind a loopback TCP port or a pseudo-terminal."""

from __future__ import annotations

import os
import re
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from ctr_nlp.exceptions import OptionError
from emulator.faults import WireFault
from emulator.firmware import Firmware
from emulator.wire import SerialLine

LOOPBACK = "127.0.0.1"
TICK_S = 0.002
HTTP_REQUEST = re.compile(rb"[A-Z]+ \S* HTTP/")
"""How what browsers send begins: any page can send it to a port of this machine, and G-code behind it."""


class TcpPort:
    """A loopback TCP port; 0 picks a free one."""

    def __init__(self, number: int = 0) -> None:
        self._server = socket.create_server((LOOPBACK, number))
        self._server.setblocking(False)
        self._host: socket.socket | None = None
        self.url = f"socket://{LOOPBACK}:{self._server.getsockname()[1]}"

    def exchange(self, line: SerialLine | None) -> bool:
        """Move bytes between host and line, within TICK_S; whether a host is connected, the newest."""
        watched = [self._server, *([self._host] if self._host else [])]
        ready, _, _ = select.select(watched, [], [], TICK_S)
        if self._server in ready:
            self.hang_up()
            self._host, _ = self._server.accept()
            self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return False
        if self._host is None or line is None:
            return self._host is not None
        try:
            if self._host in ready:
                data = self._host.recv(4096)
                if not data or HTTP_REQUEST.match(data):
                    raise ConnectionError
                line.put(data)
            if data := line.get():
                self._host.sendall(data)
        except OSError:
            self.hang_up()
        return self._host is not None

    def hang_up(self) -> None:
        """End the host's connection."""
        if self._host:
            self._host.close()
        self._host = None

    def close(self) -> None:
        """Free the port."""
        self.hang_up()
        self._server.close()


class PtyPort:
    """A pseudo-terminal; a host that closes it does not end it."""

    def __init__(self) -> None:
        import tty

        self._device, self._kept_open = os.openpty()
        tty.setraw(self._kept_open)
        os.set_blocking(self._device, False)
        self.url = os.ttyname(self._kept_open)

    def exchange(self, line: SerialLine | None) -> bool:
        """Always connected: a pseudo-terminal does not tell who listens."""
        if line is None:
            return True
        ready, _, _ = select.select([self._device], [], [], TICK_S)
        with suppress(BlockingIOError, ConnectionError):
            if ready:
                line.put(os.read(self._device, 4096))
            if data := line.get():
                os.write(self._device, data)
        return True

    def hang_up(self) -> None:
        """A terminal that is cut says nothing more; it cannot be closed from this end alone."""

    def close(self) -> None:
        """Free the terminal."""
        os.close(self._device)
        os.close(self._kept_open)


Port = TcpPort | PtyPort


def open_port(kind: str, number: int = 0) -> Port:
    """A "tcp" port of a number, 0 for a free one, or a "pty"."""
    if kind not in ("tcp", "pty"):
        raise OptionError(f"no kind of port is called {kind!r}; there are tcp, pty")
    if kind == "pty" and not hasattr(os, "openpty"):
        raise OptionError("this system has no pseudo-terminals; use tcp")
    return PtyPort() if kind == "pty" else TcpPort(number)


def run(firmware: Firmware, port: Port, stop: threading.Event, faults: tuple[WireFault, ...] = ()) -> None:
    """Serve in real time until told to stop. Faults strike the first connection; the next lines are clean."""
    line: SerialLine | None = None
    idle = SerialLine(firmware)
    last = time.monotonic()
    opened = False
    while not stop.is_set():
        connected = port.exchange(line)
        if connected and line is None:
            line = SerialLine(firmware, () if opened else faults)
            opened = True
            firmware.take()
        elif not connected:
            line = None
        now = time.monotonic()
        (line or idle).advance(now - last)
        last = now
        if line is not None and line.cut:
            port.hang_up()
            line = None if isinstance(port, TcpPort) else line
        if line is None:
            idle.get()


@contextmanager
def serving(firmware: Firmware, kind: str = "tcp", faults: tuple[WireFault, ...] = ()) -> Iterator[str]:
    """Serve in a thread; gives the URL to connect to. kind: "tcp" or "pty"."""
    port = open_port(kind)
    stop = threading.Event()
    thread = threading.Thread(target=run, args=(firmware, port, stop, faults), daemon=True)
    thread.start()
    try:
        yield port.url
    finally:
        stop.set()
        thread.join()
        port.close()
