"""C code to shared libraries, by the C compiler at hand, kept in the user's cache folder."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import platformdirs

from ctr_nlp.exceptions import OptionError

SWITCH, FOLDER = "CTR_NLP_COMPILE", "CTR_NLP_CACHE"
"""Environment variables: 0 switches compiling off, and `now` lets programs wait for it; a folder for libraries."""
FLAGS = ("-O2", "-fPIC", "-shared", "-fno-math-errno", "-Wno-psabi")
"""Higher levels take longer to compile and gain a tenth at most."""
BRIEF = ("--param=max-cselib-memory-locations=10", "--param=max-cse-insns=50")
"""How far GCC looks back for values that are in registers already: its defaults of 500 and 1000 take half of the
time that long straight code of vectors needs, and hardly change what comes of it.
"""
LIBRARIES = (
    ("-DLIBMVEC", "-mprefer-vector-width=512", "-fopenmp-simd", "-Wl,--no-undefined", "-lmvec", "-lm"),
    ("-lm",),
)
"""What is linked, in order of preference: glibc has sines of whole vectors."""
TRIAL = "#include <math.h>\ndouble trial(double x) { return sin(x); }\n"
ABANDONED = 3600.0
"""Builds that were not finished after so many s never will be."""


class Compiler(NamedTuple):
    """A C compiler: how it is called, and all that it says of its version and of the machine it writes for."""

    command: tuple[str, ...]
    identity: str


@functools.cache
def compiler() -> Compiler | None:
    """The C compiler named by CC, or cc, gcc or clang; None where there is none that works."""
    for name in filter(None, (os.environ.get("CC"), "cc", "gcc", "clang")):
        for target in (["-march=native", *BRIEF], ["-march=native"], []):
            with contextlib.suppress(OSError, ValueError):
                command = (*shlex.split(name), *target, *FLAGS)
                said = _run([*command, "-E", "-v", "-x", "c", os.devnull])
                if said.returncode == 0:
                    return Compiler(command, said.stderr)
    return None


def _run(command: list[str], folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)


def missing() -> str | None:
    """Why nothing can be compiled, or None where it can; said once where a user might mend it."""
    if os.environ.get(SWITCH) == "0":
        return f"{SWITCH} is 0"
    try:
        library(TRIAL, lambda: TRIAL)
    except OptionError as error:
        say(f"{error}; everything is solved without compiled code, several times slower")
        return str(error)
    return None


@functools.cache
def say(text: str) -> None:
    """Tell a user, once a process."""
    logging.getLogger("ctr_nlp").warning(text)


def folder() -> Path:
    """Where libraries are kept: CTR_NLP_CACHE, or ctr_nlp in the user's cache folder."""
    return Path(os.environ.get(FOLDER) or platformdirs.user_cache_dir("ctr_nlp", appauthor=False))


def library(key: str, code: Callable[[], str]) -> Path:
    """The shared library made from code() once a key, compiler and machine; raises OptionError.

    key: text that changes whenever code() does. In the cache, a library and the digest of both have a folder of
    their own, which takes its name in one step: whatever is there is whole, and what does not match its digest or
    belongs to another user is made anew. A library that this process made itself it loads from a place of its own.
    """
    name, chosen = _named(key)
    place = folder() / name
    if name not in _made:
        if _whole(place):
            return place / "library.so"
        with counted_wait():
            _made[name] = _build(code(), chosen)
    if not _whole(place):
        _keep(_made[name], place)
    return _made[name]


def waited_s() -> float:
    """Tell for how long this process has waited for libraries, a wait that goes on included.

    Returns
    -------
    float
        Seconds since the process began.
    """
    return sum(_ended_waits) + sum(time.monotonic() - begin for begin in _waits[:1])


@contextlib.contextmanager
def counted_wait() -> Iterator[None]:
    """Count the time of the block as one of waiting for a library; a block within another counts once."""
    _waits.append(time.monotonic())
    try:
        yield
    finally:
        if len(_waits) == 1:
            _ended_waits.append(time.monotonic() - _waits[0])
        _waits.pop()


