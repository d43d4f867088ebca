"""A line of JSON for every byte, state and frame of playing: what happened, and enough to go on after a crash."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

from ctr_nlp.errors import JournalError
from ctr_nlp.executor.clock import Clock

DURABLE = ("program", "state", "result")
"""Kinds of records that are on the disk before anything else happens."""


class Journal:
    """An open file to which records are added, each whole; raises JournalError where that fails.

    A record is {"t": s of the clock, "kind": ..., ...}. Bytes are latin-1 text. A file that is there is added to.
    A failure is told once: what stops the robot afterwards must not fail for want of a journal.
    """

    def __init__(self, path: str | Path, clock: Clock) -> None:
        self.path, self._clock, self._failed = Path(path), clock, False
        try:
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            self._end = os.fstat(self._file).st_size
            if self._end and not self.path.read_bytes().endswith(b"\n"):
                self._write(b"\n")
        except OSError as error:
            raise JournalError(f"journal {self.path} cannot be written: {error}") from error
        self.record("session", wall=time.time(), pid=os.getpid())

    def record(self, kind: str, **fields: Any) -> None:
        """Add a record; a half-written one is taken back before JournalError is raised."""
        if self._failed:
            return
        line = json.dumps({"t": round(self._clock.now(), 6), "kind": kind} | fields, allow_nan=False)
        try:
            self._write(line.encode() + b"\n")
            if kind in DURABLE:
                os.fsync(self._file)
        except OSError as error:
            self._failed = True
            raise JournalError(f"journal {self.path} cannot be written: {error}") from error

    def _write(self, data: bytes) -> None:
        written = os.write(self._file, data)
        if written < len(data):
            os.ftruncate(self._file, self._end)
            raise OSError(f"only {written} of {len(data)} bytes fit")
        self._end += written

    def close(self) -> None:
        """Nothing can be added afterwards."""
        os.close(self._file)


def read_journal(path: str | Path) -> list[dict[str, Any]]:
    """The records of a journal's last session, oldest first; raises JournalError.

    A last line that a crash cut short is left out.
    """
    try:
        lines = Path(path).read_bytes().split(b"\n")
    except OSError as error:
        raise JournalError(f"journal {path} cannot be read: {error}") from error
    records: list[dict[str, Any]] = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            record = json.loads(line)
            kind = record["kind"]
        except (ValueError, TypeError, KeyError) as error:
            if number == len(lines) or b'"kind": "session"' in lines[number]:
                continue
            raise JournalError(f"journal {path}, line {number}: not a record ({error})") from error
        records = [record] if kind == "session" else [*records, record]
    if not records or records[0]["kind"] != "session":
        raise JournalError(f"journal {path} holds no session")
    return records
