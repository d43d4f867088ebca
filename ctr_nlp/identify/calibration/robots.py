"""The calibrated robot: tubes with the estimated values, and the posterior covariance as tolerances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ctr_nlp.exceptions import MeasurementError, RobotError
from ctr_nlp.identify.calibration.fit import ParameterFit
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.parameters import LAGS
from ctr_nlp.plan.backlash import overlaps
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import build_calibrated_robot
from ctr_nlp.typing import Array

LARGEST_LAG = math.pi / 2
"""Largest lag that tolerances may have, rad."""


def calibrated_robot(fit: ParameterFit, measured: Measurements) -> Robot:
    """Build the robot with the tubes that fit best, and the posterior covariance as its tolerances.

    A motor's zero is no number of a tube: its value stays in the fit, and only its covariance is among the
    tolerances. Stiffness becomes the tubes' youngs_modulus.

    Parameters
    ----------
    fit : ParameterFit
        The estimates.
    measured : Measurements
        The observations, over whose configurations the largest backlash is computed.

    Returns
    -------
    Robot
        The calibrated robot.

    Raises
    ------
    MeasurementError
        No tubes can be made with these values.
    """
    parameters = fit.parameters
    robot = parameters.robot
    parts = parameters.parts(fit.values)
    try:
        return build_calibrated_robot(robot, parts, _covariance(fit), _lag(fit, measured))
    except RobotError as error:
        raise MeasurementError(
            f"the tubes that fit the measurements best are not possible: {error}. Check columns and units of the "
            "measurements, and the robot's file"
        ) from error


def _covariance(fit: ParameterFit) -> Array:
    """Return the posterior covariance (5d, 5d) of all tubes' differences; the prior's where not estimated."""
    parameters = fit.parameters
    root = parameters.robot.tolerances.covariance_root(parameters.robot.tubes)
    over = parameters.parts_jacobian
    covariance = np.array(root @ root.T)
    # Parts that no parameter changes keep their covariance; their correlations with the others are dropped.
    estimated = over.any(axis=1)
    kept = np.outer(~estimated, ~estimated)
    return np.asarray(np.where(kept, covariance, over @ fit.covariance @ over.T))


def _lag(fit: ParameterFit, measured: Measurements) -> Any:
    """Return the largest backlash of every tube, rad, by a fit; the robot's own where none was estimated."""
    parameters = fit.parameters
    if not parameters.columns(*LAGS):
        return parameters.robot.tolerances.rotation_lag
    found = parameters.lag(fit.values)
    # A tolerance is one angle a tube: play is the largest at the overlaps that were measured. Drag depends on
    # speed and has no place there.
    most = overlaps(parameters.robot, measured.q).max(axis=0)
    return np.minimum(found.play + found.play_per_mm * most, LARGEST_LAG)
