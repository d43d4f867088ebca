"""Values of parameters that fit measurements best, by robust least squares around their prior.

In the symbols of docs/method.md, "Calibration", the objective is

    sum_k rho((y_k - h_k(p)) / s) + (p - p_0)^T C_0^-1 (p - p_0),    rho(r) = 2 c^2 (sqrt(1 + r^2 / c^2) - 1),

with c = SOFT_LOSS_DEVIATIONS. The noise s is estimated from the residuals by Huber's proposal 2, the fit is
repeated with it, and so on until s converges. The covariance of p is that of an M-estimator with a normal prior,
the inverse of C_0^-1 + (e / m) J^T J / s^2, where e is the efficiency of rho at these residuals, and m the number
of observations that count as one where residuals are correlated in time (Huber and Ronchetti, Robust Statistics,
2nd ed., 2009).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ctr_nlp.identify.calibration.parameters import Parameters
from ctr_nlp.identify.calibration.prediction import Prediction, flat_measured
from ctr_nlp.typing import Array, Flags, Index

SOFT_LOSS_DEVIATIONS = 2.0
"""c of rho, in standard deviations of the noise: beyond it a residual counts linearly, and not as its square."""
NOISE_CLIP_DEVIATIONS = 2.0
"""Standard deviations at which residuals are clipped where the noise is estimated from them (Huber, proposal 2).
"""
CLIPPED_NORMAL_VARIANCE = 0.9205369256363228
"""The mean of min(|z|, c)^2 over a standard normal z with c = NOISE_CLIP_DEVIATIONS: 2 Phi(c) - 1 - 2 c phi(c) +
2 c^2 (1 - Phi(c)). Divided by it, the estimate of s is unbiased for normal residuals."""
MAX_NOISE_ROUNDS, FIT_STEPS_PER_ROUND = 12, 4
"""Largest number of estimates of the noise, and of steps of the fit between two of them."""
MOST_ROWS = 400
"""Largest number of observations of a motion in a fit, evenly spaced."""
MOST_STEPS = 40
"""Largest number of steps of the last fit, whose noise has converged."""
NOISE_TOLERANCE = 0.02
"""Relative change of the noise below which it has converged."""
NO_EQUILIBRIUM_RESIDUAL = 30.0
"""Residual, in standard deviations, of measured values where the predicted robot has no equilibrium."""
LEAST_NOISE = 1e-4, 1e-6
"""Least noise of positions, mm, and of directions, rad, by which residuals of exact data are divided."""
MAX_FREE_SIGMA_RATIO = 0.95
"""A parameter is fixed at its prior mean where its posterior deviation exceeds this part of the prior's."""
MIN_BOUND_DISTANCE_SIGMAS = 1e-3
"""Least distance of an initial guess from bounds, in prior standard deviations."""


class Noise(NamedTuple):
    """Noise of the measurements.

    Attributes
    ----------
    position : float
        Standard deviation of a measured coordinate, mm; NaN where there is none.
    direction : float
        Standard deviation of a component of a measured direction, rad; NaN where there is none.
    autocorrelation : float
        Correlation of residuals that follow each other in a motion; 0 where there is none.
    """

    position: float
    direction: float
    autocorrelation: float = 0.0

    @property
    def inflation(self) -> float:
        """Number of observations that count as one, at least 1."""
        # Of a first-order autoregressive series, whose values n steps apart have the correlation a^n: the variance
        # of its mean is (1 + a) / (1 - a) times that of independent values.
        return (1 + self.autocorrelation) / (1 - self.autocorrelation)


@dataclass(frozen=True, eq=False)
class ParameterFit:
    """Estimated parameters of a robot.

    Attributes
    ----------
    parameters : Parameters
        The P parameters, with their prior means and covariance.
    values : (P,) array
        Estimates, in the parameters' units.
    covariance : (P, P) array
        Posterior covariance of the estimates.
    information : (P, P) array
        Information matrix of the data alone, without the prior.
    residuals : (T, 6 + 3n) array
        Measured less predicted, NaN where nothing was measured; mm, and components of unit vectors.
    noise : Noise
        Estimated from these residuals.
    fixed : (P,) array of bool
        Parameters that are fixed at their prior means, as the data have hardly any information on them.
    """

    parameters: Parameters
    values: Array
    covariance: Array
    information: Array
    residuals: Array
    noise: Noise
    fixed: Flags

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,) of the estimates."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sigma_ratio(self) -> Array:
        """Posterior standard deviations (P,) as parts of those of the prior."""
        return self.sigma / self.parameters.sigma


