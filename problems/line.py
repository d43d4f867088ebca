"""The seed's straight line, Fig. 4 (c): the hardest for pre-curved tubes."""

from ctr_nlp import Problem, Robot, curve_from_formula, growing


def problem(robot: Robot, frames: int, duration: float) -> Problem:
    """(0.02 u, 0, u), u in [0, 150]; mm."""
    path = curve_from_formula(lambda u: (0.02 * u, 0, u), 0.0, 150.0)
    return Problem("line", robot, growing(path, frames), duration)
