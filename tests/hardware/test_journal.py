"""The journal: whole records of every byte in order, whatever crashes or fills up."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bench import WireLink, World, sweep
from emulator.wire import VirtualClock

from ctr_nlp.exceptions import JournalError
from ctr_nlp.hardware import journal as journal_module
from ctr_nlp.hardware.journal import Journal, read_journal
from ctr_nlp.hardware.link import RecordedLink
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState
from ctr_nlp.hardware.playing.session import play_plan


def test_every_byte_of_a_session_is_there_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent, received = bytearray(), bytearray()
    write, read = WireLink.write, WireLink.read

    def wrote(link: WireLink, data: bytes) -> None:
        sent.extend(data)
        write(link, data)

    def heard(link: WireLink) -> bytes:
        data = read(link)
        received.extend(data)
        return data

    monkeypatch.setattr(WireLink, "write", wrote)
    monkeypatch.setattr(WireLink, "read", heard)
    world = World(tmp_path, sweep(6, 0.2))
    assert world.begin().outcome is PlaybackOutcome.SUCCESS
    records = read_journal(world.path)
    for kind, data in (("sent", sent), ("received", received)):
        assert "".join(r["data"] for r in records if r["kind"] == kind).encode("latin-1") == bytes(data)
        assert len(data) > 500
    assert [r["t"] for r in records] == sorted(r["t"] for r in records)


class Half:
    """A link that takes every byte value and gives them all back."""

    data = bytes(range(256))

    def write(self, data: bytes) -> None:
        assert data == self.data

    def read(self) -> bytes:
        return self.data

    def close(self) -> None:
        pass


def test_bytes_of_all_values_are_kept(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j", VirtualClock())
    link = RecordedLink(Half(), journal)
    link.write(Half.data)
    link.read()
    sent, received = read_journal(tmp_path / "j")[1:]
    assert sent["data"].encode("latin-1") == received["data"].encode("latin-1") == Half.data


def test_what_cannot_be_recorded_is_not_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal, sent = Journal(tmp_path / "j", VirtualClock()), []
    link = RecordedLink(Half(), journal)
    monkeypatch.setattr(Half, "write", lambda _, data: sent.append(data))
    monkeypatch.setattr(journal_module.os, "write", full)
    for _ in range(2):
        with pytest.raises(JournalError, match="No space left"):
            link.write(b"G1 X1\n")
    assert sent == []
    with journal.forgiving():
        link.write(b"!")
    assert sent == [b"!"]
    with pytest.raises(JournalError):
        link.write(b"G1 X1\n")


def full(*_: Any) -> int:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_a_line_cut_by_a_crash_is_left_out_also_by_the_sessions_after_it(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "j"
    first = Journal(path, VirtualClock())
    first.record("program", digest="a" * 64)
    first.record("frame", frame=1)
    first.record("frame", frame=2, position=[1.5] * 6)
    whole = read_journal(path)
    data = path.read_bytes()
    path.write_bytes(data[:-cut])
    expected = whole if cut == 1 else whole[:-1]
    assert read_journal(path) == expected
    Journal(path, VirtualClock()).record("state", state="idle")
    assert read_journal(path)[: len(expected)] == expected
    assert [r["kind"] for r in read_journal(path)[len(expected) :]] == ["session", "state"]


def test_the_last_session_that_played_counts(tmp_path: Path) -> None:
    path = tmp_path / "j"
    for digest in ("a", "b"):
        journal = Journal(path, VirtualClock())
        journal.record("program", digest=digest)
        journal.close()
    Journal(path, VirtualClock()).close()
    records = read_journal(path)
    assert [r["kind"] for r in records] == ["session", "program", "session"]
    assert records[1]["digest"] == "b"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "holds no session"),
        (b'{"t": 0, "kind": "frame"}\n', "holds no session"),
        (b"what is this\nand this\n", "line 1 is not a record"),
        (b'{"kind": "session"}\n[1]\n{"kind": "frame"}\n', "line 2 is not a record"),
        (b'{"kind": "session"}\n\xff\xfe\n{"kind": "frame"}\n', "line 2 is not a record"),
        (b"PK\x03\x04", "holds no session"),
    ],
)
def test_what_is_no_journal_is_said_so(content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "j"
    path.write_bytes(content)
    with pytest.raises(JournalError, match=message):
        read_journal(path)


def test_a_journal_that_cannot_be_opened(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "no" / "j"):
        with pytest.raises(JournalError, match="cannot be read"):
            read_journal(path)
        with pytest.raises(JournalError, match="cannot be written"):
            Journal(path, VirtualClock())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_device_that_is_full_from_the_beginning() -> None:
    with pytest.raises(JournalError, match="No space left"):
        Journal("/dev/full", VirtualClock())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limits on file sizes")
def test_a_disk_that_fills_up_leaves_whole_records(tmp_path: Path) -> None:
    """A real limit, which writes a part of the record that crosses it."""
    program = f"""
import resource
from emulator.wire import VirtualClock
from ctr_nlp.exceptions import JournalError
from ctr_nlp.hardware.journal import Journal
journal = Journal({str(tmp_path / "j")!r}, VirtualClock())
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
try:
    for frame in range(100):
        journal.record("frame", frame=frame, position=[1.0] * 6)
except JournalError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
journal.record("result", frame=frame)
"""
    tests = Path(__file__).parents[1]
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tests)
    assert "bytes fit" in found.stdout
    records = [json.loads(line) for line in (tmp_path / "j").read_bytes().splitlines()]
    frames = [record["frame"] for record in records[1:]]
    assert frames == list(range(len(frames)))
    assert len((tmp_path / "j").read_bytes().splitlines()[-1]) < 100


@pytest.mark.parametrize("record", [*range(0, 30, 3), *range(30, 200, 17)])
def test_a_disk_that_is_full_from_any_record_on_stops_the_robot(
    record: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the first failure meets the very stop: nothing moves afterwards."""
    world, left = World(tmp_path, sweep(6, 0.2)), [record]
    player, write = world.player(), journal_module.os.write

    def filling(file: int, data: bytes) -> int:
        left[0] -= 1
        return write(file, data) if left[0] >= 0 else full()

    monkeypatch.setattr(journal_module.os, "write", filling)

    def seen(program: Any, progress: Any) -> None:
        if program.frames[0] == 1 and progress.time > 0.2:
            player.abort()

    try:
        result = play_plan(player, world.plan, world.hardware, callback=seen)
    except JournalError:
        world.clock.sleep(2.0)
        assert world.firmware.executed_blocks == []
        assert player.state is not PlayerState.RUNNING
        return
    if left[0] < 0:
        assert result.outcome in (PlaybackOutcome.DEVICE_FAULT, PlaybackOutcome.CANCELLED)
    assert result.trusted
    stood = world.firmware.position
    world.clock.sleep(2.0)
    assert (world.firmware.position == stood).all()
    assert all(json.loads(line) for line in world.path.read_bytes().splitlines())
