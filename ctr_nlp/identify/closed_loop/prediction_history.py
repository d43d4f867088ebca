"""History of predicted measurements, for readings that arrive late."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.typing import Array

PREDICTION_MEMORY_S = 1.0
"""Time, s, for which predictions are kept."""


class PastPrediction(NamedTuple):
    """A prediction at a time, s: values (m,), slopes (m, k) over differences, and the mean (k,) at that time."""

    time: float
    values: Array
    slopes: Array
    mean: Array


class PredictionHistory:
    """Predictions of the last PREDICTION_MEMORY_S s; immutable, so that copies of an observer can share it."""

    def __init__(self, records: tuple[PastPrediction, ...] = ()) -> None:
        self._records = records

    def with_prediction(self, record: PastPrediction) -> PredictionHistory:
        """Return a history with a later record added, and old ones removed."""
        return PredictionHistory(
            (*(old for old in self._records if old.time > record.time - PREDICTION_MEMORY_S), record)
        )

    def _after(self, time: float) -> int:
        """Return the index of the first record that is not before a time, s, or of the last one."""
        later = (k for k, each in enumerate(self._records) if each.time >= time - 1e-9)
        return next(later, len(self._records) - 1)

    def expected_reading(self, time: float, mean: Array) -> tuple[Array, Array]:
        """Return the values (m,) predicted for a time, s, and their slopes (m, k), for the present mean (k,).

        Between two records values and slopes are interpolated.
        """
        after = self._after(time)
        ends = [self._records[after]]
        part = 1.0
        if after and time < ends[0].time - 1e-9:
            ends.insert(0, self._records[after - 1])
            part = (time - ends[0].time) / (ends[1].time - ends[0].time)
        # First order in the change of the estimate since then: the old equilibrium need not be computed again.
        values = [each.values + each.slopes @ (mean - each.mean) for each in ends]
        if len(ends) == 1:
            return values[0], ends[0].slopes
        slopes = ends[0].slopes + part * (ends[1].slopes - ends[0].slopes)
        return values[0] + part * (values[1] - values[0]), slopes

    def rates(self, time: float) -> Array:
        """Return the rates of change (m,) of values at a time, s, per s; 0 where unknown."""
        after = self._after(time)
        if after == 0:
            return np.zeros_like(self._records[0].values)
        before, now = self._records[after - 1 : after + 1]
        return (now.values - before.values) / (now.time - before.time)
