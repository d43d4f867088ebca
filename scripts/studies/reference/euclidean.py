"""The paper's baseline: L-BFGS-B on all of q with the distance (8) under arc length, eq. (9).

Source: the paper's section IV.A, "a Jacobian-based optimization framework", which minimises (9) with the distance
(8) under arc-length parametrisation, by L-BFGS-B. What differs: the integral (8) is a trapezoidal sum over 101
points at uniform sigma; the gradient is one of finite differences (descent.py), the paper's is not described;
eqs. (2) and (3) are kept by fractions for extensions; and lambda has a unit, where the paper's weight, 500, has
none. The shape is that of eqs. (1) and (4).
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.dominant import shape as dominant
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID, Frame
from ctr_nlp.typing import Array
from reference.descent import Method, descend, extensions, fractions, motion_term, shape_error


def euclidean(problem: Problem, motion_weight: float) -> Method:
    """Return the method for a problem; motion_weight: lambda / dt^2, without unit."""
    robot = problem.robot
    d = robot.d
    # Variables are (alpha, fractions, theta): L-BFGS-B bounds the fractions, and so keeps eqs. (2) and (3).
    bounds = np.column_stack([robot.lower, robot.upper])
    bounds[d : 2 * d] = 0.0, 1.0

    def configured(x: Array) -> Array:
        return np.concatenate([x[:, :d], extensions(robot, x[:, d : 2 * d]), x[:, 2 * d :]], axis=1)

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        def cost(x: Array) -> Array:
            q = configured(x)
            points = dominant.backbone(robot.tube_numbers, list(q.T[..., None]), SIGMA_GRID, np).points
            return shape_error(points, frame.points, QUADRATURE) + motion_term(robot, q, before, motion_weight)

        start = np.concatenate([guess[:d], fractions(robot, guess[d : 2 * d]), guess[2 * d :]])
        x, objective, ok, evaluations, status = descend(cost, start, bounds)
        return FrameResult(configured(x[None])[0], ok, objective, np.nan, evaluations, status)

    return solve
