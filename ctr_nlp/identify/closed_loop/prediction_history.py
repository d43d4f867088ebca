"""What was predicted of measurements a short while ago, for readings that come late."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.typing import Array

PREDICTION_MEMORY_S = 1.0
"""s for which what was predicted is remembered, for readings that come late."""


class PastPrediction(NamedTuple):
    """A prediction at a time, s: values (m,), their slopes (m, k) over differences, and the mean (k,) they were
    made with.
    """

    time: float
    values: Array
    slopes: Array
    mean: Array


class PredictionHistory:
    """Records of the last PREDICTION_MEMORY_S s, as a value: adding one makes another."""

    def __init__(self, records: tuple[PastPrediction, ...] = ()) -> None:
        self._records = records

    def with_prediction(self, record: PastPrediction) -> PredictionHistory:
        """With a later record."""
        return PredictionHistory(
            (*(old for old in self._records if old.time > record.time - PREDICTION_MEMORY_S), record)
        )

    def _after(self, time: float) -> int:
        """The first record that is not before a time, or the last."""
        later = (k for k, each in enumerate(self._records) if each.time >= time - 1e-9)
        return next(later, len(self._records) - 1)

    def expected_reading(self, time: float, mean: Array) -> tuple[Array, Array]:
        """Return the values (m,) predicted for a time, s, and their slopes (m, k), by a mean (k,) known now.

        Between two records values and slopes are interpolated.
        """
        after = self._after(time)
        ends = [self._records[after]]
        part = 1.0
        if after and time < ends[0].time - 1e-9:
            ends.insert(0, self._records[after - 1])
            part = (time - ends[0].time) / (ends[1].time - ends[0].time)
        # To first order in how the estimate has changed since: what was predicted then need not be computed again.
        values = [each.values + each.slopes @ (mean - each.mean) for each in ends]
        if len(ends) == 1:
            return values[0], ends[0].slopes
        slopes = ends[0].slopes + part * (ends[1].slopes - ends[0].slopes)
        return values[0] + part * (values[1] - values[0]), slopes

    def rates(self, time: float) -> Array:
        """At which values (m,) change at a time, per s; 0 where that is not known."""
        after = self._after(time)
        if after == 0:
            return np.zeros_like(self._records[0].values)
        before, now = self._records[after - 1 : after + 1]
        return (now.values - before.values) / (now.time - before.time)
