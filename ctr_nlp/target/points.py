"""Points that are to be a path: which of them no curve can lead through, and evening them out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.linalg import solveh_banded

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.values import frozen
from ctr_nlp.typing import Array

LEAST_POINTS = 4
SHORTEST_MM = 1.0
"""A path shorter than this was almost surely written in metres."""
LONGEST_MM = 1e5
"""Nor was a longer one written in millimetres."""
FARTHEST_MM = 1e12
"""Largest coordinate."""
LONGEST_S = 1e6
"""No motion takes longer."""
REPEATED_MM = 1e-6
"""Neighbouring points closer than this are one point given twice."""


def checked_points(points: npt.ArrayLike) -> Array:
    """A read-only copy of points (n, 3) in mm that a curve can lead through; raises CurveError."""
    try:
        given = np.asarray(points)
    except ValueError as error:
        raise CurveError(f"points are no array of numbers ({error}); a centreline is (n, 3) in mm") from error
    if given.dtype.kind not in "iuf":
        raise CurveError(f"points are no array of numbers but of {given.dtype}; a centreline is (n, 3) in mm")
    given = frozen(given.astype(float))
    if given.ndim != 2 or given.shape[1] != 3:
        raise CurveError(f"points have shape {given.shape}; a centreline is (n, 3)")
    if len(given) < LEAST_POINTS:
        raise CurveError(
            f"the number of points of a centreline is {len(given)}; it must be at least {LEAST_POINTS}"
        )
    check_coordinates(given)
    steps = np.linalg.norm(np.diff(given, axis=0), axis=1)
    if steps.sum() < SHORTEST_MM:
        raise CurveError(
            f"the path is {steps.sum():.3g} long; coordinates must be in millimetres, and these look like metres"
        )
    if steps.sum() > LONGEST_MM:
        raise CurveError(f"the path is {steps.sum():.3g} mm long; it must be at most {LONGEST_MM:g} mm")
    repeated = np.flatnonzero(steps < REPEATED_MM)
    if repeated.size:
        i = repeated[0]
        raise CurveError(f"points {i + 1} and {i + 2} are the same, {given[i].tolist()}; no point may be repeated")
    return given


def check_coordinates(points: Array) -> None:
    """Raise CurveError unless all coordinates of points (n, 3) in mm are finite, and such that can be squared."""
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise CurveError(f"point {bad[0] + 1} is {points[bad[0]].tolist()}; coordinates must be finite")
    far = np.flatnonzero(np.abs(points).max(axis=1, initial=0.0) > FARTHEST_MM)
    if far.size:
        raise CurveError(
            f"point {far[0] + 1} is {points[far[0]].tolist()}; it must be within {FARTHEST_MM:g} mm of 0"
        )


def walked(points: Array) -> Array:
    """Lengths (n,) of the straight lines from point to point, from the first of points (n, 3) on, mm."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def checked_radii(radius: npt.ArrayLike, count: int) -> Array:
    """A read-only copy of the lumen's radii (count,) in mm; raises CurveError."""
    try:
        radii = frozen(np.array(radius, dtype=float))
    except (TypeError, ValueError):
        radii = np.empty(0)
    if radii.shape != (count,) or not (np.isfinite(radii) & (radii > 0)).all():
        raise CurveError(f"lumen radii must be {count} positive finite numbers in mm, one a point")
    return radii


def symbolic_point(formula: Callable[[Any], tuple[Any, Any, Any]], u: ca.SX) -> ca.SX:
    """The point (3, 1) that a formula gives for a symbol; raises CurveError where it does not."""
    try:
        x = ca.vertcat(*(ca.SX(c) for c in formula(u)))
    except (TypeError, ValueError, NotImplementedError, RuntimeError, AttributeError) as error:
        raise CurveError(
            f"formula cannot be evaluated for a symbol of CasADi: {error}; write it with CasADi's "
            "functions, such as casadi.cos"
        ) from error
    if any(c.is_constant() and not c.is_regular() for c in ca.vertsplit(x)):
        raise CurveError(
            f"formula gives {x}, which is not finite; write it with CasADi's functions, as casadi.cos"
        )
    if x.shape != (3, 1) or not all(ca.is_equal(s, u) for s in ca.symvar(x)):
        raise CurveError(f"formula gives {x}; it must give three coordinates that depend on its argument alone")
    return x


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
