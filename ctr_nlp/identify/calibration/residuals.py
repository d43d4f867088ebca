"""Distances between measured and predicted places, and summaries of them."""

from __future__ import annotations

import numpy as np

from ctr_nlp.typing import Array


def distances(residuals: Array) -> Array:
    """Compute the distances of measured points from predicted ones.

    Parameters
    ----------
    residuals : (T, 6 + 3n) array
        Measured less predicted; in the order of ``ObservableValues.flat``.

    Returns
    -------
    (T, 1 + n) array
        Distances of the tip and of the points, mm, over those coordinates that were measured; NaN where none was.
    """
    places = np.delete(residuals, slice(3, 6), axis=1)
    places = places.reshape(len(places), places.shape[1] // 3, 3)
    seen = np.isfinite(places).any(axis=2)
    return np.asarray(np.where(seen, np.sqrt(np.nansum(places**2, axis=2)), np.nan))


def errors(residuals: Array) -> Array:
    """Compute the root mean square distance of every observation.

    Parameters
    ----------
    residuals : (T, 6 + 3n) array
        Measured less predicted; in the order of ``ObservableValues.flat``.

    Returns
    -------
    (T,) array
        Over its tip and points, mm; NaN where no place was measured.
    """
    found = distances(residuals)
    known = np.isfinite(found)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.nansum(found**2, axis=1) / known.sum(axis=1)))


def summary_of(found: Array) -> dict[str, float] | None:
    """Summarise errors found (T,), mm, by their mean, 95 % quantile and maximum; None where none is finite."""
    known = found[np.isfinite(found)]
    if not len(known):
        return None
    return {"mean": float(known.mean()), "q95": float(np.quantile(known, 0.95)), "max": float(known.max())}
