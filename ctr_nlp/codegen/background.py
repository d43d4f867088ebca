"""Libraries built by another process, so that nobody waits for a compiler.

The process outlives the program that started it, so that the library is there for the next one. It works in a
folder in the cache, all its temporary files included, and has that folder locked as long as it lives. Where it is
killed, the system releases the lock, so that the next process removes the folder and starts the build again.
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

from ctr_nlp.codegen import cache, forward_mode, language, sample_points, tape, vector
from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.folder_lock import FolderLock, lock_named_folder, remove_abandoned
from ctr_nlp.support.pool import DetachedProcess

BACKGROUND_BUILD_MESSAGE = (
    "the programs for this kind of robot are being compiled in the background, which happens once; until that is "
    "done, they run several times slower. `ctr-nlp warm` compiles them beforehand"
)
WAITING_FOR_BUILD_MESSAGE = (
    "another process is compiling the programs for this kind of robot; this one waits until it has"
)
FAILED_BUILD_PREFIX = "failed-"
"""Prefix of the names of files in the cache that contain the reason why a library could not be made."""
_begun: list[DetachedProcess] = []
"""Processes started by this one that have not been seen to end."""
_tried: dict[str, float] = {}
"""When this process began builds, s, by the hash of their key."""
COMPILER_NICENESS = 10
"""Increment of the compiling process's nice value, so that processes that somebody waits for come first."""
LIBRARY_LOCK_RETRY_S = 0.05
"""s between two attempts to lock the build of a library that another process makes."""
LIBRARY_POLL_INTERVAL_S = 0.5
"""s between two checks whether a library has been made meanwhile."""
TEMPORARY_FOLDER_VARIABLES = "TMPDIR", "TEMP", "TMP"
"""Environment variables that set the folder of temporary files, for a process and the compiler that it calls."""
BUILD_TASK_FILE = "task"
"""Name of the file from which the other process reads what to compile."""
LOCK_HASH_DIGITS = 12
"""Digits of a key's hash that give the offset of its lock in the one file of all locks."""
FAILED_BUILD_RETRY_S = 900.0
"""s after which a build is begun again that the same process has begun before, or that a compiler has refused."""
SILENT_BUILD_WAIT_S = 5.0
"""s for which a process waits for another one's library before it logs a message."""


class Library:
    """Functions as a shared library, built when somebody first asks for it."""

    def __init__(
        self,
        described: str,
        functions: Callable[[], Sequence[ca.Function | sample_points.FunctionInParts]],
        lanes: int | None,
    ) -> None:
        """Prepare; nothing is compiled yet.

        described: text that changes whenever the functions do. functions: called only where code is written,
        perhaps in another process, and so pickled. lanes: frames that one call evaluates, None for any number. The
        attribute key is the library's key in the cache.
        """
        # Everything that the C code depends on: CasADi's version decides the order of instructions, and
        # _generator_source is the source of the modules that write it.
        self.key = "\n".join(
            [
                f"{lanes} lanes",
                language.optimisation_pragmas(lanes),
                ca.CasadiMeta.version(),
                _generator_source(),
                described,
            ]
        )
        self._functions = functions
        self._lanes = lanes
        self._missed = -math.inf

    def wait_for_path(self) -> Path:
        """Return the library's path, built first if it is missing; raise OptionError where that is impossible."""
        if (found := cache.find_library(self.key)) is not None:
            return found
        with cache.count_library_wait(), _exclusive_build(self.key):
            return cache.library(self.key, lambda: sample_points.code(tuple(self._functions()), self._lanes))

    def path_if_ready(self) -> Path | None:
        """Return the library's path, or None while it is built in the background, which the first call begins.

        Where the environment variable CTR_NLP_COMPILE is `now`, it is built at once.
        """
        if os.environ.get(cache.COMPILE_VARIABLE) == "now":
            return self.wait_for_path()
        # Callers ask in every iteration; reading the file system each time would slow them down.
        if time.monotonic() - self._missed < LIBRARY_POLL_INTERVAL_S:
            return None
        _begun[:] = [process for process in _begun if process.poll() is None]
        found = cache.find_library(self.key)
        if found is None:
            self._missed = time.monotonic()
            self._start_background_build()
        return found

    def _start_background_build(self) -> None:
        """Begin to build the library unless another process does; log a message either way."""
        failed = cache.folder() / f"{FAILED_BUILD_PREFIX}{_hash(self.key)}"
        with contextlib.suppress(OSError):
            if time.time() - failed.stat().st_mtime < FAILED_BUILD_RETRY_S:
                why = failed.read_text(encoding="utf-8", errors="replace")
                cache.warn_once(f"{why}; what needs it is solved without compiled code, several times slower")
                return
        try:
            work = _claim(self.key)
        except OSError as error:
            cache.warn_cache_unwritable(error)
            return
        cache.warn_once(BACKGROUND_BUILD_MESSAGE)
        if work is not None:
            _begin(work, self.key, self._functions, self._lanes)


