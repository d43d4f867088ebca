"""Approximate follow-the-leader deployment: the body stays near to the path of the tip at every depth.

Gilbert, Neimat, Webster, Concentric Tube Robots as Steerable Needles: Achieving Follow-the-Leader Deployment, IEEE
Transactions on Robotics 31(2), 2015, measure by a metric how similar a deployment is to an exact one. What
differs: their metric is not taken over, and the optimisation is ours. At each depth b = beta_d, minimise over
alpha and the other beta

    sum_k w_k |p(sigma_k) - l(sigma_k b)|^2  +  |p(1) - g|^2  +  1e4 mm^2 max(0, 0.1 - mu)^2

with p the body on the torsionally compliant model, l the path that the tip has travelled, continued to g, w_k
trapezoidal weights, g the end of the frame's target, and mu the stability margin. The base does not move: it
points in the direction in which the path leaves the opening. The search is L-BFGS-B (descent.py).

The initial guess is the solution at the depth before. Tubes that lie in the plane of a path are at a saddle point,
which descent does not leave sideways: where the objective is large, the search starts again with each tube turned
aside, either way, and the best result counts. A frame is solved where the search ends at a stable minimum, however
far the tip is from the target's end.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID, Frame
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from reference.descent import Method, descend, extensions, fractions, shape_error
from reference.follow_the_leader import growing_path

ELASTIC_MODEL = KINEMATIC_MODELS["elastic"]
LEADER_MIN_UNPENALISED_MARGIN, LEADER_STABILITY_PENALTY_MM2 = 0.1, 1e4
"""Stability margin below which a penalty begins, and its factor on the square of what is missing, mm^2."""
LEADER_RESTART_OBJECTIVE_MM2, LEADER_RESTART_TURN_RAD = 1.0, 0.05
"""Objective above which the search starts again with tubes turned aside, mm^2, and by which angle, rad."""
APPROXIMATE_LEADER_NAME = "follow-the-leader-approximate"


def approximate_leader(problem: Problem, motion_weight: float) -> Method:
    """Return the method for a problem; `motion_weight` is ignored.

    Raises OptionError where the target is not one path that grows, or motors' angles have limits.
    """
    del motion_weight
    robot = problem.robot
    d = problem.robot.d
    if np.isfinite([robot.lower[:d], robot.upper[:d]]).any():
        raise OptionError(
            f"{APPROXIMATE_LEADER_NAME} turns tubes as far as it takes, and alpha of the robot has limits"
        )
    theta = _initial_tilt(robot, growing_path(problem, APPROXIMATE_LEADER_NAME))
    bounds = np.concatenate([np.tile([-np.inf, np.inf], (d, 1)), np.tile([0.0, 1.0], (d - 1, 1))])

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        depth = np.array(np.clip(frame.length, robot.lower[2 * d - 1], robot.reach))
        # Rows are the depth and the tip's position there. The path begins at the opening, which is the origin.
        travelled = np.zeros((1, 4)) if before is None or before.warm is None else before.warm
        # The leader's path ends where the tip is to be, not where it is: the last part of the body follows that.
        leader = _interpolate_path(np.vstack([travelled, [depth, *frame.points[-1]]]), SIGMA_GRID * depth)

        def unknowns(variables: Array) -> Array:
            rows = len(variables)
            beta = extensions(robot, variables[:, d:], np.full(rows, depth))
            return np.concatenate([variables[:, :d], beta, np.tile(theta, (rows, 1))], axis=1)

        def cost(variables: Array) -> Array:
            x = unknowns(variables)
            points = ELASTIC_MODEL.points(robot, x, SIGMA_GRID).transpose(2, 0, 1)
            tips = ((points[:, :, -1].T - leader[-1]) ** 2).sum(axis=1)
            lacking = (
                LEADER_STABILITY_PENALTY_MM2
                * np.maximum(LEADER_MIN_UNPENALISED_MARGIN - ELASTIC_MODEL.margins(robot, x), 0.0) ** 2
            )
            return tips + shape_error((points[0], points[1], points[2]), leader, QUADRATURE) + lacking

        known = ELASTIC_MODEL.guess(robot, guess) if before is None or before.x is None else before.x
        start = np.concatenate([known[:d], fractions(robot, np.append(known[d : 2 * d - 1], depth))[:-1]])
        found = descend(cost, start, bounds)
        if found.objective > LEADER_RESTART_OBJECTIVE_MM2:
            aside = start + LEADER_RESTART_TURN_RAD * np.pad(
                np.vstack([np.eye(d), -np.eye(d)]), ((0, 0), (0, d - 1))
            )
            tried = [found, *(descend(cost, each, bounds) for each in aside)]
            found = min(tried, key=lambda one: (not one.success, one.objective))
        x = unknowns(found.variables[None])
        stable = bool(ELASTIC_MODEL.margins(robot, x)[0] > 0)
        tip = ELASTIC_MODEL.points(robot, x, np.ones(1))[0, 0]
        # Rows at this depth or beyond are replaced: depths must increase for the interpolation.
        warm = np.vstack([travelled[travelled[:, 0] < depth], [depth, *tip]])
        q = ELASTIC_MODEL.configuration(robot, x)[0]
        status = found.status if stable else "not stable"
        solved = found.success and stable
        return FrameResult(q, solved, found.objective, np.nan, found.evaluations, status, warm, x[0])

    return solve


def _interpolate_path(travelled: Array, s: Array) -> Array:
    """Interpolate the tip's path, rows (k, 4) of depth and position, to points (n, 3) at depths s (n,), mm."""
    return np.stack([np.interp(s, travelled[:, 0], travelled[:, k]) for k in (1, 2, 3)], axis=1)


def _initial_tilt(robot: Robot, path: Frame) -> Array:
    """Compute theta (2,), rad, at which the base looks along a path at the opening, clipped to its limits."""
    x, y, z = path.tangents[0]
    # Ry(theta_y) Rx(theta_x) e_z = (sin ty cos tx, -sin tx, cos ty cos tx), eq. (4).
    tilt = np.array([-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)])
    return np.clip(tilt, robot.lower[-2:], robot.upper[-2:])
