"""C code to shared libraries, by the C compiler at hand, stored in the user's cache folder.

A library's name is a digest of its source's key, the compiler's command and the compiler's report of its version
and target: another compiler or machine finds nothing. Folders are put in place by one rename, so that a library
that is found is complete even if several processes build it simultaneously or are killed.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import hashlib
import logging
import math
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

from ctr_nlp.codegen.c_structures import describe_structures
from ctr_nlp.exceptions import OptionError
from ctr_nlp.support import folder_lock

COMPILE_VARIABLE, CACHE_FOLDER_VARIABLE = "CTR_NLP_COMPILE", "CTR_NLP_CACHE"
"""Environment variables. CTR_NLP_COMPILE: 0 switches compiling off, `now` makes programs wait for it.
CTR_NLP_CACHE: a folder for libraries.
"""
COMPILER_FLAGS = ("-O2", "-fPIC", "-shared", "-fno-math-errno", "-Wno-psabi")
"""Options for the compiler. Higher levels take longer to compile and gain a tenth at most. -fno-math-errno:
without it, functions such as sqrt must set errno and cannot be vectorised.
"""
FAST_COMPILE_FLAGS = ("--param=max-cselib-memory-locations=10", "--param=max-cse-insns=50")
"""How far GCC looks back for values that are in registers already: its defaults of 500 and 1000 take half of the
time that long straight code of vectors needs, and hardly change the result.
"""
LINK_LIBRARY_CHOICES = (
    ("-DLIBMVEC", "-mprefer-vector-width=512", "-fopenmp-simd", "-Wl,--no-undefined", "-lmvec", "-lm"),
    ("-lm",),
)
"""Libraries to link, in order of preference: glibc has sines of whole vectors (libmvec)."""
TRIAL_C_CODE = "#include <math.h>\ndouble trial(double x) { return sin(x); }\n"
"""Smallest program that shows whether compiling and linking work."""
WIDEST_VECTOR_LANES = 8
"""Numbers in the longest vectors that processors have, those of AVX-512."""
BUILD_FOLDER_PREFIX, PROCESS_FOLDER_PREFIX = "building-", "ctr_nlp-libraries-"
"""Prefixes of the working folders of processes: in the cache, and in the temporary folder."""
BUILD_FOLDER_ABANDONED_AFTER_S = 900.0
"""s after which such a folder is taken for one of a process that died, on file systems without locks."""


class Compiler(NamedTuple):
    """A C compiler: its command, and its report of its version and of the machine it compiles for."""

    command: tuple[str, ...]
    identity: str


@functools.cache
def compiler() -> Compiler | None:
    """Find the C compiler named by CC, or cc, gcc or clang; return None where none works."""
    for name in filter(None, (os.environ.get("CC"), "cc", "gcc", "clang")):
        # Not every compiler has GCC's --param, and not every one knows the processor: try with less each
        # time.
        for target in (["-march=native", *FAST_COMPILE_FLAGS], ["-march=native"], []):
            with contextlib.suppress(OSError, ValueError):
                command = (*shlex.split(name), *target, *COMPILER_FLAGS)
                # With -v the compiler prints version and target, native options resolved, even for an empty
                # file.
                said = _run([*command, "-E", "-v", "-x", "c", os.devnull])
                if said.returncode == 0:
                    return Compiler(command, said.stderr)
    return None


@functools.cache
def vector_lanes() -> int:
    """Return how many numbers fit into a vector of the processor that the compiler writes code for: 8 or 4.

    Straight code of longer vectors than the processor has would keep its numbers in memory.
    """
    chosen = compiler()
    if chosen is None:
        return WIDEST_VECTOR_LANES
    said = _run([*chosen.command, "-E", "-dM", "-x", "c", os.devnull])
    return WIDEST_VECTOR_LANES if "__AVX512F__" in said.stdout else WIDEST_VECTOR_LANES // 2


def _run(command: list[str], folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)


def unavailable_reason() -> str | None:
    """Return why nothing can be compiled, or None where it can; log the reason once if a user can remedy it."""
    if os.environ.get(COMPILE_VARIABLE) == "0":
        return f"{COMPILE_VARIABLE} is 0"
    try:
        library(TRIAL_C_CODE, lambda: TRIAL_C_CODE)
    # No compiler, or one that cannot link, is no error of the user's: CasADi's interpreter takes over.
    except OptionError as error:
        warn_once(f"{error}; everything is solved without compiled code, several times slower")
        return str(error)
    return None


@functools.cache
def warn_once(text: str) -> None:
    """Log a warning, once a process for each text."""
    logging.getLogger("ctr_nlp").warning(text)


def folder() -> Path:
    """Return the folder for libraries: CTR_NLP_CACHE, or ctr_nlp in the user's cache folder."""
    return Path(os.environ.get(CACHE_FOLDER_VARIABLE) or platformdirs.user_cache_dir("ctr_nlp", appauthor=False))


