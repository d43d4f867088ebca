"""The paper's arc, Fig. 4 (b), its misprint mended."""

import math

import casadi as ca

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """(sqrt(100^2 - u^2) - 100, 0, u), u in [0, 100 sin 1.5]; mm."""
    path = curve_from_formula(lambda u: (ca.sqrt(100**2 - u**2) - 100, 0, u), 0.0, 100 * math.sin(1.5))
    return Problem("arc", robot or table_i_robot(), growing(path, frames), duration)
