"""PROBLEM on a command line: a named problem, a user's problem file, or a file of anatomy."""

from __future__ import annotations

import argparse
import math
import re
import runpy
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctr_nlp.anatomy.suffixes import CENTRELINE_SUFFIXES, MASK_SUFFIXES
from ctr_nlp.cli.terminal_output import announce, busy, print_stderr
from ctr_nlp.exceptions import CtrError, OptionError, ProblemError, suggest_names
from ctr_nlp.models import Model, model_named
from ctr_nlp.paths.lumen_fit import problem_notes
from ctr_nlp.paths.named_problems import PROBLEM_NAMES, named_problem
from ctr_nlp.paths.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.robot.shipped import read_robot

if TYPE_CHECKING:
    from ctr_nlp.anatomy.wall_files import WallFile

PROBLEM_FILE_SUFFIXES = (*CENTRELINE_SUFFIXES, *MASK_SUFFIXES, ".py")
"""Suffixes of the files that problems are read from."""

WALL_TEXT = re.compile(r"(?P<file>.*?)(:(?P<labels>\d+(,\d+)*))?(=(?P<margin>[^=/\\]*))?")
"""FILE[:LABEL[,LABEL]][=MM], as the options for walls take it."""
PACKAGE = Path(__file__).parents[1]
FILE_OPTIONS = (
    *("branch", "entry", "target", "insertion", "tilt", "reverse", "smoothing", "trim"),
    *("units", "space", "pieces", "label", "segment", "threshold", "form", "accept"),
    *("wall_of_mask", "keep_out", "inside"),
)
"""Options that go with a centreline file or a mask alone."""
PROBLEM_ARGUMENT_HELP = (
    f"{', '.join(PROBLEM_NAMES)}, a problem file (.py), a centreline file "
    f"({', '.join(CENTRELINE_SUFFIXES)}) or a mask"
)
"""Help of PROBLEM."""


def load(name: str, arguments: argparse.Namespace) -> Problem:
    """Return the problem that a name or a file stands for.

    arguments: with robot, frames, duration and the options of add_file_options. Raises CtrError, also where a
    model in arguments does not describe the problem's robot.
    """
    (problem,) = load_all([name], arguments)
    return problem


def load_all(names: Sequence[str], arguments: argparse.Namespace) -> list[Problem]:
    """Return the problems that several names or files stand for; raises CtrError as `load` does.

    arguments: as `load`. Options of `FILE_OPTIONS` are passed on to files of anatomy alone, of which there must be
    one where such an option is given.
    """
    options = {key: value for key in FILE_OPTIONS if (value := getattr(arguments, key, None)) is not None}
    if more := getattr(arguments, "more_files", None):
        options["pieces"] = [*more, *options.get("pieces", ())]
    if options and not any(is_anatomy(name) for name in names):
        kind = "problem file" if names[0].endswith(".py") else "named problem"
        if more:
            raise OptionError(
                f"{names[0]} is a {kind}, and {more[0]} is given after it; only a centreline file goes with "
                "further files, which hold pieces of the same tree"
            )
        option = next(iter(options)).replace("_", "-")
        raise OptionError(f"--{option} goes with a centreline file or a mask; {names[0]} is a {kind}")
    found = []
    for name in names:
        # Only files of anatomy take long to read.
        with busy(f"{name} is read") if is_anatomy(name) else nullcontext():
            found.append(_problem(name, arguments, options if is_anatomy(name) else {}))
    planned_on = getattr(arguments, "model", None)
    evaluated_on = getattr(arguments, "evaluate", None)
    for problem in found:
        if planned_on is not None:
            model_named(planned_on).check_planning(problem.robot)
        if evaluated_on is not None:
            _check_evaluation(model_named(evaluated_on), problem)
    return found


def file_option_words(arguments: argparse.Namespace) -> list[str]:
    """Return the options of `FILE_OPTIONS` that were given, as words of another command that takes them."""
    words = list[str]()
    given = {name: getattr(arguments, name, None) for name in FILE_OPTIONS}
    # Further files of a tree are also taken without --pieces.
    given["pieces"] = [*getattr(arguments, "more_files", ()), *(given["pieces"] or ())] or None
    for name, value in given.items():
        if value is None:
            continue
        words.append(f"--{name.replace('_', '-')}")
        if value is not True:  # a flag has no value
            words += map(str, value) if isinstance(value, list | tuple) else [str(value)]
    return words


def _check_evaluation(model: Model, problem: Problem) -> None:
    """Raise OptionError where a model does not describe a problem's robot; print where it is inaccurate for it."""
    model.check(problem.robot)
    try:
        model.check_planning(problem.robot)
    except OptionError as error:
        announce(f"errors on the {model.name} model are inaccurate: {error}")


def is_anatomy(name: str) -> bool:
    """Tell whether a PROBLEM is a file of anatomy: no named problem and no problem file."""
    return name not in PROBLEM_NAMES and not name.endswith(".py")


