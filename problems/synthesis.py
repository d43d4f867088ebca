"""The paper's time-varying target, section IV.B: shapes of the robot itself, so that q is known."""

import math

import numpy as np

from ctr_nlp import Problem, Robot, sequence, shape_curve, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """Shapes at q(t) = (1 - t) q1 + t q2; at theta_x = pi/2, alpha and theta_y are one rotation."""
    robot = robot or table_i_robot()
    first = np.array([0, 0, 0, 38, 70, 75, 0, 0], dtype=float)
    last = np.array([math.pi, math.pi, math.pi, 50, 107, 150, math.pi, math.pi])
    t = np.arange(1, frames + 1)[:, None] / frames
    truth = (1 - t) * first + t * last
    for q in truth:
        robot.check(q, "q of the synthesis problem")
    target = sequence([shape_curve(robot, q) for q in truth])
    return Problem("synthesis", robot, target, duration, truth=truth)
