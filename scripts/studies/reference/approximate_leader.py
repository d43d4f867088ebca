"""Approximate follow-the-leader deployment: the body stays near to the path of the tip at every depth.

Gilbert, Neimat, Webster, Concentric Tube Robots as Steerable Needles: Achieving Follow-the-Leader Deployment, IEEE
Transactions on Robotics 31(2), 2015, tell by a metric how similar a deployment is to an exact one. Their formula
is not taken over; what follows is ours. At each depth, tubes are rotated and translated so that the mean square of
the distance, at equal arc length, between the body and the path that the tip has travelled is least, and with the
same weight the square of that between the tip and where it is to go. Torsion counts, the base stands still, in the
direction in which the path leaves the opening, and the innermost tube is out by the depth. The search is L-BFGS-B;
what the stability margin lacks is penalised.

A depth is answered from the one before. Tubes that lie in the plane of a path are at a saddle, from which descent
does not find aside: where the body or the tip is far from where they should be, the search begins again with each
tube turned aside, either way, and the least answer counts. A frame is solved where the search ends at a stable
minimum, however far the tip is from where it is to go.
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
"""The margin from which on nothing is penalised, and mm^2 that the square of what it lacks costs."""
LEADER_RESTART_OBJECTIVE_MM2, LEADER_RESTART_TURN_RAD = 1.0, 0.05
"""mm^2 of an answer from which on tubes are turned aside, and by how much, rad."""
APPROXIMATE_LEADER_NAME = "follow-the-leader-approximate"


def approximate_leader(problem: Problem, motion_weight: float) -> Method:
    """The method for a problem; motion_weight has no part in it.

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
        travelled = np.zeros((1, 4)) if before is None or before.warm is None else before.warm
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
        warm = np.vstack([travelled[travelled[:, 0] < depth], [depth, *tip]])
        q = ELASTIC_MODEL.configuration(robot, x)[0]
        status = found.status if stable else "not stable"
        solved = found.success and stable
        return FrameResult(q, solved, found.objective, np.nan, found.evaluations, status, warm, x[0])

    return solve


def _interpolate_path(travelled: Array, s: Array) -> Array:
    """Points (n, 3) at depths s (n,) of a path of the tip, told by its depth and place (k, 4), mm."""
    return np.stack([np.interp(s, travelled[:, 0], travelled[:, k]) for k in (1, 2, 3)], axis=1)


def _initial_tilt(robot: Robot, path: Frame) -> Array:
    """The tilt (2,) in which the base looks along a path at the opening, as far as its limits allow."""
    x, y, z = path.tangents[0]
    tilt = np.array([-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)])
    return np.clip(tilt, robot.lower[-2:], robot.upper[-2:])
