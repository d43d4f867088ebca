"""The methods to compare with, in vectorised numpy and scipy, as their authors describe them.

Each file names the publication that it follows and says what differs from it. What differs in all of them: lambda
of the motion term has the unit s^2 (the paper gives 100 and 500 without one), and a search without a previous
frame takes the best of 32 starts. None of them knows the robot's speed limits; largest steps are part of every
comparison.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.support.value_checks import check_choice
from reference.approximate_leader import approximate_leader
from reference.descent import Method, ReferenceFrames
from reference.euclidean import euclidean
from reference.follow_the_leader import follow_the_leader
from reference.learned.s2j import s2j
from reference.paper_two_stage import paper_two_stage
from reference.tip_jacobian import tip_jacobian
from reference.tip_resolved import tip_resolved


class Reference(NamedTuple):
    """A published method: its factory, the model that it plans on, and whether it applies to every problem.

    method: called with a problem and lambda / dt^2. serves_every_problem: where False, the factory raises an
    OptionError that says why it does not apply to a problem, and the method is run by name only.
    """

    method: Callable[[Problem, float], Method]
    model: str = "dominant"
    serves_every_problem: bool = True


REFERENCE_METHODS: dict[str, Reference] = {
    "paper-two-stage": Reference(paper_two_stage),
    "euclidean": Reference(euclidean),
    "tip-jacobian": Reference(tip_jacobian),
    "tip-resolved": Reference(tip_resolved, "elastic"),
    "follow-the-leader": Reference(follow_the_leader, "elastic", serves_every_problem=False),
    "follow-the-leader-approximate": Reference(approximate_leader, "elastic", serves_every_problem=False),
} | {
    f"s2j{'-projected' * projected}{suffix}": Reference(
        partial(s2j, model=model, projected=projected), model, serves_every_problem=False
    )
    for model, suffix in (("dominant", ""), ("elastic", "-elastic"))
    for projected in (False, True)
}
"""Every reference method by the name that options use."""


def reference_frames(problem: Problem, name: str, settings: Settings) -> ReferenceFrames:
    """Return a reference method as a FrameSolver.

    problem: what is to be followed. name: of REFERENCE_METHODS. settings: of these, motion_weight (lambda, s^2)
    counts, and all are written into the plan's metadata. Raises OptionError where the name is unknown, or the
    method does not apply to the problem.
    """
    check_choice("reference method", name, REFERENCE_METHODS)
    found = REFERENCE_METHODS[name]
    # The motion term of eq. (9) is lambda |W dq / dt|^2 with dq / dt as a difference quotient, hence 1 / dt^2.
    KINEMATIC_MODELS[found.model].check(problem.robot)
    method = found.method(problem, settings.motion_weight / problem.dt**2)
    return ReferenceFrames(problem, name, found.model, method, settings.options())


__all__ = ["REFERENCE_METHODS", "reference_frames"]
