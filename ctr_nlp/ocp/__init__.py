"""Optimal control problems of the robot: the program of a frame, and of all frames of a motion.

A frame formulation is a tuple of stages, each an Nlp and a function that fills its parameters. `joint` solves eq.
(9) for all of q, `two_stage` eqs. (10)-(12) as the paper does. `horizon` has all frames in one program, and
`shared` several robots or tasks. `terms` are the parts of an objective, one a file; `frame` assembles a model and
terms; `wall` linearises a lumen's wall near the robot.
"""

from collections.abc import Callable, Sequence

from ctr_nlp.models import DEFAULT_MODEL, Model
from ctr_nlp.ocp.joint import joint
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.stage import Stage
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.two_stage import two_stage, two_stage_exact
from ctr_nlp.robot import Robot

FORMULATIONS: dict[str, Callable[[Robot, Settings, Model, Sequence[Term]], tuple[Stage, ...]]] = {
    "joint": joint,
    "two-stage": two_stage,
    "two-stage-exact": two_stage_exact,
}
"""Every frame formulation by the name that options use."""
TWO_STAGE = ("two-stage", "two-stage-exact")
"""Names of the formulations that find beta from the target's curvature first, and alpha after it."""


def default_model(formulation: str) -> str:
    """Return the name of the model that a formulation plans on by default; formulation may also be "horizon".

    The elastic model, except for the two-stage formulations: their first stage needs a curvature that alpha does
    not change, and only the dominant model has one.
    """
    return "dominant" if formulation in TWO_STAGE else DEFAULT_MODEL


__all__ = ["FORMULATIONS", "Stage", "default_model"]
