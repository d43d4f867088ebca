"""S2J-IK: configurations from the points of a shape, by a network that has been trained on shapes of a model.

Liang et al., 2022, the paper's [7], as far as the paper tells of it: the kinematics of a robot are learned by a
network, the whole shape is the input of the inverse kinematics, the residual of the shape is propagated back
through a differentiable forward model, every frame is solved by itself, and nothing keeps limits. The publication
itself was not at hand. So these are guesses: that the residual is propagated back in training, through our own
model in place of one learned from measurements; the network's sizes (network.py, training.py); and that angles
leave it as cosine and sine, as in Grassmann, Modes, Burgner-Kahrs, Learning the Forward and Inverse Kinematics of
a 6-DOF Concentric Tube Continuum Robot in SE(3), IROS 2018. The tilt is no part of [7]; here it turns the robot to
the direction in which the target begins. Angles are chosen nearest to those of the frame before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models import KINEMATIC_MODELS, Model
from ctr_nlp.models.dominant.shape import base_frame
from ctr_nlp.ocp.frame_solver import FrameResult
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID, Frame
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array
from reference.descent import Method, clip_configuration, clip_extensions
from reference.learned.network import InverseKinematicsNetwork, load_trained_network
from reference.learned.samples import NETWORK_INPUT_SIGMA, ShapeBatch, unwrap_tip_angles

NETWORK_INPUT_INDICES = np.searchsorted(SIGMA_GRID, NETWORK_INPUT_SIGMA)
"""Indices of the points at SIGMA_GRID that are those at NETWORK_INPUT_SIGMA."""
NETWORK_LIMIT_TOLERANCE = 1e-6
"""rad or mm by which a configuration may leave limits and still count."""


def s2j(problem: Problem, motion_weight: float, model: str = "dominant", projected: bool = False) -> Method:
    """Return the method for a problem; `motion_weight` is ignored.

    projected: whether what leaves the limits is brought to the nearest that keeps them. It always is before the
    robot moves; where this is not asked for, frames for which it makes a difference do not count as solved. Raises
    OptionError, which says how to train a network, where none is known for the problem's robot.
    """
    del motion_weight
    robot = problem.robot
    on = KINEMATIC_MODELS[model]
    network = load_trained_network(robot, model)

    def solve(frame: Frame, guess: Array, before: FrameResult | None) -> FrameResult:
        near = guess if before is None else before.q
        x, q, beyond = predict_configuration(network, robot, on, frame.points, near)
        shape = on.points(robot, x[None], SIGMA_GRID)[0]
        objective = float(((shape - frame.points) ** 2).sum(axis=1) @ QUADRATURE)
        success = projected or beyond <= NETWORK_LIMIT_TOLERANCE
        told = f"limits left by {beyond:.3g} rad or mm"
        return FrameResult(q, success, objective, np.nan, 1, told, x=x if on.several_equilibria else None)

    return solve


class PredictedConfiguration(NamedTuple):
    """Unknowns x and configuration q, (2d + 2,) each, that keep all limits of position.

    limit_violation: by how much what the network gave would have left them, rad or mm.
    """

    x: Array
    q: Array
    limit_violation: float


def predict_configuration(
    network: InverseKinematicsNetwork, robot: Robot, model: Model, points: Array, reference_q: Array
) -> PredictedConfiguration:
    """Return the configuration that a network gives for a shape, points (101, 3) at SIGMA_GRID in mm, brought
    within limits.

    reference_q: q (2d + 2,); of angles that are the same, those nearest to its are taken. On a model with several
    equilibria only a full turn of all tubes together leaves the robot as it is, on others one of each tube does.
    """
    d = robot.d
    theta = np.clip(target_tilt(points), *(robot.split(limit)[2] for limit in (robot.lower, robot.upper)))
    upright = points[NETWORK_INPUT_INDICES] @ np.array(base_frame(theta[0], theta[1], np)).T
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    found = network.tips(ShapeBatch(upright[None], np.array([length])))[0]
    beta = clip_extensions(robot, found[d:])
    tips = unwrap_tip_angles(np.concatenate([found[:d], beta, theta])[None], d)[0]
    turns = np.round(
        (reference_q - model.configuration(robot, model.guess(robot, tips)[None])[0])[:d] / (2 * np.pi)
    )
    tips[:d] += 2 * np.pi * (turns[d - 1] if model.several_equilibria else turns)
    x = model.guess(robot, tips)
    q = model.configuration(robot, x[None])[0]
    kept = clip_configuration(robot, q)
    if (kept != q).any():
        x = model.rest(robot, kept)
    return PredictedConfiguration(x, kept, float(max(np.abs(found[d:] - beta).max(), np.abs(q - kept).max())))


def target_tilt(points: Array) -> Array:
    """Return the theta (2,) rad at which a robot leaves the insertion point in the direction of points (101, 3) at
    SIGMA_GRID.

    Ry(theta_y) Rx(theta_x) turns +z there, eq. (4). The direction is that of the parabola through the first three.
    """
    x, y, z = -3 * points[0] + 4 * points[1] - points[2]
    return np.array([-np.arctan2(y, np.hypot(x, z)), np.arctan2(x, z)])
