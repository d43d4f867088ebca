"""A problem file as users wrote them before tubes were parameters."""

import casadi as ca

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """A path that bends to one side."""
    path = curve_from_formula(lambda u: (20 - 20 * ca.cos(u / 60), 0, u), 0.0, 80.0)
    return Problem("spiral", robot or table_i_robot(), growing(path, frames), duration)
