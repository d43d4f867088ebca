"""Errors of a trained network on shapes that it has not seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.reference.learned.network import Network
from ctr_nlp.reference.learned.s2j import WITHIN, answer
from ctr_nlp.robot import Robot
from ctr_nlp.target.target import QUADRATURE, SIGMA
from ctr_nlp.typing import Array


class Recovered(NamedTuple):
    """Results on n shapes that were asked for: root mean square and tip distances (n,) mm of the robot that stands
    at the answers, the shapes' lengths (n,) mm, and which answers (n,) had kept the limits unprojected.
    """

    rms: Array
    tip: Array
    length: Array
    kept: Array


def recovered(network: Network, robot: Robot, model: Model, asked: Array) -> Recovered:
    """Measure how well a network gives back the shapes of unknowns `asked` (n, 2d + 2), which have no tilt.

    Robots come to rest at its answers without a history.
    """
    targets = model.points(robot, asked, SIGMA)
    straight = np.zeros(2 * robot.d + 2)
    answers = [answer(network, robot, model, target, straight) for target in targets]
    found = model.at_rest(robot, np.array([each.q for each in answers]), SIGMA)
    distance = np.linalg.norm(found.points - targets, axis=2)
    return Recovered(
        np.sqrt(distance**2 @ QUADRATURE),
        distance[:, -1],
        model.extensions(robot, asked)[:, -1],
        np.array([each.beyond <= WITHIN for each in answers]),
    )
