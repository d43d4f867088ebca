"""What is remembered of a device between sessions: whether its position is to be trusted, and where it was.

Steppers have no encoders. A session that ended badly, or without a word, leaves a position that only homing or a
person can vouch for; so does a controller that was switched off, which is seen by its own count.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.support.extras import needed
from ctr_nlp.support.whole_file import whole_file

FOLDER = "CTR_NLP_STATE"
"""Environment variable: a folder for what is remembered, instead of the user's own."""

REMEDY = "home, or make sure that the axes stand where the device says, and say so (--position-verified)"


def state_folder() -> Path:
    """Where devices are remembered: CTR_NLP_STATE, or ctr_nlp in the user's state folder."""
    named = os.environ.get(FOLDER)
    return Path(named) if named else Path(needed("platformdirs").user_state_path("ctr_nlp", appauthor=False))


@dataclass(frozen=True)
class Remembered:
    """How a session left a device. why: a sentence where it is not trusted; position (m,): of the axes, if known.

    session: of a motion that had begun and had not ended, "" for none.
    """

    trusted: bool
    why: str = ""
    position: tuple[float, ...] | None = None
    session: str = ""


class Memory:
    """What is remembered of the device at an address; whoever claims it is its only player. Raises DeviceFault."""

    def __init__(self, folder: Path, address: str) -> None:
        self._folder, self._address = folder, address
        self._lock: Any = None

    def claim(self) -> None:
        """Keep other players off this device until it is released or this process ends."""
        filelock = needed("filelock")
        lock = filelock.FileLock(self._path("lock", ""))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
        except filelock.Timeout as error:
            raise DeviceFault(f"another player is connected to {self._address}: only one may be") from error
        except OSError as error:
            raise self._unwritten(error) from error
        self._lock = lock

    def release(self) -> None:
        """Let others play."""
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def read(self, identity: str) -> Remembered | None:
        """How the device was left, None where it was never met; what cannot be read is no reason for trust."""
        path = self._path("json", identity)
        try:
            return Remembered(**json.loads(path.read_text(encoding="utf-8")))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError) as error:
            return Remembered(False, f"what was remembered of it, in {path}, cannot be read ({error})")

    def write(self, identity: str, left: Remembered) -> None:
        """Remember it, on the disk before this returns."""
        path = self._path("json", identity)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as partial, open(partial, "w", encoding="utf-8") as file:
                json.dump(asdict(left), file)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise self._unwritten(error) from error

    def _path(self, kind: str, identity: str) -> Path:
        name = hashlib.sha256(f"{self._address}\n{identity}".encode()).hexdigest()[:24]
        return self._folder / f"{name}.{kind}"

    def _unwritten(self, error: OSError) -> DeviceFault:
        return DeviceFault(
            f"whether {self._address} can be trusted cannot be remembered in {self._folder} ({error}): nothing is "
            f"played; {FOLDER} names another folder"
        )


def doubt(
    left: Remembered | None,
    position: npt.NDArray[np.float64],
    resolution: npt.NDArray[np.float64],
    session: str = "",
) -> str:
    """Why a device at a position (m,) is not to be trusted, "" where nothing speaks against it.

    resolution (m,): what it can tell apart. session: one that is being resumed, whose motion is looked for by
    itself.
    """
    if left is None or (session and left.session == session):
        return ""
    if not left.trusted:
        return f"the position of the axes is not to be trusted, since {left.why}: {REMEDY}"
    known = np.array(position if left.position is None else left.position)
    if known.shape != position.shape or (abs(position - known) > resolution).any():
        there = ", ".join(f"{value:.4g}" for value in position)
        was = ", ".join(f"{value:.4g}" for value in known)
        return (
            f"the device counts {there}, and was left at {was}: it was switched off or moved by somebody else, "
            f"and its position is not to be trusted: {REMEDY}"
        )
    return ""