def library(key: str, code: Callable[[], str]) -> Path:
    """Return the shared library made from code(), compiled once for each key, compiler and machine.

    key: text that changes whenever code() does. In the cache, a library and the digest of both have a folder of
    their own, which takes its name in one step: whatever is there is complete, and what does not match its digest
    or belongs to another user is built again. A library that this process built itself is loaded from a folder of
    its own. Raises OptionError where nothing can be compiled.
    """
    name, chosen = _identify_library(key)
    place = folder() / name
    if name not in _made:
        if _is_complete(place):
            return place / "library.so"
        with count_library_wait():
            _made[name] = _build(code(), chosen)
    # Another process may have stored the same library meanwhile; then it stays.
    if not _is_complete(place):
        _keep(_made[name], place)
    return _made[name]


def library_wait_s() -> float:
    """Return for how long this process has waited for libraries, including a wait that has not ended.

    Returns
    -------
    float
        Seconds since the process began.
    """
    # Only the outermost wait that has not ended: inner ones are part of it.
    return sum(_ended_waits) + sum(time.monotonic() - begin for begin in _waits[:1])


@contextlib.contextmanager
def count_library_wait() -> Iterator[None]:
    """Count the time of the block as one of waiting for a library; a block within another counts once."""
    _waits.append(time.monotonic())
    try:
        yield
    finally:
        if len(_waits) == 1:
            _ended_waits.append(time.monotonic() - _waits[0])
        _waits.pop()


def find_library(key: str) -> Path | None:
    """Return the library of a key if it has been built before, else None; raises OptionError as `library` does."""
    name, _ = _identify_library(key)
    place = folder() / name
    return _made.get(name) or (place / "library.so" if _is_complete(place) else None)


def _identify_library(key: str) -> tuple[str, Compiler]:
    """Return the name of a key's folder, and the compiler."""
    if os.environ.get(COMPILE_VARIABLE) == "0":
        raise OptionError(f"nothing is compiled: {COMPILE_VARIABLE} is 0")
    chosen = compiler()
    if chosen is None:
        raise OptionError("no C compiler was found; install gcc or clang")
    return _hash_build_inputs(key, chosen, LINK_LIBRARY_CHOICES), chosen


@functools.lru_cache(maxsize=64)
def _hash_build_inputs(key: str, chosen: Compiler, linked: tuple[tuple[str, ...], ...]) -> str:
    """Return the digest of all that a library depends on: key, command, libraries, compiler and target."""
    parts = [key, *chosen.command, *map(" ".join, linked), chosen.identity]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


@functools.cache
def load_c_files(package: str, *names: str, before: str = "") -> ctypes.CDLL:
    """Compile and load a package's C files as one; raises OptionError where nothing can be compiled.

    before: C that comes before them.
    """
    code = before + read_c_files(package, *names)
    code += describe_structures(code)
    return ctypes.CDLL(str(library(code, lambda: code)))


def read_c_files(package: str, *names: str) -> str:
    """Return the text of a package's C files, one after the other."""
    return "".join(files(package).joinpath(name).read_text(encoding="utf-8") for name in names)


_waits: list[float] = []
"""Start times in s of waits of this process for libraries that have not ended; inner ones come later."""
_ended_waits: list[float] = []
"""Durations in s of the waits that have ended."""
_made: dict[str, Path] = {}
"""Paths of libraries that this process has built, by name."""


