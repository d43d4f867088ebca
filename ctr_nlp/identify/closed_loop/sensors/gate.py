"""Which values can be believed: those no further from what is expected than chance lets them be."""

from __future__ import annotations

import numpy as np

from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.typing import Array, Flags

GATE = {1: 10.83, 2: 13.82, 3: 16.27}
"""Squared distances, in standard deviations, that values which belong together exceed once in a thousand:
chi-square."""


def gate_values(sensors: Sensors, excess: Array, spread: Array) -> Flags:
    """Which values (m,) are taken: groups no further from what is expected than once in a thousand readings.

    excess (m,): by how much, NaN where one is missing; spread (m, m): the covariance expected of that.
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
    """How many groups were measured whole, and how many of these were not taken; excess (m,), taken (m,)."""
    whole = [np.isfinite(excess[rows]).all(axis=1) for rows in sensors.value_groups]
    left = [each & ~taken[rows[:, 0]] for each, rows in zip(whole, sensors.value_groups, strict=True)]
    return sum(int(each.sum()) for each in whole), sum(int(each.sum()) for each in left)
