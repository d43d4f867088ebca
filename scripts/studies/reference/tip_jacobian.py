"""Tip-only control, Fig. 9 (d): damped least squares on the Jacobian of the tip's position.

Source: the paper compares with "a traditional Jacobian-based method [26]" (section IV.C, Fig. 9 (d)) and describes
no more of it. Chosen here: q <- q + W^-1 J^T (J J^T + mu^2 I)^-1 e with e the tip's error in mm, J its Jacobian on
the dominant model with motors in mm (angles by W, 10 mm/rad), and mu the damping of Nakamura and Hanafusa (1986),
constant; repeated in each frame until the tip has arrived; then clipped to the limits. Nothing steers the rest of
the shape.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import Frame
from ctr_nlp.plan.simulation import shapes
from ctr_nlp.typing import Array
from reference.descent import REFERENCE_DIFFERENCE_STEP, Method, clip_configuration

TIP_JACOBIAN_DAMPING = 1.0
"""mu of the damped inverse J^T (J J^T + mu^2 I)^-1, in mm/mm."""
MAX_TIP_JACOBIAN_ITERATIONS = 100
"""Largest number of steps in a frame."""
CLOSE_MM = 1e-2
"""The tip has arrived when it is this close to the target's end."""


def tip_jacobian(problem: Problem, motion_weight: float) -> Method:
    """Return the method for a problem; `motion_weight` is ignored."""
    del motion_weight
    robot = problem.robot

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        q = clip_configuration(robot, guess)
        evaluations = 0
        for _ in range(MAX_TIP_JACOBIAN_ITERATIONS):
            batch = np.vstack([q, q + np.eye(len(q)) * REFERENCE_DIFFERENCE_STEP])
            tips = shapes(robot, batch, np.ones(1))[:, 0]
            evaluations += len(batch)
            error = frame.points[-1] - tips[0]
            if np.linalg.norm(error) < CLOSE_MM:
                break
            # In mm of tip per mm of motor: without W, mu would damp radians and millimetres alike.
            jacobian = (tips[1:] - tips[0]).T / REFERENCE_DIFFERENCE_STEP / robot.mm_per_unit
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + TIP_JACOBIAN_DAMPING**2 * np.eye(3), error)
            q = clip_configuration(robot, q + step / robot.mm_per_unit)
        distance = float(np.linalg.norm(error))
        return FrameResult(q, distance < 1.0, distance**2, np.nan, evaluations, f"tip within {distance:.3g} mm")

    return solve
