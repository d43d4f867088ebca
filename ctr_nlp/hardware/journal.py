"""Journal of a session: a line of JSON for every byte, state and frame, enough to resume after a crash."""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import JournalError
from ctr_nlp.hardware.clock import Clock

DURABLE = ("program", "state", "result")
"""Kinds of records that are on the disk before the program goes on."""


class Journal:
    """An open file to which whole records are appended; raises JournalError where that fails.

    A record is {"t": s of the clock, "kind": ..., ...}. Bytes are latin-1 text. An existing file is continued.
    session: a unique name. unwritten: why records are missing, "" where none is.
    """

    def __init__(self, path: str | Path, clock: Clock) -> None:
        self.path = Path(path)
        self._clock = clock
        self._strict = True
        self.session = uuid.uuid4().hex
        self.unwritten = ""
        with self._written():
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            with self._written():
                self._end = os.fstat(self._file).st_size
                # A crash may have cut the last line short: end it, so that ours begins a new one.
                if self._end and not self.path.read_bytes().endswith(b"\n"):
                    self._write(b"\n")
            self.record("session", id=self.session, wall=time.time(), pid=os.getpid())
        except JournalError:
            self.close()
            raise

    def record(self, kind: str, **fields: Any) -> None:
        """Add a record; one that fits only in part is removed again before JournalError is raised.

        kind: of the record. fields: the rest of it, values as JSON has them.
        """
        line = json.dumps({"t": round(self._clock.now(), 6), "kind": kind} | fields, allow_nan=False)
        with self._written():
            self._write(line.encode() + b"\n")
            if kind in DURABLE:
                # Only for these: waiting for the disk at every byte would hold up the player, which looks every 5
                # ms.
                os.fsync(self._file)

    @contextmanager
    def forgiving(self) -> Iterator[None]:
        """Note write errors within the block instead of raising them, so that they cannot prevent a stop."""
        before = self._strict
        self._strict = False
        try:
            yield
        finally:
            self._strict = before

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as exception:
            self.unwritten = f"journal {self.path} cannot be written: {exception}"
            if self._strict:
                raise JournalError(self.unwritten) from exception

    def _write(self, data: bytes) -> None:
        written = os.write(self._file, data)
        if written < len(data):
            os.ftruncate(self._file, self._end)
            raise OSError(f"only {written} of {len(data)} bytes fit")
        self._end += written

    def close(self) -> None:
        """Close the file; write errors are noted."""
        with self.forgiving(), self._written():
            os.close(self._file)


def read_journal(path: str | Path) -> list[dict[str, Any]]:
    """Return the records since the session that played last began, oldest first; raises JournalError.

    path: of the journal. Later sessions that played nothing are included. Lines that a crash cut short are left
    out.
    """
    try:
        lines = Path(path).read_bytes().split(b"\n")
    except OSError as exception:
        raise JournalError(f"journal {path} cannot be read: {exception}") from exception
    sessions: list[list[dict[str, Any]]] = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            record = json.loads(line)
            kind = record["kind"]
        except (ValueError, TypeError, KeyError) as exception:
            # number counts from 1, so that lines[number] is the next line. Only the last record of a session can
            # be cut short; any other damage means that the file is not to be relied on.
            if number == len(lines) or b'"kind": "session"' in lines[number]:
                continue
            raise JournalError(f"journal {path}: line {number} is not a record ({exception})") from exception
        if kind == "session":
            sessions.append([])
        if not sessions:
            break
        sessions[-1].append(record)
    if not sessions:
        raise JournalError(f"journal {path} holds no session")
    played = [n for n, records in enumerate(sessions) if any(r["kind"] == "program" for r in records)]
    return [record for records in sessions[played[-1] if played else -1 :] for record in records]
