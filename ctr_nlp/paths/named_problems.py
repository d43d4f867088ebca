"""Named problems: a small file each in the folder `problems`, which is installed as `ctr_nlp.problems`."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path

from ctr_nlp.paths.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import check_choice

PROBLEM_PACKAGE = "ctr_nlp.problems"
"""Package with a module for each named problem."""


def _list_problem_names() -> tuple[str, ...]:
    """Return the names of the modules in the package, in alphabetical order."""
    # The package is located without importing it, because it imports this module.
    spec = importlib.util.find_spec(PROBLEM_PACKAGE)
    folders = spec.submodule_search_locations if spec is not None else None
    return tuple(sorted(path.stem for folder in folders or () for path in Path(folder).glob("[a-z]*.py")))


PROBLEM_NAMES = _list_problem_names()
"""Every named problem, in alphabetical order."""


def named_problem(name: str, frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """Return the problem of a name.

    Parameters
    ----------
    name : str
        One of `PROBLEM_NAMES`.
    frames : int
        Number of frames T.
    duration : float
        Duration of the motion, s.
    robot : Robot, optional
        Robot to follow the target with; by default the problem's own.

    Returns
    -------
    Problem
        Robot and target; lengths in mm, angles in rad.

    Raises
    ------
    OptionError
        There is no problem of that name.
    ProblemError
        The robot cannot reach the target.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> ctr.named_problem("arc", frames=20).frames
    20
    """
    check_choice("problem", name, PROBLEM_NAMES)
    problem: Problem = importlib.import_module(f"{PROBLEM_PACKAGE}.{name}").problem(frames, duration, robot)
    return problem
