"""Curves by arc length: from a formula, from points, cut, moved and smoothed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.arc_length import ByArcLength, Formula, Radii, Spline
from ctr_nlp.paths.points import checked_points, checked_radii, cumulative_arc_length, smooth_points
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import floats, number
from ctr_nlp.support.value_objects import ReadOnlyValue, Value
from ctr_nlp.typing import Array, Field

ARC_LENGTH_TABLE_CELLS = 2000
"""Cells of the table between a curve's parameter and its arc length."""
SAMPLE_MM = 0.05
"""Largest distance, mm, between samples at which smoothing satisfies its bound."""
MAX_SMOOTHING_SAMPLES = 50_000
"""Most samples of a curve that is smoothed; on longer curves they are further apart than SAMPLE_MM."""
RIGID_TRANSFORM_TOLERANCE = 1e-6
"""By how much the axes of a rigid transform may miss being orthonormal."""
DEVIATION_CHECK_SUBDIVISIONS = 8
"""Points between two samples of a smoothed curve at which its distance from the original curve is measured."""
MAX_SMOOTHING_RADIUS_SHARE = 0.5
"""Largest part of the lumen's radius by which smoothing may move the curve."""


@packable("curve")
@dataclass(frozen=True, eq=False, repr=False)
class Curve(Value):
    """A curve in space by its arc length s in [0, length].

    Curves are equal where all of their fields are. Those made by this library can be pickled; functions of a
    user's own must be picklable for that.

    Attributes
    ----------
    length : float
        Arc length, mm.
    point : callable
        Maps s (n,) in mm to points (n, 3) in mm.
    tangent : callable
        Maps s (n,) to unit tangents (n, 3).
    curvature : callable
        Maps s (n,) to the unsigned curvature (n,), 1/mm.
    radius : callable or None
        Maps s (n,) to the radius of the lumen (n,), mm; None where no lumen is known.
    by_parameter : callable or None
        Maps a fraction in [0, 1] of the range of the curve's own parameter to arc length in mm; None where the
        parameter is arc length.
    deviation : float
        By how much smoothing moved the curve at most, mm.
    deviation_share : float
        Largest ratio of this displacement to the lumen's radius.

    Raises
    ------
    CurveError
        The length is not positive and finite, or a field that must be a function is none.

    Examples
    --------
    >>> import casadi as ca
    >>> import numpy as np
    >>> import ctr_nlp as ctr
    >>> arc = ctr.curve_from_formula(lambda u: (0, 80 * (1 - ca.cos(u)), 80 * ca.sin(u)), 0, 1)
    >>> arc
    Curve(80.00 mm)
    >>> arc.curvature(np.array([0.0, 40.0]))
    array([0.0125, 0.0125])
    """

    length: float
    point: Field
    tangent: Field
    curvature: Field
    radius: Field | None = None
    by_parameter: Callable[[float], float] | None = None
    deviation: float = 0.0
    deviation_share: float = 0.0

    def __post_init__(self) -> None:
        what = "length of a curve"
        allowed = "be a finite number > 0"
        number(CurveError, what, self.length, lambda x: 0 < x < math.inf, allowed, " mm")
        for name in ("point", "tangent", "curvature"):
            if not callable(given := getattr(self, name)):
                raise CurveError(f"{name} of a curve is {given!r:.80}; it must be a function of arc length")

    def __repr__(self) -> str:
        walled = ", within a lumen" if self.radius else ""
        smoothed = f", smoothed by {self.deviation:.2g} mm" if self.deviation else ""
        return f"Curve({self.length:.2f} mm{walled}{smoothed})"

    def length_at(self, fraction: float) -> float:
        """Return the arc length where the curve's own parameter has covered a part of its range.

        Parameters
        ----------
        fraction : float
            Part of the range of the parameter, in [0, 1].

        Returns
        -------
        float
            Arc length from the first point, mm.
        """
        return self.length * fraction if self.by_parameter is None else self.by_parameter(fraction)

    def part(self, start: float, stop: float) -> Curve:
        """Cut a piece out of the curve.

        Parameters
        ----------
        start, stop : float
            Arc lengths of its ends, mm, with 0 <= start < stop <= length.

        Returns
        -------
        Curve
            The piece, with arc length as its parameter.

        Raises
        ------
        CurveError
            The ends are not finite or not in order along the curve.

        Examples
        --------
        >>> import ctr_nlp as ctr
        >>> line = ctr.curve_from_formula(lambda u: (0, 0, u), 0, 100)
        >>> line.part(20, 50)
        Curve(30.00 mm)
        """
        for name, end in (("start", start), ("stop", stop)):
            number(CurveError, f"{name} of a piece", end, math.isfinite, "be a finite number of mm")
        if not 0 <= start < stop <= self.length:
            raise CurveError(
                f"start and stop of a piece of a curve are {start:g} and {stop:g} mm; "
                f"they must grow and lie within [0, {self.length:g}]"
            )
        return self._curve_from_piece(Piece(self, start, 1.0), stop - start)

    def reverse_direction(self) -> Curve:
        """Return the curve that leads from the last point of this one to its first.

        Returns
        -------
        Curve
            The same points, lumen and deviation.
        """
        return self._curve_from_piece(Piece(self, self.length, -1.0), self.length)

    def _curve_from_piece(self, piece: Piece, length: float) -> Curve:
        """Return a piece of a given length in mm as a curve, with the lumen and the deviation of this one."""
        radius = None if self.radius is None else piece.radius
        smoothed = self.deviation, self.deviation_share
        return Curve(length, piece.point, piece.tangent, piece.curvature, radius, None, *smoothed)

    def apply_transform(self, transform: Array) -> Curve:
        """Move the curve by a rigid transform.

        Parameters
        ----------
        transform : array_like
            Homogeneous matrix (4, 4) of a rotation and a translation in mm.

        Returns
        -------
        Curve
            The moved curve; curvature and radii stay.

        Raises
        ------
        CurveError
            The matrix is not rigid.
        """
        rigid = floats(CurveError, "transform of a curve", transform, (4, 4))
        rotation = rigid[:3, :3]
        if (
            abs(rotation @ rotation.T - np.eye(3)).max() > RIGID_TRANSFORM_TOLERANCE
            or (rigid[3] != [0, 0, 0, 1]).any()
        ):
            raise CurveError(
                f"transform of a curve is {rigid.tolist()}; it must be rigid: a turn and a shift in mm"
            )
        # Orthonormal matrices with determinant -1 mirror: of patient coordinates, one axis was then taken the
        # wrong way.
        if np.linalg.det(rotation) < 0:
            raise CurveError(
                f"transform of a curve is {rigid.tolist()}, which mirrors; it must be a turn and a shift in mm. "
                "One of its axes points the other way"
            )
        elsewhere = TransformedCurve(self, rigid)
        return replace(self, point=elsewhere.point, tangent=elsewhere.tangent)

    def smooth(self, allowed: float) -> Curve:
        """Return the least bent curve within a distance of this one.

        The bound holds everywhere, between given points too, and is at most half of the lumen's radius, so that
        the curve stays in the lumen. The radius of the new curve is that of a sphere around its own points inside
        the old one: the old radius less the distance that the point was moved by.

        Parameters
        ----------
        allowed : float
            Largest distance from this curve, mm; 0 returns the curve itself.

        Returns
        -------
        Curve
            The smoothed curve, with its deviation.

        Raises
        ------
        CurveError
            `allowed` is negative or not finite.

        See Also
        --------
        ctr_nlp.paths.points.smooth_points : The penalised least squares problem that is solved.
        """
        number(CurveError, "smoothing", allowed, lambda x: 0 <= x < math.inf, "be a finite number >= 0", " mm")
        if allowed == 0:
            return self
        # With eight samples or more to a bound, the reserve below, half a spacing, is a small part of it.
        spacing = max(min(SAMPLE_MM, allowed / 8), self.length / MAX_SMOOTHING_SAMPLES)
        s = np.linspace(0.0, self.length, max(16, int(np.ceil(self.length / spacing)) + 1))
        given = self.point(s)
        radius = None if self.radius is None else self.radius(s)
        bound = (
            np.full(len(s), allowed)
            if radius is None
            else np.minimum(allowed, MAX_SMOOTHING_RADIUS_SHARE * radius)
        )
        # The bound is enforced at the samples only. Half of their spacing, at most half of the bound, is kept in
        # hand for what the curves differ by between them.
        points = smooth_points(given, np.maximum(bound - s[1] / 2, bound / 2))
        away = np.linalg.norm(points - given, axis=1)
        spline = Spline(s, points)
        between = np.linspace(0.0, self.length, DEVIATION_CHECK_SUBDIVISIONS * (len(s) - 1) + 1)
        moved = np.linalg.norm(spline.derivative(between, 0) - self.point(between), axis=1)
        curve = _by_arc_length(spline, s)
        # A smoothed path is followed by arc length: its own parameter is that of the samples.
        found = replace(curve, by_parameter=None, deviation=float(moved.max()))
        if radius is None:
            return found
        # A ball around a moved point lies in the old ball if its radius is smaller by the displacement.
        lengths = np.array([curve.length_at(fraction) for fraction in s / self.length])
        return replace(
            found, radius=Radii(lengths, radius - away).at, deviation_share=float((away / radius).max())
        )


