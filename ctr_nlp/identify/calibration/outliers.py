"""Outliers among measured values: found from the residuals of a fit, and left out of the next one.

A place is what a sensor measured in one observation at one spot: the tip, the direction there, or a point. With
residuals r and noise s of n coordinates, the mean of r^2 / s^2 over a place follows an F distribution with n and
N - P degrees of freedom, as s is estimated from all N coordinates and P parameters. The soft loss of fit.py limits
what an outlier does to the estimates, but does not remove it: its pull stays that of a residual of
SOFT_LOSS_DEVIATIONS. Places that noise does not explain therefore get the weight 0.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import f

from ctr_nlp.identify.calibration.fit import (
    SOFT_LOSS_DEVIATIONS,
    Noise,
    ParameterFit,
    fit_parameters,
    noise_of_columns,
)
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.prediction import Prediction, flat_measured
from ctr_nlp.typing import Array, Flags

OUTLIER_PROBABILITY = 1e-3
"""Probability that noise alone makes an outlier of any place of a whole set of measurements."""
LEAST_OUTLIER_MM, LEAST_OUTLIER_RAD = 0.5, 0.05
"""Residuals below are no outliers, however small the noise of the others is."""
MAX_OUTLIER_ROUNDS = 5
"""Largest number of fits, each without the outliers of the one before."""


def fit_without_outliers(prediction: Prediction, max_noise: float) -> tuple[ParameterFit, Flags]:
    """Estimate parameters, and again without the outliers, until these stay the same.

    Parameters
    ----------
    prediction : Prediction
        The measurements, and their predictions.
    max_noise : float
        Noise, mm, above which the measurements contradict the robot as a whole; outliers are then not looked for.

    Returns
    -------
    fit : ParameterFit
        The estimates; its residuals are those of all observations, with the outliers.
    outliers : (T, 2 + n) array of bool
        The tip, the direction and the points that were left out.
    """
    measured = prediction.measured
    values = flat_measured(measured)
    outliers = np.zeros((len(measured), 2 + measured.sigma.shape[1]), dtype=bool)
    fit = fit_parameters(prediction)
    for _ in range(MAX_OUTLIER_ROUNDS):
        residuals = values - prediction.predict_values(fit.values).flat()
        found = find_outliers(residuals, fit.noise, int((~fit.fixed).sum()))
        if fit.noise.position > max_noise or (found == outliers).all():
            break
        outliers = found
        fit = fit_parameters(leave_out(prediction, outliers))
    residuals = values - prediction.predict_values(fit.values).flat()
    return replace(fit, residuals=residuals), outliers


def find_outliers(residuals: Array, noise: Noise, free_count: int) -> Flags:
    """Find the places whose residuals noise does not explain.

    Parameters
    ----------
    residuals : (T, 6 + 3n) array
        Measured less predicted, NaN where nothing was measured.
    noise : Noise
        The noise of a fit.
    free_count : int
        Number of parameters that were fitted.

    Returns
    -------
    (T, 2 + n) array of bool
        Outliers among the tip, the direction and the points.
    """
    places = by_place(residuals)
    known = np.isfinite(places)
    degrees = known.sum(axis=2)
    squares = np.nansum(by_place(residuals / noise_of_columns(noise, residuals.shape[1])) ** 2, axis=2)
    # Each place may be an outlier by chance; so that hardly any of all of them is, the probability is shared.
    chance = OUTLIER_PROBABILITY / max(int((degrees > 0).sum()), 1)
    most = degrees * f.isf(chance, np.maximum(degrees, 1), max(int(degrees.sum()) - free_count, 1))
    least = np.full(places.shape[1], LEAST_OUTLIER_MM)
    least[1] = LEAST_OUTLIER_RAD
    return np.asarray((degrees > 0) & (squares > most) & (np.sqrt(np.nansum(places**2, axis=2)) > least))


def leave_out(prediction: Prediction, outliers: Flags) -> Prediction:
    """Return a prediction whose measurements are without some outliers.

    Parameters
    ----------
    prediction : Prediction
        The predictions.
    outliers : (T, 2 + n) array of bool
        What is left out of the tips, the directions and the points.

    Returns
    -------
    Prediction
        With NaN in their places.
    """
    if not outliers.any():
        return prediction
    return prediction.with_measurements(without_places(prediction.measured, outliers))


def without_places(measured: Measurements, outliers: Flags) -> Measurements:
    """Return measurements with NaN in some places; outliers: (T, 2 + n), the tips, directions and points."""
    return replace(
        measured,
        tip=np.where(outliers[:, :1], np.nan, measured.tip),
        direction=np.where(outliers[:, 1:2], np.nan, measured.direction),
        points=np.where(outliers[:, 2:, None], np.nan, measured.points),
    )


def by_place(values: Array) -> Array:
    """Return values (T, 6 + 3n) of the tip, the direction and n points as (T, 2 + n, 3)."""
    return values.reshape(len(values), values.shape[1] // 3, 3)


def fit_weights(residuals: Array, noise: Noise, outliers: Flags) -> Array:
    """Compute the weight of every place in the fit.

    Parameters
    ----------
    residuals : (T, 6 + 3n) array
        Residuals of the fit.
    noise : Noise
        The noise of the fit.
    outliers : (T, 2 + n) array of bool
        Places that were left out.

    Returns
    -------
    (T, 2 + n) array
        Mean over the coordinates, 1 for a residual of 0 and 0 for outliers; NaN where nothing was measured.
    """
    scaled = by_place(residuals / noise_of_columns(noise, residuals.shape[1]))
    # Weights of iteratively reweighted least squares: the slope of the loss over that of a square.
    weights = 1 / np.sqrt(1 + (scaled / SOFT_LOSS_DEVIATIONS) ** 2)
    known = np.isfinite(weights)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(weights, axis=2) / known.sum(axis=2)
    return np.where(outliers, 0.0, mean)