def expand_folders(names: Sequence[str]) -> list[str]:
    """Return `names`, each folder replaced by its centreline files in order; raises OptionError where it
    has none.
    """
    # Readers of anatomy are loaded where a file of anatomy is named, and not for a named problem.
    from ctr_nlp.anatomy.files import centrelines_in

    found = list[str]()
    for name in names:
        found += map(str, centrelines_in(name)) if Path(name).is_dir() else [name]
    return found


def _problem(name: str, arguments: argparse.Namespace, options: Mapping[str, Any]) -> Problem:
    """Return the problem of a name, a Python file or a file of anatomy; options: those of `FILE_OPTIONS` that were
    given.
    """
    robot = None if arguments.robot is None else read_robot(arguments.robot)
    if name in PROBLEM_NAMES:
        return named_problem(name, arguments.frames, arguments.duration, robot)
    if not Path(name).is_file():
        beside = [str(path) for path in Path(name).parent.glob("*") if path.name.endswith(PROBLEM_FILE_SUFFIXES)]
        raise OptionError(
            f"problem is {name!r}; it must be one of {', '.join(PROBLEM_NAMES)} or an existing centreline file "
            f"({', '.join(CENTRELINE_SUFFIXES)}), mask ({', '.join(MASK_SUFFIXES)}) or problem file (.py)"
            f"{suggest_names(name, [*PROBLEM_NAMES, *beside])}"
        )
    if name.endswith(".py"):
        return from_python(name, arguments.frames, arguments.duration, robot)
    # Readers of anatomy are loaded where a file of anatomy is named, and not for a named problem.
    from ctr_nlp.anatomy.problem_files import problem_from_file

    tilt = {"tilt": math.radians(options["tilt"])} if "tilt" in options else {}
    walls = [
        _wall_file(text, key == "keep_out") for key in ("inside", "keep_out") for text in options.get(key, ())
    ]
    others = {key: value for key, value in options.items() if key not in ("inside", "keep_out")}
    return problem_from_file(name, robot, arguments.frames, arguments.duration, walls=walls, **{**others, **tilt})


def _wall_file(text: str, keep_out: bool) -> WallFile:
    """Return the wall that FILE[:LABEL[,LABEL]][=MM] stands for; raises OptionError where it has no such file.

    keep_out: whether the robot keeps out of it.
    """
    # Readers of anatomy are loaded where a file of anatomy is named, and not for a named problem.
    from ctr_nlp.anatomy.reading import ReadOptions
    from ctr_nlp.anatomy.wall_files import WallFile, name_of_wall

    found = WALL_TEXT.fullmatch(text)
    assert found is not None
    file, labels, margin = found["file"], found["labels"], found["margin"]
    option = "--keep-out" if keep_out else "--inside"
    if not Path(file).is_file():
        raise OptionError(f"{option} is {text!r}; there is no file {file!r}. Write FILE, FILE=MM or FILE:LABEL=MM")
    try:
        distance = float(margin or 0)
    except ValueError as error:
        raise OptionError(f"{option} is {text!r}; its margin is {margin!r}, which is no number of mm") from error
    chosen = tuple(int(label) for label in labels.split(",")) if labels else ()
    name = f"{name_of_wall(file)}:{labels}" if labels else None
    return WallFile(file, keep_out, margin=distance, name=name, options=ReadOptions(labels=chosen))


def from_python(file: str, frames: int, duration: float, robot: Robot | None) -> Problem:
    """Call problem(frames, duration, robot) in a user's Python file and return its problem; raises ProblemError.

    The file may import others beside it. A CtrError that it raises becomes a ProblemError with the file's name and
    line before its message.
    """
    folder = str(Path(file).resolve().parent)
    sys.path.insert(0, folder)
    try:
        make = _call_user_code(file, lambda: runpy.run_path(file)).get("problem")
        if not callable(make):
            raise ProblemError(f"{file} defines no problem(frames, duration, robot); see `ctr-nlp new problem`")
        made = _call_user_code(file, lambda: make(frames, duration, robot))
    finally:
        sys.path.remove(folder)
    if not isinstance(made, Problem):
        raise ProblemError(f"{file}: problem() returned {made!r:.60}; it must return a ctr_nlp.Problem")
    return made


def _call_user_code(file: str, call: Callable[[], Any]) -> Any:
    """Call into a user's file and return the result; raises ProblemError with the line of `file` that failed."""
    try:
        return call()
    # A user's file may call sys.exit(), which is an error here, too.
    except (Exception, SystemExit) as error:
        lines = [at.lineno for at in traceback.extract_tb(error.__traceback__) if at.filename == file]
        place = f"{file}, line {lines[-1]}" if lines else file
        kind = "" if isinstance(error, CtrError) else f"{type(error).__name__}: "
        raise ProblemError(f"{place}: {kind}{error}") from error


def print_problem_notes(problem: Problem) -> None:
    """Print on stderr notes on a problem that are worth knowing before it is solved."""
    for note in problem_notes(problem):
        print_stderr(f"note: {note}")
