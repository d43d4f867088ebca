"""PROBLEM on a command line: the name of a file in problems/, or a centreline file."""

from __future__ import annotations

import argparse
import runpy
from pathlib import Path

from ctr_nlp.errors import OptionError
from ctr_nlp.problem import Problem, problem_from_file
from ctr_nlp.robot import Robot


def names(folder: Path) -> list[str]:
    """The named problems in a folder, in alphabetical order."""
    return sorted(path.stem for path in folder.glob("*.py"))


def named(
    name: str, folder: Path, frames: int = 100, duration: float = 10.0, robot: Robot | None = None
) -> Problem:
    """The problem of that name in folder."""
    problem: Problem = runpy.run_path(str(folder / f"{name}.py"))["problem"](frames, duration, robot)
    return problem


def load(name: str, folder: Path, arguments: argparse.Namespace) -> Problem:
    """The problem that a name in folder, or a centreline file, stands for; raises a CtrError."""
    robot = None if arguments.robot is None else Robot.from_toml(arguments.robot)
    if name in names(folder):
        for option in ("reverse", "trim", "smoothing"):
            if getattr(arguments, option, None):
                raise OptionError(f"--{option} goes with a centreline file; {name} is a named problem")
        return named(name, folder, arguments.frames, arguments.duration, robot)
    if not Path(name).is_file():
        raise OptionError(
            f"problem is {name!r}; it must be one of {', '.join(names(folder))} or an existing centreline file"
        )
    options = {key: getattr(arguments, key) for key in ("reverse", "trim", "smoothing") if hasattr(arguments, key)}
    return problem_from_file(name, robot, arguments.frames, arguments.duration, **options)
