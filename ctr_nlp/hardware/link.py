"""Byte links to a controller through pyserial: serial ports, pseudo terminals and sockets."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Protocol

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.support.extras import import_extra

WRITE_TIMEOUT = 1.0
"""s after which a controller that takes no bytes counts as disconnected."""


class ByteLink(Protocol):
    """An open connection; one that breaks raises DeviceFault."""

    def write(self, data: bytes) -> None:
        """Send all bytes of data."""

    def read(self) -> bytes:
        """Return the bytes that have come since the last call, without waiting."""

    def close(self) -> None:
        """Close the connection."""


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
        """Send all bytes of data."""
        try:
            sent = self._port.write(data)
        except self._lost as exception:
            raise DeviceFault(f"the link to {self._url} is lost: {exception}") from exception
        if sent is not None and sent < len(data):
            raise DeviceFault(f"the link to {self._url} took {sent} of {len(data)} bytes")

    def read(self) -> bytes:
        """Return the bytes that have come since the last call, without waiting."""
        try:
            return bytes(self._port.read(4096))
        except self._lost as exception:
            raise DeviceFault(f"the link to {self._url} is lost: {exception}") from exception

    def close(self) -> None:
        """Close the port, also one whose connection is broken."""
        with suppress(*self._lost):
            self._port.close()


def _failures(serial: Any) -> tuple[type[Exception], ...]:
    """Return the exceptions of pyserial's module `serial` for a plug that is pulled."""
    try:
        # Where a USB adapter is pulled, POSIX ports let termios.error through, which is no OSError. Windows has no
        # termios.
        import termios
    except ImportError:
        return serial.SerialException, OSError
    return serial.SerialException, OSError, termios.error


class RecordedLink:
    """A link of which every byte is in a journal: sent bytes before they are sent, received ones at once."""

    def __init__(self, link: ByteLink, journal: Journal) -> None:
        self._link = link
        self._journal = journal

    def write(self, data: bytes) -> None:
        """Record data, then send it; data that cannot be recorded is not sent."""
        self._journal.record("sent", data=data.decode("latin-1"))
        self._link.write(data)

    def read(self) -> bytes:
        """Return and record the bytes that have come, without waiting."""
        if data := self._link.read():
            self._journal.record("received", data=data.decode("latin-1"))
        return data

    def close(self) -> None:
        """Close the link; the journal stays open."""
        self._link.close()
