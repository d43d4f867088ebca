"""The paper's method: L-BFGS-B on curvature for extensions, eq. (11), then on points for rotations, eq. (12).

Source: the paper's sections III.A and III.B. Stage one minimises sum_i int (k_i - kbar(s L / beta_d))^2 ds over
beta, with k_i the tubes' curvatures and kbar the target's, in 1/mm; stage two minimises the distance of points
over alpha and theta. Both start from the frame before and have a motion term. What differs:

- (11) as an integral is least for a robot that is not out at all. The tip belongs to the target's end, so beta_d
  is the target's length, and the integral is a mean over the robot.
- It is scaled to mm^2 (ocp.curvature), so that one lambda serves both stages; the paper's weight of 100 is without
  a unit.
- The paper samples (11) at uniform points, of which a sum is piecewise constant in beta; here each segment has
  midpoints of its own.
- Gradients are finite differences, and fractions keep eqs. (2) and (3) (descent.py).
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.models.dominant import shape as dominant
from ctr_nlp.ocp.curvature import curvature_to_shape_scale
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID, Frame
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from reference.descent import Method, descend, extensions, fractions, motion_term, shape_error

CURVATURE_MIDPOINTS_PER_SEGMENT = 20
"""Midpoints per segment of the integral (11); they move with the segment, so that the sum has a gradient."""
DEFAULT_POINTS_PER_SEGMENT = 2
"""Points on a segment in (12): its middle and its end, which the paper found sufficient (Fig. 3)."""


def paper_two_stage(problem: Problem, motion_weight: float, points: int = DEFAULT_POINTS_PER_SEGMENT) -> Method:
    """Return the method for a problem; motion_weight: lambda / dt^2 of both stages, without unit.

    points: samples of the shape on a segment in stage two, the last at its end; Fig. 3 varies them.
    """
    robot = problem.robot

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        beta, ok_first, n_first, first = _extend(robot, frame, guess, before, motion_weight)
        q, objective, ok, n, second = _rotate(robot, frame, beta, points, guess, before, motion_weight)
        return FrameResult(q, ok_first and ok, objective, np.nan, n_first + n, f"{first}; {second}")

    return solve


def _extend(
    robot: Robot, frame: Frame, guess: Array, before: FrameResult | None, weight: float
) -> tuple[Array, bool, int, str]:
    """Find beta (d,) in mm from curvature, eq. (11); returns success, evaluations and the status, too.

    The tip belongs to the target's end, so beta_d is the target's length. guess: q (2d + 2,), the start. weight:
    of the motion term, lambda / dt^2.
    """
    d = robot.d
    low = robot.lower[2 * robot.d - 1]
    high = robot.reach
    last = float(np.clip(frame.length, low, high))
    middles = (np.arange(CURVATURE_MIDPOINTS_PER_SEGMENT) + 0.5) / CURVATURE_MIDPOINTS_PER_SEGMENT

    def cost(x: Array) -> Array:
        beta = extensions(robot, x, np.full(len(x), last))
        edges = np.concatenate([np.zeros((len(x), 1)), beta], axis=1)
        widths = np.diff(edges, axis=1)
        # Midpoints move with their segment: at fixed points the sum would be piecewise constant in beta, and its
        # gradient 0.
        s = (edges[:, :-1, None] + widths[..., None] * middles).reshape(len(x), -1)
        k = dominant.curvature(
            robot.tube_numbers, [b[:, None] for b in beta.T], s, lambda v: np.heaviside(v, 0.0), np
        )
        # The target is read at equal fractions of its length: the paper's factor L / beta_3 in (11).
        kappa = np.interp(s / last, SIGMA_GRID, frame.curvature)
        squares = ((k - kappa) ** 2).reshape(len(x), d, CURVATURE_MIDPOINTS_PER_SEGMENT).mean(axis=2)
        change = 0.0 if before is None else weight * ((beta - robot.split(before.q)[1]) ** 2).sum(axis=1)
        # Divided by the length: a mean, which a shorter robot does not make smaller.
        return curvature_to_shape_scale(robot.reach) ** 2 * (squares * widths).sum(axis=1) / last + change

    start = fractions(robot, np.append(robot.split(guess)[1][:-1], last))[: d - 1]
    if d == 1:
        return np.array([last]), True, 0, "given"
    x, _, ok, evaluations, status = descend(cost, start, np.tile([0.0, 1.0], (d - 1, 1)))
    return extensions(robot, x, np.array(last)), ok, evaluations, status


def _rotate(
    robot: Robot, frame: Frame, beta: Array, points: int, guess: Array, before: FrameResult | None, weight: float
) -> tuple[Array, float, bool, int, str]:
    """Find alpha and theta from points of the segments, eq. (12), with beta (d,) in mm given.

    points: number of evenly spaced points on each segment, all weighted alike. guess: q (2d + 2,), the start.
    weight: of the motion term. Returns q, the objective in mm^2, success, evaluations and the status.
    """
    d = robot.d
    parts = np.arange(1, points + 1) / points
    sigma = (beta - np.outer(1 - parts, np.diff(beta, prepend=0.0))).ravel() / beta[-1]
    target = frame.at(sigma)
    # The paper samples every segment alike, so that short segments count as much as long ones, unlike in (8).
    even = np.full(len(sigma), 1 / len(sigma))

    def configured(x: Array) -> Array:
        return np.concatenate([x[:, :d], np.broadcast_to(beta, (len(x), d)), x[:, d:]], axis=1)

    def cost(x: Array) -> Array:
        q = configured(x)
        shape = dominant.backbone(robot.tube_numbers, list(q.T[..., None]), sigma, np).points
        return shape_error(shape, target, even) + motion_term(robot, q, before, weight)

    angles = np.r_[0:d, 2 * d : 2 * d + 2]
    bounds = np.column_stack([robot.lower, robot.upper])[angles]
    x, objective, ok, evaluations, status = descend(cost, guess[angles], bounds)
    return configured(x[None])[0], objective, ok, evaluations, status
