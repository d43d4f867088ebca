"""The paper's straight line, Fig. 4 (c): the hardest for pre-curved tubes."""

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """(0.02 u, 0, u), u in [0, 150]; mm."""
    path = curve_from_formula(lambda u: (0.02 * u, 0, u), 0.0, 150.0)
    return Problem("line", robot or table_i_robot(), growing(path, frames), duration)
