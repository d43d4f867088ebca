"""Curves x(u), a formula or a spline through points, reparameterised by arc length s; lumen radii along them.

Targets are compared with the robot at equal normalised arc length sigma, eq. (8), and most formulas do not have
the arc length as parameter. s(u) is the integral of |x'|, by Gauss-Legendre quadrature; u(s) and s(u) are then
cubic Hermite interpolants with the exact slopes du/ds = 1 / |x'| and ds/du = |x'|. Curvature is |x' x x''| /
|x'|^3, whatever the parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, PchipInterpolator, make_smoothing_spline

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.points import symbolic_point
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_objects import ReadOnlyValue, Value
from ctr_nlp.typing import Array

CASADI_OPERATION_NAMES = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}
"""Names of CasADi's operations by their codes."""
CASADI_OPERATION_CODES = {name: code for code, name in CASADI_OPERATION_NAMES.items()}
"""Codes of CasADi's operations by their names."""
Step = tuple[str, float, tuple[int, ...], int]
"""One operation: name, constant, slots of the work vector that it reads, and the slot that it writes; for `output`
the number of the coordinate.
"""


@packable("formula")
@dataclass(frozen=True, eq=False)
class Formula(Value):
    """A curve x(u) in mm as a list of operations, which can be saved and compared, unlike a Python function.

    Attributes
    ----------
    steps : tuple of Step
        Operations, in order.
    """

    steps: tuple[Step, ...]

    @classmethod
    def of(cls, formula: Callable[[Any], tuple[Any, Any, Any]]) -> Formula:
        """Record the operations of a function.

        Parameters
        ----------
        formula : callable
            Maps u to x, y, z in mm, with CasADi's functions.

        Returns
        -------
        Formula
            Its operations.

        Raises
        ------
        CurveError
            The function cannot be evaluated for a symbol, or does not give three finite coordinates.
        """
        u = ca.SX.sym("u")
        function = ca.Function("x", [u], [ca.densify(symbolic_point(formula, u))])
        return cls(tuple(_step(function, k) for k in range(function.n_instructions())))

    @cached_property
    def _functions(self) -> tuple[ca.Function, ...]:
        """CasADi functions from u to x(u) and to its first and second derivative, by automatic differentiation."""
        u = ca.SX.sym("u")
        orders = [self._expression(u)]
        for _ in range(2):
            orders.append(ca.jacobian(orders[-1], u))
        return tuple(ca.Function(f"d{i}", [u], [ca.densify(each)]) for i, each in enumerate(orders))

    def _expression(self, u: ca.SX) -> ca.SX:
        """Return x(u) (3, 1) as an expression, by replaying the operations on the symbol u."""
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
                places[writes] = (ca.SX.unary if len(read) == 1 else ca.SX.binary)(
                    CASADI_OPERATION_CODES[name], *read
                )
        return ca.vertcat(*x)

    def derivative(self, u: Array, order: int) -> Array:
        """Evaluate the curve or one of its derivatives.

        Parameters
        ----------
        u : ndarray
            Values (n,) of the parameter.
        order : int
            0 for x(u), 1 and 2 for its derivatives.

        Returns
        -------
        ndarray
            (n, 3), mm per unit of u to the power of the order.
        """
        given = np.array(u, dtype=float)
        found = np.empty((len(u), 3))
        if len(u):  # a buffer saves the copies through CasADi's matrices, which take longer than most formulas
            buffer, evaluate = self._functions[order].map(len(u)).buffer()
            buffer.set_arg(0, given.data)  # type: ignore[call-arg]
            buffer.set_res(0, found.data)  # type: ignore[call-arg]
            evaluate()
        return found

    bending = derivative


def _step(function: ca.Function, k: int) -> Step:
    """Return the k-th operation of a CasADi function; raise CurveError where it calls another function."""
    code = function.instruction_id(k)
    reads = function.instruction_input(k)
    writes = function.instruction_output(k)
    name = CASADI_OPERATION_NAMES.get(code, "")
    # A call refers to another CasADi function, which a list of operations cannot contain.
    if name == "call" or not writes:
        raise CurveError("formula calls a function that is kept apart from it (never_inline); write it out")
    if name == "output":
        return name, 0.0, (reads[0],), writes[1]
    constant = function.instruction_constant(k) if name == "const" else 0.0
    return name, constant, () if name == "input" else tuple(reads), writes[0]


