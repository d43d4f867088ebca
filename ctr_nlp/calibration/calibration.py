"""A calibration: from measurements to a robot, what is left to doubt, and errors on what was held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ctr_nlp.calibration.determined import standing, untold
from ctr_nlp.calibration.fit import Fit, at, fitted
from ctr_nlp.calibration.folds import BLOCK, folds, retraced
from ctr_nlp.calibration.measurements import Measurements
from ctr_nlp.calibration.next_poses import next_poses
from ctr_nlp.calibration.parameters import BASE, Parameters, parameters_of
from ctr_nlp.calibration.prediction import Prediction, flat_measured, registered_to
from ctr_nlp.calibration.robots import calibrated_robot
from ctr_nlp.exceptions import MeasurementError
from ctr_nlp.models import Model, bearing, model_named
from ctr_nlp.robot import Robot
from ctr_nlp.support.equal import Kept
from ctr_nlp.support.values import instance
from ctr_nlp.typing import Array, Index

Progress = Callable[[int, int, str], None]
"""Called with how many fits are done, of how many, and what was done last."""


@dataclass(frozen=True, eq=False)
class Calibration(Kept):
    """What measurements say of a robot. Residuals are (T, 6 + 3 n): of tip, direction and points, as measured less
    predicted; NaN where nothing was measured.

    robot: with the tubes found, and their covariance as tolerances. fit: values, covariance, noise. standing: of
    every parameter, determined, partly or held. untold: what the data cannot tell, in sentences. before: residuals
    of the robot as it was described, with bases registered. held_out: of fits that did not see the observation,
    NaN where that was not asked for. fold (T,): -1 where it was not. retraced (n, 2): observations, and those that
    had the same pose before. floor: half of what their places differ by on average, mm, which no model without a
    memory of the motion can explain; None where there are none. bases: of every recording, the rotation (3, 3) and
    the place (3,) mm of the robot's base for the sensor. next_q (k, 2d + 2): poses that would teach most;
    next_left (k,): what part of the doubt is left then.
    """

    robot: Robot
    described: Robot
    measured: Measurements
    model: str
    fit: Fit
    standing: tuple[str, ...]
    untold: tuple[str, ...]
    before: Array
    held_out: Array
    fold: Index
    retraced: Index
    floor: float | None
    bases: tuple[tuple[Array, Array], ...]
    next_q: Array = field(default_factory=lambda: np.zeros((0, 0)))
    next_left: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def parameters(self) -> Parameters:
        """What was estimated."""
        return self.fit.parameters


def calibrate(
    robot: Robot,
    measured: Measurements,
    estimate: Sequence[str] | None = None,
    *,
    model: str | Model = "elastic",
    registered: bool = False,
    held_out: int = 5,
    block: float = BLOCK,
    next_count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """What measurements say of a robot, as robust least squares around its tolerances tell it.

    estimate: kinds of parameters (calibration.parameters.KINDS); by default what has a tolerance, and where time
    is known lags and the sensor's delay. Where known forces pull at the tip (measured.force), or the model bears a
    load, which then acts in every observation, stiffnesses show themselves and not their ratios alone: by default
    the tubes' modulus is estimated, too, of which the robot must tell a first value. registered: whether the
    sensor's axes are those of the robot's base; otherwise the base's pose is estimated, in every recording.
    held_out: number of folds for errors held out, 0 for none; block: seconds of a motion that stay together in
    one. next_count: how many next poses are proposed. seed: of folds and of proposals. Raises LoadError,
    MeasurementError, OptionError.
    """
    instance(MeasurementError, "robot", robot, Robot)
    instance(MeasurementError, "measurements", measured, Measurements)
    measured = measured.distinct()
    described = bearing(model_named(model), measured.pushed)
    described.check(robot)
    measured.check(robot)
    parameters = parameters_of(robot, measured, estimate, registered, described.bears is not None)
    fold = folds(robot, measured, held_out, block, seed=seed) if held_out else np.full(len(measured), -1)
    prediction = placed(parameters, measured, described)
    before = flat_measured(measured) - prediction.seen(parameters.mean).flat()
    told, total = progress or (lambda *_: None), 1 + held_out
    told(0, total, "all observations")
    fit = fitted(prediction)
    out = np.full(before.shape, np.nan)
    for k in range(held_out):
        told(1 + k, total, f"without fold {k + 1}")
        found = at(fitted(prediction, fold != k), prediction)
        out[fold == k] = found.residuals[fold == k]
    told(total, total, "done")
    made, again = calibrated_robot(fit, measured), retraced(robot, measured, block)
    proposed = next_poses(fit, prediction, described, made, next_count, seed) if next_count else ()
    return Calibration(
        *(made, robot, measured, described.name, fit, tuple(standing(fit)), tuple(untold(fit))),
        *(before, out, fold, again, _floor(before, again), prediction.bases_at(fit.values), *proposed),
    )


def placed(parameters: Parameters, measured: Measurements, model: Model) -> Prediction:
    """Predictions with bases where the robot as described fits the measurements of each recording best."""
    prediction = Prediction(parameters, measured, model)
    if not parameters.columns(*BASE):
        return prediction
    seen, bases = prediction.seen(parameters.mean), []
    for recording in range(measured.recordings):
        own = measured.recording == recording
        pairs = ((seen.tip, measured.tip), (seen.points, measured.points))
        predicted, there = (np.concatenate([pair[k][own].reshape(-1, 3) for pair in pairs]) for k in range(2))
        bases.append(registered_to(predicted, there))
    return Prediction(parameters, measured, model, bases)


def _floor(before: Array, again: Index) -> float | None:
    """Half the mean distance between places that were measured at the same pose, mm."""
    known = errors(before[again[:, 0]] - before[again[:, 1]])
    return float(np.nanmean(known)) / 2 if np.isfinite(known).any() else None


def distances(residuals: Array) -> Array:
    """How far measured places are from predicted ones, (T, 1 + n) mm: the tip and the points; NaN where unseen.

    Of a place whose coordinates are known in part, by these.
    """
    places = np.delete(residuals, slice(3, 6), axis=1)
    places = places.reshape(len(places), places.shape[1] // 3, 3)
    seen = np.isfinite(places).any(axis=2)
    return np.asarray(np.where(seen, np.sqrt(np.nansum(places**2, axis=2)), np.nan))


def errors(residuals: Array) -> Array:
    """The root mean square of an observation's distances, (T,) mm; NaN where no place was seen."""
    found = distances(residuals)
    known = np.isfinite(found)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.nansum(found**2, axis=1) / known.sum(axis=1)))


def summary_of(found: Array) -> dict[str, float] | None:
    """Mean, 95 % quantile and largest of errors (T,), mm; None where there are none."""
    known = found[np.isfinite(found)]
    if not len(known):
        return None
    return {"mean": float(known.mean()), "q95": float(np.quantile(known, 0.95)), "max": float(known.max())}
