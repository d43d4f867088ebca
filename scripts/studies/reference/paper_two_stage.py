"""The paper's method: L-BFGS-B on curvature for extensions, eq. (11), then on points for rotations, eq. (12)."""

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
"""On a segment in (12): its middle and its end, what the paper found sufficient."""


def paper_two_stage(problem: Problem, motion_weight: float, points: int = DEFAULT_POINTS_PER_SEGMENT) -> Method:
    """The method for a problem; motion_weight: lambda / dt^2 of both stages.

    points: samples of the shape on a segment in stage two, the last at its end; Fig. 3 asks how many it takes.
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
    """Beta from curvature; the tip belongs to the target's end, so beta_d is the target's length."""
    d = robot.d
    low = robot.lower[2 * robot.d - 1]
    high = robot.reach
    last = float(np.clip(frame.length, low, high))
    middles = (np.arange(CURVATURE_MIDPOINTS_PER_SEGMENT) + 0.5) / CURVATURE_MIDPOINTS_PER_SEGMENT

    def cost(x: Array) -> Array:
        beta = extensions(robot, x, np.full(len(x), last))
        edges = np.concatenate([np.zeros((len(x), 1)), beta], axis=1)
        widths = np.diff(edges, axis=1)
        s = (edges[:, :-1, None] + widths[..., None] * middles).reshape(len(x), -1)
        k = dominant.curvature(
            robot.tube_numbers, [b[:, None] for b in beta.T], s, lambda v: np.heaviside(v, 0.0), np
        )
        kappa = np.interp(s / last, SIGMA_GRID, frame.curvature)
        squares = ((k - kappa) ** 2).reshape(len(x), d, CURVATURE_MIDPOINTS_PER_SEGMENT).mean(axis=2)
        change = 0.0 if before is None else weight * ((beta - robot.split(before.q)[1]) ** 2).sum(axis=1)
        return curvature_to_shape_scale(robot.reach) ** 2 * (squares * widths).sum(axis=1) / last + change

    start = fractions(robot, np.append(robot.split(guess)[1][:-1], last))[: d - 1]
    if d == 1:
        return np.array([last]), True, 0, "given"
    x, _, ok, evaluations, status = descend(cost, start, np.tile([0.0, 1.0], (d - 1, 1)))
    return extensions(robot, x, np.array(last)), ok, evaluations, status


def _rotate(
    robot: Robot, frame: Frame, beta: Array, points: int, guess: Array, before: FrameResult | None, weight: float
) -> tuple[Array, float, bool, int, str]:
    """Alpha and theta from evenly spaced points of the segments, all weighted alike."""
    d = robot.d
    parts = np.arange(1, points + 1) / points
    sigma = (beta - np.outer(1 - parts, np.diff(beta, prepend=0.0))).ravel() / beta[-1]
    target = frame.at(sigma)
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
