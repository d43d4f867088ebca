"""Libraries made by a process of its own, so that nobody waits for a compiler.

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
"""Processes of this one that have not been seen to end."""
NICE = 10
"""By how much a compiling process steps back for those that somebody waits for."""
POLL = 0.5
"""s between two looks at whether a library has been made meanwhile."""
TASK = "task"
"""The file that tells a process what to compile."""
LOCKED = 12
"""Digits of a key's hash that tell its place among the locks of one file."""
CLAIMED = 900.0
"""s after which a build that has not ended is given up."""


class Library:
    """Functions as a shared library, made when somebody first asks for it."""

    def __init__(
        self, described: str, functions: Callable[[], Sequence[ca.Function | places.Whole]], lanes: int | None
    ) -> None:
        """described: text that changes whenever the functions do. lanes: of frames at once, None for any number.

        functions: called only where code is written, perhaps in another process, and so pickled. key: under which
        the cache keeps the library.
        """
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
        """The same, or None while it is made in the background, which the first call begins.

        Where the environment variable CTR_NLP_COMPILE is `now`, it is made at once.
        """
        if os.environ.get(cache.SWITCH) == "now":
            return self.now()
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
    """Where processes of a user wait for one library, one makes it for all, if the system has locks."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            lock = stack.enter_context(open(Path(tempfile.gettempdir(), f"ctr_nlp-{os.getuid()}.lock"), "a"))
            fcntl.lockf(lock, fcntl.LOCK_EX, 1, int(_hash(key)[:LOCKED], 16))
        yield


def _hash(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()[:32]


@functools.cache
def _writer() -> str:
    return "".join(map(inspect.getsource, (language, vector, tape, directions, places)))


def _claimed(key: str) -> bool:
    """Whether nobody makes the library yet, so that this process is the one to begin."""
    claim = cache.folder() / f"claim-{_hash(key)}"
    with contextlib.suppress(OSError):
        if claim.exists() and time.time() - claim.stat().st_mtime > CLAIMED:
            claim.unlink()
        claim.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        claim.touch(exist_ok=False)
        return True
    return False


def _begin(key: str, functions: Callable[[], Sequence[ca.Function | places.Whole]], lanes: int | None) -> None:
    """Begin to make a library: whoever waits for a solution need not even derive what is compiled."""
    work = Path(tempfile.mkdtemp(prefix="ctr_nlp-build-"))
    (work / TASK).write_bytes(pickle.dumps((key, functions, lanes)))
    path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])])
    with contextlib.suppress(OSError):
        process = Lasting(
            [sys.executable, "-m", "ctr_nlp.codegen.background", str(work)],
            env=os.environ | {"PYTHONPATH": path, "PYTHONWARNINGS": "ignore"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        _begun.append(process)
        _step_back(process.pid)


def _step_back(pid: int) -> None:
    """Let a process, and all that it starts, wait for others, on systems where that can be asked for.

    Linux weighs the processes of one session against those of others; with its groups for sessions (sched(7)), the
    nice value of a process that leads its own session means nothing to others unless the group has it, too.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, pid, NICE)
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(NICE), encoding="ascii")


def main(work: Path) -> None:
    """Make the library that a folder describes, and remove the folder."""
    try:
        key, functions, lanes = pickle.loads((work / TASK).read_bytes())
        cache.library(key, lambda: places.code(tuple(functions()), lanes))
    finally:
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
