"""Errors of a trained network on shapes that were not trained on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from reference.learned.network import InverseKinematicsNetwork
from reference.learned.s2j import NETWORK_LIMIT_TOLERANCE, predict_configuration

from ctr_nlp.models import Model
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array


class NetworkErrors(NamedTuple):
    """Errors of a network on n shapes.

    rms, tip: (n,), root mean square and tip distance of the robot at the predicted configurations, mm. length:
    (n,) of the shapes, mm. unprojected_within_limits: (n,), whether the predictions needed no clipping to the
    limits.
    """

    rms: Array
    tip: Array
    length: Array
    unprojected_within_limits: Array


def evaluate_network(
    network: InverseKinematicsNetwork, robot: Robot, model: Model, unknowns: Array
) -> NetworkErrors:
    """Measure how well a network reproduces known shapes of a robot on a model.

    unknowns: (n, 2d + 2), at which the shapes are; they must have no tilt.
    """
    targets = model.points(robot, unknowns, SIGMA_GRID)
    straight = np.zeros(2 * robot.d + 2)
    answers = [predict_configuration(network, robot, model, target, straight) for target in targets]
    # Judged by where the robot comes to rest at q, without a history: that may be another equilibrium than x.
    found = model.rest_states(robot, np.array([each.q for each in answers]), SIGMA_GRID)
    distance = np.linalg.norm(found.points - targets, axis=2)
    return NetworkErrors(
        np.sqrt(distance**2 @ QUADRATURE),
        distance[:, -1],
        model.extensions(robot, unknowns)[:, -1],
        np.array([each.limit_violation <= NETWORK_LIMIT_TOLERANCE for each in answers]),
    )
