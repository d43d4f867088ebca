"""Curves by arc length: from a formula, from points, cut and moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, PchipInterpolator, make_smoothing_spline

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.values import floats, number
from ctr_nlp.target.points import checked_points, checked_radii, symbolic_point
from ctr_nlp.target.smoothing import evened
from ctr_nlp.typing import Array

Field = Callable[[Array], Array]
Derivative = Callable[[Array, int], Array]

CELLS = 2000
"""Cells of the table between a curve's parameter and its arc length."""
SAMPLE_MM = 0.05
"""Places along a curve, at most so far apart, at which smoothing keeps its bound."""
MOST_SAMPLES = 50_000
RIGID = 1e-6
"""By how much the axes of a rigid transform may miss being perpendicular and of length 1."""
ROOM_SPENT = 0.5
"""How much of the lumen's radius smoothing may take at any place."""


@dataclass(frozen=True)
class Curve:
    """A curve in space by its arc length s in [0, length], in mm.

    point, tangent: (n,) -> (n, 3), mm and unit vectors. curvature: (n,) -> (n,), unsigned, 1/mm.
    radius: of the lumen, (n,) -> (n,) mm, or None. by_parameter: a fraction in [0, 1] of the range of the
    curve's own parameter -> arc length in mm; None where the parameter is arc length. deviation: how far
    smoothing moved the curve at most, in mm, and deviation_share, how much of the lumen's radius that is at most.
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
        number(
            CurveError,
            "length of a curve",
            self.length,
            lambda x: 0 < x < math.inf,
            "be a finite number > 0",
            " mm",
        )
        for name in ("point", "tangent", "curvature"):
            if not callable(getattr(self, name)):
                raise CurveError(
                    f"{name} of a curve is {getattr(self, name)!r:.80}; it must be a function of arc length"
                )

    def length_at(self, fraction: float) -> float:
        """Arc length in mm where the curve's own parameter has covered a fraction in [0, 1] of its range."""
        return self.length * fraction if self.by_parameter is None else self.by_parameter(fraction)

    def part(self, start: float, stop: float) -> Curve:
        """The piece from arc length start to stop, in mm, its own parameter being arc length."""
        for name, end in (("start", start), ("stop", stop)):
            number(CurveError, f"{name} of a piece", end, math.isfinite, "be a finite number of mm")
        if not 0 <= start < stop <= self.length:
            raise CurveError(f"piece [{start:g}, {stop:g}] mm of a curve: it must lie within [0, {self.length:g}]")
        return self._along(lambda s: s + start, stop - start)

    def reversed(self) -> Curve:
        """The same curve from its last point to its first."""
        turned = self._along(lambda s: self.length - s, self.length)
        return replace(turned, tangent=lambda s: -self.tangent(self.length - s))

    def _along(self, at: Field, length: float) -> Curve:
        radius = self.radius
        return Curve(
            length,
            lambda s: self.point(at(s)),
            lambda s: self.tangent(at(s)),
            lambda s: self.curvature(at(s)),
            None if radius is None else lambda s: radius(at(s)),
            deviation=self.deviation,
            deviation_share=self.deviation_share,
        )

    def moved(self, transform: Array) -> Curve:
        """The curve under a rigid transform (4, 4)."""
        rigid = floats(CurveError, "transform of a curve", transform, (4, 4))
        rotation, shift = rigid[:3, :3], rigid[:3, 3]
        if abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or (rigid[3] != [0, 0, 0, 1]).any():
            raise CurveError(
                f"transform of a curve is {rigid.tolist()}; it must be rigid: a turn and a shift in mm"
            )
        return replace(
            self,
            point=lambda s: self.point(s) @ rotation.T + shift,
            tangent=lambda s: self.tangent(s) @ rotation.T,
        )

    def smoothed(self, allowed: float) -> Curve:
        """The least bent curve within allowed mm, and within half of the lumen's radius, of this one.

        The bound holds everywhere, between given points too, so that the curve stays in the lumen. Its radius is
        that of the sphere around its own points inside the lumen's: what it was, less the way to there. 0 mm is
        the curve itself. Raises CurveError.
        """
        number(CurveError, "smoothing", allowed, lambda x: 0 <= x < math.inf, "be a finite number >= 0", " mm")
        if allowed == 0:
            return self
        spacing = max(min(SAMPLE_MM, allowed / 8), self.length / MOST_SAMPLES)
        s = np.linspace(0.0, self.length, max(16, int(np.ceil(self.length / spacing)) + 1))
        given, radius = self.point(s), None if self.radius is None else self.radius(s)
        bound = np.full(len(s), allowed) if radius is None else np.minimum(allowed, ROOM_SPENT * radius)
        points = evened(given, np.maximum(bound - s[1] / 2, bound / 2))
        away = np.linalg.norm(points - given, axis=1)
        spline = CubicSpline(s, points)
        curve = _by_arc_length(lambda v, order: spline(v, nu=order), s)
        found = replace(curve, by_parameter=None, deviation=float(away.max()))
        if radius is None:
            return found
        lengths = np.array([curve.length_at(fraction) for fraction in s / self.length])
        return replace(
            found, radius=_radius_along(lengths, radius - away), deviation_share=float((away / radius).max())
        )


