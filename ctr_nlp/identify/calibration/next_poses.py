"""Next poses of a calibration: sequential D-optimal design of experiments.

The information of observations adds up. With J_k the derivatives of observation k and s the noise, the next pose
is the k that minimises det (C^-1 + J_k^T J_k / s^2)^-1 over the parameters of the robot, C the covariance so far
(Fedorov, Theory of Optimal Experiments, 1972).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.calibration.fit import Noise, ParameterFit, information_of, posterior
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.parameters import BASE, Parameters
from ctr_nlp.identify.calibration.prediction import Prediction, flat_measured
from ctr_nlp.models import Model
from ctr_nlp.models.protocol import MotionSubsteps
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.typing import Array

CANDIDATE_POSE_COUNT = 300
"""Number of random poses to choose from."""
MIN_POSE_STABILITY_MARGIN = 0.3
"""Least stability margin of a pose that is proposed, on the robot as calibrated."""
MOST_TURN = math.pi
"""Largest angle of candidate poses to either side where motors have no limits, rad."""


def next_poses(
    fit: ParameterFit, prediction: Prediction, model: Model, robot: Robot, count: int, seed: int = 0
) -> tuple[Array, Array]:
    """Choose poses whose measurement would lower the uncertainty most, one after the other.

    Candidates are random poses in which the calibrated robot is stable. Each choice minimises the determinant of
    the covariance of all parameters but those of the base, given all that was measured and chosen before. Each
    pose is assumed to be measured like the observation with most measured values.

    Parameters
    ----------
    fit : ParameterFit
        The fit so far.
    prediction : Prediction
        The measurements of that fit.
    model : Model
        The kinematic model.
    robot : Robot
        The calibrated robot.
    count : int
        Number of poses, at least 1.
    seed : int
        Seed of the candidates.

    Returns
    -------
    q : (k, 2d + 2) array
        The poses, rad, mm and rad; fewer than `count` where so few candidates are stable.
    left : (k,) array
        Geometric mean of the standard deviations along the principal axes of the covariance after each pose, as a
        part of that before the first.

    Raises
    ------
    OptionError
        `count` is no whole number of at least 1.
    """
    count = whole_number(OptionError, "number of next poses", count)
    parameters = fit.parameters
    measured = prediction.measured
    q = stable_poses(robot, model, max(CANDIDATE_POSE_COUNT, 2 * count), seed)
    seen = _observations_at(measured, q)
    there = Prediction(parameters, seen, model, prediction.bases)
    _, changes = there.predict_with_derivatives(fit.values)
    told = information_of(changes, np.isfinite(flat_measured(seen)), Noise(*fit.noise[:2]))
    # The base's pose belongs to this setup, and is no parameter of the robot.
    taught = [k for k, one in enumerate(parameters.each) if one.kind not in BASE]
    information = fit.information
    chosen = list[int]()
    left = list[float]()
    begin = _log_mean_sigma(parameters, information, taught)
    # Information adds up over observations, so that each candidate is only linearised once. Greedy: the best one,
    # given those chosen, not the best set.
    for _ in range(min(count, len(q))):
        doubts = [
            math.inf if k in chosen else _log_mean_sigma(parameters, information + told[k], taught)
            for k in range(len(q))
        ]
        best = int(np.argmin(doubts))
        chosen.append(best)
        information = information + told[best]
        left.append(math.exp(doubts[best] - begin))
    return q[chosen], np.array(left)


def stable_poses(
    robot: Robot, model: Model, count: int, seed: int, margin: float = MIN_POSE_STABILITY_MARGIN
) -> Array:
    """Sample random poses in which a robot is stable.

    Parameters
    ----------
    robot : Robot
        The robot, whose limits and order of extensions the poses keep. Angles without limits are drawn from
        [-pi, pi].
    model : Model
        The kinematic model.
    count : int
        Largest number of poses.
    seed : int
        Seed of the random numbers.
    margin : float
        Least stability margin; poses that cannot be unstable count as stable.

    Returns
    -------
    (n, 2d + 2) array
        At most `count` poses; rad, mm and rad.
    """
    # A stream of its own, independent of folds with the same seed.
    random = np.random.default_rng([seed, 2])
    d = robot.d
    low = robot.lower
    high = robot.upper
    bounded = np.isfinite(low) & np.isfinite(high)
    low = np.where(bounded, low, -MOST_TURN)
    high = np.where(bounded, high, MOST_TURN)
    q = random.uniform(low, high, (4 * count, len(low)))
    # beta_1 <= .. <= beta_d, eq. (2): sorting keeps every sample, rejection would keep one of d!.
    beta = np.sort(q[:, d : 2 * d], axis=1)
    q[:, d : 2 * d] = np.clip(beta, low[d : 2 * d], high[d : 2 * d])
    growth = np.diff(q[:, d : 2 * d], axis=1)
    kept = q[((growth >= 0) & (growth <= robot.max_extension_differences)).all(axis=1) & (q[:, 2 * d - 1] > 0)]
    # Every pose is fresh: reached by itself from aligned tubes, and not from the one before.
    way = MotionSubsteps(kept, np.arange(len(kept)), np.ones(len(kept), dtype=bool), len(kept))
    (found,) = model.follow_batch(robot.structure, robot.numbers[None], way, kept[None])
    steady = np.isfinite(found.x).all(axis=1) & ~(found.stability < margin)
    return kept[steady][:count]


def _observations_at(measured: Measurements, q: Array) -> Measurements:
    """Return observations at q (n, 2d + 2) with the same entries measured as in the one that has most of them.

    Only which entries are finite matters; their values are not used.
    """
    most = int(np.isfinite(flat_measured(measured)).sum(axis=1).argmax())
    like = measured[np.full(len(q), most)]
    return replace(like, q=q, time=np.full(len(q), np.nan))


def _log_mean_sigma(parameters: Parameters, information: Array, columns: list[int]) -> float:
    """Return the logarithm of the geometric mean of standard deviations along the axes of a covariance.

    information: (P, P) of the data. columns: indices of the parameters whose covariance it is.
    """
    # The determinant of a covariance is the product of variances along its axes: their n-th root's root is the
    # geometric mean of standard deviations. Over sigma, so that mm and rad may stand beside each other.
    sigma = parameters.sigma[columns]
    scaled = posterior(parameters, information)[np.ix_(columns, columns)] / np.outer(sigma, sigma)
    return float(np.linalg.slogdet(scaled)[1]) / (2 * max(len(columns), 1))
