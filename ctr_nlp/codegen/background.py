"""Libraries built by another process, so that nobody waits for a compiler.

The process outlives the program that started it: what was begun is there for the next one. It works in a folder in
the cache, all its temporary files included, and holds the lock of that folder as long as it lives. Where it is
killed, the system lets go of the lock, so that the next process removes the folder and begins anew.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import math
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import casadi as ca

from ctr_nlp.codegen import cache, directions, language, places, tape, vector
from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.folder_lock import Held, hold_named, remove_abandoned
from ctr_nlp.support.pool import Lasting

NOTE = (
    "the programs for this kind of robot are being compiled in the background, which happens once; until that is "
    "done, they run several times slower. `ctr-nlp warm` compiles them beforehand"
)
WAITING = "another process is compiling the programs for this kind of robot; this one waits until it has"
FAILED = "failed-"
"""How files in the cache begin that tell why a library could not be made."""
_begun: list[Lasting] = []
"""Processes started by this one that have not been seen to end."""
_tried: dict[str, float] = {}
"""When this process began builds, s, by the hash of their key."""
NICE = 10
"""Increment of the compiling process's nice value, so that processes that somebody waits for come first."""
TURN_S = 0.05
"""s between two attempts to get hold of a library that another process makes."""
POLL = 0.5
"""s between two looks at whether a library has been made meanwhile."""
TEMPORARY = "TMPDIR", "TEMP", "TMP"
"""What tells a process, and the compiler that it calls, where temporary files go."""
TASK = "task"
"""Name of the file that tells the other process what to compile."""
LOCKED = 12
"""Digits of a key's hash that tell its place among the locks of one file."""
RETRY_S = 900.0
"""s after which a build is begun again that the same process has begun before, or that a compiler has refused."""
PATIENCE_S = 5.0
"""s for which a process waits for another one's library without a word."""


class Library:
    """Functions as a shared library, built when somebody first asks for it."""

    def __init__(
        self, described: str, functions: Callable[[], Sequence[ca.Function | places.Whole]], lanes: int | None
    ) -> None:
        """Prepare; nothing is compiled yet.

        described: text that changes whenever the functions do. functions: called only where code is written,
        perhaps in another process, and so pickled. lanes: frames that one call evaluates, None for any number. The
        attribute key is the library's key in the cache.
        """
        # Everything that the C code depends on: CasADi's version decides the order of instructions, and
        # _writer is the source of the modules that write it.
        self.key = "\n".join(
            [f"{lanes} lanes", language.effort(lanes), ca.CasadiMeta.version(), _writer(), described]
        )
        self._functions, self._lanes = functions, lanes
        self._missed = -math.inf

    def now(self) -> Path:
        """The library, made at once where it is not there; raises OptionError where nothing can be compiled."""
        if (found := cache.kept(self.key)) is not None:
            return found
        with cache.counted_wait(), _alone(self.key):
            return cache.library(self.key, lambda: places.code(tuple(self._functions()), self._lanes))

    def soon(self) -> Path | None:
        """The library, or None while it is built in the background, which the first call begins.

        Where the environment variable CTR_NLP_COMPILE is `now`, it is built at once.
        """
        if os.environ.get(cache.SWITCH) == "now":
            return self.now()
        # Callers ask in every iteration; a look at the file system each time would slow them down.
        if time.monotonic() - self._missed < POLL:
            return None
        _begun[:] = [process for process in _begun if process.poll() is None]
        found = cache.kept(self.key)
        if found is None:
            self._missed = time.monotonic()
            self._build_in_background()
        return found

    def _build_in_background(self) -> None:
        """Begin to make the library unless another process is at it; either way, tell the user."""
        failed = cache.folder() / f"{FAILED}{_hash(self.key)}"
        with contextlib.suppress(OSError):
            if time.time() - failed.stat().st_mtime < RETRY_S:
                why = failed.read_text(encoding="utf-8", errors="replace")
                cache.say(f"{why}; what needs it is solved without compiled code, several times slower")
                return
        try:
            work = _claim(self.key)
        except OSError as error:
            cache.say_not_kept(error)
            return
        cache.say(NOTE)
        if work is not None:
            _begin(work, self.key, self._functions, self._lanes)


