"""Make a problem for a robot that has none: a path of its own shape."""

from __future__ import annotations

import numpy as np

from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import growing
from ctr_nlp.plan.simulation import shape_curve
from ctr_nlp.robot import Robot


def free_problem(name: str, robot: Robot, frames: int = 100) -> Problem:
    """Return a problem that follows the robot's own shape, all tubes deployed and turned alike, without a lumen.

    name: of the problem. robot: the robot. frames: number of frames. Raises OptionError where the dominant model
    does not describe the robot, and ProblemError.
    """
    turned = np.zeros(robot.d)
    tilted = np.zeros(2)
    q = np.clip(np.concatenate([turned, robot.max_extensions, tilted]), robot.lower, robot.upper)
    return Problem(name, robot, growing(shape_curve(robot, q), frames))
