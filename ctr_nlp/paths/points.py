"""Points of a centreline: checks, and smoothing within a bound (Whittaker's graduation)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.linalg import solveh_banded

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.value_checks import frozen
from ctr_nlp.typing import Array

LEAST_POINTS = 4
"""Least number of points of a centreline: fewer do not determine a cubic."""
SHORTEST_MM = 1.0
"""Shortest path, mm: a shorter one was almost surely written in metres."""
LONGEST_MM = 1e5
"""Longest path, mm: a longer one was hardly written in millimetres."""
FARTHEST_MM = 1e12
"""Largest coordinate, mm."""
LONGEST_S = 1e6
"""Longest motion, s."""
REPEATED_MM = 1e-6
"""Distance, mm, below which two neighbouring points are one point given twice."""


def checked_points(points: npt.ArrayLike) -> Array:
    """Check the points of a centreline.

    Parameters
    ----------
    points : array_like
        Points (n, 3), mm.

    Returns
    -------
    ndarray
        A read-only copy (n, 3).

    Raises
    ------
    CurveError
        They are no finite numbers of this shape, fewer than four, one is repeated, or the path is too short or too
        long to be in mm.
    """
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
    """Check that points (n, 3), mm, are finite and small enough to be squared; raise CurveError otherwise."""
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise CurveError(f"point {bad[0] + 1} is {points[bad[0]].tolist()}; coordinates must be finite")
    far = np.flatnonzero(np.abs(points).max(axis=1, initial=0.0) > FARTHEST_MM)
    if far.size:
        raise CurveError(
            f"point {far[0] + 1} is {points[far[0]].tolist()}; it must be within {FARTHEST_MM:g} mm of 0"
        )


def cumulative_arc_length(points: Array) -> Array:
    """Return the length of the polyline up to each of points (n, 3), from the first on: (n,), mm."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def checked_radii(radius: npt.ArrayLike, count: int) -> Array:
    """Check the radii of a lumen.

    Parameters
    ----------
    radius : array_like
        Radii (count,), mm.
    count : int
        Number of points of the path.

    Returns
    -------
    ndarray
        A read-only copy (count,).

    Raises
    ------
    CurveError
        They are not as many positive finite numbers.
    """
    try:
        radii = frozen(np.array(radius, dtype=float))
    except (TypeError, ValueError):
        radii = np.empty(0)
    if radii.shape != (count,) or not (np.isfinite(radii) & (radii > 0)).all():
        raise CurveError(f"lumen radii must be {count} positive finite numbers in mm, one a point")
    return radii


def symbolic_point(formula: Callable[[Any], tuple[Any, Any, Any]], u: ca.SX) -> ca.SX:
    """Evaluate a formula for a symbol.

    Parameters
    ----------
    formula : callable
        Maps u to (x, y, z) in mm.
    u : casadi.SX
        The symbol of its parameter.

    Returns
    -------
    casadi.SX
        The point (3, 1).

    Raises
    ------
    CurveError
        The formula cannot be evaluated for a symbol, or does not give three finite coordinates that depend on u
        alone.
    """
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


MIN_PENALTY_EXPONENT, MAX_PENALTY_EXPONENT = -4.0, 13.0
"""Powers of ten between which the penalty on bending is searched; beyond, double precision ends."""
PENALTY_BISECTIONS = 24
"""Bisections of that range."""


def smooth_points(points: Array, allowed: Array) -> Array:
    """Smooth a path as far as a bound on the displacement of each point allows.

    Minimises sum_k |(x_k - p_k) / a_k|^2 + penalty sum_k |x_{k-1} - 2 x_k + x_{k+1}|^2 (Whittaker, On a new method
    of graduation, Proceedings of the Edinburgh Mathematical Society 41, 1923; for close points a smoothing spline)
    at the largest penalty that satisfies |x_k - p_k| <= a_k, found by bisection.

    Parameters
    ----------
    points : ndarray
        Points p (n, 3), evenly spaced, mm.
    allowed : ndarray
        Bounds a (n,) on their displacements, mm.

    Returns
    -------
    ndarray
        Smoothed points x (n, 3), mm; the points themselves where no penalty satisfies the bounds.
    """
    # Scaled so that the largest weight is 1, and one range of penalties suits every bound.
    weight = (allowed.min() / allowed) ** 2
    best = points
    weakest = MIN_PENALTY_EXPONENT
    strongest = MAX_PENALTY_EXPONENT
    for _ in range(PENALTY_BISECTIONS):
        # Bisection over powers of ten, since the penalty ranges over many orders of magnitude.
        power = (weakest + strongest) / 2
        # On the whole, displacements grow with the penalty, from 0 towards those of a straight line, so that
        # bisection finds the largest one.
        step = _step(points, weight, 10.0**power)
        if (np.linalg.norm(step, axis=1) <= allowed).all():
            best = points + step
            weakest = power
        else:
            strongest = power
    return best


def _step(points: Array, weight: Array, penalty: float) -> Array:
    """Return the displacements (n, 3) of points (n, 3) that minimise the penalised sum, with weights (n,).

    With D the second differences they solve (W + penalty D^T D) step = -penalty D^T D points.
    """
    count = len(points)
    bend = np.diff(points, 2, axis=0)
    slope = np.zeros_like(points)
    # Upper bands of W + penalty D^T D, as solveh_banded stores them: row 2 the diagonal, rows 1 and 0 those above
    # it. D has rows (1, -2, 1), so that neighbours meet in products of -2 twice, but for the ends.
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
