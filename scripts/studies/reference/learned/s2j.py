"""S2J-IK: configurations from the points of a shape, by a network that has been trained on shapes of a model.

Source: Liang et al., 2022, the paper's [7], as the paper describes it (sections I, I.A and V): a network learns
the robot's kinematics, the whole shape is the input of the inverse kinematics, the residual of the shape is
propagated back through a differentiable forward model, every frame is solved by itself, and limits are not
enforced. The publication itself was not at hand. What may differ, since it is a guess: the residual is propagated
back in training, once for all shapes, where the paper says that S2J-IK "finds the control signals of CTR by
backpropagating the shape residuals" for one curve; the forward model is our own (loss.py) in place of one learned
from measurements; the network's sizes (network.py, training.py); and angles are output as cosine and sine, as in
Grassmann, Modes, Burgner-Kahrs, Learning the Forward and Inverse Kinematics of a 6-DOF Concentric Tube Continuum
Robot in SE(3), IROS 2018. What differs for certain: the tilt theta is no part of [7]; here it turns the robot to
the direction in which the target begins. Of equivalent angles the nearest to those of the frame before are taken.
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
"""Indices in SIGMA_GRID of NETWORK_INPUT_SIGMA."""
NETWORK_LIMIT_TOLERANCE = 1e-6
"""Largest violation of the limits at which a frame counts as solved, rad or mm."""


def s2j(problem: Problem, motion_weight: float, model: str = "dominant", projected: bool = False) -> Method:
    """Return the method for a problem; `motion_weight` is ignored.

    model: name of the kinematic model that the network was trained on. projected: whether frames count as solved
    whose configuration had to be clipped to the limits; it is clipped before the robot moves in any case. Raises
    OptionError, which says how to train a network, where there is none for the problem's robot.
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
    """Unknowns x and configuration q, (2d + 2,) each, within all limits of position.

    limit_violation: largest violation of the limits by the network's output before it was clipped, rad or mm.
    """

    x: Array
    q: Array
    limit_violation: float


def predict_configuration(
    network: InverseKinematicsNetwork, robot: Robot, model: Model, points: Array, reference_q: Array
) -> PredictedConfiguration:
    """Predict the configuration for a shape by a network, and clip it to the robot's limits.

    network: trained for robot and model. points: (101, 3) of the shape at SIGMA_GRID, mm. reference_q: q (2d +
    2,); of equivalent angles the nearest to its own are taken.
    """
    d = robot.d
    theta = np.clip(target_tilt(points), *(robot.split(limit)[2] for limit in (robot.lower, robot.upper)))
    # Points as rows times R are R^T p: the shape of a robot without tilt, which is what the network knows.
    upright = points[NETWORK_INPUT_INDICES] @ np.array(base_frame(theta[0], theta[1], np)).T
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    found = network.tips(ShapeBatch(upright[None], np.array([length])))[0]
    beta = clip_extensions(robot, found[d:])
    tips = unwrap_tip_angles(np.concatenate([found[:d], beta, theta])[None], d)[0]
    turns = np.round(
        (reference_q - model.configuration(robot, model.guess(robot, tips)[None])[0])[:d] / (2 * np.pi)
    )
    # Where twist matters, one tube's full turn is another equilibrium, and only a turn of all tubes together
    # leaves the robot as it is; on a torsionally rigid model each tube may turn for itself.
    tips[:d] += 2 * np.pi * (turns[d - 1] if model.several_equilibria else turns)
    x = model.guess(robot, tips)
    q = model.configuration(robot, x[None])[0]
    kept = clip_configuration(robot, q)
    if (kept != q).any():
        # Clipping changes q, which does not determine x on the elastic model: come to rest without a history.
        x = model.rest(robot, kept)
    return PredictedConfiguration(x, kept, float(max(np.abs(found[d:] - beta).max(), np.abs(q - kept).max())))


def target_tilt(points: Array) -> Array:
    """Compute the tilt theta (2,), rad, at which the robot's base points in the initial direction of a shape.

    points: (101, 3) of the shape at SIGMA_GRID, mm. Ry(theta_y) Rx(theta_x) turns +z to that direction, eq. (4).
    """
    # The slope at 0 of the parabola through three evenly spaced points, but for its length: a chord would be off
    # by half the angle that the shape bends along it.
    x, y, z = -3 * points[0] + 4 * points[1] - points[2]
    return np.array([-np.arctan2(y, np.hypot(x, z)), np.arctan2(x, z)])
