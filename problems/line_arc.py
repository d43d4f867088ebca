"""The paper's line followed by an arc, Fig. 4 (d), joined with a common tangent."""

import math

import casadi as ca

from ctr_nlp import Problem, Robot, curve_from_formula, growing, table_i_robot


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """75 mm along (0.02, 0, 1), then 75 mm of an arc of radius 100 mm towards -x; u is arc length."""
    sine, cosine = (c / math.hypot(0.02, 1) for c in (0.02, 1))

    def path(u: ca.SX) -> tuple[ca.SX, float, ca.SX]:
        angle = ca.fmax(u - 75, 0) / 100
        along, aside = ca.fmin(u, 75) + 100 * ca.sin(angle), 200 * ca.sin(angle / 2) ** 2
        return sine * along - cosine * aside, 0, cosine * along + sine * aside

    return Problem(
        "line_arc", robot or table_i_robot(), growing(curve_from_formula(path, 0.0, 150.0), frames), duration
    )
