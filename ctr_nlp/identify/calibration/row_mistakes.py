"""Mistakes in single rows of a file: exchanged points, exchanged rows, another unit.

A row that contradicts the others is an outlier. If it agrees with them once a usual mistake is undone, it was no
outlier of the sensor, and the file is to be corrected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from ctr_nlp.identify.calibration.causes import (
    LENGTH_UNITS,
    name_lines,
    place_distances,
    places_of,
    repair_rows,
    row_order_words,
)
from ctr_nlp.identify.calibration.fit import ParameterFit
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.outliers import find_outliers
from ctr_nlp.identify.calibration.prediction import Prediction, flat_measured
from ctr_nlp.typing import Array, Flags, Index


class _RowMistake(NamedTuple):
    """A mistake in some rows: in words, the measurements without it, and which rows (n,) it changes."""

    words: str
    measured: Measurements
    rows: Index


def describe_row_mistake(prediction: Prediction, fit: ParameterFit, outliers: Flags) -> str | None:
    """Describe a mistake without which rows that are outliers agree with the others.

    Parameters
    ----------
    prediction : Prediction
        Predictions of the T observations.
    fit : ParameterFit
        The fit without the outliers.
    outliers : (T, 2 + n) array of bool
        Outliers among the tips, the directions and the points.

    Returns
    -------
    str or None
        A message; None where there is no such mistake.
    """
    measured = prediction.measured
    rows = np.flatnonzero(np.delete(outliers, 1, axis=1).any(axis=1))
    seen = prediction.predict_values(fit.values)
    predicted = np.concatenate([seen.tip[:, None], seen.points], axis=1)
    apart = place_distances(predicted, places_of(measured))
    mistakes = (
        *_exchanged_points(measured, predicted, rows),
        *_exchanged_rows(measured, predicted, rows),
        *_rows_in_other_units(measured, rows),
    )
    for mistake in mistakes:
        corrected = prediction.with_measurements(mistake.measured).predict_values(fit.values).flat()
        still = find_outliers(flat_measured(mistake.measured) - corrected, fit.noise, int((~fit.fixed).sum()))
        if not np.delete(still, 1, axis=1)[mistake.rows].any():
            those = mistake.rows
            contradict = "contradicts" if len(those) == 1 else "contradict"
            return (
                f"{name_lines(measured, those)} of the measurements {contradict} the others, by "
                f"{float(np.nanmean(apart[those])):.3g} mm on average, and would not if "
                f"{mistake.words}. Correct the file"
            )
    return None


def _exchanged_points(measured: Measurements, predicted: Array, rows: Index) -> Iterator[_RowMistake]:
    """Yield exchanged points in some rows, all and each; predicted: (T, 1 + n, 3), mm, in the sensor's axes."""
    count = measured.sigma.shape[1]
    points = np.array(measured.points)
    changed = list[int]()
    for row in rows:
        cost = np.nansum((predicted[row, 1:, None] - measured.points[row][None]) ** 2, axis=2)
        order = linear_sum_assignment(cost)[1]
        if (order != np.arange(count)).any():
            points[row] = measured.points[row, order]
            changed.append(int(row))
    if changed:
        yield _RowMistake(
            "points were in another order there", replace(measured, points=points), np.array(changed)
        )
    for row in changed if len(changed) > 1 else []:
        one = np.array(measured.points)
        one[row] = points[row]
        yield _RowMistake("points were in another order there", replace(measured, points=one), np.array([row]))


def _exchanged_rows(measured: Measurements, predicted: Array, rows: Index) -> Iterator[_RowMistake]:
    """Yield an exchange among some rows, all at once and in pairs; predicted: (T, 1 + n, 3), mm."""
    if len(rows) < 2 or measured.has_times:
        return
    places = places_of(measured)
    costs = np.array(
        [np.nanmean(place_distances(predicted[[row] * len(rows)], places[rows]), axis=1) for row in rows]
    )
    order = np.arange(len(measured))
    order[rows] = rows[linear_sum_assignment(np.nan_to_num(costs, nan=1e9))[1]]
    changed = np.flatnonzero(order != np.arange(len(measured)))
    if not len(changed):
        return
    yield _exchange(measured, order, changed)
    for row in changed:
        if row < order[row] and order[order[row]] == row:
            pair = np.arange(len(measured))
            pair[[row, order[row]]] = order[row], row
            yield _exchange(measured, pair, np.array([row, order[row]]))


def _exchange(measured: Measurements, order: Index, changed: Index) -> _RowMistake:
    """Return the mistake that what was measured is in an order (T,), which differs from theirs in some rows."""
    repaired = repair_rows(measured, np.arange(len(measured)), order)
    return _RowMistake(row_order_words(measured, order), repaired, changed)


def _rows_in_other_units(measured: Measurements, rows: Index) -> Iterator[_RowMistake]:
    """Yield other units of what was measured in each of some rows, and in all of them."""
    for unit, factor in LENGTH_UNITS.items():
        for those in (rows, *(np.array([row]) for row in rows)) if len(rows) > 1 else (rows,):
            if not len(those):
                continue
            scale = np.ones(len(measured))
            scale[those] = factor
            tip, points = measured.tip * scale[:, None], measured.points * scale[:, None, None]
            changed = replace(measured, tip=tip, points=points)
            yield _RowMistake(f"what was measured there were in {unit}", changed, those)
