"""Evening out a jagged path within a bound."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded

from ctr_nlp.typing import Array

WEAKEST, STRONGEST = -4.0, 13.0
"""Powers of ten between which the penalty on bending is looked for; beyond, double precision ends."""
HALVINGS = 24


def evened(points: Array, allowed: Array) -> Array:
    """The least bent path that keeps within allowed (n,) mm of points (n, 3), each of its own, evenly spaced.

    It minimises sum |(x - points) / allowed|^2 + penalty sum |x_{k-1} - 2 x_k + x_{k+1}|^2 (Whittaker 1923; a
    smoothing spline for close points) at the largest penalty that keeps the bound.
    """
    weight = (allowed.min() / allowed) ** 2
    best, weakest, strongest = points, WEAKEST, STRONGEST
    for _ in range(HALVINGS):
        power = (weakest + strongest) / 2
        step = _step(points, weight, 10.0**power)
        if (np.linalg.norm(step, axis=1) <= allowed).all():
            best, weakest = points + step, power
        else:
            strongest = power
    return best


def _step(points: Array, weight: Array, penalty: float) -> Array:
    """From points (n, 3) to the minimum at a penalty."""
    count, bend = len(points), np.diff(points, 2, axis=0)
    slope = np.zeros_like(points)
    bands = np.zeros((3, count))
    for k, factor in enumerate((1.0, -2.0, 1.0)):
        bands[2, k : count - 2 + k] += factor**2
        slope[k : count - 2 + k] += factor * bend
    bands[1, 1:-1] += -2.0
    bands[1, 2:] += -2.0
    bands[0, 2:] = 1.0
    bands *= penalty
    bands[2] += weight
    return np.asarray(solveh_banded(bands, -penalty * slope))
