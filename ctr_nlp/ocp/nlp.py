"""The nonlinear program of one frame, as symbols, names and bounds; nothing here knows a solver.

    minimise  f(x) = sum |residual(x)|^2 + sum cost(x)     subject to  l <= (x, g(x)) <= u

with the unknowns x (rad and mm), the objective f in mm^2 and the constraints g. Eqs. (8), (9), (11) and (12) of
the paper become residuals and costs, eqs. (2) and (3) constraints and bounds. All numbers that change from frame
to frame or from robot to robot are parameters p, so that one program serves them all. Multipliers have CasADi's
sign: positive at upper bounds.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.models.inner import Inner
from ctr_nlp.ocp.expressions import FrameFunctions, ProgramExpressions
from ctr_nlp.typing import Array, Flags, Index


@dataclass(frozen=True)
class Residual:
    """A least-squares term: the objective gains |value|^2."""

    name: str
    value: ca.SX
    """(n, 1), in mm: weights have been applied."""


@dataclass(frozen=True)
class CostTerm:
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


@dataclass(frozen=True, eq=False)
class Nlp:
    """Minimise sum |residual|^2 + sum cost over x, subject to constraints and bounds.

    x: the unknowns (n, 1), within lower and upper (n,). The bounds of the configuration may be replaced for one
    solve, as by a robot's limits. parameters: symbols by name. inner: layers of quantities between x and the
    terms. picks: positions of the configuration's entries among x and then g; None where the configuration is x
    itself, without its slacks. slacks: number of x's last entries, which measure the violation of soft
    constraints.
    """

    name: str
    x: ca.SX
    lower: Array
    upper: Array
    parameters: Mapping[str, ca.SX]
    residuals: tuple[Residual, ...] = ()
    costs: tuple[CostTerm, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    inner: tuple[Inner, ...] = ()
    picks: tuple[int, ...] | None = None
    slacks: int = 0

    @cached_property
    def p(self) -> ca.SX:
        """All parameters in one column."""
        return ca.vertcat(*(ca.vec(symbol) for symbol in self.parameters.values()))

    @cached_property
    def expressions(self) -> ProgramExpressions:
        """The expressions of the program's terms, in the symbols of inner quantities."""
        residual, g = (
            ca.vertcat(ca.SX(0, 1), *(term.value for term in terms))
            for terms in (self.residuals, self.constraints)
        )
        cost = sum((term.value for term in self.costs), ca.SX(0))
        return ProgramExpressions(self.x, self.p, residual, cost, g, tuple(inner.columns for inner in self.inner))

    @property
    def residual(self) -> ca.SX:
        """All residuals in one column."""
        return self.expressions.terms_in_x[0]

    @cached_property
    def objective(self) -> ca.SX:
        """The objective, mm^2."""
        return ca.sumsqr(self.residual) + self.expressions.terms_in_x[1]

    @property
    def g(self) -> ca.SX:
        """All constraint values in one column."""
        return self.expressions.terms_in_x[2]

    @cached_property
    def g_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of g."""
        # The empty row in front keeps the type of a program without constraints.
        lower = [constraint.lower for constraint in self.constraints]
        upper = [constraint.upper for constraint in self.constraints]
        return np.concatenate([np.zeros(0), *lower]), np.concatenate([np.zeros(0), *upper])

    @cached_property
    def configuration(self) -> Index:
        """Positions of the configuration's entries among x's entries and then g's."""
        return np.arange(self.x.numel() - self.slacks) if self.picks is None else np.array(self.picks)

    @property
    def q(self) -> ca.SX:
        """The configuration (k, 1), in the symbols of inner quantities."""
        return ca.vertcat(self.x, self.expressions.g)[self.configuration.tolist()]

    def row_bounds(self, lower: Array | None = None, upper: Array | None = None) -> tuple[Array, Array]:
        """Return lower and upper bounds of x and then g, (n + m,).

        lower, upper (k,): bounds of the configuration, which replace the program's own. The configuration may lie
        in g: on the elastic model alpha is a function of x, and a limit of a motor is a constraint.
        """
        rows = [np.concatenate(pair) for pair in zip((self.lower, self.upper), self.g_bounds, strict=True)]
        for row, given in zip(rows, (lower, upper), strict=True):
            if given is not None:
                row[self.configuration] = given
        return rows[0], rows[1]

    @cached_property
    def g_depends(self) -> Flags:
        """Whether each entry of g may depend on each entry of x, (m, n), by structure."""
        pattern = ca.jacobian_sparsity(self.g, self.x)
        return np.asarray(ca.DM(pattern, 1).full() > 0)

    @cached_property
    def g_nonlinear(self) -> Flags:
        """Whether each entry of g is nonlinear in x, (m,)."""
        # Order 2 asks for nonlinear dependence; True asks for the entries of g, not those of x.
        return np.array(ca.which_depends(self.g, self.x, 2, True), dtype=bool)

    def parameter_slice(self, name: str) -> slice:
        """Return the positions of the parameter `name` among the entries of p."""
        # Parameters follow each other in the order in which they were added, as in p.
        sizes = {key: symbol.numel() for key, symbol in self.parameters.items()}
        begin = sum(itertools.islice(sizes.values(), list(sizes).index(name)))
        return slice(begin, begin + sizes[name])

    def pack(self, values: Mapping[str, Any]) -> Array:
        """Return the values of all parameters in one column (len(p),), each given in its own shape.

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
            # Column by column, as ca.vec packs the symbols in p.
            columns.append(value.ravel(order="F"))
        return np.concatenate(columns)

    @property
    def functions(self) -> FrameFunctions:
        """Value, slopes and second-order expansion of the program, evaluated by CasADi's interpreter."""
        return self.expressions.functions

    @cached_property
    def value_function(self) -> ca.Function:
        """(x, p) -> (objective, g), without the derivatives that `functions` takes longer to build."""
        return ca.Function("value", [self.x, self.p], [self.objective, self.g])

    @cached_property
    def kkt_function(self) -> ca.Function:
        """(x, p, lam_x, lam_g) -> (gradient of the Lagrangian, g)."""
        lam_x = ca.SX.sym("lam_x", self.x.numel())
        lam_g = ca.SX.sym("lam_g", self.g.numel())
        # Stationarity: df/dx + (dg/dx)' lam_g + lam_x = 0, where lam_x belongs to the bounds of x.
        gradient = ca.gradient(self.objective + ca.dot(lam_g, self.g), self.x) + lam_x
        return ca.Function("kkt", [self.x, self.p, lam_x, lam_g], [gradient, self.g], {"cse": True})


