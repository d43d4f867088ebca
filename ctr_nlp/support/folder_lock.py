"""Folders that one process at a time may write into."""

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
    """Hold a folder against other processes within the block. The lock of a process that dies is gone with it.

    Parameters
    ----------
    folder : Path
        An existing folder; nothing is written into it.
    patience : float
        For how many s to wait for another process that holds it.

    Yields
    ------
    bool
        False where the file system knows no such locks.

    Raises
    ------
    BlockingIOError
        Another process still holds the folder.
    OSError
        There is no such folder, or it cannot be read.
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
