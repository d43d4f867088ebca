"""PROBLEM on a command line: the name of a file in problems/, or a file of anatomy."""

from __future__ import annotations

import argparse
import math
import runpy
import sys
from pathlib import Path

from ctr_nlp.anatomy.files import CENTRELINES, MASKS
from ctr_nlp.anatomy.problem_files import problem_from_file
from ctr_nlp.cli.arguments import FILE_OPTIONS
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import model_named
from ctr_nlp.robot import Robot
from ctr_nlp.target.fit import notes
from ctr_nlp.target.problem import Problem


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
    """The problem that a name in folder, or a file of anatomy, stands for; raises a CtrError.

    Also where a model that is asked for does not describe its robot.
    """
    problem = _problem(name, folder, arguments)
    for asked in (getattr(arguments, option, None) for option in ("model", "evaluate")):
        if asked is not None:
            model_named(asked).check(problem.robot)
    return problem


def _problem(name: str, folder: Path, arguments: argparse.Namespace) -> Problem:
    robot = None if arguments.robot is None else Robot.from_toml(arguments.robot)
    given = {key: getattr(arguments, key, None) for key in FILE_OPTIONS}
    options = {key: value for key, value in given.items() if value is not None}
    if name in names(folder):
        if options:
            raise OptionError(
                f"--{next(iter(options))} goes with a centreline file or a mask; {name} is a named problem"
            )
        return named(name, folder, arguments.frames, arguments.duration, robot)
    if not Path(name).is_file():
        raise OptionError(
            f"problem is {name!r}; it must be one of {', '.join(names(folder))} or an existing centreline file "
            f"({', '.join(CENTRELINES)}) or a mask ({', '.join(MASKS)})"
        )
    if "tilt" in options:
        options["tilt"] = math.radians(options["tilt"])
    return problem_from_file(name, robot, arguments.frames, arguments.duration, **options)


def tell(problem: Problem) -> None:
    """What is worth knowing of a problem before it is solved, on stderr."""
    for note in notes(problem):
        sys.stderr.write(f"note: {note}\n")
