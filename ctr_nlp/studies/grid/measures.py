"""Further figures of plans that a study may ask for, beside their summaries."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import contact_depths
from ctr_nlp.plan.plan import Plan


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


MEASURES: Mapping[str, Callable[[Plan, Problem], dict[str, float]]] = {"contact": contact}
"""Name of a measure -> function that returns its columns of a plan's row."""
