"""Folders that one process at a time may write into."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

FOLDER_LOCK_POLL_S = 0.02
"""Seconds between two attempts to get hold of a folder."""
NEW_FOLDER_LOCK_TIMEOUT_S = 1.0
"""Seconds for which a process waits for one that looks whether its new folder is abandoned."""


@contextmanager
def lock_folder(folder: Path, timeout_s: float = 0.0) -> Iterator[bool]:
    """Hold a folder against other processes within the block. The lock of a process that dies is gone with it.

    Parameters
    ----------
    folder : Path
        An existing folder; nothing is written into it.
    timeout_s : float
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
    held = acquire_folder_lock(folder, timeout_s)
    try:
        yield held.is_exclusive
    finally:
        held.release()


class FolderLock(NamedTuple):
    """A folder that this process holds, and so does every process that inherits its descriptor."""

    folder: Path
    descriptor: int | None
    """None where the file system knows no such locks."""

    @property
    def is_exclusive(self) -> bool:
        """Whether others are kept off the folder."""
        return self.descriptor is not None

    @property
    def inheritable_descriptors(self) -> tuple[int, ...]:
        """Descriptors that a child process must be given (``pass_fds``) to hold the folder, too."""
        return () if self.descriptor is None else (self.descriptor,)

    def release(self) -> None:
        """Let go of the folder here; processes that inherited it still hold it."""
        if self.descriptor is not None:
            os.close(self.descriptor)


def acquire_folder_lock(folder: Path, timeout_s: float = 0.0) -> FolderLock:
    """Hold a folder against other processes until it is released, or the last process that holds it has ended.

    Parameters
    ----------
    folder : Path
        An existing folder; nothing is written into it.
    timeout_s : float
        For how many s to wait for another process that holds it.

    Returns
    -------
    Held
        To be released.

    Raises
    ------
    BlockingIOError
        Another process still holds the folder.
    OSError
        There is no such folder, or it cannot be read.
    """
    if fcntl is None:
        return FolderLock(folder, None)
    door = os.open(folder, os.O_RDONLY)
    try:
        certain = _acquire_flock(door, folder, time.monotonic() + timeout_s)
    except BaseException:
        os.close(door)
        raise
    if not certain:
        os.close(door)
    return FolderLock(folder, door if certain else None)


def lock_new_folder(place: Path, prefix: str) -> FolderLock:
    """Make a folder of a new name in a place and hold it; raises OSError where none can be made."""
    while True:
        held = _lock_if_present(Path(tempfile.mkdtemp(prefix=prefix, dir=place)))
        if held is not None:
            return held


def lock_named_folder(folder: Path) -> FolderLock | None:
    """Make a folder of a given name and hold it.

    Parameters
    ----------
    folder : Path
        In a folder that exists; only its owner may look into it.

    Returns
    -------
    Held or None
        None where it is there already.

    Raises
    ------
    OSError
        It cannot be made.
    """
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        return None
    return _lock_if_present(folder)


def _lock_if_present(folder: Path) -> FolderLock | None:
    """Hold a folder that was made just now; None where another process took it for abandoned and removed it."""
    try:
        held = acquire_folder_lock(folder, NEW_FOLDER_LOCK_TIMEOUT_S)
    except (BlockingIOError, FileNotFoundError):
        return None
    with suppress(OSError):
        if held.descriptor is None or os.path.samestat(os.fstat(held.descriptor), folder.stat()):
            return held
    held.release()
    return None


def remove_abandoned(place: Path, pattern: str, uncertain_s: float) -> None:
    """Remove folders that processes which have died held.

    Parameters
    ----------
    place : Path
        Where they are.
    pattern : str
        A glob of names that only such folders have.
    uncertain_s : float
        Where the file system knows no locks: age in s from which a folder is taken for abandoned.
    """
    found = list[Path]()
    with suppress(OSError):  # as where the place is a file
        found.extend(place.glob(pattern))
    for folder in found:
        with suppress(OSError):  # BlockingIOError: a living process holds it
            if folder.is_symlink() or not folder.is_dir():
                continue
            held = acquire_folder_lock(folder)
            try:
                if held.is_exclusive or time.time() - folder.stat().st_mtime > uncertain_s:
                    shutil.rmtree(folder)
            finally:
                held.release()


def _acquire_flock(door: int, folder: Path, deadline: float) -> bool:
    """Lock the open folder `door`; False where the file system knows no locks. Raises BlockingIOError after the
    deadline.
    """
    while True:
        try:
            fcntl.flock(door, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                raise BlockingIOError(f"another run is writing into {folder}") from error
            time.sleep(FOLDER_LOCK_POLL_S)
        except OSError:
            return False
        else:
            return True
