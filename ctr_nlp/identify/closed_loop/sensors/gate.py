"""Validation gate: values whose innovation is larger than chance allows are rejected.

The squared Mahalanobis distance e' S^-1 e of n normal innovations e with covariance S has the chi-square
distribution of n degrees of freedom (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001).
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.typing import Array, Flags

GATE = {1: 10.83, 2: 13.82, 3: 16.27}
"""99.9 % quantiles of the chi-square distribution, by the number of values in a group."""


def gate_values(sensors: Sensors, excess: Array, spread: Array) -> Flags:
    """Return the mask (m,) of the values that pass the gate, by groups.

    sensors: whose groups they are. excess: (m,), innovations, NaN where a value is missing. spread: (m, m), their
    expected covariance.
    """
    found = np.zeros(len(excess), dtype=bool)
    for rows in sensors.value_groups:
        away = excess[rows]
        known: Flags = np.asarray(np.isfinite(away).all(axis=1))
        there = np.where(known[:, None], away, 0.0)
        solved = np.linalg.solve(spread[rows[:, :, None], rows[:, None, :]], there[..., None])[..., 0]
        near: Flags = np.asarray((solved * there).sum(axis=1) <= GATE[rows.shape[1]])
        found[rows] = (known & near).reshape(-1, 1)
    return found


def count_groups(sensors: Sensors, excess: Array, taken: Flags) -> tuple[int, int]:
    """Return the number of complete groups, and of those that were rejected.

    sensors: whose groups they are. excess: (m,), innovations, NaN where missing. taken: (m,), accepted values.
    """
    whole = [np.isfinite(excess[rows]).all(axis=1) for rows in sensors.value_groups]
    left = [each & ~taken[rows[:, 0]] for each, rows in zip(whole, sensors.value_groups, strict=True)]
    return sum(int(each.sum()) for each in whole), sum(int(each.sum()) for each in left)
