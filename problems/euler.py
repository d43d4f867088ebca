"""Three Euler tubes along an Euler curve, Fig. 10 (a); the numbers are ours."""

from dataclasses import replace

import casadi as ca
import numpy as np

from ctr_nlp import Curve, Problem, Robot, curve_from_formula, growing, table_i_robot

EULER_CURVATURES_PER_MM = ((1 / 200, 1 / 100), (1 / 90, 1 / 50), (1 / 120, 1 / 60))
"""Root and tip of the curved part of each tube, 1/mm."""


def problem(frames: int = 100, duration: float = 10.0, robot: Robot | None = None) -> Problem:
    """Pre-curvature linear in the distance from the tip; target planar, 1/180 at the base to 1/60 at 150 mm."""
    return Problem(
        "euler", robot or robot_with_curvatures(EULER_CURVATURES_PER_MM), growing(euler_curve(), frames), duration
    )


def robot_with_curvatures(curvatures: tuple[float | tuple[float, float], ...]) -> Robot:
    """The paper's robot with other pre-curvatures, 1/mm."""
    robot = table_i_robot()
    tubes = (replace(tube, curvature=k) for tube, k in zip(robot.tubes, curvatures, strict=True))
    return replace(robot, tubes=tuple(tubes))


def euler_curve() -> Curve:
    """150 mm in the zx-plane towards +x; the Fresnel integrals by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(24)

    def point(u: ca.SX) -> tuple[ca.SX, float, ca.SX]:
        s = u * ca.DM((nodes + 1) / 2)
        angle = s / 180 + (1 / 60 - 1 / 180) / 150 * s**2 / 2
        weight = u * ca.DM(weights / 2)
        return ca.dot(weight, ca.sin(angle)), 0, ca.dot(weight, ca.cos(angle))

    return curve_from_formula(point, 0.0, 150.0)
