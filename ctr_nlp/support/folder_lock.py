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
"""Seconds between two attempts to lock a folder."""
NEW_FOLDER_LOCK_TIMEOUT_S = 1.0
"""Seconds for which a process waits for the lock of its new folder, which a process that removes abandoned folders
may hold for a moment.
"""

REMOVAL_ATTEMPTS = 5
"""How often the removal of a folder is tried into which another process may still write."""


@contextmanager
def lock_folder(folder: Path, timeout_s: float = 0.0) -> Iterator[bool]:
    """Lock a folder against other processes within the block. The lock of a process that dies is released.

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
    """A folder that this process has locked, together with every process that inherits its descriptor."""

    folder: Path
    descriptor: int | None
    """None where the file system knows no such locks."""

    @property
    def is_exclusive(self) -> bool:
        """Whether others are kept off the folder."""
        return self.descriptor is not None

    @property
    def inheritable_descriptors(self) -> tuple[int, ...]:
        """Descriptors that a child process must be given (``pass_fds``) to share the lock."""
        return () if self.descriptor is None else (self.descriptor,)

    def release(self) -> None:
        """Release the lock in this process; processes that inherited it keep it."""
        if self.descriptor is not None:
            # Closed instead of unlocked: flock's LOCK_UN would take the lock from child processes as well, which
            # share it (flock(2)).
            os.close(self.descriptor)


def acquire_folder_lock(folder: Path, timeout_s: float = 0.0) -> FolderLock:
    """Lock a folder until it is released, or the last process that shares the lock has ended.

    Parameters
    ----------
    folder : Path
        An existing folder; nothing is written into it.
    timeout_s : float
        For how many s to wait for another process that holds it.

    Returns
    -------
    FolderLock
        The lock, to be released by the caller.

    Raises
    ------
    BlockingIOError
        Another process still holds the folder.
    OSError
        There is no such folder, or it cannot be read.
    """
    if fcntl is None:
        return FolderLock(folder, None)
    # The folder itself is locked, not a file in it: nothing is left behind, and the kernel releases the lock of a
    # process that is killed.
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
    """Make a folder with a new name and lock it.

    place: where to make it. prefix: beginning of its name. Raises OSError where it cannot be made.
    """
    while True:
        held = _lock_if_present(Path(tempfile.mkdtemp(prefix=prefix, dir=place)))
        if held is not None:
            return held


def lock_named_folder(folder: Path) -> FolderLock | None:
    """Make a folder of a given name and lock it.

    Parameters
    ----------
    folder : Path
        In a folder that exists; only its owner may look into it.

    Returns
    -------
    FolderLock or None
        None where the folder exists already.

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
    """Lock a folder that was made just now; return None where another process took it for abandoned and removed
    it.
    """
    try:
        held = acquire_folder_lock(folder, NEW_FOLDER_LOCK_TIMEOUT_S)
    except (BlockingIOError, FileNotFoundError):
        return None
    with suppress(OSError):
        # Between mkdir and flock another process may have removed the folder, or replaced it by one of the same
        # name: the lock counts only if the descriptor and the path still are the same folder.
        if held.descriptor is None or os.path.samestat(os.fstat(held.descriptor), folder.stat()):
            return held
    held.release()
    return None


def remove_abandoned(place: Path, pattern: str, uncertain_s: float) -> None:
    """Remove folders of processes that have died.

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
                # A lock that can be had means that its owner is dead. Without locks only the folder's age can
                # tell.
                if held.is_exclusive or time.time() - folder.stat().st_mtime > uncertain_s:
                    _remove_tree(folder)
            finally:
                held.release()


def _remove_tree(folder: Path) -> None:
    """Free the folder's name at once, then remove its contents; raise OSError where that is impossible.

    A process that the dead owner had started, such as a compiler, may still write into the folder, so that it is
    not empty when it is removed. The new name keeps the old one's beginning: whatever is left is found next time.
    """
    renamed = Path(tempfile.mkdtemp(prefix=f"{folder.name}-", dir=folder.parent))
    folder.rename(renamed / folder.name)
    for attempt in range(REMOVAL_ATTEMPTS):
        try:
            shutil.rmtree(renamed)
        except OSError:
            if attempt == REMOVAL_ATTEMPTS - 1:
                raise
            time.sleep(FOLDER_LOCK_POLL_S)
        else:
            return


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
            # Not supported, as on some network file systems.
            return False
        else:
            return True