def fit_parameters(prediction: Prediction, rows: Flags | None = None, start: Array | None = None) -> ParameterFit:
    """Estimate parameters from some of the observations.

    Minimises the objective at the top of this module. First all parameters are free, and the noise is estimated
    again after every few steps until it converges; then those on which the data have next to no information are
    fixed at their prior means, and the rest is solved to the end.

    Parameters
    ----------
    prediction : Prediction
        The measurements, and their predictions for values of the parameters.
    rows : (T,) array of bool, optional
        The observations that are used, by default all; of a motion at most MOST_ROWS of them.
    start : (P,) array, optional
        Initial guess; by default the prior means.

    Returns
    -------
    ParameterFit
        The estimates; residuals are those of all observations.
    """
    measured = prediction.measured
    parameters = prediction.parameters
    used = (
        thin_rows(measured.observed_mask & (True if rows is None else rows))
        if measured.has_times
        else measured.observed_mask
    )
    used = used if rows is None else used & rows
    problem = _Problem(prediction, used)
    free = np.ones(len(parameters), dtype=bool)
    values = _start_within_bounds(parameters, start)
    noise = problem.noise(values, np.zeros(0, dtype=int))
    # A few steps for each estimate of the noise: a fit to the end with a noise that is still wrong is wasted.
    for _ in range(MAX_NOISE_ROUNDS):
        values = problem.solve_values(values, free, noise, FIT_STEPS_PER_ROUND)
        before = noise
        noise = problem.noise(values, np.flatnonzero(free))
        if _same(before, noise):
            break
    # Parameters without information in the data would only follow rounding and the errors of the model.
    held = problem.fit(values, free, noise).sigma_ratio > MAX_FREE_SIGMA_RATIO
    free = ~held
    values = np.where(held, parameters.mean, values)
    values = problem.solve_values(values, free, noise, MOST_STEPS)
    return problem.fit(values, free, problem.noise(values, np.flatnonzero(free)))