def kkt_residual(
    nlp: Nlp, x: Array, p: Array, lower: Array | None, upper: Array | None, lam_x: Array, lam_g: Array
) -> float:
    """Return how far x is from a KKT point of nlp, computed from the problem alone.

    p: parameters (n_p,). lower, upper (k,): bounds of the configuration, where they are not the program's own
    (None). lam_x, lam_g: multipliers, positive at upper bounds. The result is the largest of stationarity (mm^2
    per unit of x), infeasibility (units of x and g) and complementarity (mm^2), whatever a solver reports.
    """
    gradient, g = (value.full().ravel() for value in nlp.kkt_function(x, p, lam_x, lam_g))
    values = np.concatenate([x, g])
    multipliers = np.concatenate([lam_x, lam_g])
    lows, highs = nlp.row_bounds(lower, upper)
    # By how much x or g is outside of its bounds, on either side.
    infeasible = np.maximum(np.maximum(lows - values, values - highs), 0.0)
    # Complementarity is |multiplier| times the distance to the bound that the multiplier's sign names.
    # Where that bound is infinite, the multiplier must be 0: then its own size counts.
    to_bound = np.where(multipliers > 0, highs, lows) - values
    slack = np.where(np.isfinite(to_bound), np.abs(to_bound), 1.0)
    residuals = np.abs(gradient), infeasible, np.abs(multipliers) * slack
    return float(max(part.max(initial=0.0) for part in residuals))
