"""Calibration: from measurements to a robot, its remaining uncertainty, and errors on held-out observations.

Symbols are those of "Calibration" in docs/method.md: y_k are the measured values of observation k,
h_k(p) the values predicted for a robot of parameters p, and p_0 and C_0 mean and covariance of p before measuring
(the prior). Residuals y_k - h_k(p) are rows of 6 + 3n: the tip (3, mm), the direction at the tip (3, components of
unit vectors), and n points of the shape (3 each, mm).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ctr_nlp.exceptions import MeasurementError, OptionError
from ctr_nlp.identify.calibration.consistency import (
    CALIBRATION_FINDINGS,
    FittedMeasurements,
    check_agreement,
    describe_distant_parameters,
    describe_outliers,
    largest_agreeing_noise,
)
from ctr_nlp.identify.calibration.fit import ParameterFit, fit_parameters, recompute_residuals
from ctr_nlp.identify.calibration.folds import FOLD_BLOCK_S, assign_folds, find_repeated_poses
from ctr_nlp.identify.calibration.identifiability import classify_parameters, describe_unidentified
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.next_poses import next_poses
from ctr_nlp.identify.calibration.outliers import fit_weights, fit_without_outliers, leave_out
from ctr_nlp.identify.calibration.parameters import Parameters, parameters_of
from ctr_nlp.identify.calibration.prediction import build_registered_prediction, flat_measured
from ctr_nlp.identify.calibration.residuals import errors
from ctr_nlp.identify.calibration.robots import calibrated_robot
from ctr_nlp.models import Model, model_for_tip_forces, model_named
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import check_choice, check_instance
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags, Index

Progress = Callable[[int, int, str], None]
"""Callback ``progress(done, total, what)``: fits done, their total number, and which comes next."""


@dataclass(frozen=True, eq=False)
class Calibration(ReadOnlyValue):
    """Result of :func:`calibrate`: a robot, how well the data identify it, and its errors.

    Residuals are (T, 6 + 3n) arrays, measured less predicted, NaN where nothing was measured.

    Attributes
    ----------
    robot : Robot
        With the tubes that fit best, and the posterior covariance as its tolerances.
    nominal : Robot
        The nominal robot that was given.
    measured : Measurements
        The T observations that were used, without copies.
    model : str
        Name of the kinematic model.
    fit : ParameterFit
        Estimated values, their covariance, the noise and the residuals.
    standing : tuple of str
        For every parameter ``"determined"``, ``"partly"``, or ``"held"``: fixed at its prior mean, as the data
        have next to no information on it.
    unidentified : tuple of str
        Sentences that name the parameters, and combinations of them, that the data cannot identify.
    nominal_residuals : (T, 6 + 3n) array
        Residuals of the nominal robot, with the bases registered to the measurements.
    held_out : (T, 6 + 3n) array
        Residuals of fits that did not see the observation; NaN without folds.
    fold : (T,) array of int
        The fold, from 0, that an observation belongs to; -1 without folds.
    repeated_poses : (n, 2) array of int
        Observations, and the first ones that had the same pose before.
    floor : float or None
        Half the mean distance between points measured at the same pose, mm: an error that no model of the pose
        alone can explain. None where no pose was repeated.
    bases : tuple of (rotation, place)
        For every recording the pose of the robot's base in the sensor's axes: (3, 3), and (3,) mm.
    weights : (T, 2 + n) array
        Weights of the tip, of its direction and of the points in the fit: 0 for outliers, which were left out; NaN
        where nothing was measured.
    notes : tuple of str
        Outliers by their line, parameters beyond their tolerances, and findings that were accepted; a sentence
        each.
    next_q : (k, 2d + 2) array
        Poses whose measurement would lower the uncertainty most, rad and mm.
    next_left : (k,) array
        Part of the uncertainty that remains after measuring the poses up to each.
    """

    robot: Robot
    nominal: Robot
    measured: Measurements
    model: str
    fit: ParameterFit
    standing: tuple[str, ...]
    unidentified: tuple[str, ...]
    nominal_residuals: Array
    held_out: Array
    fold: Index
    repeated_poses: Index
    floor: float | None
    bases: tuple[tuple[Array, Array], ...]
    weights: Array = field(default_factory=lambda: np.zeros((0, 0)))
    notes: tuple[str, ...] = ()
    next_q: Array = field(default_factory=lambda: np.zeros((0, 0)))
    next_left: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def outliers(self) -> Flags:
        """Mask (T, 2 + n) of the tip, its direction and the points that were left out of the fit."""
        return np.asarray(self.weights == 0)

    @property
    def parameters(self) -> Parameters:
        """The parameters that were estimated, with their means and covariance before measuring."""
        return self.fit.parameters


def calibrate(
    robot: Robot,
    measured: Measurements,
    estimate: Sequence[str] | None = None,
    *,
    model: str | Model = "elastic",
    registered: bool = False,
    held_out: int = 5,
    block: float = FOLD_BLOCK_S,
    next_count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    noise: float | None = None,
    accept: Sequence[str] = (),
) -> Calibration:
    """Estimate the parameters of a robot from measured shapes, by robust least squares around its tolerances.

    Minimises the sum over observations of rho((y_k - h_k(p)) / s) plus (p - p_0)^T C_0^-1 (p - p_0), with rho(r) =
    2 c^2 (sqrt(1 + r^2 / c^2) - 1) and c = 2. p_0 and C_0 come from the robot's tolerances; the noise s is
    estimated along with p (Huber and Ronchetti, Robust Statistics, 2nd ed., 2009, proposal 2).

    Parameters
    ----------
    robot : Robot
        The nominal robot, with tolerances for what is to be estimated.
    measured : Measurements
        The observations.
    estimate : sequence of str, optional
        Kinds of parameters, of ``calibration.parameters.PARAMETER_KINDS``. By default whatever has a tolerance;
        where the time is known, also the tubes' backlash and drag and the sensor's delay; and under a load, the
        tubes' Young's modulus.
    model : str or Model
        The kinematic model. If it has a load, or `measured` has forces at the tip, every observation is that of
        the loaded robot, whose tubes must have Young's moduli in MPa: only then are stiffnesses identifiable, and
        not just their ratios.
    registered : bool
        Whether the sensor's axes are those of the robot's base. Otherwise the pose of the base is estimated, one
        for every recording.
    held_out : int
        Number of folds for cross-validation, at least 2; 0 for none.
    block : float
        Length of the blocks of a motion that are in one fold, s.
    next_count : int
        Number of next poses that are proposed.
    seed : int
        Seed of the folds and of the proposals.
    progress : callable, optional
        Called as ``progress(done, total, what)`` before each fit, with the number of fits done, their total number
        and the next one, and once at the end.
    noise : float, optional
        Standard deviation of the sensor in each coordinate, mm, from which it follows how much may be left over; 1
        mm if it is not stated.
    accept : sequence of str
        Findings that are confirmed and do not raise, of ``calibration.consistency.CALIBRATION_FINDINGS``:
        ``"cause"``, ``"base"`` and ``"residual"``.

    Returns
    -------
    Calibration
        The robot found, the remaining uncertainty, and errors before, after and held out.

    Raises
    ------
    MeasurementError
        The robot cannot have been at these configurations, the measurements contradict it, or the tubes that fit
        best cannot be made.
    OptionError
        An option is unknown or out of its range, or a parameter is not identifiable from such measurements.
    LoadError
        There is a load and a tube's modulus is not in MPa, or the load changes over time.

    Examples
    --------
    The curvature of the inner tube is off by 5 % and found from six measured tips:

    >>> import numpy as np
    >>> import ctr_nlp as ctr
    >>> tubes = ctr.Tube(90, 60, 1 / 130, 3.0, 2.4), ctr.Tube(160, 110, 1 / 60, 2.0, 1.4)
    >>> nominal = ctr.Robot(tubes, tolerances=ctr.Tolerances(curvature=0.1))
    >>> real = ctr.Robot((tubes[0], ctr.Tube(160, 110, 1.05 / 60, 2.0, 1.4)))
    >>> q = np.array([[0.0, turn, 30.0, out, 0.0, 0.0] for turn in (0, 1, 2) for out in (50, 80)])
    >>> none = np.full((6, 3), np.nan)
    >>> measured = ctr.Measurements(
    ...     q=q,
    ...     tip=ctr.shapes(real, q, np.ones(1))[:, 0],
    ...     direction=none,
    ...     points=np.zeros((6, 0, 3)),
    ...     sigma=np.zeros((6, 0)),
    ...     time=none[:, 0],
    ...     recording=np.zeros(6, dtype=int),
    ... )
    >>> options = {"model": "dominant", "registered": True, "held_out": 0}
    >>> found = ctr.calibrate(nominal, measured, ["curvature"], **options)
    >>> found.parameters.names, (found.fit.values.round(3) + 0.0).tolist()
    (['curvature_1', 'curvature_2'], [0.0, 0.05])
    """
    check_instance(MeasurementError, "robot", robot, Robot)
    check_instance(MeasurementError, "measurements", measured, Measurements)
    for finding in accept:
        check_choice("accept", finding, CALIBRATION_FINDINGS)
    if noise is not None and not 0 < noise < math.inf:
        raise OptionError(f"noise is {noise!r}; it must be a positive number, in mm")
    # A copy of an observation is no further information, and in another fold it would leak the held-out one.
    measured = measured.distinct()
    described = model_for_tip_forces(model_named(model), measured.has_tip_force)
    described.check(robot)
    measured.check(robot)
    parameters = parameters_of(robot, measured, estimate, registered, described.applied_load is not None)
    fold = assign_folds(robot, measured, held_out, block, seed=seed) if held_out else np.full(len(measured), -1)
    prediction = build_registered_prediction(parameters, measured, described)
    before = flat_measured(measured) - prediction.predict_values(parameters.mean).flat()
    report = progress or (lambda *_: None)
    total = 1 + held_out
    report(0, total, "all observations")
    fit, outliers = fit_without_outliers(prediction, largest_agreeing_noise(measured, robot.d, noise))
    fitted = FittedMeasurements(prediction, described, fit, outliers, registered, noise)
    accepted = check_agreement(fitted, accept)
    kept = leave_out(prediction, outliers)
    out = np.full(before.shape, np.nan)
    for k in range(held_out):
        report(1 + k, total, f"without fold {k + 1}")
        # The noise is estimated again, too: nothing in a fit depends on the held-out fold.
        found = recompute_residuals(fit_parameters(kept, fold != k), prediction)
        out[fold == k] = found.residuals[fold == k]
    report(total, total, "done")
    made = calibrated_robot(fit, measured)
    again = find_repeated_poses(robot, measured, block)
    proposed = next_poses(fit, prediction, described, made, next_count, seed) if next_count else ()
    notes = (*describe_outliers(fitted), *describe_distant_parameters(fitted), *accepted)
    weights = fit_weights(fit.residuals, fit.noise, outliers)
    return Calibration(
        *(
            made,
            robot,
            measured,
            described.name,
            fit,
            tuple(classify_parameters(fit)),
            tuple(describe_unidentified(fit)),
        ),
        *(before, out, fold, again, _floor(before, again), prediction.bases_at(fit.values)),
        *(weights, notes, *proposed),
    )


def _floor(before: Array, again: Index) -> float | None:
    """Return half the mean distance between points measured at the same pose, mm; None where there are none.

    before: (T, 6 + 3n), residuals. again: (n, 2), pairs of observations of one pose.
    """
    # Predictions at one pose cancel in the difference. Two points that differ by 2 e are both e off their middle,
    # which is the best that any model of the pose alone can predict.
    known = errors(before[again[:, 0]] - before[again[:, 1]])
    return float(np.nanmean(known)) / 2 if np.isfinite(known).any() else None
