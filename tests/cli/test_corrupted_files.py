"""Twelve hundred corrupted files through the commands that read them: read rightly, or one clear error."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import traceback
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bench import sweep
from common import UNJUDGED
from corrupted import GOOD, Corrupted, configurations, corrupted
from malformed import ENTRY, ROBOT, TARGET, plan, plan_entries

from ctr_nlp import Plan
from ctr_nlp.cli.main import main
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS

pytestmark = [
    pytest.mark.interpreted,
    # numbers on the edge of what floats hold: users see a line of numpy's, and then what is wrong with them
    pytest.mark.filterwarnings("default::RuntimeWarning"),
]
SEED, COUNT, QUICK = 20261129, 1200, 40
BUSY_S, PATIENCE_S = 60, 600
"""s of work, and s on the clock of a machine that may be busy, after which a command is taken to hang; the longest
of a good file works for a few."""
LONGEST = 1000
"""Letters of an error of one line."""
BRIEF = "--model", "dominant", "--no-figures", *UNJUDGED
FOR_PLANS = ("--formulation", "joint", "--frames", "2", *BRIEF)
FOR_PATHS = [
    ["plan", "FILE", "--out", "out", *FOR_PLANS],
    ["branches", "FILE", "--out", "out.png"],
    *2 * [["import", "q.csv", "--problem", "FILE", "--out", "out", *BRIEF]],
]
ENDS = "--entry", *map(str, ENTRY), "--target", *map(str, TARGET)
MODULUS = "--youngs-modulus", "60000"
COMMANDS: dict[str, list[list[str]]] = {
    "plan": [
        ["play", "FILE", "--dry-run", "--uncertified"],
        *(
            ["export", "FILE", "--to", to, "--out", f"out.{to}"]
            for to in ("csv", "gcode", "urscript", "slicer", "gltf", "mat", "shapes-csv", "rosbag2")
        ),
        ["report", "FILE", "--out", "out"],
        ["robust", "FILE", "--draws", "1", "--no-figures", "--out", "out"],
        ["plan", "arc", "--initial", "FILE", "--formulation", "horizon", "--frames", "4", "--out", "out", *BRIEF],
        ["contact", "FILE", *MODULUS, "--no-figures", "--out", "out"],
    ],
    "robot": [
        ["plan", "arc", "--robot", "FILE", "--out", "out", *FOR_PLANS],
        *3 * [["import", "q.csv", "--problem", "arc", "--robot", "FILE", "--out", "out", *BRIEF]],
    ],
    "hardware": [
        ["play", "plan.npz", "--hardware", "FILE", "--dry-run", "--free-space", "--uncertified"],
        *(
            ["export", "plan.npz", "--to", to, "--hardware", "FILE", "--out", f"out.{to}"]
            for to in ("csv", "gcode", "rosbag2")
        ),
    ],
    "csv path": FOR_PATHS,
    "slicer path": FOR_PATHS,
    "vtk path": FOR_PATHS,
    "mask": [
        ["plan", "FILE", *ENDS, "--out", "out", *FOR_PLANS],
        *3 * [["import", "q.csv", "--problem", "FILE", *ENDS, "--out", "out", *BRIEF]],
    ],
    "load": [["under", "plan.npz", "--load", "FILE", *MODULUS, "--out", "out", "--no-figures", "--no-evaluate"]],
    "study": [["study", "FILE", "--only", "x", "--out", "out"]],
    "configurations": [["import", "FILE", "--problem", "arc", "--out", "out", *BRIEF]],
}
"""Commands that read a file of each kind, beside which their other files are; those that solve are few."""
PARTIAL = re.compile(r"\.ctr_nlp-[0-9a-f]{8}|\..*-[0-9a-f]{8}(\..*)?")
"""Names of what is being written."""


class Hangs(BaseException):
    """A command takes too long."""


class Outcome(NamedTuple):
    """What a command did with a file.

    Attributes
    ----------
    word : str
        "read", "refused", or what is wrong.
    told : str
        The error, or the traceback.
    """

    word: str
    told: str


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Raise Hangs in the block when it has worked or waited for too long."""

    def over(*_: object) -> None:
        raise Hangs

    limits = (signal.SIGPROF, signal.ITIMER_PROF, BUSY_S), (signal.SIGALRM, signal.ITIMER_REAL, PATIENCE_S)
    before = [signal.signal(number, over) for number, _, _ in limits]
    for _, timer, seconds in limits:
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for (number, timer, _), handler in zip(limits, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


def outcome(given: Corrupted, command: list[str], folder: Path) -> Outcome:
    """What a command does with a file in a folder that holds its other files."""
    (folder / given.name).write_bytes(given.content)
    before = {path.name for path in folder.iterdir()}
    out, err = io.StringIO(), io.StringIO()
    argv = [given.name if part == "FILE" else part for part in command]
    try:
        with limited(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(argv)
    except SystemExit as ended:
        return Outcome("usage", f"{ended} {err.getvalue()}")
    except Hangs:
        return Outcome("hangs", traceback.format_exc())
    except BaseException:
        return Outcome("traceback", traceback.format_exc())
    lines = err.getvalue().strip().splitlines()
    new = {path.name for path in folder.iterdir()} - before
    left = [path.name for path in folder.rglob("*") if PARTIAL.fullmatch(path.name)]
    if left:
        return Outcome("half-written", f"{status} {left}")
    if not all(line.isprintable() for line in (*lines, *out.getvalue().splitlines())):
        return Outcome("unprintable", err.getvalue() + out.getvalue())
    if status in (0, 1):
        return _read(given, command, folder, status, new)
    if status != 2:
        return Outcome("status", f"{status} {err.getvalue()}")
    errors = [line for line in lines if line.startswith("error: ")]
    others = [line for line in lines[:-1] if not line.startswith(("note: ", "warning: ", NOT_FOR_PATIENTS))]
    if len(errors) != 1 or not lines[-1].startswith("error: ") or others:
        return Outcome("not one error", err.getvalue())
    if len(lines[-1]) > LONGEST:
        return Outcome("long error", lines[-1])
    if new:
        return Outcome("refused and written", f"{new} {lines[-1]}")
    if "--only" in lines[-1] and given.kind == "study":
        return Outcome("read", lines[-1])
    return Outcome("refused", lines[-1])


def _read(given: Corrupted, command: list[str], folder: Path, status: int, new: set[str]) -> Outcome:
    """What a command did that took a file, which must have said as much as before where that can be told."""
    if given.refused:
        return Outcome("taken", f"status {status}")
    if not all(name.startswith("out") for name in new):
        return Outcome("written elsewhere", f"{new}")
    if given.whole and given.kind == "plan":
        found = Plan.load(folder / given.name)
        same = all(
            np.array_equal(getattr(found, name), value, equal_nan=value.dtype.kind == "f")
            for name, value in plan_entries().items()
            if name != "meta"
        )
        if not same or found.meta["robot"] != plan().meta["robot"]:
            return Outcome("taken though changed", "")
    return Outcome("read", f"status {status}")


def prepared(folder: Path) -> Path:
    """A new folder with the files that commands need beside the one that is spoilt."""
    folder.mkdir()
    sweep(3, 1.0).save(folder / "plan.npz")
    (folder / "robot.toml").write_text(ROBOT, encoding="utf-8")
    (folder / "q.csv").write_text(configurations(), encoding="utf-8")
    return folder


@contextlib.contextmanager
def within(folder: Path) -> Iterator[None]:
    """Work in a folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def outcomes(count: int, seed: int, folder: Path) -> Iterator[tuple[int, Corrupted, list[str], Outcome]]:
    """The number, the file, the command and what it did, for so many files."""
    for number, given in enumerate(corrupted(count, seed)):
        commands = COMMANDS[given.kind]
        command, place = commands[number * 7 % len(commands)], prepared(folder / str(number))
        with within(place):
            yield number, given, command, outcome(given, command, place)


def judge(count: int, seed: int, folder: Path) -> Counter[tuple[str, str]]:
    """How many files of each kind were read and refused; fails where anything else happened."""
    found, bad = Counter[tuple[str, str]](), list[str]()
    for number, given, command, what in outcomes(count, seed, folder):
        found[given.kind, what.word] += 1
        if what.word not in ("read", "refused"):
            bad.append(f"{number} {given.kind}, {given.how}: {' '.join(command)}: {what.word}: {what.told[-600:]}")
    assert not bad, "\n".join([f"{len(bad)} of {count}", *bad])
    return found


@pytest.mark.slow
def test_good_files_are_read_by_every_command(tmp_path):
    """So that no file is refused for what is amiss with a command."""
    for kind, (name, make) in GOOD.items():
        for number, command in enumerate(COMMANDS[kind]):
            place = prepared(tmp_path / f"{kind}-{number}")
            with within(place):
                what = outcome(Corrupted(kind, "good", name, make()), command, place)
            assert what.word == "read", (kind, command, what)


def test_a_few_corrupted_files_are_read_or_refused(tmp_path):
    found = judge(QUICK, SEED, tmp_path)
    assert {kind for kind, _ in found} == set(COMMANDS)


@pytest.mark.slow
def test_twelve_hundred_corrupted_files_are_read_or_refused(tmp_path):
    """Plans, robots, hardware, paths, loads, studies and configurations; a seed gives the same ones each time."""
    found = judge(COUNT, SEED, tmp_path)
    print()
    for kind in COMMANDS:
        print(f"{kind}: {found[kind, 'read']} read, {found[kind, 'refused']} refused")
