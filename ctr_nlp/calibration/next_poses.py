"""Which poses to measure next, so that they teach most."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ctr_nlp.calibration.fit import Fit, Noise, information_of, posterior
from ctr_nlp.calibration.measurements import Measurements
from ctr_nlp.calibration.parameters import BASE, Parameters
from ctr_nlp.calibration.prediction import Prediction, flat_measured
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model
from ctr_nlp.models.protocol import Passage
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import whole_number
from ctr_nlp.typing import Array

CANDIDATES = 300
"""Random poses among which is chosen."""
MARGIN = 0.3
"""Least stability margin of a pose that is proposed, on the robot as calibrated."""
MOST_TURN = math.pi
"""rad: within which tubes are turned to either side where their motors have no limits."""


def next_poses(
    fit: Fit, prediction: Prediction, model: Model, robot: Robot, count: int, seed: int = 0
) -> tuple[Array, Array]:
    """The poses q (count, 2d + 2) that teach most, one after the other, and what each of them leaves (count,).

    Chosen among random ones that the calibrated robot can reach and stands stable in: each is the one that,
    together with those chosen before, lowers the determinant of the covariance of all parameters but the bases'
    most (D-optimal). What is left is the geometric mean of standard deviations along that covariance's axes, over
    the one before all of them. As much is measured at each as in the observation that says most. Raises
    OptionError.
    """
    count = whole_number(OptionError, "number of next poses", count)
    parameters, measured = fit.parameters, prediction.measured
    q = stable_poses(robot, model, max(CANDIDATES, 2 * count), seed)
    seen = _as_seen(measured, q)
    there = Prediction(parameters, seen, model, prediction.bases)
    _, changes = there.with_changes(fit.values)
    told = information_of(changes, np.isfinite(flat_measured(seen)), Noise(*fit.noise[:2]))
    taught = [k for k, one in enumerate(parameters.each) if one.kind not in BASE]
    information, chosen, left = fit.information, list[int](), list[float]()
    begin = _doubt(parameters, information, taught)
    for _ in range(min(count, len(q))):
        doubts = [
            math.inf if k in chosen else _doubt(parameters, information + told[k], taught) for k in range(len(q))
        ]
        best = int(np.argmin(doubts))
        chosen.append(best)
        information = information + told[best]
        left.append(math.exp(doubts[best] - begin))
    return q[chosen], np.array(left)


def stable_poses(robot: Robot, model: Model, count: int, seed: int, margin: float = MARGIN) -> Array:
    """Random poses q (at most count, 2d + 2) within limits and order whose stability margin is at least margin."""
    random, d = np.random.default_rng([seed, 2]), robot.d
    low, high = robot.lower, robot.upper
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -MOST_TURN), np.where(bounded, high, MOST_TURN)
    q = random.uniform(low, high, (4 * count, len(low)))
    beta = np.sort(q[:, d : 2 * d], axis=1)
    q[:, d : 2 * d] = np.clip(beta, low[d : 2 * d], high[d : 2 * d])
    growth = np.diff(q[:, d : 2 * d], axis=1)
    kept = q[((growth >= 0) & (growth <= robot.most_growth)).all(axis=1) & (q[:, 2 * d - 1] > 0)]
    way = Passage(kept, np.arange(len(kept)), np.ones(len(kept), dtype=bool), len(kept))
    (found,) = model.follow_apart(robot.structure, robot.numbers[None], way, kept[None])
    steady = np.isfinite(found.x).all(axis=1) & ~(found.stability < margin)
    return kept[steady][:count]


def _as_seen(measured: Measurements, q: Array) -> Measurements:
    """Observations at q, each of as much as in the one that says most; their values are without meaning."""
    most = int(np.isfinite(flat_measured(measured)).sum(axis=1).argmax())
    like = measured[np.full(len(q), most)]
    return replace(like, q=q, time=np.full(len(q), np.nan))


def _doubt(parameters: Parameters, information: Array, columns: list[int]) -> float:
    """The logarithm of the geometric mean of standard deviations along the axes of some parameters' covariance."""
    sigma = parameters.sigma[columns]
    scaled = posterior(parameters, information)[np.ix_(columns, columns)] / np.outer(sigma, sigma)
    return float(np.linalg.slogdet(scaled)[1]) / (2 * max(len(columns), 1))