@contextlib.contextmanager
def _exclusive_build(key: str) -> Iterator[None]:
    """Let only one process of a user build a library within the block, if the system has locks; others wait."""
    with contextlib.ExitStack() as stack:
        # Without locks (as on Windows) processes may build the same library twice, which costs time only.
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            # One file for all keys: a lock covers one byte of it, whose offset is taken from the key's
            # hash.
            lock = stack.enter_context(open(Path(tempfile.gettempdir(), f"ctr_nlp-{os.getuid()}.lock"), "a"))
            begin = time.monotonic()
            place = int(_hash(key)[:LOCK_HASH_DIGITS], 16)
            while time.monotonic() - begin < SILENT_BUILD_WAIT_S:
                with contextlib.suppress(BlockingIOError, PermissionError):  # either, says POSIX
                    fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
                    break
                time.sleep(LIBRARY_LOCK_RETRY_S)
            else:
                cache.warn_once(WAITING_FOR_BUILD_MESSAGE)
                fcntl.lockf(lock, fcntl.LOCK_EX, 1, place)
        yield


def _hash(key: str) -> str:
    """Return the hash of a key, for names of files."""
    return hashlib.sha256(key.encode()).hexdigest()[:32]


@functools.cache
def _generator_source() -> str:
    """Return the source of the modules that write C: a change to them changes what is compiled."""
    return "".join(map(inspect.getsource, (language, vector, tape, forward_mode, sample_points)))


def _claim(key: str) -> FolderLock | None:
    """Return the locked folder for building a library; None where a build is running or was tried before.

    Raises OSError where nothing can be written into the cache.
    """
    name = _hash(key)
    if time.monotonic() - _tried.get(name, -math.inf) < FAILED_BUILD_RETRY_S:
        return None  # whatever ended that build, as a lack of memory, would end this one, too
    place = cache.folder().absolute()
    own = f"{cache.BUILD_FOLDER_PREFIX}{name}"
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    remove_abandoned(place, own, cache.BUILD_FOLDER_ABANDONED_AFTER_S)
    work = lock_named_folder(place / own)
    if work is not None:
        _tried[name] = time.monotonic()
        cache.remove_abandoned_folders()
    return work


def _begin(
    work: FolderLock,
    key: str,
    functions: Callable[[], Sequence[ca.Function | sample_points.FunctionInParts]],
    lanes: int | None,
) -> None:
    """Start a process that builds a library: whoever waits for a solution need not even derive what is compiled.

    work: the claim, which that process takes over, so that the lock lasts as long as the process. key, functions,
    lanes: as in Library.
    """
    # The other process must import this very package, also where it is not installed.
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    own = {
        "PYTHONPATH": path,
        "PYTHONWARNINGS": "ignore",
        **dict.fromkeys(TEMPORARY_FOLDER_VARIABLES, str(work.folder)),
    }
    try:
        (work.folder / BUILD_TASK_FILE).write_bytes(pickle.dumps((key, functions, lanes)))
        process = DetachedProcess(
            [sys.executable, "-m", "ctr_nlp.codegen.background", str(work.folder)],
            env=os.environ | own,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # A session of its own: Ctrl-C and the end of the terminal do not reach the build.
            start_new_session=True,
            pass_fds=work.inheritable_descriptors,
        )
    except OSError as error:
        shutil.rmtree(work.folder, ignore_errors=True)
        cache.warn_cache_unwritable(error)
    else:
        _begun.append(process)
        _lower_priority(process.pid)
    finally:
        work.release()


def _lower_priority(pid: int) -> None:
    """Lower the priority of a process and of all processes that it starts, on systems that allow it.

    Linux weighs the processes of one session against those of others; with its groups for sessions (sched(7)), the
    nice value of a process that leads its own session means nothing to others unless the group has it, too.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, pid, COMPILER_NICENESS)
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(COMPILER_NICENESS), encoding="ascii")


def main(work: Path) -> None:
    """Build the library that the folder `work` describes, or note why that failed, and remove the folder."""
    try:
        key, functions, lanes = pickle.loads((work / BUILD_TASK_FILE).read_bytes())
        failed = cache.folder() / f"{FAILED_BUILD_PREFIX}{_hash(key)}"
        try:
            cache.library(key, lambda: sample_points.code(tuple(functions()), lanes))
            failed.unlink(missing_ok=True)
        except OptionError as error:
            failed.write_text(str(error), encoding="utf-8")
    finally:
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
