"""The seed's arc, Fig. 4 (b), its misprint mended."""

import math

import casadi as ca

from ctr_nlp import Problem, Robot, curve_from_formula, growing


def problem(robot: Robot, frames: int, duration: float) -> Problem:
    """(sqrt(100^2 - u^2) - 100, 0, u), u in [0, 100 sin 1.5]; mm."""
    path = curve_from_formula(lambda u: (ca.sqrt(100**2 - u**2) - 100, 0, u), 0.0, 100 * math.sin(1.5))
    return Problem("arc", robot, growing(path, frames), duration)