def thin_rows(rows: Flags) -> Flags:
    """Return at most MOST_ROWS of the rows (T,) that are true, evenly spaced: neighbours in time hardly differ."""
    found = np.zeros(len(rows), dtype=bool)
    chosen = np.flatnonzero(rows)
    found[chosen[:: -(-len(chosen) // MOST_ROWS) or 1]] = True
    return found


def posterior(parameters: Parameters, information: Array) -> Array:
    """Compute the posterior covariance of parameters, the inverse of C_0^-1 + information.

    Parameters
    ----------
    parameters : Parameters
        The P parameters, with their prior covariance C_0.
    information : (P, P) array
        Information matrix of the data; it may be singular.

    Returns
    -------
    (P, P) array
        The covariance, symmetric and positive semidefinite whatever rounding does.
    """
    # With S S^T = C_0, (C_0^-1 + I)^-1 = S (1 + S^T I S)^-1 S^T, which needs no inverse of C_0 or I and stays
    # symmetric. Negative eigenvalues of S^T I S are rounding.
    scaled = np.linalg.inv(parameters.whitening_matrix)
    core = scaled.T @ information @ scaled
    sizes, axes = np.linalg.eigh((core + core.T) / 2)
    root = scaled @ axes / np.sqrt(1 + np.maximum(sizes, 0.0))
    return np.asarray(root @ root.T)


def information_of(changes: Array, known: Flags, noise: Noise) -> Array:
    """Compute J^T J / s^2 of every observation.

    Parameters
    ----------
    changes : (T, 6 + 3n, P) array
        Derivatives of what is predicted over the parameters.
    known : (T, 6 + 3n) array of bool
        Which entries are measured.
    noise : Noise
        Standard deviations s of the entries.

    Returns
    -------
    (T, P, P) array
        Information of every observation.
    """
    weighed = np.where(known[..., None], changes, 0.0) / noise_of_columns(noise, changes.shape[1])[:, None]
    return np.asarray(np.einsum("tkp,tkq->tpq", weighed, weighed))


class _Problem:
    """Residuals of the observations in some rows (T,), as functions of the parameters' values (P,)."""

    def __init__(self, prediction: Prediction, rows: Flags) -> None:
        self._prediction = prediction
        self._rows = rows
        self._parameters = prediction.parameters
        self._measured = flat_measured(prediction.measured)
        self._known = np.isfinite(self._measured) & rows[:, None]

    def solve_values(self, values: Array, free: Flags, noise: Noise, steps: int) -> Array:
        """Return values (P,) improved in those that are `free` (P,) at a given noise, in at most `steps` steps."""
        chosen = np.flatnonzero(free)
        if not len(chosen):
            return values
        sigma, (low, high) = self._parameters.sigma, self._parameters.bounds
        weights = 1 / noise_of_columns(noise, self._measured.shape[1])
        whitened = self._parameters.whitening_matrix
        count = int(self._known.sum())

        # The unknowns u are values over their prior standard deviations, so that steps in mm, rad and parts have
        # one scale.
        def all_values(u: Array) -> Array:
            found = np.array(values)
            found[chosen] = u * sigma[chosen]
            return found

        def residuals(u: Array) -> Array:
            here = all_values(u)
            return np.concatenate(
                [self._weighted_residuals(here, weights)[self._known], whitened @ (here - self._parameters.mean)]
            )

        def slopes(u: Array) -> Array:
            _, changes = self._prediction.predict_with_derivatives(all_values(u), self._rows)
            rows = -(changes * weights[:, None])[self._known]  # residuals are measured less predicted
            return np.asarray(np.vstack([rows, whitened])[:, chosen] * sigma[chosen])

        def loss(squares: Array) -> Array:
            return _soft_l1(squares, count)

        bounds = low[chosen] / sigma[chosen], high[chosen] / sigma[chosen]
        # The method wants a start strictly within bounds.
        begin = np.clip(
            values[chosen] / sigma[chosen],
            bounds[0] + MIN_BOUND_DISTANCE_SIGMAS,
            bounds[1] - MIN_BOUND_DISTANCE_SIGMAS,
        )
        options: dict[str, Any] = {"xtol": 1e-5, "ftol": 1e-6, "gtol": 1e-8, "max_nfev": steps}
        done = least_squares(residuals, begin, slopes, bounds, loss=loss, **options)
        return all_values(done.x)

    def _weighted_residuals(self, values: Array, weights: Array) -> Array:
        """Return residuals (T, 6 + 3n) at values (P,), times weights (6 + 3n,)."""
        found = (self._measured - self._prediction.predict_values(values).flat()) * weights
        # A robot without an equilibrium must cost something finite, and more than one that is merely off.
        return np.where(np.isfinite(found) | ~self._known, found, NO_EQUILIBRIUM_RESIDUAL)

    def noise(self, values: Array, free: Index) -> Noise:
        """Estimate the noise from the residuals at values (P,); free: indices of those that were fitted."""
        residuals = self._measured - self._prediction.predict_values(values).flat()
        residuals[~self._known] = np.nan
        count = np.isfinite(residuals).sum()
        # Residuals of a fit are smaller than the noise: n - p of n degrees of freedom are left. At least one
        # counts.
        spent = max(1 - len(free) / max(count, 1), 1 / max(count, 1))
        position = np.delete(residuals, slice(3, 6), axis=1)
        size = _spread(position, spent, LEAST_NOISE[0]), _spread(residuals[:, 3:6], spent, LEAST_NOISE[1])
        return Noise(*size, self._autocorrelation(residuals / noise_of_columns(Noise(*size), residuals.shape[1])))

    def _autocorrelation(self, residuals: Array) -> float:
        """Return the lag-1 correlation of residuals (T, 6 + 3n), which are over their noise, along motions."""
        measured = self._prediction.measured
        if not measured.has_times:
            return 0.0
        used = np.flatnonzero(self._rows)
        clipped = np.clip(residuals[used], -NOISE_CLIP_DEVIATIONS, NOISE_CLIP_DEVIATIONS)
        pairs = clipped[:-1] * clipped[1:]
        # The last observation of one recording and the first of the next are no neighbours.
        pairs[np.diff(measured.recording[used]) != 0] = np.nan
        if not np.isfinite(pairs).any():
            return 0.0
        return float(np.clip(np.nanmean(pairs) / np.nanmean(clipped**2), 0.0, 0.99))

    def fit(self, values: Array, free: Flags, noise: Noise) -> ParameterFit:
        """Return the fit at values (P,), those `free` (P,) fitted, with their covariance at this noise."""
        seen, changes = self._prediction.predict_with_derivatives(values, self._rows)
        residuals = self._measured - seen.flat()
        weighed = (residuals / noise_of_columns(noise, residuals.shape[1]))[self._known]
        # J^T J / s^2 is the information of independent normal residuals under least squares. The soft loss uses a
        # part of it (its efficiency), and of correlated residuals several count as one.
        factor = _efficiency(weighed[np.isfinite(weighed)]) / noise.inflation
        information = information_of(changes, self._known, noise).sum(axis=0) * factor
        covariance = posterior(self._parameters, information)
        return ParameterFit(self._parameters, values, covariance, information, residuals, noise, ~free)


def _start_within_bounds(parameters: Parameters, start: Array | None) -> Array:
    """Return an initial guess (P,) well within the parameters' bounds, by default near their prior means."""
    low, high = parameters.bounds
    near = 0.1 * parameters.sigma
    return np.clip(parameters.mean if start is None else start, low + near, np.maximum(high - near, low + near))


def _soft_l1(squares: Array, count: int) -> Array:
    """Return rho of squares (m,) and its first two derivatives over them, (3, m), for scipy's least_squares.

    The first `count` are squared residuals and get the soft loss; the others are those of the prior and stay
    squares.
    """
    found = np.stack([squares, np.ones_like(squares), np.zeros_like(squares)])
    # scipy takes rho as a function of z = r^2: rho = 2 c^2 (sqrt(1 + z / c^2) - 1), rho' and rho''.
    t = 1 + squares[:count] / SOFT_LOSS_DEVIATIONS**2
    found[:, :count] = (
        2 * SOFT_LOSS_DEVIATIONS**2 * (np.sqrt(t) - 1),
        t**-0.5,
        -0.5 * t**-1.5 / SOFT_LOSS_DEVIATIONS**2,
    )
    return found


def _efficiency(residuals: Array) -> float:
    """Efficiency of the soft loss against least squares at residuals (m,) that are over their noise."""
    if not len(residuals):
        return 1.0
    # An M-estimator's asymptotic covariance is E[psi^2] / E[psi']^2 (J^T J)^-1, with psi = r / sqrt(1 + r^2 /
    # c^2), the slope of rho / 2: here psi^2 = r^2 / t and psi' = t^-1.5.
    t = 1 + (residuals / SOFT_LOSS_DEVIATIONS) ** 2
    return float(np.mean(t**-1.5) ** 2 / np.mean(residuals**2 / t))


def _spread(residuals: Array, spent: float, least: float) -> float:
    """Return the robust standard deviation of residuals by Huber's proposal 2; NaN where there are none.

    spent: the share of degrees of freedom that the fit has left. least: the smallest result.
    """
    found = residuals[np.isfinite(residuals)]
    if not len(found):
        return math.nan
    # From the median's estimate on (1.4826 for normal residuals), the fixed point of s^2 = mean(min(|r|, c s)^2) /
    # CLIPPED_NORMAL_VARIANCE: far residuals count as if they were c s.
    size = max(1.4826 * float(np.median(abs(found))), least)
    for _ in range(50):
        size = max(
            math.sqrt(
                float(np.mean(np.minimum(abs(found), NOISE_CLIP_DEVIATIONS * size) ** 2))
                / (CLIPPED_NORMAL_VARIANCE * spent)
            ),
            least,
        )
    return size


def noise_of_columns(noise: Noise, width: int) -> Array:
    """Return the noise of every entry of ``ObservableValues.flat``, which has `width` of them; 1 where none is."""
    found = np.full(width, noise.position)
    found[3:6] = noise.direction
    return np.where(np.isfinite(found), found, 1.0)


def _same(one: Noise, other: Noise) -> bool:
    """Return whether two estimates of the noise differ by at most NOISE_TOLERANCE; NaN counts as equal."""
    pairs = zip(one[:2], other[:2], strict=True)
    return all(abs(a - b) <= NOISE_TOLERANCE * b or math.isnan(a) for a, b in pairs)


def recompute_residuals(fit: ParameterFit, prediction: Prediction) -> ParameterFit:
    """Return a fit with the residuals that it leaves in all observations of a prediction."""
    residuals = flat_measured(prediction.measured) - prediction.predict_values(fit.values).flat()
    return replace(fit, residuals=residuals)
