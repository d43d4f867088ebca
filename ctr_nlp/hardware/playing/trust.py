"""Trust in a device's position between sessions: what is remembered of a device, and where it was left.

Steppers have no encoders. A session that ended badly, or without a record, leaves a position that only homing or a
person can confirm; so does a controller that was switched off, which shows in its own count.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.devices import Device, Standing
from ctr_nlp.hardware.playing.results import Result
from ctr_nlp.support.atomic_write import write_atomically
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

STATE_FOLDER_VARIABLE = "CTR_NLP_STATE"
"""Environment variable: a folder for what is remembered, instead of the user's own."""

SHARED_FOLDER = Path("/tmp") if os.name == "posix" else Path(tempfile.gettempdir())
"""Where all users of this machine lock devices; TMPDIR, which each may set, does not move it."""

DISTRUST_REMEDY = "home the device, or check that its axes are where it reports and give --position-verified"


def state_folder() -> Path:
    """Return the folder where devices are remembered: CTR_NLP_STATE, or ctr_nlp in the user's state folder."""
    named = os.environ.get(STATE_FOLDER_VARIABLE)
    return Path(named) if named else Path(import_extra("platformdirs").user_state_path("ctr_nlp", appauthor=False))


@dataclass(frozen=True)
class Remembered:
    """State in which a session left a device.

    why: a sentence where it is not trusted. position (m,): of the axes, if known. session: of a motion that had
    begun and had not ended, "" for none.
    """

    trusted: bool
    why: str = ""
    position: tuple[float, ...] | None = None
    session: str = ""


class Memory:
    """Memory of the device at an address, which also locks it for one player. Raises DeviceFault.

    Parameters
    ----------
    folder : Path
        State folder of this user, where devices are remembered.
    address : str
        Canonical address of the device, the same however a hardware file spells it.
    url : str, optional
        Name of the device in messages; by default its address.
    shared_folder : Path, optional
        Folder where players of all users lock devices.
    """

    def __init__(self, folder: Path, address: str, url: str = "", shared_folder: Path = SHARED_FOLDER) -> None:
        self._folder = folder
        self._address = address
        self._url = url or address
        self._shared_folder = shared_folder
        self._locks = ExitStack()

    def claim(self) -> None:
        """Lock the device against players of all users of this machine, until release or the process' end."""
        filelock = import_extra("filelock")
        own = filelock.FileLock(self._path("lock", ""))
        with ExitStack() as taken:
            try:
                shared = self._shared_folder / f"ctr_nlp-{_digest(self._address)}.lock"
                # Users have state folders of their own, so that the shared lock alone keeps them apart. The own
                # one serves where the shared one does nothing, without fcntl.
                taken.enter_context(_locked_for_all(shared))
                self._folder.mkdir(parents=True, exist_ok=True)
                own.acquire(timeout=0)
            except (BlockingIOError, filelock.Timeout) as exception:
                raise DeviceFault(f"another player is connected to {self._url}: only one may be") from exception
            except _Unlockable as exception:
                raise DeviceFault(
                    f"{self._url} cannot be locked against other users of this machine: {exception}; nothing is "
                    "played"
                ) from exception
            except OSError as exception:
                raise self._unwritten(exception) from exception
            taken.callback(own.release)
            self._locks = taken.pop_all()

    def release(self) -> None:
        """Release the locks, so that others can play."""
        self._locks.close()

    def read(self, identity: str) -> Remembered | None:
        """Return how the device was left, None where it is not known; an unreadable record is no reason for trust.

        identity: of the connected device.
        """
        path = self._path("json", identity)
        try:
            return Remembered(**json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError) as exception:
            return Remembered(False, f"what was remembered of it, in {path}, cannot be read ({exception})")

    def write(self, identity: str, left: Remembered) -> None:
        """Remember how the device was left, on the disk before this returns.

        identity: of the connected device. left: its state.
        """
        path = self._path("json", identity)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with write_atomically(path) as partial, open(partial, "w", encoding="utf-8") as file:
                json.dump(asdict(left), file)
                file.flush()
                os.fsync(file.fileno())
        except OSError as exception:
            raise self._unwritten(exception) from exception

    def _path(self, kind: str, identity: str) -> Path:
        """Return the path of a file of some kind, its suffix, for a device with an identity."""
        return self._folder / f"{_digest(self._address, identity)}.{kind}"

    def _unwritten(self, exception: OSError) -> DeviceFault:
        return DeviceFault(
            f"the state of {self._url} cannot be saved in {self._folder} ({exception}); set "
            f"{STATE_FOLDER_VARIABLE} to a folder that can be written"
        )


