"""Formulations of one frame: a tuple of stages, each an Nlp and how its parameters are filled."""

from collections.abc import Callable, Sequence

from ctr_nlp.formulations.joint import joint
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.stage import Stage
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.two_stage import two_stage, two_stage_exact
from ctr_nlp.models import Model
from ctr_nlp.robot import Robot

FORMULATIONS: dict[str, Callable[[Robot, Settings, Model, Sequence[Term]], tuple[Stage, ...]]] = {
    "joint": joint,
    "two-stage": two_stage,
    "two-stage-exact": two_stage_exact,
}
"""Every frame formulation by the name that options use."""

__all__ = ["FORMULATIONS", "Stage"]
