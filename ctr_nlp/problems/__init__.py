"""The named problems, a file each: a robot and a target, nothing else. Knows no solver."""

from __future__ import annotations

import importlib
from pathlib import Path

from ctr_nlp.robot import Robot
from ctr_nlp.support.values import check_choice
from ctr_nlp.target.problem import Problem

PROBLEM_NAMES = tuple(sorted(path.stem for path in Path(__file__).parent.glob("[a-z]*.py")))
"""Every named problem, in alphabetical order."""


def named_problem(name: str, frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """The problem of a name; duration in s, its own robot where None. Raises OptionError, ProblemError."""
    check_choice("problem", name, PROBLEM_NAMES)
    made: Problem = importlib.import_module(f"{__name__}.{name}").problem(frames, duration, robot)
    return made


__all__ = ["PROBLEM_NAMES", "named_problem"]
