"""Curves x(u), a formula or a spline through points, by their arc length; radii along them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, PchipInterpolator, make_smoothing_spline

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.equal import Kept, Value
from ctr_nlp.support.packing import packable
from ctr_nlp.target.points import symbolic_point
from ctr_nlp.typing import Array

NAMES = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}
CODES = {name: code for code, name in NAMES.items()}
"""CasADi's operations by number, and their numbers."""
Step = tuple[str, float, tuple[int, ...], int]
"""An operation, its constant, the places that it reads, and the one that it writes: a coordinate for `output`."""


@packable("formula")
@dataclass(frozen=True, eq=False)
class Formula(Value):
    """x(u) in mm, step by step."""

    steps: tuple[Step, ...]

    @classmethod
    def of(cls, formula: Callable[[Any], tuple[Any, Any, Any]]) -> Formula:
        """That of a function written with CasADi's own; raises CurveError."""
        u = ca.SX.sym("u")
        function = ca.Function("x", [u], [ca.densify(symbolic_point(formula, u))])
        return cls(tuple(_step(function, k) for k in range(function.n_instructions())))

    @cached_property
    def _functions(self) -> tuple[ca.Function, ...]:
        """U to x and its first two derivatives."""
        u = ca.SX.sym("u")
        orders = [self._expression(u)]
        for _ in range(2):
            orders.append(ca.jacobian(orders[-1], u))
        return tuple(ca.Function(f"d{i}", [u], [ca.densify(each)]) for i, each in enumerate(orders))

    def _expression(self, u: ca.SX) -> ca.SX:
        places: dict[int, ca.SX] = {}
        x = [ca.SX(0)] * 3
        for name, constant, reads, writes in self.steps:
            if name == "output":
                x[writes] = places[reads[0]]
                continue
            read = [places[place] for place in reads]
            if name == "input":
                places[writes] = u
            elif name == "const":
                places[writes] = ca.SX(constant)
            else:
                places[writes] = (ca.SX.unary if len(read) == 1 else ca.SX.binary)(CODES[name], *read)
        return ca.vertcat(*x)

    def derivative(self, u: Array, order: int) -> Array:
        """x(u) (n, 3), or its first or second derivative, at u (n,)."""
        given, found = np.array(u, dtype=float), np.empty((len(u), 3))
        if len(u):  # a buffer saves the copies through CasADi's matrices, which take longer than most formulas
            buffer, evaluate = self._functions[order].map(len(u)).buffer()
            buffer.set_arg(0, given.data)  # type: ignore[call-arg]
            buffer.set_res(0, found.data)  # type: ignore[call-arg]
            evaluate()
        return found

    bending = derivative


def _step(function: ca.Function, k: int) -> Step:
    code, reads, writes = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
    name = NAMES.get(code, "")
    if name == "call" or not writes:
        raise CurveError("formula calls a function that is kept apart from it (never_inline); write it out")
    if name == "output":
        return name, 0.0, (reads[0],), writes[1]
    constant = function.instruction_constant(k) if name == "const" else 0.0
    return name, constant, () if name == "input" else tuple(reads), writes[0]


@packable("spline")
@dataclass(frozen=True, eq=False)
class Spline(Kept):
    """The C2 cubic spline through points (n, 3) in mm at knots (n,).

    by_smoothing: its curvature comes from a smoothing spline, as curve_from_points says.
    """

    knots: Array
    points: Array
    by_smoothing: bool = False

    @cached_property
    def _through(self) -> CubicSpline:
        return CubicSpline(self.knots, self.points)

    @cached_property
    def _bending(self) -> CubicSpline:
        """What curvature is taken from: the spline through points, each first moved onto a smoothing spline.

        The smoothing spline itself has no curvature at its ends.
        """
        if not self.by_smoothing or len(self.points) < 5:
            return self._through
        try:
            each = [make_smoothing_spline(self.knots, coordinate) for coordinate in self.points.T]
            even = BSpline(each[0].t, np.column_stack([spline.c for spline in each]), each[0].k)
            return CubicSpline(self.knots, even(self.knots))
        except (ValueError, np.linalg.LinAlgError):
            return self._through

    def derivative(self, u: Array, order: int) -> Array:
        """x(u) (n, 3), or its first or second derivative, at u (n,)."""
        return np.asarray(self._through(u, nu=order))

    def bending(self, u: Array, order: int) -> Array:
        """The same of what curvature is taken from."""
        return np.asarray(self._bending(u, nu=order))


@packable("by arc length")
@dataclass(frozen=True, eq=False)
class ByArcLength(Kept):
    """x(u), with its derivatives of order 0 to 2, by arc length; breaks (n,) span u. Raises CurveError."""

    x: Formula | Spline
    breaks: Array

    @property
    def length(self) -> float:
        """Arc length in mm."""
        return float(self._table[0].x[-1])

    @cached_property
    def _table(self) -> tuple[CubicHermiteSpline, CubicHermiteSpline]:
        """From arc length to u, and back."""
        nodes, weights = np.polynomial.legendre.leggauss(5)
        breaks, width = self.breaks, np.diff(self.breaks)
        u = (breaks[:-1, None] + width[:, None] * (nodes + 1) / 2).ravel()
        speeds = np.linalg.norm(self.x.derivative(u, 1), axis=1).reshape(len(width), -1)
        s = np.concatenate([[0.0], np.cumsum(speeds @ weights * width / 2)])
        at_breaks = np.linalg.norm(self.x.derivative(breaks, 1), axis=1)
        if not np.isfinite([s[-1], *at_breaks]).all() or (at_breaks <= 0).any() or (np.diff(s) <= 0).any():
            raise CurveError("the curve stands still or leaves the finite numbers somewhere in its range")
        return CubicHermiteSpline(s, breaks, 1 / at_breaks), CubicHermiteSpline(breaks, s, at_breaks)

    def _at(self, s: Array) -> Array:
        to_parameter = self._table[0]
        return np.clip(to_parameter(np.clip(s, 0, to_parameter.x[-1])), self.breaks[0], self.breaks[-1])

    def point(self, s: Array) -> Array:
        """(n, 3) mm."""
        return self.x.derivative(self._at(s), 0)

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        first = self.x.derivative(self._at(s), 1)
        return np.asarray(first / np.linalg.norm(first, axis=1, keepdims=True))

    def curvature(self, s: Array) -> Array:
        """(n,) 1/mm."""
        first, second = (self.x.bending(self._at(s), order) for order in (1, 2))
        return np.asarray(np.linalg.norm(np.cross(first, second), axis=1) / np.linalg.norm(first, axis=1) ** 3)

    def by_parameter(self, fraction: float) -> float:
        """Arc length in mm at a fraction of the range of u."""
        return float(self._table[1](self.breaks[0] + fraction * (self.breaks[-1] - self.breaks[0])))


@packable("radii")
@dataclass(frozen=True, eq=False)
class Radii(Kept):
    """Radii (n,) in mm at arc lengths (n,) mm."""

    lengths: Array
    radii: Array

    @cached_property
    def _between(self) -> PchipInterpolator:
        return PchipInterpolator(self.lengths, self.radii)

    def at(self, s: Array) -> Array:
        """(n,) mm, between the given ones within their range."""
        return np.asarray(self._between(np.clip(s, self.lengths[0], self.lengths[-1])))
