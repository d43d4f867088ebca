"""The robot that a fit describes: tubes of the values found, and what is left to doubt as tolerances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ctr_nlp.calibration.fit import Fit
from ctr_nlp.calibration.measurements import Measurements
from ctr_nlp.calibration.parameters import LAGS
from ctr_nlp.exceptions import MeasurementError, RobotError
from ctr_nlp.robot import Limits, Robot, Tolerances, Tube
from ctr_nlp.robot.tolerances import NAMES
from ctr_nlp.simulation.lag import overlaps
from ctr_nlp.typing import Array

LARGEST_LAG = math.pi / 2
"""rad: what tolerances may say of a lag."""


def calibrated_robot(fit: Fit, measured: Measurements) -> Robot:
    """The robot with the tubes that fit best, and the covariance of what is left to doubt as its tolerances.

    Motors' zeros are no numbers of tubes: what they are off by is in the fit alone, and their covariance in the
    tolerances. Stiffness is told by youngs_modulus. Raises MeasurementError where no such tubes can be made.
    """
    parameters = fit.parameters
    robot, parts = parameters.robot, parameters.parts(fit.values)
    try:
        tubes = tuple(_tube(tube, own) for tube, own in zip(robot.tubes, parts, strict=True))
        return replace(robot, tubes=tubes, limits=_limits(robot), tolerances=_tolerances(fit, measured, parts))
    except RobotError as error:
        raise MeasurementError(
            f"the tubes that fit the measurements best are none that can be made: {error}. Are columns, units and "
            "the robot's file right?"
        ) from error


def _tube(tube: Tube, parts: Array) -> Tube:
    curvature, stiffness, ratio, length, _ = parts.tolist()
    return replace(
        tube,
        curvature=(tube.root_curvature * (1 + curvature), tube.tip_curvature * (1 + curvature)),
        youngs_modulus=tube.youngs_modulus * (1 + stiffness),
        poisson_ratio=(1 + tube.poisson_ratio) * (1 + ratio) - 1,
        curved_length=tube.curved_length + length,
    )


def _limits(robot: Robot) -> Limits:
    """Those of the robot, of which positions do not change with the lengths found."""
    beta = zip(*(robot.split(ends)[1].tolist() for ends in (robot.lower, robot.upper)), strict=True)
    return replace(robot.limits, beta=tuple(beta))


def _tolerances(fit: Fit, measured: Measurements, parts: Array) -> Tolerances:
    """What is left to doubt of parts of the tubes found; what was not estimated is as it was."""
    parameters = fit.parameters
    robot = parameters.robot
    root = robot.tolerances.root(robot.tubes)
    columns, covariance = parameters.columns(*NAMES), np.array(root @ root.T)
    places = [len(NAMES) * parameters.tube(k) + NAMES.index(parameters.each[k].kind) for k in columns]
    covariance[places], covariance[:, places] = 0.0, 0.0
    covariance[np.ix_(places, places)] = fit.covariance[np.ix_(columns, columns)]
    scale = np.ones(parts.shape)
    scale[:, :3] = 1 / (1 + parts[:, :3])
    covariance *= np.outer(scale.ravel(), scale.ravel())
    covariance = (covariance + covariance.T) / 2
    lag = robot.tolerances.rotation_lag
    if parameters.columns(*LAGS):
        found = parameters.lag(fit.values)
        most = overlaps(robot, measured.q).max(axis=0)
        lag = np.minimum(found.play + found.play_per_mm * most, LARGEST_LAG)
    return Tolerances(rotation_lag=lag, distribution="normal", covariance=covariance)
