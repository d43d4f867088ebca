"""A nonlinear program as symbols, names and bounds; nothing here knows a solver."""

from __future__ import annotations

from collections.abc import Mapping
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


class FrameFunctions(NamedTuple):
    """What a solver of many frames evaluates, as symbols or compiled.

    value: (x, p) -> (objective, g). slopes: (x, p) -> (objective, its gradient, g, the dense Jacobian of g).
    expansion: (x, p, lam_f, lam_g) -> slopes and the dense exact Hessian of lam_f objective + lam_g g.
    """

    value: ca.Function
    slopes: ca.Function
    expansion: ca.Function


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

    @cached_property
    def p(self) -> ca.SX:
        """All parameters in one column."""
        return ca.vertcat(*(ca.vec(symbol) for symbol in self.parameters.values()))

    @cached_property
    def residual(self) -> ca.SX:
        """All residuals in one column."""
        return ca.vertcat(*(term.value for term in self.residuals))

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
        hessian, _ = ca.hessian(lam_f * self.objective + ca.dot(lam_g, self.g), self.x)
        jacobian = ca.densify(ca.jacobian(self.g, self.x))
        gradient = ca.densify(ca.gradient(self.objective, self.x))
        inputs, multipliers = [self.x, self.p], [lam_f, lam_g]
        value = [self.objective, ca.densify(self.g)]
        slopes = [self.objective, gradient, ca.densify(self.g), jacobian]
        return FrameFunctions(
            ca.Function("value", inputs, value, {"cse": True}),
            ca.Function("slopes", inputs, slopes, {"cse": True}),
            ca.Function("expansion", inputs + multipliers, [*slopes, ca.densify(hessian)], {"cse": True}),
        )

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
