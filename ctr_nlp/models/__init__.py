"""Models of the robot: configuration to backbone."""

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.dominant import check_order
from ctr_nlp.models.symbolic import Shape, dominant_shape, elastic_shape
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import check_choice

MODELS = {"dominant": dominant_shape, "elastic": elastic_shape}
"""What a model gives a formulation, by the name that options use."""


def check_model(robot: Robot, model: str, name: str = "model") -> None:
    """Raise OptionError unless there is a model of that name, and the robot is one that it describes."""
    check_choice(name, model, MODELS)
    if model == "dominant":
        check_order(robot)


def suits(robot: Robot, model: str) -> bool:
    """Whether a model describes a robot."""
    try:
        check_model(robot, model)
    except OptionError:
        return False
    return True


__all__ = ["MODELS", "Shape", "check_model", "suits"]