@functools.cache
def _process_folder() -> Path:
    """Make a folder that is removed when this process ends; raises OSError."""
    remove_abandoned_folders()
    own = folder_lock.lock_new_folder(Path(tempfile.gettempdir()), PROCESS_FOLDER_PREFIX).folder
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own


def remove_abandoned_folders() -> None:
    """Remove folders of processes that were killed, in the cache and in the temporary folder."""
    folder_lock.remove_abandoned(folder(), f"{BUILD_FOLDER_PREFIX}*", BUILD_FOLDER_ABANDONED_AFTER_S)
    # without locks, age tells nothing of the libraries that a process has loaded: it may live for weeks
    folder_lock.remove_abandoned(Path(tempfile.gettempdir()), f"{PROCESS_FOLDER_PREFIX}*", math.inf)


def _build(code: str, chosen: Compiler) -> Path:
    """Compile code in a folder of this process, with the first set of libraries that can be linked."""
    try:
        made = Path(tempfile.mkdtemp(dir=_process_folder()))
        (made / "code.c").write_text(code, encoding="utf-8")
        # With glibc's vector sines if they can be linked, else without; --no-undefined makes the first try
        # fail in time.
        for linked in LINK_LIBRARY_CHOICES:
            run = _run([*chosen.command, "-o", "library.so", "code.c", *linked], made)
            if run.returncode == 0:
                return made / "library.so"
    except OSError as error:
        raise OptionError(f"compiled code cannot be made: {error}") from error
    raise OptionError(f"{chosen.command[0]} cannot compile: {run.stderr.strip()[:500]}")


def _keep(made: Path, kept: Path) -> None:
    """Store a library in the cache, in place of one that is not complete, if anything can be written there."""
    place = kept.parent
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        remove_abandoned_folders()
        # Built beside its place, in the same file system, so that renaming it is one step for all processes.
        new = folder_lock.lock_new_folder(place, BUILD_FOLDER_PREFIX)
        try:
            good = new.folder / "good"
            good.mkdir(mode=0o700)
            shutil.copy(made, good)
            # The source is kept beside the library for people who look into it.
            shutil.copy(made.with_name("code.c"), good)
            (good / "sha256").write_text(_digest(good / made.name, kept.name), encoding="ascii")
            with contextlib.suppress(OSError):
                # A folder cannot be renamed onto one that is not empty. The first rename fails where nothing is
                # there, the second where another process has just stored the same library, which then stays.
                kept.rename(new.folder / "bad")
            with contextlib.suppress(OSError):
                good.rename(kept)
        finally:
            shutil.rmtree(new.folder, ignore_errors=True)
            new.release()
    except OSError as error:
        warn_cache_unwritable(error)


def warn_cache_unwritable(error: OSError) -> None:
    """Warn, once a process, that nothing can be written into the cache; `error` gives the reason."""
    warn_once(f"compiled code cannot be kept in {folder()}: {error.strerror}")


def _is_complete(kept: Path) -> bool:
    """Return whether a library belongs to this user and is the one that was built under its name."""
    try:
        library, digest = ((kept / name).stat() for name in ("library.so", "sha256"))
        # A library that another user put into a shared folder would be run with this user's rights.
        ours = not hasattr(os, "getuid") or library.st_uid == os.getuid()
        # Digests are read again only if either file has changed: inode, size and time say so.
        return ours and _matches_digest(
            kept, *((of.st_ino, of.st_size, of.st_mtime_ns) for of in (library, digest))
        )
    except (OSError, UnicodeDecodeError):
        return False


@functools.lru_cache(maxsize=64)
def _matches_digest(kept: Path, *as_they_are: tuple[int, ...]) -> bool:
    """Return whether a library matches its digest.

    as_they_are: inode, size and time of both files, which are keys of the cache of results only.
    """
    return (kept / "sha256").read_text(encoding="ascii") == _digest(kept / "library.so", kept.name)


def _digest(path: Path, name: str) -> str:
    """Return the digest of a library and its name, so that a library under another's name does not match."""
    return hashlib.sha256(name.encode() + path.read_bytes()).hexdigest()
