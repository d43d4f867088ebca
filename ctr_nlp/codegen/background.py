"""Libraries built by another process, so that nobody waits for a compiler.

The process outlives the program that started it: what was begun is there for the next one.
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
from ctr_nlp.support.pool import Lasting

NOTE = (
    "the programs for this kind of robot are being compiled in the background, which happens once; until that is "
    "done, they run several times slower. `ctr-nlp warm` compiles them beforehand"
)
_begun: list[Lasting] = []
"""Processes started by this one that have not been seen to end."""
NICE = 10
"""Increment of the compiling process's nice value, so that processes that somebody waits for come first."""
POLL = 0.5
"""Seconds between two looks at whether a library has been built meanwhile."""
TASK = "task"
"""Name of the file that tells the other process what to compile."""
LOCKED = 12
"""Digits of a key's hash that are its byte among the locks of one file."""
CLAIMED = 900.0
"""Seconds after which a build that has not ended is given up, and another process may start it."""


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
            if _claimed(self.key):
                cache.say(NOTE)
                _begin(self.key, self._functions, self._lanes)
        return found


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
            fcntl.lockf(lock, fcntl.LOCK_EX, 1, int(_hash(key)[:LOCKED], 16))
        yield


def _hash(key: str) -> str:
    """Hash of a key, for names of files."""
    return hashlib.sha256(key.encode()).hexdigest()[:32]


@functools.cache
def _writer() -> str:
    """Source of the modules that write C: a change to them changes what is compiled."""
    return "".join(map(inspect.getsource, (language, vector, tape, directions, places)))


def _claimed(key: str) -> bool:
    """Whether no process builds the library yet, so that this one is to begin."""
    claim = cache.folder() / f"claim-{_hash(key)}"
    with contextlib.suppress(OSError):
        # A claim whose process was killed must not keep others from building for ever.
        if claim.exists() and time.time() - claim.stat().st_mtime > CLAIMED:
            claim.unlink()
        claim.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Creating a file that must not exist is one step: only one of several processes succeeds.
        claim.touch(exist_ok=False)
        return True
    return False


def _begin(key: str, functions: Callable[[], Sequence[ca.Function | places.Whole]], lanes: int | None) -> None:
    """Start to build a library in another process, which derives the functions from their pickled form, too."""
    work = Path(tempfile.mkdtemp(prefix="ctr_nlp-build-"))
    (work / TASK).write_bytes(pickle.dumps((key, functions, lanes)))
    # The other process must import this very package, also where it is not installed.
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    with contextlib.suppress(OSError):
        process = Lasting(
            [sys.executable, "-m", "ctr_nlp.codegen.background", str(work)],
            env=os.environ | {"PYTHONPATH": path, "PYTHONWARNINGS": "ignore"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # A session of its own: Ctrl-C and the end of the terminal do not reach the build.
            start_new_session=True,
        )
        _begun.append(process)
        _step_back(process.pid)


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
    """Build the library that the folder `work` describes, and remove the folder."""
    try:
        key, functions, lanes = pickle.loads((work / TASK).read_bytes())
        cache.library(key, lambda: places.code(tuple(functions()), lanes))
    finally:
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