@packable("piece")
@dataclass(frozen=True, eq=False)
class Piece(Value):
    """A piece of a curve, in either direction.

    Attributes
    ----------
    curve : Curve
        The whole curve.
    start : float
        Arc length of the piece's first point along it, mm.
    direction : float
        1 along the curve, -1 back towards its first point.
    """

    curve: Curve
    start: float
    direction: float

    def at(self, s: Array) -> Array:
        """Return the arc lengths (n,) along the whole curve at s (n,) along the piece, mm."""
        return self.start + self.direction * s

    def point(self, s: Array) -> Array:
        """Return the points (n, 3) at arc lengths s (n,) along the piece, mm."""
        return self.curve.point(self.at(s))

    def tangent(self, s: Array) -> Array:
        """Return the unit tangents (n, 3) at arc lengths s (n,), in the direction of the piece."""
        # Backwards along the curve the derivative by arc length changes its sign; curvature, unsigned, does not.
        return self.direction * self.curve.tangent(self.at(s))

    def curvature(self, s: Array) -> Array:
        """Return the curvature (n,), 1/mm, at arc lengths s (n,) along the piece."""
        return self.curve.curvature(self.at(s))

    def radius(self, s: Array) -> Array:
        """Return the radius of the lumen (n,), mm, at arc lengths s (n,), where the curve knows it."""
        assert self.curve.radius is not None
        return self.curve.radius(self.at(s))


