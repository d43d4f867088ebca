"""Whether measurements and a robot agree after a calibration, and if not, why.

What is left over after the fit is compared with what noise and the model's own error allow: with residuals r and
standard deviations s of n coordinates, and P parameters, sum r^2 / s^2 is chi-square distributed with n - P
degrees of freedom. Beyond its quantile the robot is not the one that was measured, or the file is misread. Smaller
contradictions show by comparison: without the mistake (causes.py) the same robot fits many times better.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from ctr_nlp.exceptions import MeasurementError
from ctr_nlp.identify.calibration.causes import (
    MAX_COMPARED_ROWS,
    Cause,
    CauseSearch,
    compare_causes,
    name_lines,
    places_of,
)
from ctr_nlp.identify.calibration.fit import ParameterFit, fit_parameters
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.outliers import without_places
from ctr_nlp.identify.calibration.parameters import BASE, PRIOR_SIGMAS, Parameter, Parameters
from ctr_nlp.identify.calibration.prediction import Prediction, build_registered_prediction, flat_measured
from ctr_nlp.identify.calibration.residuals import distances
from ctr_nlp.identify.calibration.row_mistakes import describe_row_mistake
from ctr_nlp.models import Model
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.typing import Array, Flags

CALIBRATION_FINDINGS = ("cause", "base", "residual")
"""Findings on measurements that are refused unless a person confirms them: a mistake without which they fit many
times better, a pose of the base that explains them although it was said to be known, and residuals beyond what
noise allows."""
ASSUMED_NOISE_MM = 1.0
"""Standard deviation of each coordinate of a position where none is stated: that of an electromagnetic tracker."""
ASSUMED_DIRECTION_NOISE_RAD = 0.1
"""Standard deviation of each component of a direction: a sensor that is not quite aligned with the tip."""
MODEL_ERROR_PART = 0.02
"""Standard deviation of the distance from the model's shape to a robot's, as a part of the arc length: published
models of concentric tubes are 1 to 3 % off (Rucker et al., IEEE Trans. Robotics 26, 2010)."""
AGREEMENT_PROBABILITY = 1e-3
"""Probability that residuals of a robot that agrees exceed the bound."""
MAX_OUTLIER_SHARE = 0.2
"""Largest share of measured values that may be left out as outliers."""
MIN_SCREENED_GAIN = 1.25
"""By how much better a cause must fit unchanged tubes to be fitted at all."""
LEAST_COMPARED_COORDINATES = 6
"""Least number of measured coordinates by which causes are compared."""
MAX_FITTED_CAUSES = 5
"""Largest number of causes that are fitted."""
MIN_CAUSE_FACTOR, MIN_ORDER_FACTOR = 2.0, 3.0
"""By how many times a cause must fit better to be named, and one that chooses the best order of rows or points."""
LIKEWISE_FACTOR = 1.25
"""Causes that fit as well as the best one up to this factor are named beside it."""
LEAST_RELATIVE_MISMATCH = 1e-3
"""Residuals below this part of the size of what was measured are no contradiction: nothing is looked for."""
MAX_NAMED_FACTOR = 100
"""Largest factor that a message states; a larger one says nothing more."""
MIN_BASE_GAIN, BASE_PROBABILITY = 1.5, 1e-6
"""By how much a pose of the base must lower residuals to be named, and the largest probability of chance."""
MAX_TOLERANCE_SIGMAS = 4.0
"""Parameters further off than this, in standard deviations of their tolerances, are reported."""


@dataclass(frozen=True, eq=False)
class FittedMeasurements:
    """A fit to measurements, and what is needed to fit others.

    Attributes
    ----------
    prediction : Prediction
        Predictions of the measurements.
    model : Model
        The kinematic model.
    fit : ParameterFit
        The fit, with residuals of all observations.
    outliers : (T, 2 + n) array of bool
        The tip, the direction and the points that were left out of it.
    registered : bool
        Whether the sensor's axes are those of the base.
    noise : float or None
        Standard deviation of the sensor in each coordinate, mm, if it was stated.
    """

    prediction: Prediction
    model: Model
    fit: ParameterFit
    outliers: Flags
    registered: bool
    noise: float | None

    @property
    def measurements(self) -> Measurements:
        """The measurements."""
        return self.prediction.measured

    @property
    def parameters(self) -> Parameters:
        """The parameters that were estimated."""
        return self.prediction.parameters


def check_agreement(fitted: FittedMeasurements, accept: Sequence[str] = ()) -> tuple[str, ...]:
    """Check that measurements do not contradict the robot.

    Parameters
    ----------
    fitted : FittedMeasurements
        The fit.
    accept : sequence of str
        Findings that are confirmed, of CALIBRATION_FINDINGS; they are returned and not raised.

    Returns
    -------
    tuple of str
        Findings that were confirmed, a sentence each.

    Raises
    ------
    MeasurementError
        A mistake in the file explains the measurements many times better, a pose of the base does, or more is left
        over than noise allows.
    """
    notes = list[str]()
    for name, find in (("cause", find_contradiction), ("base", find_base), ("residual", find_excess)):
        message = find(fitted)
        if message is None:
            continue
        if name not in accept:
            raise MeasurementError(f"{message}; --accept {name} calibrates with it as it is")
        notes.append(f"{message}; this was accepted")
    return tuple(notes)


def largest_agreeing_noise(measured: Measurements, d: int, noise: float | None) -> float:
    """Return the noise of a coordinate, mm, beyond which measurements contradict the robot as a whole.

    Parameters
    ----------
    measured : Measurements
        The observations.
    d : int
        Number of tubes.
    noise : float or None
        Stated standard deviation of the sensor, mm.

    Returns
    -------
    float
        Twice the largest standard deviation that is allowed for any of them, mm.
    """
    return 2 * float(_allowed_sigmas(measured, d, noise)[:, 0].max())


def find_excess(fitted: FittedMeasurements) -> str | None:
    """Return a message on residuals beyond what noise allows; None where there are none."""
    measured = without_places(fitted.measurements, fitted.outliers)
    known = np.isfinite(flat_measured(measured))
    share = fitted.outliers.sum() / max(int((np.isfinite(distances(flat_measured(fitted.measurements)))).sum()), 1)
    if share > MAX_OUTLIER_SHARE:
        rows = np.flatnonzero(fitted.outliers.any(axis=1))
        return (
            f"{share:.0%} of what was measured contradicts the rest and the robot, and at most "
            f"{MAX_OUTLIER_SHARE:.0%} may: {name_lines(fitted.measurements, rows)}"
        )
    sigmas = _allowed_sigmas(measured, fitted.parameters.robot.d, fitted.noise)
    residuals = np.where(known, fitted.fit.residuals, 0.0)
    # A robot without an equilibrium explains nothing.
    failed = known & ~np.isfinite(fitted.fit.residuals)
    residuals = np.where(failed, 10 * sigmas, residuals)
    directions = np.zeros(known.shape[1], dtype=bool)
    directions[3:6] = True
    free = int((~fitted.fit.fixed).sum())
    for columns, unit, what in ((~directions, "mm", "positions"), (directions, "rad", "directions")):
        own = known[:, columns]
        if not own.any():
            continue
        squares = ((residuals / sigmas)[:, columns] ** 2)[own].sum()
        count = max(int(own.sum()) - free, 1)
        most = float(chi2.isf(AGREEMENT_PROBABILITY, count))
        if squares > most:
            # Root mean square of distances, and that of the largest residuals that would agree.
            left = math.sqrt(3 * float((residuals[:, columns] ** 2)[own].mean()))
            stated = "stated" if fitted.noise is not None else "assumed, state yours with --noise"
            noise = ASSUMED_NOISE_MM if fitted.noise is None else fitted.noise
            allowed = (
                f"a noise of {noise:g} mm in each coordinate ({stated}) and a model that is "
                f"{MODEL_ERROR_PART:.0%} of the length off"
                if unit == "mm"
                else f"a noise of {ASSUMED_DIRECTION_NOISE_RAD:g} rad in each component"
            )
            return (
                f"the measurements contradict the robot: after the fit, {what} are {left:.3g} {unit} off (root "
                f"mean square), and {allowed} would leave {left * math.sqrt(most / squares):.2g} {unit}. No usual "
                "mistake in the file explains it; check the robot's file, columns, units and the order of rows"
            )
    return None


def find_contradiction(fitted: FittedMeasurements) -> str | None:
    """Return a message that names the mistake without which measurements fit many times better; None without."""
    compared = fitted.measurements[: min(len(fitted.measurements), MAX_COMPARED_ROWS)]
    causes = _screen_causes(fitted, compared)
    if not causes:
        return describe_row_mistake(fitted.prediction, fitted.fit, fitted.outliers)
    before = _left_over(fitted.fit.residuals[: len(compared)])
    gains = [(_gain(fitted, cause, before), cause) for cause in causes]
    likely = [
        (gain, cause)
        for gain, cause in gains
        if gain > (MIN_ORDER_FACTOR if cause.free_order else MIN_CAUSE_FACTOR)
    ]
    best = max((gain for gain, _ in likely), default=0.0)
    chosen = [cause for gain, cause in likely if gain * LIKEWISE_FACTOR > best]
    # Simple causes come first: a free order or pose explains whatever one exchange of columns explains.
    simple = [cause for cause in chosen if not cause.free_order and not cause.has_base] or chosen
    if not all(cause.words for cause in simple):
        return None  # the base's pose alone, which find_base reports
    if not simple:
        return describe_row_mistake(fitted.prediction, fitted.fit, fitted.outliers)
    words = ", or if ".join(dict.fromkeys(cause.words for cause in simple[:3]))
    relative = ", relative to the size of what was measured," if simple[0].scale != 1 else ""
    times = f"{best:.2g}" if best < MAX_NAMED_FACTOR else f"more than {MAX_NAMED_FACTOR}"
    return (
        f"the measurements contradict the robot: {before[0]:.3g} mm are left over on average after the fit. They "
        f"fit {times} times better{relative} if {words}. Correct the file"
    )


def _screen_causes(fitted: FittedMeasurements, compared: Measurements) -> list[Cause]:
    """Return the causes that fit better than none on tubes that stay as they are; compared: observations used."""
    robot = fitted.parameters.robot
    # As poses of their own: causes are compared without backlash and delay.
    poses = replace(compared, time=np.full(len(compared), np.nan))
    if np.isfinite(places_of(poses)).sum() < LEAST_COMPARED_COORDINATES:
        return []
    # Tubes within tolerances may be so far off that a small mistake does not show on the nominal ones.
    tubes = [k for k, one in enumerate(fitted.parameters.each) if one.kind in DEVIATION_NAMES]
    nominal = Parameters(robot, ())
    estimated = Parameters(robot, tuple(fitted.parameters.each[k] for k in tubes))
    suspect = bool(fitted.outliers.any()) or find_excess(fitted) is not None
    found = list[Cause]()
    for parameters, values in ((nominal, np.zeros(0)), (estimated, fitted.fit.values[tubes])):
        search = CauseSearch(robot, poses, Prediction(parameters, poses, fitted.model), values, fitted.registered)
        as_it_is = search.mismatch(Cause("", poses))
        if as_it_is < LEAST_RELATIVE_MISMATCH * _size(poses):
            return []
        ranked = compare_causes(search, suspect, fitted.measurements.has_times)
        better = [cause for mismatch, cause in ranked if as_it_is > MIN_SCREENED_GAIN * mismatch]
        found += [cause for cause in better if not _names(found, cause)][:MAX_FITTED_CAUSES]
    return found


def _names(candidates: Sequence[Cause], cause: Cause) -> bool:
    """Return whether a cause of the same words is among some."""
    return any(one.words == cause.words for one in candidates)


def _size(measured: Measurements) -> float:
    """Return the root mean square distance of measured places from their mean, mm."""
    places = places_of(measured).reshape(-1, 3)
    return math.sqrt(3 * float(np.nanmean((places - np.nanmean(places, axis=0)) ** 2)))


def _left_over(residuals: Array) -> Array:
    """Return mean and median distance (2,), mm, of residuals (T, 6 + 3n)."""
    found = distances(residuals)
    return np.array([np.nanmean(found), np.nanmedian(found)])


def _gain(fitted: FittedMeasurements, cause: Cause, before: Array) -> float:
    """Return how many times better measurements fit without a mistake; before: (2,), of _left_over with it."""
    parameters = _with_base(fitted) if cause.has_base else fitted.parameters
    try:
        prediction = build_registered_prediction(parameters, cause.measured, fitted.model)
        after = _left_over(fit_parameters(prediction).residuals) / cause.scale
    except (ValueError, np.linalg.LinAlgError):
        return 0.0
    # The mean shows mistakes in a few rows, the median those in all of them beside an outlier.
    return float(np.max(before / np.maximum(after, 1e-12)))


def find_base(fitted: FittedMeasurements) -> str | None:
    """Return a message that a pose of the base explains measurements which were said to be registered, or None."""
    if not fitted.registered:
        return None
    recordings = fitted.measurements.recordings
    parameters = _with_base(fitted)
    added = len(parameters) - len(fitted.parameters)
    measured = without_places(fitted.measurements, fitted.outliers)
    known = np.isfinite(flat_measured(measured))
    known[:, 3:6] = False
    count = known.sum() / fitted.fit.noise.inflation
    free = int((~fitted.fit.fixed).sum())
    left_degrees = count - free - added
    if left_degrees < 1:
        return None
    prediction = build_registered_prediction(parameters, measured, fitted.model)
    other = fit_parameters(prediction)
    before, after = (
        float(np.nanmean(np.where(known, each.residuals, np.nan) ** 2)) for each in (fitted.fit, other)
    )
    gain = before / max(after, 1e-12)
    # The F test of nested models: the pose's parameters lower the sum of squares by no more than chance.
    chance = float(f.sf((gain - 1) * left_degrees / added, added, left_degrees))
    if math.sqrt(gain) < MIN_BASE_GAIN or chance > BASE_PROBABILITY or before < LEAST_RELATIVE_MISMATCH**2:
        return None
    poses = [
        f"turned by {math.degrees(Rotation.from_matrix(turn).magnitude()):.2g} degrees and shifted by "
        f"{np.linalg.norm(place):.2g} mm"
        for turn, place in prediction.bases_at(other.values)
    ]
    of_each = f"{poses[0]}{' in the first recording' if recordings > 1 else ''}"
    return (
        f"a base pose explains it: with the sensor {of_each}, "
        f"{math.sqrt(3 * after):.2g} mm are left over (root mean square), and {math.sqrt(3 * before):.2g} mm "
        "without; drop --registered"
    )


def _with_base(fitted: FittedMeasurements) -> Parameters:
    """Return the parameters of a fit to registered measurements, and those of the base of each recording."""
    recordings = fitted.measurements.recordings
    numbers = [None] if recordings == 1 else list(range(1, recordings + 1))
    base = tuple(Parameter(kind, number, PRIOR_SIGMAS[kind]) for number in numbers for kind in BASE)
    return Parameters(fitted.parameters.robot, (*fitted.parameters.each, *base))


def describe_outliers(fitted: FittedMeasurements) -> tuple[str, ...]:
    """Describe the values that were left out of a fit.

    Parameters
    ----------
    fitted : FittedMeasurements
        The fit.

    Returns
    -------
    tuple of str
        A sentence for each place.
    """
    measured = fitted.measurements
    count = measured.sigma.shape[1]
    names = ["tip", "direction at the tip", *(f"p{k + 1}" for k in range(count))]
    found = []
    places = fitted.fit.residuals.reshape(len(measured), -1, 3)
    for row, place in np.argwhere(fitted.outliers):
        off = math.sqrt(float(np.nansum(places[row, place] ** 2)))
        unit = "rad" if place == 1 else "mm"
        found.append(
            f"{measured.place_of(int(row))}: the {names[place]} is {off:.3g} {unit} off; it is an outlier, with "
            "the weight 0 in the fit"
        )
    return tuple(found)


def describe_distant_parameters(fitted: FittedMeasurements) -> tuple[str, ...]:
    """Describe parameters that are further from the robot's file than its tolerances allow.

    Parameters
    ----------
    fitted : FittedMeasurements
        The fit.

    Returns
    -------
    tuple of str
        A sentence for each of them.
    """
    parameters = fitted.parameters
    off = (fitted.fit.values - parameters.mean) / parameters.sigma
    return tuple(
        f"{one.words} is {value - one.mean:.2g} {one.unit} off, {abs(by):.1f} standard deviations of its tolerance"
        for one, value, by in zip(parameters.each, fitted.fit.values, off, strict=True)
        if one.kind in DEVIATION_NAMES and abs(by) > MAX_TOLERANCE_SIGMAS
    )


def _allowed_sigmas(measured: Measurements, d: int, noise: float | None) -> Array:
    """Return standard deviations (T, 6 + 3n) of measured values that agree with a model, mm and rad.

    d: number of tubes. noise: stated one of the sensor, mm.
    """
    sensor = ASSUMED_NOISE_MM if noise is None else noise
    reach = measured.q[:, 2 * d - 1 : 2 * d]
    sigma = np.where(np.isfinite(measured.sigma), measured.sigma, 1.0)
    # A third of the variance of a distance is that of each coordinate.
    along = np.hstack([reach, reach, sigma * reach]) * MODEL_ERROR_PART / math.sqrt(3)
    found = np.repeat(np.hypot(sensor, along), 3, axis=1)
    found[:, 3:6] = ASSUMED_DIRECTION_NOISE_RAD
    return np.asarray(found)
