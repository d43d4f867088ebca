"""C code to shared libraries, by the C compiler at hand, kept in the user's cache folder."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ctr_nlp.errors import OptionError

SWITCH, FOLDER = "CTR_NLP_COMPILE", "CTR_NLP_CACHE"
"""Environment variables: 0 switches compiling off; a folder to keep libraries in."""
FLAGS = ("-O2", "-fPIC", "-shared", "-fno-math-errno", "-Wno-psabi")
"""Higher levels take longer to compile and gain a tenth at most."""
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
        path = shutil.which(name)
        for target in (("-march=native",), ()) if path else ():
            command = (str(path), *target, *FLAGS)
            said = subprocess.run(
                [*command, "-E", "-v", "-x", "c", os.devnull], capture_output=True, text=True, check=False
            )
            if said.returncode == 0:
                return Compiler(command, said.stderr)
    return None


def missing() -> str | None:
    """Why nothing can be compiled, or None where it can; said once where a user might mend it."""
    if os.environ.get(SWITCH) == "0":
        return f"{SWITCH} is 0"
    try:
        library(TRIAL, lambda: TRIAL)
    except OptionError as error:
        _say(f"{error}; everything is solved without compiled code, several times slower")
        return str(error)
    return None


@functools.cache
def _say(text: str) -> None:
    logging.getLogger("ctr_nlp").warning(text)


def folder() -> Path:
    """Where libraries are kept: CTR_NLP_CACHE, or ctr_nlp in the user's cache folder."""
    if os.environ.get(FOLDER):
        return Path(os.environ[FOLDER])
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "ctr_nlp"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ctr_nlp"


def library(key: str, code: Callable[[], str]) -> Path:
    """The shared library made from code() once a key, compiler and machine; raises OptionError.

    key: text that changes whenever code() does. A library is kept with its digest in a folder of its own, which
    takes its name in one step: whatever is there is whole, and a library that does not match its digest or
    belongs to another user is made anew. Where nothing can be kept, it is made for this process alone.
    """
    if os.environ.get(SWITCH) == "0":
        raise OptionError(f"nothing is compiled: {SWITCH} is 0")
    chosen = compiler()
    if chosen is None:
        raise OptionError("no C compiler was found; install gcc or clang")
    name = hashlib.sha256("\0".join([key, *chosen.command, chosen.identity]).encode()).hexdigest()[:32]
    place = folder()
    found = place / name / "library.so"
    if _whole(found):
        return found
    with contextlib.suppress(OSError):
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        _sweep(place)
    try:
        made = Path(tempfile.mkdtemp(prefix="building-", dir=place))
    except OSError as error:
        _say(f"compiled code cannot be kept in {place}: {error.strerror}")
        return _build(_private(), code(), chosen)
    _build(made, code(), chosen)
    return _settle(made, found)


def _build(made: Path, code: str, chosen: Compiler) -> Path:
    """A library and its digest in a folder."""
    (made / "code.c").write_text(code, encoding="utf-8")
    for linked in LIBRARIES:
        command = [*chosen.command, "-o", "library.so", "code.c", *linked]
        run = subprocess.run(command, cwd=made, capture_output=True, text=True, check=False)
        if run.returncode == 0:
            break
    else:
        shutil.rmtree(made, ignore_errors=True)
        raise OptionError(f"{chosen.command[0]} cannot compile: {run.stderr.strip()[:500]}")
    found = made / "library.so"
    (made / "sha256").write_text(_digest(found), encoding="ascii")
    return found


def _settle(made: Path, found: Path) -> Path:
    """Give a new build its name; where another process was first, theirs serves as well."""
    for _ in range(3):
        with contextlib.suppress(OSError):
            made.rename(found.parent)
        if _whole(found):
            shutil.rmtree(made, ignore_errors=True)
            return found
        with contextlib.suppress(OSError):
            found.parent.rename(found.parent.with_name(f"building-bad-{os.getpid()}-{time.monotonic_ns()}"))
    return made / "library.so"


def _whole(found: Path) -> bool:
    """Whether a library is ours and what was built."""
    try:
        ours = not hasattr(os, "getuid") or found.stat().st_uid == os.getuid()
        return ours and found.with_name("sha256").read_text(encoding="ascii") == _digest(found)
    except (OSError, UnicodeDecodeError):
        return False


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _sweep(place: Path) -> None:
    """Remove builds that were killed."""
    for left in place.glob("building-*"):
        if time.time() - left.stat().st_mtime > ABANDONED:
            shutil.rmtree(left, ignore_errors=True)


@functools.cache
def _holder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="ctr_nlp-")


def _private() -> Path:
    """A new folder that lives as long as this process."""
    return Path(tempfile.mkdtemp(dir=_holder().name))