@contextlib.contextmanager
def _alone(key: str) -> Iterator[None]:
    """Context in which only one process of a user builds a library, if the system has locks; others wait."""
    with contextlib.ExitStack() as stack:
        # Without locks (as on Windows) processes may build the same library twice, which costs time only.
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            # One file for all keys: a lock covers one byte of it, whose offset is taken from the key's
            # hash.
            lock = stack.enter_context(open(Path(tempfile.gettempdir(), f"ctr_nlp-{os.getuid()}.lock"), "a"))
            begin, place = time.monotonic(), int(_hash(key)[:LOCKED], 16)
            while time.monotonic() - begin < PATIENCE_S:
                with contextlib.suppress(BlockingIOError, PermissionError):  # either, says POSIX
                    fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
                    break
                time.sleep(TURN_S)
            else:
                cache.say(WAITING)
                fcntl.lockf(lock, fcntl.LOCK_EX, 1, place)
        yield


def _hash(key: str) -> str:
    """Hash of a key, for names of files."""
    return hashlib.sha256(key.encode()).hexdigest()[:32]


@functools.cache
def _writer() -> str:
    """Source of the modules that write C: a change to them changes what is compiled."""
    return "".join(map(inspect.getsource, (language, vector, tape, directions, places)))


def _claim(key: str) -> Held | None:
    """The folder in which this process is to begin a library; None where one is at work, or has begun it before.

    Raises OSError where nothing can be written into the cache.
    """
    name = _hash(key)
    if time.monotonic() - _tried.get(name, -math.inf) < RETRY_S:
        return None  # whatever ended that build, as a lack of memory, would end this one, too
    place, own = cache.folder().absolute(), f"{cache.BUILDING}{name}"
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    remove_abandoned(place, own, cache.ABANDONED)
    work = hold_named(place / own)
    if work is not None:
        _tried[name] = time.monotonic()
        cache.sweep()
    return work


def _begin(
    work: Held, key: str, functions: Callable[[], Sequence[ca.Function | places.Whole]], lanes: int | None
) -> None:
    """Begin to make a library: whoever waits for a solution need not even derive what is compiled.

    The process that makes it takes over the claim, work, so that it lasts as long as that process.
    """
    # The other process must import this very package, also where it is not installed.
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    own = {"PYTHONPATH": path, "PYTHONWARNINGS": "ignore", **dict.fromkeys(TEMPORARY, str(work.folder))}
    try:
        (work.folder / TASK).write_bytes(pickle.dumps((key, functions, lanes)))
        process = Lasting(
            [sys.executable, "-m", "ctr_nlp.codegen.background", str(work.folder)],
            env=os.environ | own,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # A session of its own: Ctrl-C and the end of the terminal do not reach the build.
            start_new_session=True,
            pass_fds=work.inherited,
        )
    except OSError as error:
        shutil.rmtree(work.folder, ignore_errors=True)
        cache.say_not_kept(error)
    else:
        _begun.append(process)
        _step_back(process.pid)
    finally:
        work.release()


def _step_back(pid: int) -> None:
    """Lower the priority of a process and all that it starts, on systems that allow it.

    Linux weighs the processes of one session against those of others; with its groups for sessions (sched(7)), the
    nice value of a process that leads its own session means nothing to others unless the group has it, too.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, pid, NICE)
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(NICE), encoding="ascii")


def main(work: Path) -> None:
    """Make the library that a folder describes, or note why that failed, and remove the folder."""
    try:
        key, functions, lanes = pickle.loads((work / TASK).read_bytes())
        failed = cache.folder() / f"{FAILED}{_hash(key)}"
        try:
            cache.library(key, lambda: places.code(tuple(functions()), lanes))
            failed.unlink(missing_ok=True)
        except OptionError as error:
            failed.write_text(str(error), encoding="utf-8")
    finally:
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
