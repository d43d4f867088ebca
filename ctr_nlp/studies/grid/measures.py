"""Further figures of plans that a study may ask for, beside their summaries."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.check.checker import NOT_COVERED
from ctr_nlp.check.comparison import compare_verdicts
from ctr_nlp.check.records import check_plan
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import contact_depths
from ctr_nlp.plan.plan import Plan
from ctr_nlp.studies.reach.binding import describe_end


def contact(plan: Plan, problem: Problem) -> dict[str, float]:
    """Measure the contact of a plan with the wall.

    Parameters
    ----------
    plan : Plan
        A plan within a lumen.
    problem : Problem
        The problem that it was planned for.

    Returns
    -------
    dict
        ``contact_sum``: depth beyond the wall summed over frames, mm; ``contact_frames``: frames in contact;
        ``length``: of the target in its last frame, mm; ``short``: by how much the robot is shorter than its
        target at most, mm.
    """
    deep = contact_depths(plan)
    # A target longer than the robot's reach does not count as a robot that is too short.
    out = np.minimum(problem.target.lengths, problem.robot.reach)
    return {
        "contact_sum": float(deep.sum()),
        "contact_frames": float((deep > 0).sum()),
        "length": max(problem.target.lengths),
        "short": max(0.0, float((out - plan.beta[:, -1]).max())),
    }


def check(plan: Plan, problem: Problem) -> dict[str, Any]:
    """Check a plan a second time, with all its simulated robots, by code that shares nothing with planners.

    Parameters
    ----------
    plan : Plan
        The plan.
    problem : Problem
        The problem that it was planned for; not used.

    Returns
    -------
    dict
        ``check_agrees``: whether the checker agrees with the plan; ``check_disagrees`` and ``check_not_covered``:
        names of verdicts and parts of the record, joined by commas.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.npz"
        plan.save(path)
        found = check_plan(path, samples=0 if plan.drawn is None else len(plan.drawn))
    opinions = compare_verdicts(found, plan.verdicts._asdict())
    apart = [each.name for each in opinions if not each.agrees]
    uncovered = [each.name for each in opinions if each.word == NOT_COVERED]
    return {
        "check_agrees": not apart,
        "check_disagrees": ",".join(apart),
        "check_not_covered": ",".join(uncovered),
    }


CHECK_MEASURE = "check"
"""Name of the measure that checks a plan a second time."""


def binding(plan: Plan, _: Problem) -> dict[str, Any]:
    """Describe where a plan touches the wall, and which constraints are active at its end; see describe_end."""
    return describe_end(plan)


MEASURES: Mapping[str, Callable[[Plan, Problem], dict[str, Any]]] = {
    "contact": contact,
    CHECK_MEASURE: check,
    "binding": binding,
}
"""Name of a measure -> function that returns its columns of a plan's row."""
