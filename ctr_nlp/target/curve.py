"""Curves by arc length: from a formula, from points, cut and moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.equal import Kept, Value
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import floats, number
from ctr_nlp.target.arc_length import ByArcLength, Formula, Radii, Spline
from ctr_nlp.target.points import checked_points, checked_radii, evened, walked
from ctr_nlp.typing import Array, Field

CELLS = 2000
"""Cells of the table between a curve's parameter and its arc length."""
SAMPLE_MM = 0.05
"""Places along a curve, at most so far apart, at which smoothing keeps its bound."""
MOST_SAMPLES = 50_000
RIGID = 1e-6
"""By how much the axes of a rigid transform may miss being perpendicular and of length 1."""
FINER = 8
"""Places in each cell of a smoothed curve at which it is measured how far it was moved."""
ROOM_SPENT = 0.5
"""How much of the lumen's radius smoothing may take at any place."""


@packable("curve")
@dataclass(frozen=True, eq=False, repr=False)
class Curve(Value):
    """A curve in space by its arc length s in [0, length], in mm.

    point, tangent: (n,) -> (n, 3), mm and unit vectors. curvature: (n,) -> (n,), unsigned, 1/mm.
    radius: of the lumen, (n,) -> (n,) mm, or None. by_parameter: a fraction in [0, 1] of the range of the
    curve's own parameter -> arc length in mm; None where the parameter is arc length. deviation: how far
    smoothing moved the curve at most, in mm, and deviation_share, how much of the lumen's radius that is at most.

    Curves are equal where all of this is. Those made by this library can be pickled; where functions are a user's
    own they must be fit for it.
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
        what, allowed = "length of a curve", "be a finite number > 0"
        number(CurveError, what, self.length, lambda x: 0 < x < math.inf, allowed, " mm")
        for name in ("point", "tangent", "curvature"):
            if not callable(given := getattr(self, name)):
                raise CurveError(f"{name} of a curve is {given!r:.80}; it must be a function of arc length")

    def __repr__(self) -> str:
        walled = ", within a lumen" if self.radius else ""
        smoothed = f", smoothed by {self.deviation:.2g} mm" if self.deviation else ""
        return f"Curve({self.length:.2f} mm{walled}{smoothed})"

    def length_at(self, fraction: float) -> float:
        """Arc length in mm where the curve's own parameter has covered a fraction in [0, 1] of its range."""
        return self.length * fraction if self.by_parameter is None else self.by_parameter(fraction)

    def part(self, start: float, stop: float) -> Curve:
        """The piece from arc length start to stop, in mm, its own parameter being arc length."""
        for name, end in (("start", start), ("stop", stop)):
            number(CurveError, f"{name} of a piece", end, math.isfinite, "be a finite number of mm")
        if not 0 <= start < stop <= self.length:
            raise CurveError(
                f"start and stop of a piece of a curve are {start:g} and {stop:g} mm; "
                f"they must grow and lie within [0, {self.length:g}]"
            )
        return self._through(Piece(self, start, 1.0), stop - start)

    def reversed(self) -> Curve:
        """The same curve from its last point to its first."""
        return self._through(Piece(self, self.length, -1.0), self.length)

    def _through(self, piece: Piece, length: float) -> Curve:
        radius = None if self.radius is None else piece.radius
        smoothed = self.deviation, self.deviation_share
        return Curve(length, piece.point, piece.tangent, piece.curvature, radius, None, *smoothed)

    def moved(self, transform: Array) -> Curve:
        """The curve under a rigid transform (4, 4)."""
        rigid = floats(CurveError, "transform of a curve", transform, (4, 4))
        rotation = rigid[:3, :3]
        if abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or (rigid[3] != [0, 0, 0, 1]).any():
            raise CurveError(
                f"transform of a curve is {rigid.tolist()}; it must be rigid: a turn and a shift in mm"
            )
        elsewhere = Moved(self, rigid)
        return replace(self, point=elsewhere.point, tangent=elsewhere.tangent)

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
        spline = Spline(s, points)
        between = np.linspace(0.0, self.length, FINER * (len(s) - 1) + 1)
        moved = np.linalg.norm(spline.derivative(between, 0) - self.point(between), axis=1)
        curve = _by_arc_length(spline, s)
        found = replace(curve, by_parameter=None, deviation=float(moved.max()))
        if radius is None:
            return found
        lengths = np.array([curve.length_at(fraction) for fraction in s / self.length])
        return replace(
            found, radius=Radii(lengths, radius - away).at, deviation_share=float((away / radius).max())
        )


