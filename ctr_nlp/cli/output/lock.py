"""Folders that one process holds against others. The system lets go of them when the process ends, in any way."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

POLL = 0.02
"""Seconds between two attempts to get hold of a folder."""


@contextmanager
def locked(folder: Path, patience: float = 0.0) -> Iterator[bool]:
    """Hold a folder within the block; what is yielded is False where the file system knows no such locks.

    Raises BlockingIOError where another process still holds it after so many seconds of patience, and OSError.
    """
    if fcntl is None:
        yield False
        return
    door = os.open(folder, os.O_RDONLY)
    try:
        yield _taken(door, folder, time.monotonic() + patience)
    finally:
        os.close(door)


def _taken(door: int, folder: Path, deadline: float) -> bool:
    while True:
        try:
            fcntl.flock(door, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                raise BlockingIOError(f"another run is writing into {folder}") from error
            time.sleep(POLL)
        except OSError:
            return False
        else:
            return True
