"""Tubes and the limits of their motors: the description of a robot. Imports no target, model or solver."""

from ctr_nlp.robot.limits import Limits
from ctr_nlp.robot.paper import table_i_robot
from ctr_nlp.robot.robot import MM_PER_RAD, Robot
from ctr_nlp.robot.tolerances import Tolerances
from ctr_nlp.robot.tube import Tube

__all__ = ["MM_PER_RAD", "Limits", "Robot", "Tolerances", "Tube", "table_i_robot"]
