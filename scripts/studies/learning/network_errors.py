"""Errors of a trained network on shapes that it has not seen."""

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
    """Results on n shapes that were asked for: root mean square and tip distances (n,) mm of the robot that stands
    at the answers, the shapes' lengths (n,) mm, and which answers (n,) had kept the limits unprojected.
    """

    rms: Array
    tip: Array
    length: Array
    unprojected_within_limits: Array


def evaluate_network(
    network: InverseKinematicsNetwork, robot: Robot, model: Model, unknowns: Array
) -> NetworkErrors:
    """Measure how well a network gives back the shapes of unknowns `unknowns` (n, 2d + 2), which have no tilt.

    Robots come to rest at its answers without a history.
    """
    targets = model.points(robot, unknowns, SIGMA_GRID)
    straight = np.zeros(2 * robot.d + 2)
    answers = [predict_configuration(network, robot, model, target, straight) for target in targets]
    found = model.rest_states(robot, np.array([each.q for each in answers]), SIGMA_GRID)
    distance = np.linalg.norm(found.points - targets, axis=2)
    return NetworkErrors(
        np.sqrt(distance**2 @ QUADRATURE),
        distance[:, -1],
        model.extensions(robot, unknowns)[:, -1],
        np.array([each.limit_violation <= NETWORK_LIMIT_TOLERANCE for each in answers]),
    )