def kept(key: str) -> Path | None:
    """The library of a key where it has been made before, else None; raises OptionError as library."""
    name, _ = _named(key)
    place = folder() / name
    return _made.get(name) or (place / "library.so" if _whole(place) else None)


def _named(key: str) -> tuple[str, Compiler]:
    """The name of a key's folder, and the compiler."""
    if os.environ.get(SWITCH) == "0":
        raise OptionError(f"nothing is compiled: {SWITCH} is 0")
    chosen = compiler()
    if chosen is None:
        raise OptionError("no C compiler was found; install gcc or clang")
    return _hashed(key, chosen, LIBRARIES), chosen


@functools.lru_cache(maxsize=64)
def _hashed(key: str, chosen: Compiler, linked: tuple[tuple[str, ...], ...]) -> str:
    parts = [key, *chosen.command, *map(" ".join, linked), chosen.identity]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


@functools.cache
def loaded(package: str, *names: str) -> ctypes.CDLL:
    """A package's files of C, compiled as one; raises OptionError where nothing can be compiled."""
    code = "".join(files(package).joinpath(name).read_text(encoding="utf-8") for name in names)
    return ctypes.CDLL(str(library(code, lambda: code)))


_waits: list[float] = []
"""When the waits of this process for libraries began that have not ended, s; those within others come later."""
_ended_waits: list[float] = []
"""How long those lasted that have ended, s."""
_made: dict[str, Path] = {}
"""Libraries that this process has made, by name."""


@functools.cache
def _own() -> tempfile.TemporaryDirectory[str]:
    """A folder that lives as long as this process."""
    return tempfile.TemporaryDirectory(prefix="ctr_nlp-")


def _build(code: str, chosen: Compiler) -> Path:
    try:
        made = Path(tempfile.mkdtemp(dir=_own().name))
        (made / "code.c").write_text(code, encoding="utf-8")
        for linked in LIBRARIES:
            run = _run([*chosen.command, "-o", "library.so", "code.c", *linked], made)
            if run.returncode == 0:
                return made / "library.so"
    except OSError as error:
        raise OptionError(f"compiled code cannot be made: {error}") from error
    raise OptionError(f"{chosen.command[0]} cannot compile: {run.stderr.strip()[:500]}")


def _keep(made: Path, kept: Path) -> None:
    """Put a library into the cache in place of what is not whole, if anything can be written there."""
    place = kept.parent
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        _sweep(place)
        with tempfile.TemporaryDirectory(prefix="building-", dir=place, ignore_cleanup_errors=True) as new:
            good = Path(new) / "good"
            good.mkdir(mode=0o700)
            shutil.copy(made, good)
            shutil.copy(made.with_name("code.c"), good)
            (good / "sha256").write_text(_digest(good / made.name, kept.name), encoding="ascii")
            with contextlib.suppress(OSError):
                kept.rename(Path(new) / "bad")
            with contextlib.suppress(OSError):
                good.rename(kept)
    except OSError as error:
        say(f"compiled code cannot be kept in {place}: {error.strerror}")


def _sweep(place: Path) -> None:
    """Remove what killed processes left."""
    for left in place.glob("building-*"):
        with contextlib.suppress(OSError):
            if time.time() - left.lstat().st_mtime > ABANDONED:
                shutil.rmtree(left)


def _whole(kept: Path) -> bool:
    """Whether a library is ours and what was built under its name."""
    try:
        library, digest = ((kept / name).stat() for name in ("library.so", "sha256"))
        ours = not hasattr(os, "getuid") or library.st_uid == os.getuid()
        return ours and _matching(kept, *((of.st_ino, of.st_size, of.st_mtime_ns) for of in (library, digest)))
    except (OSError, UnicodeDecodeError):
        return False


@functools.lru_cache(maxsize=64)
def _matching(kept: Path, *as_they_are: tuple[int, ...]) -> bool:
    """Whether a library matches its digest; as_they_are: what changes with either file."""
    return (kept / "sha256").read_text(encoding="ascii") == _digest(kept / "library.so", kept.name)


def _digest(path: Path, name: str) -> str:
    return hashlib.sha256(name.encode() + path.read_bytes()).hexdigest()
