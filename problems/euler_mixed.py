"""A straight tube, an arc and an Euler tube along the same Euler curve, Fig. 10 (b); the numbers are ours."""

from ctr_nlp import Problem, Robot, growing
from ctr_nlp.problems.euler import euler_curve, robot_with_curvatures

EULER_MIXED_CURVATURES_PER_MM = (0.0, 1 / 80, (1 / 120, 1 / 60))
"""Of each tube, 1/mm; root and tip of the curved part where it varies."""


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """Tube 1 straight, tube 2 an arc of 1/80, tube 3 from 1/120 to 1/60; target as in euler."""
    return Problem(
        "euler_mixed",
        robot or robot_with_curvatures(EULER_MIXED_CURVATURES_PER_MM),
        growing(euler_curve(), frames),
        duration,
    )
