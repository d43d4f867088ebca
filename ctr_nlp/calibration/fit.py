"""Values that fit measurements best, by robust least squares around what was known before."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ctr_nlp.calibration.parameters import Parameters
from ctr_nlp.calibration.prediction import Prediction, flat_measured
from ctr_nlp.typing import Array, Flags, Index

SOFT = 2.0
"""Standard deviations of the noise beyond which a residual counts less than its square: linearly, in the end."""
CLIPPED = 2.0
"""Standard deviations at which residuals are clipped where the noise is estimated from them (Huber, proposal 2).
"""
WITHIN = 0.9205369256363228
"""The mean of min(|z|, CLIPPED)^2 over a standard normal z."""
ROUNDS, STEPS = 12, 4
"""At most so many estimates of the noise, each followed by so many steps of a fit; the last one is to the end."""
MOST_ROWS = 400
"""Observations of a motion that a fit takes, evenly among more."""
MOST_STEPS = 40
"""Of the last fit."""
SETTLED = 0.02
"""By which part the noise may still change in the last round."""
LOST = 30.0
"""Standard deviations by which a place counts as missed where a robot has no equilibrium."""
LEAST_NOISE = 1e-6, 1e-8
"""mm and rad: noise that is taken for none."""
HELD = 0.95
"""A parameter keeps the value of before where the data leave more than this part of its standard deviation."""
INSIDE = 1e-3
"""Standard deviations by which a fit starts within bounds."""


class Noise(NamedTuple):
    """Standard deviations of a measured coordinate, mm, and of a component of a direction, rad; NaN for none.

    alike: correlation of residuals that follow each other in a motion, 0 where there is none.
    """

    position: float
    direction: float
    alike: float = 0.0

    @property
    def inflation(self) -> float:
        """Of how many observations one stands where residuals are alike, at least 1."""
        return (1 + self.alike) / (1 - self.alike)


@dataclass(frozen=True, eq=False)
class Fit:
    """Values (P,) of parameters and their covariance (P, P); residuals (T, 6 + 3 n), measured less predicted.

    information (P, P): what the data alone tell, as the inverse of a covariance. held (P,): which parameters keep
    the value of before since the data hardly tell them.
    """

    parameters: Parameters
    values: Array
    covariance: Array
    information: Array
    residuals: Array
    noise: Noise
    held: Flags

    @property
    def sigma(self) -> Array:
        """Standard deviations (P,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def left(self) -> Array:
        """Which part of the standard deviations of before the data leave, (P,)."""
        return self.sigma / self.parameters.sigma


def fitted(prediction: Prediction, rows: Flags | None = None, start: Array | None = None) -> Fit:
    """The values that fit the observations of some rows (T,) best, by default all.

    The sum of soft_l1 of residuals over their noise, and of squares of what parameters differ from the values of
    before over their standard deviations (covariance). The noise is estimated from residuals and fitted with
    again until it stays. What the data hardly tell is then held at the value of before.
    """
    measured, parameters = prediction.measured, prediction.parameters
    used = thinned(measured.seen & (True if rows is None else rows)) if measured.timed else measured.seen
    used = used if rows is None else used & rows
    problem = _Problem(prediction, used)
    free, values = np.ones(len(parameters), dtype=bool), _inside(parameters, start)
    noise = problem.noise(values, np.zeros(0, dtype=int))
    for _ in range(ROUNDS):
        values = problem.solved(values, free, noise, STEPS)
        before, noise = noise, problem.noise(values, np.flatnonzero(free))
        if _same(before, noise):
            break
    held = problem.fit(values, free, noise).left > HELD
    free, values = ~held, np.where(held, parameters.mean, values)
    values = problem.solved(values, free, noise, MOST_STEPS)
    return problem.fit(values, free, problem.noise(values, np.flatnonzero(free)))


def thinned(rows: Flags) -> Flags:
    """Rows (T,) of a motion, at most MOST_ROWS of those that there are: neighbours hardly differ."""
    found, chosen = np.zeros(len(rows), dtype=bool), np.flatnonzero(rows)
    found[chosen[:: -(-len(chosen) // MOST_ROWS) or 1]] = True
    return found


def posterior(parameters: Parameters, information: Array) -> Array:
    """The covariance (P, P) of parameters after what data tell, (P, P)."""
    scaled = np.linalg.inv(parameters.whitened)
    core = np.eye(len(parameters)) + scaled.T @ information @ scaled
    return np.asarray(scaled @ np.linalg.inv((core + core.T) / 2) @ scaled.T)


def information_of(changes: Array, known: Flags, noise: Noise) -> Array:
    """What observations tell of parameters, (T, P, P): from derivatives (T, 6 + 3 n, P) at entries known."""
    weighed = np.where(known[..., None], changes, 0.0) / _scales(noise, changes.shape[1])[:, None]
    return np.asarray(np.einsum("tkp,tkq->tpq", weighed, weighed))


class _Problem:
    """Residuals of some observations, as functions of parameters' values."""

    def __init__(self, prediction: Prediction, rows: Flags) -> None:
        self._prediction, self._rows = prediction, rows
        self._parameters = prediction.parameters
        self._measured = flat_measured(prediction.measured)
        self._known = np.isfinite(self._measured) & rows[:, None]

    def solved(self, values: Array, free: Flags, noise: Noise, steps: int) -> Array:
        """The best values (P,) from others, after so many steps at most; those not free stay."""
        chosen = np.flatnonzero(free)
        if not len(chosen):
            return values
        sigma, (low, high) = self._parameters.sigma, self._parameters.bounds
        weights, whitened = 1 / _scales(noise, self._measured.shape[1]), self._parameters.whitened
        count = int(self._known.sum())

        def all_values(u: Array) -> Array:
            found = np.array(values)
            found[chosen] = u * sigma[chosen]
            return found

        def residuals(u: Array) -> Array:
            here = all_values(u)
            return np.concatenate(
                [self._weighed(here, weights)[self._known], whitened @ (here - self._parameters.mean)]
            )

        def slopes(u: Array) -> Array:
            _, changes = self._prediction.with_changes(all_values(u), self._rows)
            rows = -(changes * weights[:, None])[self._known]
            return np.asarray(np.vstack([rows, whitened])[:, chosen] * sigma[chosen])

        def loss(squares: Array) -> Array:
            return _soft_l1(squares, count)

        bounds = low[chosen] / sigma[chosen], high[chosen] / sigma[chosen]
        begin = np.clip(values[chosen] / sigma[chosen], bounds[0] + INSIDE, bounds[1] - INSIDE)
        options: dict[str, Any] = {"xtol": 1e-5, "ftol": 1e-6, "gtol": 1e-8, "max_nfev": steps}
        done = least_squares(residuals, begin, slopes, bounds, loss=loss, **options)
        return all_values(done.x)

    def _weighed(self, values: Array, weights: Array) -> Array:
        """Residuals over their noise, (T, 6 + 3 n)."""
        found = (self._measured - self._prediction.seen(values).flat()) * weights
        return np.where(np.isfinite(found) | ~self._known, found, LOST)

    def noise(self, values: Array, free: Index) -> Noise:
        """The noise of residuals at values of which some were fitted."""
        residuals = self._measured - self._prediction.seen(values).flat()
        residuals[~self._known] = np.nan
        count = np.isfinite(residuals).sum()
        spent = max(1 - len(free) / max(count, 1), 1 / max(count, 1))
        position = np.delete(residuals, slice(3, 6), axis=1)
        size = _spread(position, spent, LEAST_NOISE[0]), _spread(residuals[:, 3:6], spent, LEAST_NOISE[1])
        return Noise(*size, self._alike(residuals / _scales(Noise(*size), residuals.shape[1])))

    def _alike(self, residuals: Array) -> float:
        """The correlation of residuals, over their noise and clipped, that follow each other in a motion."""
        measured = self._prediction.measured
        if not measured.timed:
            return 0.0
        used = np.flatnonzero(self._rows)
        clipped = np.clip(residuals[used], -CLIPPED, CLIPPED)
        pairs = clipped[:-1] * clipped[1:]
        pairs[np.diff(measured.recording[used]) != 0] = np.nan
        if not np.isfinite(pairs).any():
            return 0.0
        return float(np.clip(np.nanmean(pairs) / np.nanmean(clipped**2), 0.0, 0.99))

    def fit(self, values: Array, free: Flags, noise: Noise) -> Fit:
        """With the covariance of values."""
        seen, changes = self._prediction.with_changes(values, self._rows)
        residuals = self._measured - seen.flat()
        weighed = (residuals / _scales(noise, residuals.shape[1]))[self._known]
        factor = _efficiency(weighed[np.isfinite(weighed)]) / noise.inflation
        information = information_of(changes, self._known, noise).sum(axis=0) * factor
        covariance = posterior(self._parameters, information)
        return Fit(self._parameters, values, covariance, information, residuals, noise, ~free)


def _inside(parameters: Parameters, start: Array | None) -> Array:
    """Where a fit starts: within bounds, at what was known before."""
    low, high = parameters.bounds
    near = 0.1 * parameters.sigma
    return np.clip(parameters.mean if start is None else start, low + near, np.maximum(high - near, low + near))


def _soft_l1(squares: Array, count: int) -> Array:
    """Rho of squares (m,) and its first two derivatives, (3, m): soft for the first so many, then the square."""
    found = np.stack([squares, np.ones_like(squares), np.zeros_like(squares)])
    t = 1 + squares[:count] / SOFT**2
    found[:, :count] = 2 * SOFT**2 * (np.sqrt(t) - 1), t**-0.5, -0.5 * t**-1.5 / SOFT**2
    return found


def _efficiency(residuals: Array) -> float:
    """What soft_l1 makes of as much information as least squares have, where residuals are over their noise."""
    if not len(residuals):
        return 1.0
    t = 1 + (residuals / SOFT) ** 2
    return float(np.mean(t**-1.5) ** 2 / np.mean(residuals**2 / t))


def _spread(residuals: Array, spent: float, least: float) -> float:
    """The standard deviation of residuals, most of them normal, by Huber's proposal 2; NaN where there are none.

    spent: the share of degrees of freedom that a fit has left.
    """
    found = residuals[np.isfinite(residuals)]
    if not len(found):
        return math.nan
    size = max(1.4826 * float(np.median(abs(found))), least)
    for _ in range(50):
        size = max(
            math.sqrt(float(np.mean(np.minimum(abs(found), CLIPPED * size) ** 2)) / (WITHIN * spent)), least
        )
    return size


def _scales(noise: Noise, width: int) -> Array:
    """The noise of every entry of Seen.flat, (width,); 1 where there is none."""
    found = np.full(width, noise.position)
    found[3:6] = noise.direction
    return np.where(np.isfinite(found), found, 1.0)


def _same(one: Noise, other: Noise) -> bool:
    pairs = zip(one[:2], other[:2], strict=True)
    return all(abs(a - b) <= SETTLED * b or math.isnan(a) for a, b in pairs)


def at(fit: Fit, prediction: Prediction) -> Fit:
    """A fit with the residuals that it leaves in all observations."""
    residuals = flat_measured(prediction.measured) - prediction.seen(fit.values).flat()
    return replace(fit, residuals=residuals)
