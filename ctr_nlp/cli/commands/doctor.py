"""`ctr-nlp doctor`: check what is installed and works, what is missing, and how to get it."""

from __future__ import annotations

import argparse
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import ctr_nlp
from ctr_nlp.cli.console import EXIT_SOLVED, EXIT_SOME_FAILED, Command
from ctr_nlp.cli.terminal_output import console, print_table
from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import CtrError

DISTRIBUTION_NAME = "ctr_nlp"
"""Name of the distribution whose requirements are checked."""
VECTORS = ("avx512f", "avx2", "neon", "asimd")
"""Processor features that make compiled code faster, the best first of each kind."""


class CheckResult(NamedTuple):
    """Result of one check.

    what: the thing that was checked. good: whether it works. detail: what was found. remedy: how to repair it.
    core: whether planning needs it.
    """

    what: str
    good: bool
    detail: str
    remedy: str = ""
    core: bool = False


def _parser(prog: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        prog=prog,
        description="Check what is installed and works, what is missing, and which command installs it.",
        epilog="Exit status: 0 where planning works, 1 where it does not. What is optional may be missing.",
    )


def _run(_: argparse.Namespace) -> int:
    checks: tuple[Callable[[], Iterator[CheckResult]], ...] = (_packages, _compiler, _cache, _devices, _plan)
    found = [finding for check in checks for finding in check()]
    rows = [(one.what, "yes" if one.good else "no", one.detail) for one in found]
    print_table(f"ctr-nlp {ctr_nlp.__version__}", ("", "works", "found"), rows, text=("works", "found"))
    for one in found:
        if not one.good and one.remedy:
            console().print(f"{one.what}: {one.remedy}", soft_wrap=True)
    broken = [one.what for one in found if one.core and not one.good]
    told = f"planning does not work: {', '.join(broken)}" if broken else "planning works"
    console().print(told)
    return EXIT_SOME_FAILED if broken else EXIT_SOLVED


def _packages() -> Iterator[CheckResult]:
    """Check the packages that the core needs, and those of each extra but `dev`, which users do not need."""
    yield CheckResult("Python", True, f"{platform.python_version()} at {sys.executable}")
    try:
        required = metadata.requires(DISTRIBUTION_NAME) or []
    except metadata.PackageNotFoundError:
        yield CheckResult("core", True, "unknown: this copy runs without having been installed")
        return
    needs: dict[str, list[str]] = {"core": []}
    for line in required:
        spec, _, marker = (part.strip() for part in line.partition(";"))
        found = re.search(r"""extra == ["']([\w-]+)["']""", marker)
        if found or not marker or sys.version_info < (3, 11):  # the only other marker is of Python below 3.11
            needs.setdefault(f"extra {found[1]}" if found else "core", []).append(spec)
    for part, specs in needs.items():
        versions = {spec: _version(spec) for spec in specs if _name(spec).replace("-", "_") != DISTRIBUTION_NAME}
        seen = ", ".join(f"{_name(spec)} {version or 'missing'}" for spec, version in versions.items())
        missing = " ".join(f'"{spec}"' for spec, version in versions.items() if version is None)
        if part != "extra dev":
            yield CheckResult(
                part, not missing, seen, f"{sys.executable} -m pip install {missing}", part == "core"
            )


def _name(spec: str) -> str:
    return re.split(r"[^\w.-]", spec, maxsplit=1)[0]


def _version(spec: str) -> str | None:
    try:
        return metadata.version(_name(spec))
    except metadata.PackageNotFoundError:
        return None


def _compiler() -> Iterator[CheckResult]:
    """Check the compiler, and list the processor's VECTORS where Linux reports them."""
    why = cache.unavailable_reason()
    chosen = cache.compiler()
    told = set[str]()
    with suppress(OSError):
        told = set(Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").split())
    vectors = ", ".join(name for name in VECTORS if name in told)
    found = "" if chosen is None else " ".join(chosen.command[:2]) + (f"; vectors: {vectors}" if vectors else "")
    remedy = "install gcc or clang; without, planning is thirty times slower"
    yield CheckResult("C compiler", why is None, why or found, remedy)


def _cache() -> Iterator[CheckResult]:
    folder = cache.folder()
    sizes = [path.stat().st_size for path in folder.rglob("*.so")] if folder.is_dir() else []
    try:
        with tempfile.TemporaryDirectory(dir=next(p for p in (folder, *folder.absolute().parents) if p.exists())):
            writable = True
    except OSError:
        writable = False
    seen = f"{folder}: {len(sizes)} libraries, {sum(sizes) / 1e6:.0f} MB" + ", cannot be written" * (not writable)
    yield CheckResult("cache", writable, seen, f"let {cache.CACHE_FOLDER_VARIABLE} name another folder")


def _devices() -> Iterator[CheckResult]:
    ffmpeg = shutil.which("ffmpeg")
    yield CheckResult("ffmpeg", ffmpeg is not None, ffmpeg or "missing", "install it; --film FILE.mp4 needs it")
    ports = [*Path("/dev").glob("ttyUSB*"), *Path("/dev").glob("ttyACM*")]
    usable = all(os.access(port, os.R_OK | os.W_OK) for port in ports)
    if ports:
        remedy = "join the group that owns them, often dialout"
        yield CheckResult("serial ports", usable, " ".join(map(str, ports)), remedy)


def _plan() -> Iterator[CheckResult]:
    """Solve two frames of the simplest problem without compiled code, to check whether planning works at all.

    On the dominant model, since elastic frames take long where nothing is compiled.
    """
    try:
        from ctr_nlp.paths.named_problems import named_problem

        plan = ctr_nlp.solve_per_frame(
            named_problem("arc", 2), model="dominant", solver="ipopt", direction="forward"
        )
        good = plan.complete
        seen = f"two frames solved, e3 {ctr_nlp.summary(plan)['e3']:.2f} mm"
    except (CtrError, ImportError, RuntimeError, OSError) as error:
        good = False
        seen = f"{type(error).__name__}: {error}"
    yield CheckResult("a plan", good, seen if good else f"not solved: {seen}", core=True)


main = Command("ctr-nlp doctor", _parser, _run)
