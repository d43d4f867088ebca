"""The robot that a fit describes: tubes of the values found, and what is left to doubt as tolerances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ctr_nlp.calibration.fit import Fit
from ctr_nlp.calibration.measurements import Measurements
from ctr_nlp.calibration.parameters import LAGS
from ctr_nlp.exceptions import MeasurementError, RobotError
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import known_robot
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
        return known_robot(robot, parts, _covariance(fit), _lag(fit, measured))
    except RobotError as error:
        raise MeasurementError(
            f"the tubes that fit the measurements best are none that can be made: {error}. Are columns, units and "
            "the robot's file right?"
        ) from error


def _covariance(fit: Fit) -> Array:
    """Of what is left to doubt of all parts, (5 d, 5 d); what was not estimated is as it was."""
    parameters = fit.parameters
    root = parameters.robot.tolerances.root(parameters.robot.tubes)
    over, covariance = parameters.parts_over, np.array(root @ root.T)
    estimated = over.any(axis=1)
    kept = np.outer(~estimated, ~estimated)
    return np.asarray(np.where(kept, covariance, over @ fit.covariance @ over.T))


def _lag(fit: Fit, measured: Measurements) -> Any:
    """The largest lag of every tube that was found, rad; as it was where none was estimated."""
    parameters = fit.parameters
    if not parameters.columns(*LAGS):
        return parameters.robot.tolerances.rotation_lag
    found = parameters.lag(fit.values)
    most = overlaps(parameters.robot, measured.q).max(axis=0)
    return np.minimum(found.play + found.play_per_mm * most, LARGEST_LAG)
