"""What is asked of a search, checked before anything is built for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.formulations.settings import Settings, check_motion_weight
from ctr_nlp.formulations.terms import Term
from ctr_nlp.support.values import check_choice, floats, instance, whole_number
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

Direction = Literal["forward", "backward", "best"]

DIRECTIONS = ("forward", "backward", "best")


def check_described(problem: Any, settings: Any) -> None:
    """Raise ProblemError or OptionError unless these are a problem and settings."""
    instance(ProblemError, "problem", problem, Problem)
    instance(OptionError, "settings", settings, Settings)


def checked_ends(
    problem: Problem, direction: Direction, start: npt.ArrayLike | None, end: npt.ArrayLike | None = None
) -> tuple[Array | None, Array | None]:
    """Given ends of a motion, q (2d + 2,), as arrays; raises RobotError and, with direction, OptionError."""
    check_choice("direction", direction, DIRECTIONS)
    if start is not None and direction == "backward":
        raise OptionError("direction is 'backward' and a start is given; a motion from a start goes forward")
    check = problem.robot.check
    return None if start is None else check(start, "start"), None if end is None else check(end, "end")


def check_search(motion_weight: float | None, starts: int | None, jobs: int) -> None:
    """Raise OptionError unless a horizon can be searched for so."""
    for name, count in (("starts", starts), ("jobs", jobs)):
        if count is not None:
            whole_number(OptionError, name, count)
    if motion_weight is not None:
        check_motion_weight(motion_weight)


def checked_motions(problem: Problem, initial: Sequence[npt.ArrayLike]) -> list[Array]:
    """Motions (T, 2d + 2) to start from, as arrays; raises OptionError."""
    if not isinstance(initial, Sequence | np.ndarray) or isinstance(initial, str):
        raise OptionError(f"initial is {initial!r:.80}; it must be a sequence of motions")
    expected = (problem.frames, len(problem.robot.axes))
    return [floats(OptionError, "a motion of initial", motion, expected) for motion in initial]


def checked_terms(terms: Sequence[Term]) -> tuple[Term, ...]:
    """Further terms of the objective; raises OptionError unless they are terms."""
    for term in terms if isinstance(terms, Sequence) else [terms]:
        instance(OptionError, "a term", term, Term)
    return tuple(terms)
