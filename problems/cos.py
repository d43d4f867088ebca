"""The paper's cosine, Fig. 4 (a)."""

import math

import casadi as ca

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """(10 cos 0.044 u - 10, 0, u), u in [0, 45.45 pi]; mm."""
    path = curve_from_formula(lambda u: (10 * ca.cos(0.044 * u) - 10, 0, u), 0.0, 45.45 * math.pi)
    return Problem("cos", robot or table_i_robot(), growing(path, frames), duration)
