"""A nonlinear program as symbols, names and bounds; nothing here knows a solver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Residual:
    """A least-squares term: the objective gains |value|^2."""

    name: str
    value: ca.SX
    """(n, 1), in mm: weights have been applied."""


@dataclass(frozen=True)
class Cost:
    """A term without residual form: the objective gains value, in mm^2."""

    name: str
    value: ca.SX


@dataclass(frozen=True)
class Constraint:
    """lower <= value <= upper, entry by entry."""

    name: str
    value: ca.SX
    lower: Array
    upper: Array


@dataclass(frozen=True)
class Inner:
    """Quantities between x and the residuals, which are written in their symbols.

    Where residuals are simple in a few quantities and these depend on few x each, as points that are sums of
    lengths times directions, derivatives taken in two steps need a third fewer operations.
    """

    symbols: tuple[ca.SX, ...] = ()
    values: tuple[ca.SX, ...] = ()

    @classmethod
    def of(cls, values: Sequence[ca.SX]) -> Inner:
        """Values with a symbol of the same shape for each."""
        dense = tuple(ca.densify(value) for value in values)
        return cls(tuple(ca.SX.sym("inner", *value.shape) for value in dense), dense)

    @property
    def columns(self) -> tuple[ca.SX, ca.SX]:
        """All symbols, and all values, in one column."""
        symbols, values = ([ca.vec(each) for each in part] for part in (self.symbols, self.values))
        return ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *values)


class FrameFunctions(NamedTuple):
    """What a solver of many frames evaluates, as symbols or compiled.

    value: (x, p) -> (objective, g). slopes: (x, p) -> (objective, its gradient, g, the dense Jacobian of g).
    expansion: (x, p, lam_f, lam_g) -> slopes and the dense exact Hessian of lam_f objective + lam_g g.
    lanes: for how many frames at once, side by side as `map` lays them out.
    """

    value: ca.Function
    slopes: ca.Function
    expansion: ca.Function
    lanes: int = 1


@dataclass(frozen=True)
class Nlp:
    """Minimise sum |residual|^2 + sum cost over x, subject to constraints and bounds.

    x (n, 1); lower, upper (n,), which a caller may tighten from solve to solve; parameters by name.
    """

    name: str
    x: ca.SX
    lower: Array
    upper: Array
    parameters: Mapping[str, ca.SX]
    residuals: tuple[Residual, ...] = ()
    costs: tuple[Cost, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    inner: Inner = Inner()

    @cached_property
    def p(self) -> ca.SX:
        """All parameters in one column."""
        return ca.vertcat(*(ca.vec(symbol) for symbol in self.parameters.values()))

    @cached_property
    def residual(self) -> ca.SX:
        """All residuals in one column."""
        return ca.substitute(self._outer, *self.inner.columns)

    @property
    def _outer(self) -> ca.SX:
        """The residuals as they are written."""
        return ca.vertcat(ca.SX(0, 1), *(term.value for term in self.residuals))

    @cached_property
    def objective(self) -> ca.SX:
        """The objective, mm^2."""
        return ca.sumsqr(self.residual) + sum((term.value for term in self.costs), ca.SX(0))

    @cached_property
    def g(self) -> ca.SX:
        """All constraint values in one column."""
        return ca.vertcat(*(constraint.value for constraint in self.constraints))

    @cached_property
    def g_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of g."""
        lower = [constraint.lower for constraint in self.constraints]
        upper = [constraint.upper for constraint in self.constraints]
        return np.concatenate([np.zeros(0), *lower]), np.concatenate([np.zeros(0), *upper])

    @cached_property
    def g_depends(self) -> npt.NDArray[np.bool_]:
        """Which x each entry of g may depend on, (m, n)."""
        pattern = ca.jacobian_sparsity(self.g, self.x)
        return np.asarray(ca.DM(pattern, 1).full() > 0)

    @cached_property
    def g_nonlinear(self) -> npt.NDArray[np.bool_]:
        """Which entries of g are not linear in x, (m,)."""
        return np.array(ca.which_depends(self.g, self.x, 2, True), dtype=bool)

    def pack(self, values: Mapping[str, Any]) -> Array:
        """Parameter values in one column (len(p),); every parameter must be given, in its own shape.

        CasADi would take a missing parameter for zeros and stretch a scalar. Raises ValueError.
        """
        if values.keys() != self.parameters.keys():
            raise ValueError(f"{self.name} takes parameters {sorted(self.parameters)}, not {sorted(values)}")
        columns = [np.zeros(0)]
        for name, symbol in self.parameters.items():
            value = np.asarray(values[name], dtype=float)
            shape = value.shape + (1,) * (2 - value.ndim)
            if shape != symbol.shape:
                raise ValueError(f"parameter {name} of {self.name} has shape {value.shape}, not {symbol.shape}")
            columns.append(value.ravel(order="F"))
        return np.concatenate(columns)

    @cached_property
    def functions(self) -> FrameFunctions:
        """Value and second-order expansion, for solvers that take many of these at once."""
        lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", self.g.numel())
        jacobian = ca.densify(ca.jacobian(self.g, self.x))
        gradient, hessian = self._derivatives(lam_f, lam_g)
        inputs, multipliers = [self.x, self.p], [lam_f, lam_g]
        value = [self.objective, ca.densify(self.g)]
        slopes = [self.objective, ca.densify(gradient), ca.densify(self.g), jacobian]
        return FrameFunctions(
            ca.Function("value", inputs, value, {"cse": True}),
            ca.Function("slopes", inputs, slopes, {"cse": True}),
            ca.Function("expansion", inputs + multipliers, [*slopes, ca.densify(hessian)], {"cse": True}),
        )

    def _derivatives(self, lam_f: ca.SX, lam_g: ca.SX) -> tuple[ca.SX, ca.SX]:
        """The objective's gradient, and the Hessian of lam_f objective + lam_g g.

        With residuals r(u) of u(x): 2 J'J + u_x' (sum 2 r r_uu) u_x + sum (2 r_u' r) u_xx, where J = r_u u_x.
        """
        symbols, values = self.inner.columns
        u, at = ca.vertcat(symbols, self.x), ca.vertcat(values, self.x)
        r, u_x = self._outer, ca.jacobian(at, self.x)
        r_u = ca.jacobian(r, u)
        slope, pull = r_u @ u_x, ca.densify(2 * r_u.T @ r)
        pushes, pulls = ca.SX.sym("pushes", r.numel()), ca.SX.sym("pulls", u.numel())
        r_uu, u_xx = ca.hessian(ca.dot(pushes, r), u)[0], ca.hessian(ca.dot(pulls, at), self.x)[0]
        half = ca.triu(2 * slope.T @ slope + u_x.T @ r_uu @ u_x + u_xx)
        (half,) = ca.substitute([half], [pushes, pulls], [ca.densify(2 * r), pull])
        half, pull = ca.substitute([half, pull], [symbols], [values])
        cost = sum((term.value for term in self.costs), ca.SX(0))
        rest = ca.hessian(lam_f * cost + ca.dot(lam_g, self.g), self.x)[0]
        return u_x.T @ pull + ca.gradient(cost, self.x), lam_f * ca.triu2symm(half) + rest

    @cached_property
    def kkt_function(self) -> ca.Function:
        """(x, p, lam_x, lam_g) -> (gradient of the Lagrangian, g)."""
        lam_x, lam_g = ca.SX.sym("lam_x", self.x.numel()), ca.SX.sym("lam_g", self.g.numel())
        gradient = ca.gradient(self.objective + ca.dot(lam_g, self.g), self.x) + lam_x
        return ca.Function("kkt", [self.x, self.p, lam_x, lam_g], [gradient, self.g], {"cse": True})


def kkt_residual(nlp: Nlp, x: Array, p: Array, lower: Array, upper: Array, lam_x: Array, lam_g: Array) -> float:
    """How far x is from a KKT point, computed from the problem alone and not from what a solver says.

    The largest of: stationarity (mm^2 per unit of x), infeasibility (units of x and g) and complementarity
    (mm^2). CasADi's sign: positive multipliers belong to upper bounds.
    """
    gradient, g = (value.full().ravel() for value in nlp.kkt_function(x, p, lam_x, lam_g))
    values, multipliers = np.concatenate([x, g]), np.concatenate([lam_x, lam_g])
    lows = np.concatenate([lower, nlp.g_bounds[0]])
    highs = np.concatenate([upper, nlp.g_bounds[1]])
    infeasible = np.maximum(np.maximum(lows - values, values - highs), 0.0)
    to_bound = np.where(multipliers > 0, highs, lows) - values
    slack = np.where(np.isfinite(to_bound), np.abs(to_bound), 1.0)
    residuals = np.abs(gradient), infeasible, np.abs(multipliers) * slack
    return float(max(part.max(initial=0.0) for part in residuals))