@packable("spline")
@dataclass(frozen=True, eq=False)
class Spline(ReadOnlyValue):
    """C2 cubic spline through points.

    Attributes
    ----------
    knots : ndarray
        Values (n,) of the parameter, growing.
    points : ndarray
        Points (n, 3), mm.
    by_smoothing : bool
        Whether curvature comes from a smoothing spline near the points; see :func:`curve_from_points`.
    """

    knots: Array
    points: Array
    by_smoothing: bool = False

    @cached_property
    def _through(self) -> CubicSpline:
        """The spline through the points."""
        return CubicSpline(self.knots, self.points)

    @cached_property
    def _bending(self) -> CubicSpline:
        """The spline from which curvature is taken: through the points, each first moved onto a smoothing spline.

        The smoothing spline itself is natural, so that its curvature is 0 at its ends, where that of the path is
        not.
        """
        # make_smoothing_spline needs five points.
        if not self.by_smoothing or len(self.points) < 5:
            return self._through
        try:
            each = [make_smoothing_spline(self.knots, coordinate) for coordinate in self.points.T]
            # The knots depend on the abscissae alone, so that the splines of all three coordinates have the same.
            even = BSpline(each[0].t, np.column_stack([spline.c for spline in each]), each[0].k)
            return CubicSpline(self.knots, even(self.knots))
        except (ValueError, np.linalg.LinAlgError):
            return self._through

    def derivative(self, u: Array, order: int) -> Array:
        """Evaluate the spline, or its derivative of the order 1 or 2, at u (n,): (n, 3), mm."""
        return np.asarray(self._through(u, nu=order))

    def bending(self, u: Array, order: int) -> Array:
        """Evaluate the spline from which curvature is taken, or its derivative of the order 1 or 2, at u (n,): (n,
        3).
        """
        return np.asarray(self._bending(u, nu=order))


@packable("by arc length")
@dataclass(frozen=True, eq=False)
class ByArcLength(ReadOnlyValue):
    """A curve x(u) by its arc length.

    Attributes
    ----------
    x : Formula or Spline
        The curve, with its derivatives of order 0 to 2.
    breaks : ndarray
        Values (n,) of u that span its range, ends included; cells of the tables of s(u) and u(s).
    """

    x: Formula | Spline
    breaks: Array

    @property
    def length(self) -> float:
        """Arc length in mm."""
        return float(self._table[0].x[-1])

    @cached_property
    def _table(self) -> tuple[CubicHermiteSpline, CubicHermiteSpline]:
        """Interpolants u(s) and s(u); raise CurveError where the curve stands still, so that u(s) does
        not exist.
        """
        # Five Gauss-Legendre nodes a cell: within a cell |x'| is smooth, since the knots of a spline are among the
        # breaks.
        nodes, weights = np.polynomial.legendre.leggauss(5)
        breaks = self.breaks
        width = np.diff(self.breaks)
        u = (breaks[:-1, None] + width[:, None] * (nodes + 1) / 2).ravel()
        speeds = np.linalg.norm(self.x.derivative(u, 1), axis=1).reshape(len(width), -1)
        # Gauss-Legendre nodes are on [-1, 1]: half the width of a cell is the scale of its integral.
        s = np.concatenate([[0.0], np.cumsum(speeds @ weights * width / 2)])
        at_breaks = np.linalg.norm(self.x.derivative(breaks, 1), axis=1)
        if not np.isfinite([s[-1], *at_breaks]).all() or (at_breaks <= 0).any() or (np.diff(s) <= 0).any():
            raise CurveError("the curve stands still or leaves the finite numbers somewhere in its range")
        return CubicHermiteSpline(s, breaks, 1 / at_breaks), CubicHermiteSpline(breaks, s, at_breaks)

    def _at(self, s: Array) -> Array:
        """Return the values of u at arc lengths s (n,), mm, clipped to the curve."""
        # Clipped on both sides: rounding may carry either table beyond its end.
        to_parameter = self._table[0]
        return np.clip(to_parameter(np.clip(s, 0, to_parameter.x[-1])), self.breaks[0], self.breaks[-1])

    def point(self, s: Array) -> Array:
        """Return the points (n, 3) at arc lengths s (n,), mm."""
        return self.x.derivative(self._at(s), 0)

    def tangent(self, s: Array) -> Array:
        """Return the unit tangents (n, 3) at arc lengths s (n,), mm."""
        first = self.x.derivative(self._at(s), 1)
        return np.asarray(first / np.linalg.norm(first, axis=1, keepdims=True))

    def curvature(self, s: Array) -> Array:
        """Return the curvature (n,), 1/mm and unsigned, at arc lengths s (n,), mm."""
        # |x' x x''| / |x'|^3 holds for any parameter, so that the smoothing spline need not have this one's arc
        # length.
        first, second = (self.x.bending(self._at(s), order) for order in (1, 2))
        return np.asarray(np.linalg.norm(np.cross(first, second), axis=1) / np.linalg.norm(first, axis=1) ** 3)

    def by_parameter(self, fraction: float) -> float:
        """Return the arc length in mm where u has covered `fraction`, in [0, 1], of its range."""
        return float(self._table[1](self.breaks[0] + fraction * (self.breaks[-1] - self.breaks[0])))


@packable("radii")
@dataclass(frozen=True, eq=False)
class Radii(ReadOnlyValue):
    """Radii of the lumen along a curve, interpolated without overshoot (PCHIP).

    Attributes
    ----------
    lengths : ndarray
        Arc lengths (n,), mm, growing.
    radii : ndarray
        Radii (n,) there, mm.
    """

    lengths: Array
    radii: Array

    @cached_property
    def _interpolant(self) -> PchipInterpolator:
        """The interpolant; monotone between given radii, so that no radius becomes smaller than the
        two beside it.
        """
        return PchipInterpolator(self.lengths, self.radii)

    def at(self, s: Array) -> Array:
        """Return the radii (n,) at arc lengths s (n,), both in mm; constant beyond the given range."""
        return np.asarray(self._interpolant(np.clip(s, self.lengths[0], self.lengths[-1])))
