"""Links: whatever a serial port raises becomes a fault, and every byte is in the journal before it is sent."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from emulator import Firmware, VirtualClock, serving

from ctr_nlp.exceptions import DeviceFault, JournalError
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.link import RecordedLink, SerialLink

serial = pytest.importorskip("serial")
termios = pytest.importorskip("termios")


class Port:
    """A port that fails as told."""

    def __init__(self, error: Exception | None = None, sent: int | None = None) -> None:
        self.error, self.sent, self.closed = error, sent, False

    def write(self, data: bytes) -> int:
        """How much was taken."""
        self._fail()
        return len(data) if self.sent is None else self.sent

    def read(self, size: int) -> bytes:
        """Something."""
        self._fail()
        return b"ok\r\n"

    def close(self) -> None:
        """Fail once more."""
        self.closed = True
        self._fail()

    def _fail(self) -> None:
        if self.error is not None:
            raise self.error


def linked(monkeypatch: pytest.MonkeyPatch, port: Port) -> SerialLink:
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: port)
    return SerialLink("/dev/ttyUSB0", 115200)


@pytest.mark.parametrize(
    "error",
    [
        serial.SerialException("gone"),
        OSError(5, "gone"),
        termios.error(5, "gone"),
        serial.SerialTimeoutException("gone"),
    ],
    ids=["pyserial", "system", "termios", "timeout"],
)
def test_a_pulled_plug_is_a_fault_that_names_the_port(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    port = Port(error)
    link = linked(monkeypatch, port)
    with pytest.raises(DeviceFault, match=r"link to /dev/ttyUSB0 is lost: .*gone"):
        link.read()
    with pytest.raises(DeviceFault, match=r"link to /dev/ttyUSB0 is lost: .*gone"):
        link.write(b"?")
    link.close()
    assert port.closed


def test_bytes_that_do_not_fit_are_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceFault, match="took 3 of 5 bytes"):
        linked(monkeypatch, Port(sent=3)).write(b"G1 X1")


@pytest.mark.parametrize(
    "url", ["/dev/nothing-here", "socket://127.0.0.1:1", "socket://nowhere", "what://is.this"]
)
def test_what_cannot_be_opened_is_a_fault(url: str) -> None:
    with pytest.raises(DeviceFault, match="cannot be opened"):
        SerialLink(url, 115200)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="only others than root are kept out of a port")
@pytest.mark.hazard("two programs move one device")
def test_a_port_has_one_owner() -> None:
    with serving(Firmware(), "pty") as url:
        link = SerialLink(url, 115200)
        with pytest.raises(DeviceFault, match="cannot be opened"):
            SerialLink(url, 115200)
        link.close()


def test_what_cannot_be_recorded_is_not_sent(tmp_path: Path) -> None:
    sent: list[bytes] = []

    class Told:
        def write(self, data: bytes) -> None:
            sent.append(data)

        def read(self) -> bytes:
            return b"\xff\x00ok"

        def close(self) -> None: ...

    journal = Journal(tmp_path / "journal.jsonl", VirtualClock())
    link = RecordedLink(Told(), journal)
    link.write(b"\x18")
    assert link.read() == b"\xff\x00ok"
    records: list[dict[str, Any]] = [json.loads(line) for line in journal.path.read_text().splitlines()]
    assert [record.get("data", "").encode("latin-1") for record in records[1:]] == [b"\x18", b"\xff\x00ok"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ctr_nlp.hardware.journal.os.write", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
        with pytest.raises(JournalError, match="full"):
            link.write(b"G1 X1 F1\n")
    assert sent == [b"\x18"]
