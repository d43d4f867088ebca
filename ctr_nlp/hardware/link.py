"""Bytes to and from a controller, by pyserial: serial ports, pseudo terminals and sockets."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Protocol

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.support.extras import import_extra

WRITE_TIMEOUT = 1.0
"""s: a controller that takes no bytes for so long is lost."""


class ByteLink(Protocol):
    """An open connection; a lost one raises DeviceFault."""

    def write(self, data: bytes) -> None:
        """Send all of it."""

    def read(self) -> bytes:
        """What has come since the last call, without waiting."""

    def close(self) -> None:
        """Let go of it."""


class SerialLink:
    """A port that pyserial can open: "/dev/ttyUSB0", "COM3", "socket://127.0.0.1:23". Raises DeviceFault."""

    def __init__(self, url: str, baud: int) -> None:
        self._url = url
        serial = import_extra("serial")
        self._lost: tuple[type[Exception], ...] = _failures(serial)
        unopened: tuple[type[Exception], ...] = (*self._lost, ValueError)
        try:
            self._port: Any = serial.serial_for_url(
                url, baudrate=baud, timeout=0, write_timeout=WRITE_TIMEOUT, exclusive=True
            )
        except unopened as exception:
            raise DeviceFault(f"{url} cannot be opened: {exception}") from exception

    def write(self, data: bytes) -> None:
        """Send all of it."""
        try:
            sent = self._port.write(data)
        except self._lost as exception:
            raise DeviceFault(f"the link to {self._url} is lost: {exception}") from exception
        if sent is not None and sent < len(data):
            raise DeviceFault(f"the link to {self._url} took {sent} of {len(data)} bytes")

    def read(self) -> bytes:
        """What has come since the last call, without waiting."""
        try:
            return bytes(self._port.read(4096))
        except self._lost as exception:
            raise DeviceFault(f"the link to {self._url} is lost: {exception}") from exception

    def close(self) -> None:
        """Let go of it; a lost one is let go of as well."""
        with suppress(*self._lost):
            self._port.close()


def _failures(serial: Any) -> tuple[type[Exception], ...]:
    """What pyserial raises when a plug is pulled: its own error, the system's, or a bare termios.error."""
    try:
        import termios
    except ImportError:
        return serial.SerialException, OSError
    return serial.SerialException, OSError, termios.error


class RecordedLink:
    """A link of which every byte is in a journal: what is sent before it is sent, what comes when it has come."""

    def __init__(self, link: ByteLink, journal: Journal) -> None:
        self._link = link
        self._journal = journal

    def write(self, data: bytes) -> None:
        """Record, then send; what cannot be recorded is not sent."""
        self._journal.record("sent", data=data.decode("latin-1"))
        self._link.write(data)

    def read(self) -> bytes:
        """What has come, recorded."""
        if data := self._link.read():
            self._journal.record("received", data=data.decode("latin-1"))
        return data

    def close(self) -> None:
        """Let go of the link."""
        self._link.close()