@packable("moved")
@dataclass(frozen=True, eq=False)
class TransformedCurve(ReadOnlyValue):
    """A curve moved by a rigid transform.

    Attributes
    ----------
    curve : Curve
        The curve before.
    transform : ndarray
        Homogeneous matrix (4, 4), translation in mm.
    """

    curve: Curve
    transform: Array

    def point(self, s: Array) -> Array:
        """Return the moved points (n, 3) at arc lengths s (n,), mm."""
        return np.asarray(self.curve.point(s) @ self.transform[:3, :3].T + self.transform[:3, 3])

    def tangent(self, s: Array) -> Array:
        """Return the rotated unit tangents (n, 3) at arc lengths s (n,), mm."""
        return np.asarray(self.curve.tangent(s) @ self.transform[:3, :3].T)


def curve_from_formula(formula: Callable[[Any], tuple[Any, Any, Any]], start: float, stop: float) -> Curve:
    """Build a curve from a formula of its parameter.

    Parameters
    ----------
    formula : callable
        Maps u to (x, y, z) in mm, written with CasADi's functions, as ``casadi.cos``.
    start, stop : float
        Range of u.

    Returns
    -------
    Curve
        The curve by arc length. Derivatives, and the curvature from them, are exact.

    Raises
    ------
    CurveError
        The range is not finite or does not grow, the formula cannot be evaluated for a symbol, or the curve stands
        still somewhere.

    Examples
    --------
    >>> import casadi as ca
    >>> import ctr_nlp as ctr
    >>> ctr.curve_from_formula(lambda u: (5 * ca.cos(u), 5 * ca.sin(u), 10 * u), 0, 4)
    Curve(44.72 mm)
    """
    for name, end in (("start", start), ("stop", stop)):
        number(CurveError, f"{name} of the parameter range", end, math.isfinite, "be a finite number")
    if not start < stop:
        raise CurveError(f"parameter range is [{start}, {stop}]; it must be finite and grow")
    return _by_arc_length(Formula.of(formula), np.linspace(start, stop, ARC_LENGTH_TABLE_CELLS + 1))


def curve_from_points(points: npt.ArrayLike, radius: npt.ArrayLike | None = None, smoothing: float = 0.0) -> Curve:
    """Build a curve as the C2 cubic spline through points, by chord length.

    Parameters
    ----------
    points : array_like
        Points (n, 3) of a centreline, mm, n >= 4, none repeated.
    radius : array_like, optional
        Radius of the lumen (n,) at the points, mm, where it is known.
    smoothing : float
        How far the curve may be moved from the spline to be less bent, mm; see :meth:`Curve.smooth`.

    Returns
    -------
    Curve
        The curve by arc length. Its curvature comes from a smoothing spline near the points (generalised
        cross-validation), since second derivatives magnify the rounding of coordinates.

    Raises
    ------
    CurveError
        The points or radii are not finite numbers of these shapes, or the path is too short or too long to be in
        mm.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> ctr.curve_from_points([[0, 0, 0], [0, 1, 20], [0, 4, 40], [0, 9, 60]], radius=[3, 3, 3, 2.5])
    Curve(60.89 mm, within a lumen)
    """
    given = checked_points(points)
    radii = None if radius is None else checked_radii(radius, len(given))
    # Chord length is close to arc length, so that the spline has no loops where points are unevenly spaced.
    chord = cumulative_arc_length(given)
    per_span = max(1, ARC_LENGTH_TABLE_CELLS // (len(chord) - 1))
    # The same number of cells between all neighbouring points: knots of the spline are among the breaks, and
    # within a cell |x'| is smooth, as the quadrature needs it.
    breaks = np.interp(np.arange(per_span * (len(chord) - 1) + 1) / per_span, np.arange(len(chord)), chord)
    by_chord = _by_arc_length(Spline(chord, given, by_smoothing=True), breaks)
    curve = replace(by_chord, by_parameter=None)
    if radii is not None:
        # Radii belong to the points: they are interpolated over the arc length there, not over the chord length.
        lengths = np.array([by_chord.length_at(c / chord[-1]) for c in chord])
        curve = replace(curve, radius=Radii(lengths, radii).at)
    return curve.smooth(smoothing)


def _by_arc_length(x: Formula | Spline, breaks: Array) -> Curve:
    """Return the curve x(u) with u as its own parameter; `breaks` (n,) span the range of u."""
    found = ByArcLength(x, breaks)
    return Curve(found.length, found.point, found.tangent, found.curvature, by_parameter=found.by_parameter)
