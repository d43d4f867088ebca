"""The methods to compare with, in vectorised numpy and scipy, as their authors describe them.

None of them knows the robot's speed limits; largest steps are part of every comparison.
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
    """A method of others: made of a problem and lambda / dt^2, and the model that it knows.

    serves_every_problem: whether it serves every problem; another one says why it does not serve one, and is run
    by name only.
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
    """A reference method as a FrameSolver; raises OptionError of an unknown name or a problem not served."""
    check_choice("reference method", name, REFERENCE_METHODS)
    found = REFERENCE_METHODS[name]
    KINEMATIC_MODELS[found.model].check(problem.robot)
    method = found.method(problem, settings.motion_weight / problem.dt**2)
    return ReferenceFrames(problem, name, found.model, method, settings.options())


__all__ = ["REFERENCE_METHODS", "reference_frames"]