def curve_from_formula(formula: Callable[[Any], tuple[Any, Any, Any]], start: float, stop: float) -> Curve:
    """The curve (x, y, z) = formula(u) in mm for u in [start, stop], written with CasADi's functions.

    Derivatives are exact; curvature follows from them. Raises CurveError.
    """
    for name, end in (("start", start), ("stop", stop)):
        number(CurveError, f"{name} of the parameter range", end, math.isfinite, "be a finite number")
    if not start < stop:
        raise CurveError(f"parameter range is [{start}, {stop}]; it must be finite and grow")
    u = ca.SX.sym("u")
    x = symbolic_point(formula, u)
    orders = [x, ca.jacobian(x, u)]
    orders.append(ca.jacobian(orders[1], u))
    functions = [ca.Function(f"d{i}", [u], [expression]) for i, expression in enumerate(orders)]
    breaks = np.linspace(start, stop, CELLS + 1)
    return _by_arc_length(lambda v, order: functions[order](v[None]).full().T, breaks)


def curve_from_points(points: npt.ArrayLike, radius: npt.ArrayLike | None = None, smoothing: float = 0.0) -> Curve:
    """The C2 cubic spline through points (n, 3) in mm, n >= 4; radius (n,) in mm where the lumen's is known.

    Only its curvature comes from a smoothing spline (by generalised cross-validation), since second derivatives
    magnify the rounding of coordinates. smoothing: how far the curve may keep from that spline, mm; see
    Curve.smoothed. Raises CurveError.
    """
    given = checked_points(points)
    radii = None if radius is None else checked_radii(radius, len(given))
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(given, axis=0), axis=1))])
    spline = CubicSpline(chord, given)
    bending = cache(lambda: _bending(chord, given, spline))
    per_span = max(1, CELLS // (len(chord) - 1))
    breaks = np.interp(np.arange(per_span * (len(chord) - 1) + 1) / per_span, np.arange(len(chord)), chord)
    by_chord = _by_arc_length(
        lambda v, order: spline(v, nu=order), breaks, lambda v, order: bending()(v, nu=order)
    )
    curve = replace(by_chord, by_parameter=None)
    if radii is not None:
        lengths = np.array([by_chord.length_at(c / chord[-1]) for c in chord])
        curve = replace(curve, radius=_radius_along(lengths, radii))
    return curve.smoothed(smoothing)


def _radius_along(lengths: Array, radii: Array) -> Field:
    """Radii (n,) at arc lengths (n,), and between them within their range."""
    between = PchipInterpolator(lengths, radii)
    return lambda s: np.asarray(between(np.clip(s, lengths[0], lengths[-1])))


def _smoothing_spline(chord: Array, points: Array) -> BSpline:
    """Cubic smoothing splines of the coordinates as one, by generalised cross-validation."""
    each = [make_smoothing_spline(chord, coordinate) for coordinate in points.T]
    return BSpline(each[0].t, np.column_stack([spline.c for spline in each]), each[0].k)


def _bending(chord: Array, points: Array, through: Any) -> Any:
    """What curvature is taken from: the spline through points, each first moved onto a smoothing spline.

    The smoothing spline itself has no curvature at its ends.
    """
    if len(points) < 5:
        return through
    try:
        return CubicSpline(chord, _smoothing_spline(chord, points)(chord))
    except (ValueError, np.linalg.LinAlgError):
        return through


def _by_arc_length(derivative: Derivative, breaks: Array, bending: Derivative | None = None) -> Curve:
    """Reparametrise x(u), given with its derivatives of order 0 to 2, by arc length; breaks (n,) span u.

    Curvature comes from bending, where given, instead of x itself.
    """
    nodes, weights = np.polynomial.legendre.leggauss(5)
    width = np.diff(breaks)
    u = (breaks[:-1, None] + width[:, None] * (nodes + 1) / 2).ravel()
    speeds = np.linalg.norm(derivative(u, 1), axis=1).reshape(len(width), -1)
    s = np.concatenate([[0.0], np.cumsum(speeds @ weights * width / 2)])
    at_breaks = np.linalg.norm(derivative(breaks, 1), axis=1)
    if not np.isfinite([s[-1], *at_breaks]).all() or (at_breaks <= 0).any() or (np.diff(s) <= 0).any():
        raise CurveError("the curve stands still or leaves the finite numbers somewhere in its range")
    bent = bending or derivative
    to_parameter = CubicHermiteSpline(s, breaks, 1 / at_breaks)
    to_length = CubicHermiteSpline(breaks, s, at_breaks)

    def at(arc_length: Array) -> Array:
        return np.clip(to_parameter(np.clip(arc_length, 0, s[-1])), breaks[0], breaks[-1])

    def tangent(arc_length: Array) -> Array:
        first = derivative(at(arc_length), 1)
        return first / np.linalg.norm(first, axis=1, keepdims=True)

    def curvature(arc_length: Array) -> Array:
        first, second = (bent(at(arc_length), order) for order in (1, 2))
        return np.linalg.norm(np.cross(first, second), axis=1) / np.linalg.norm(first, axis=1) ** 3

    return Curve(
        float(s[-1]),
        lambda arc_length: derivative(at(arc_length), 0),
        tangent,
        curvature,
        by_parameter=lambda fraction: float(to_length(breaks[0] + fraction * (breaks[-1] - breaks[0]))),
    )