@packable("piece")
@dataclass(frozen=True, eq=False)
class Piece(Value):
    """A curve from arc length start on, in mm; direction: 1 along it, -1 back towards its first point."""

    curve: Curve
    start: float
    direction: float

    def at(self, s: Array) -> Array:
        """The curve's arc length, (n,) mm."""
        return self.start + self.direction * s

    def point(self, s: Array) -> Array:
        """(n, 3) mm."""
        return self.curve.point(self.at(s))

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        return self.direction * self.curve.tangent(self.at(s))

    def curvature(self, s: Array) -> Array:
        """(n,) 1/mm."""
        return self.curve.curvature(self.at(s))

    def radius(self, s: Array) -> Array:
        """Of the lumen, (n,) mm, where the curve knows it."""
        assert self.curve.radius is not None
        return self.curve.radius(self.at(s))


@packable("moved")
@dataclass(frozen=True, eq=False)
class Moved(Kept):
    """A curve under a rigid transform (4, 4)."""

    curve: Curve
    transform: Array

    def point(self, s: Array) -> Array:
        """(n, 3) mm."""
        return np.asarray(self.curve.point(s) @ self.transform[:3, :3].T + self.transform[:3, 3])

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        return np.asarray(self.curve.tangent(s) @ self.transform[:3, :3].T)


def curve_from_formula(formula: Callable[[Any], tuple[Any, Any, Any]], start: float, stop: float) -> Curve:
    """The curve (x, y, z) = formula(u) in mm for u in [start, stop], written with CasADi's functions.

    Derivatives are exact; curvature follows from them. Raises CurveError.
    """
    for name, end in (("start", start), ("stop", stop)):
        number(CurveError, f"{name} of the parameter range", end, math.isfinite, "be a finite number")
    if not start < stop:
        raise CurveError(f"parameter range is [{start}, {stop}]; it must be finite and grow")
    return _by_arc_length(Formula.of(formula), np.linspace(start, stop, CELLS + 1))


def curve_from_points(points: npt.ArrayLike, radius: npt.ArrayLike | None = None, smoothing: float = 0.0) -> Curve:
    """The C2 cubic spline through points (n, 3) in mm, n >= 4; radius (n,) in mm where the lumen's is known.

    Only its curvature comes from a smoothing spline (by generalised cross-validation), since second derivatives
    magnify the rounding of coordinates. smoothing: how far the curve may keep from that spline, mm; see
    Curve.smoothed. Raises CurveError.
    """
    given = checked_points(points)
    radii = None if radius is None else checked_radii(radius, len(given))
    chord = walked(given)
    per_span = max(1, CELLS // (len(chord) - 1))
    breaks = np.interp(np.arange(per_span * (len(chord) - 1) + 1) / per_span, np.arange(len(chord)), chord)
    by_chord = _by_arc_length(Spline(chord, given, by_smoothing=True), breaks)
    curve = replace(by_chord, by_parameter=None)
    if radii is not None:
        lengths = np.array([by_chord.length_at(c / chord[-1]) for c in chord])
        curve = replace(curve, radius=Radii(lengths, radii).at)
    return curve.smoothed(smoothing)


def _by_arc_length(x: Formula | Spline, breaks: Array) -> Curve:
    """The curve x(u) whose own parameter is u; breaks (n,) span its range."""
    found = ByArcLength(x, breaks)
    return Curve(found.length, found.point, found.tangent, found.curvature, by_parameter=found.by_parameter)