def _digest(*words: str) -> str:
    """Return a short name for some words, which is also a file name."""
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:24]


class _Unlockable(Exception):
    """A file cannot be used as a lock; the message is the system's."""


@contextmanager
def _locked_for_all(path: Path) -> Iterator[None]:
    """Hold a lock file that every user can lock; raises BlockingIOError where another holds it, _Unlockable.

    filelock refuses a file of another user in a folder that all may write to. Locking needs no right to write, and
    a file that is there is not created again, which Linux forbids in such a folder (fs.protected_regular).
    """
    try:
        import fcntl
    except ImportError:  # not on Unix: the lock in the user's own folder must do
        yield
        return
    try:
        with suppress(FileExistsError):
            made = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_EXCL)
            os.fchmod(made, 0o444)  # the umask does not count
            os.close(made)
        # Anybody could put a link of this name into a folder that all may write to.
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError as exception:
        raise _Unlockable(exception) from exception
    try:
        # The system drops this lock when the process dies, however it does.
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(file)


class Trust:
    """Trust in the position of a connected device; memory: None where nothing is remembered of it.

    doubt: why the position is not to be trusted, "" where it is.
    """

    def __init__(self, memory: Memory | None) -> None:
        self._memory = memory
        self.doubt = ""
        self._vouched = False
        """Whether memory, homing or a person confirms the position, so that later results count."""

    def claim(self) -> None:
        """Lock the device against other players; raises DeviceFault."""
        if self._memory is not None:
            self._memory.claim()

    def release(self) -> None:
        """Release the lock, so that others can play."""
        if self._memory is not None:
            self._memory.release()

    def look_back(self, device: Device, standing: Standing, homed: bool = False, session: str = "") -> None:
        """Judge the position of a connected device by what is remembered of it.

        standing: of the device now. homed: just now, which replaces memory. session: one that is being resumed, ""
        for none.
        """
        if self._memory is not None and not homed:
            left = self._memory.read(device.identity)
            self.doubt = doubt(left, standing.position, device.resolution, session)
        self._vouched = not self.doubt

    def vouch(self) -> None:
        """Trust the position, since a person has checked it."""
        self.doubt = ""
        self._vouched = True

    def holds(self, device: Device, standing: Standing) -> bool:
        """Return whether the position that a device reports at the end of a session is to be trusted.

        standing: of the device now.
        """
        if not self._vouched:
            self.look_back(device, standing)
        return standing.homed and not self.doubt

    def note_motion_start(self, device: Device, session: str) -> None:
        """Remember the device as not trusted from now on, in case the motion's end is never recorded.

        session: name of the one that begins. Raises DeviceFault.
        """
        self._write(
            device, Remembered(False, "a motion had begun, and its end was never recorded", session=session)
        )

    def note_motion_end(self, device: Device, result: Result) -> None:
        """Remember how a session left the device, unless nobody confirms what it reports; raises DeviceFault.

        result: of the motion.
        """
        if self._vouched or result.position is None:
            position = None if result.position is None else tuple(result.position.tolist())
            self._write(device, Remembered(result.trusted, "" if result.trusted else result.message, position))

    def _write(self, device: Device, left: Remembered) -> None:
        if self._memory is not None:
            self._memory.write(device.identity, left)


def doubt(left: Remembered | None, position: Array, resolution: Array, session: str = "") -> str:
    """Return why a device at a position (m,) is not to be trusted, "" where it is.

    left: None where nothing is remembered, so that somebody must look. resolution (m,): of the axes, in their
    units. session: one that is being resumed, whose place on the path is looked for instead.
    """
    if left is None:
        return (
            f"there is no record of this device, so that its reported position is unconfirmed: {DISTRUST_REMEDY}"
        )
    # A motion of this session was interrupted: its position cannot be the one it was left at, but must lie on the
    # path, which resume checks.
    if session and left.session == session:
        return ""
    if not left.trusted:
        return f"the position of the axes is not to be trusted, since {left.why}: {DISTRUST_REMEDY}"
    known = np.array(position if left.position is None else left.position)
    if known.shape != position.shape or (abs(position - known) > resolution).any():
        there = ", ".join(f"{value:.4g}" for value in position)
        was = ", ".join(f"{value:.4g}" for value in known)
        return (
            f"the device reports the position {there}, but was left at {was}: it was switched off, or moved "
            f"by other means, and its position is not to be trusted: {DISTRUST_REMEDY}"
        )
    return ""
