"""The expressions of a program as they are written, and their derivatives; nothing here knows names or bounds.

Expressions may be nested: residuals r(u), with u = (v, x) and inner quantities v(x), in several layers. The chain
rule is applied layer by layer, which needs fewer operations than differentiating the substituted expression;
`ProgramExpressions.derivatives` has the formulas. Units are those of nlp.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca


class FrameFunctions(NamedTuple):
    """The functions of one frame that a solver evaluates, as symbols or compiled.

    value: (x, p) -> (objective, g). slopes: (x, p) -> (objective, its gradient, g, the dense Jacobian of g).
    expansion: (x, p, lam_f, lam_g) -> slopes and the dense exact Hessian of lam_f objective + lam_g g. lanes:
    number of frames that one call evaluates, side by side as `map` lays them out; codegen.batch_evaluator takes
    any number.
    """

    value: ca.Function
    slopes: ca.Function
    expansion: ca.Function
    lanes: int = 1


@dataclass(frozen=True, eq=False)
class ProgramExpressions:
    """Residuals, costs and constraint values in x, parameters p and the symbols of inner quantities; all columns.

    inner: symbols and values of each layer, of which later ones may be written in the symbols of those before. It
    is pickled as one CasADi function, and unpickled with new symbols.
    """

    x: ca.SX
    p: ca.SX
    residual: ca.SX
    cost: ca.SX
    g: ca.SX
    inner: tuple[tuple[ca.SX, ca.SX], ...]

    @classmethod
    def of(cls, function: ca.Function) -> ProgramExpressions:
        """Rebuild the expressions from the `function` of another ProgramExpressions, in new symbols."""
        symbols = [ca.SX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
        residual, cost, g, *values = function.call(symbols)
        x, p, *inner = symbols
        return cls(x, p, residual, cost, g, tuple(zip(inner, values, strict=True)))

    def __reduce__(self) -> tuple[Callable[[ca.Function], ProgramExpressions], tuple[ca.Function]]:
        # SX symbols cannot be pickled, a ca.Function can: background processes are given programs this way.
        return ProgramExpressions.of, (self.function,)

    @cached_property
    def function(self) -> ca.Function:
        """(x, p, symbols of each layer) -> (residual, cost, g, values of each layer), all as they are written."""
        symbols, values = ([layer[k] for layer in self.inner] for k in range(2))
        return ca.Function("written", [self.x, self.p, *symbols], [self.residual, self.cost, self.g, *values])

    @property
    def rows(self) -> ca.SX:
        """Residuals, then constraint values, as they are written."""
        return ca.vertcat(self.residual, self.g)

    @property
    def first_layer(self) -> tuple[ca.SX, ca.SX]:
        """Symbols and values of the inner quantities that are written in x and p alone."""
        return self.inner[0] if self.inner else (ca.SX(0, 1), ca.SX(0, 1))

    @staticmethod
    def without(layers: Sequence[tuple[ca.SX, ca.SX]], expressions: list[ca.SX]) -> list[ca.SX]:
        """Return expressions with the symbols of some layers replaced by their values.

        layers: pairs of symbols and values.
        """
        # From the last layer to the first: values of later layers contain symbols of earlier ones.
        for symbols, values in reversed(layers):
            expressions = ca.substitute(expressions, [symbols], [values])
        return expressions

    def in_x(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Return expressions with all inner symbols replaced by their values."""
        return self.without(self.inner, expressions)

    @cached_property
    def terms_in_x(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Residuals, cost and constraint values in x and p alone."""
        residual, cost, g = self.in_x([self.residual, self.cost, self.g])
        return residual, cost, g

    @cached_property
    def functions(self) -> FrameFunctions:
        """Value, slopes and second-order expansion, for solvers that evaluate these often.

        Common subexpressions are not eliminated here, which takes seconds: the generator of machine code does it.
        """
        residual, cost, g = self.terms_in_x
        lam_f = ca.SX.sym("lam_f")
        lam_g = ca.SX.sym("lam_g", g.numel())
        gradient, jacobian, hessian = (ca.densify(part) for part in self.derivatives(lam_f, lam_g))
        inputs = [self.x, self.p]
        multipliers = [lam_f, lam_g]
        value = [ca.sumsqr(residual) + cost, ca.densify(g)]
        slopes = [value[0], gradient, value[1], jacobian]
        return FrameFunctions(
            ca.Function("value", inputs, value),
            ca.Function("slopes", inputs, slopes),
            ca.Function("expansion", inputs + multipliers, [*slopes, hessian]),
        )

    def functions_to_compile(self) -> tuple[ca.Function, ...]:
        """Return value, slopes and expansion as a tuple of functions, to be compiled."""
        return self.functions[:3]

    def derivatives(self, lam_f: ca.SX, lam_g: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Return the objective's gradient, the Jacobian of g, and the Hessian of lam_f objective + lam_g g.

        With L(u) = lam_f (|r(u)|^2 + cost(u)) + lam_g g(u) of u(x), the Hessian is u_x' L_uu u_x + sum L_u u_xx,
        where of L_uu the part 2 r_u' r_u becomes 2 J'J with J = r_u u_x; and so on for u(v(x)), layer by layer.
        """
        # Forward through the layers: u are the quantities so far, u_x their Jacobian over x. For each layer
        # keep the quantities below, their Jacobian over x, all quantities in terms of those below, and the
        # Jacobian of that step.
        u = self.x
        u_x = ca.SX.eye(self.x.numel())
        layers = list[tuple[ca.SX, ca.SX, ca.SX, ca.SX]]()
        for symbols, values in self.inner:
            at = ca.vertcat(values, u)
            step = ca.jacobian(at, u)
            layers.append((u, u_x, at, step))
            u = ca.vertcat(symbols, u)
            u_x = step @ u_x
        r = self.residual
        cost = self.cost
        g = self.g
        r_u = ca.jacobian(r, u)
        g_u = ca.jacobian(g, u)
        # slope = dr/dx; pull = d(|r|^2 + cost)/du, from which the gradient is u_x' pull.
        slope = r_u @ u_x
        pull = ca.densify(2 * r_u.T @ r + ca.gradient(cost, u))
        # The residuals' curvature is sum_k 2 lam_f r_k d2r_k/du2. Stand-ins for the factors 2 lam_f r keep
        # these constant while `pushes . r` is differentiated; their values are substituted at the end.
        pushes = ca.SX.sym("pushes", r.numel())
        straight = ca.dot(pushes, r) + lam_f * cost + ca.dot(lam_g, g)
        # Gauss-Newton part 2 lam_f J'J plus the curvature of the outermost expressions. Only upper
        # triangles are formed, since the Hessian is symmetric.
        half = ca.triu(2 * lam_f * slope.T @ slope + u_x.T @ ca.hessian(straight, u)[0] @ u_x)
        stand_ins = [pushes]
        given = [ca.densify(2 * lam_f * r)]
        # force = L_u, what the Lagrangian's slope over u multiplies second derivatives of u(v) with.
        force = ca.densify(lam_f * pull + g_u.T @ lam_g)
        # Backward through the layers: each adds below_x' (sum_k force_k d2u_k/dbelow2) below_x, and hands
        # the force down by the transposed Jacobian of its step.
        for below, below_x, at, step in reversed(layers):
            pulls = ca.SX.sym("pulls", at.numel())
            half += ca.triu(below_x.T @ ca.hessian(ca.dot(pulls, at), below)[0] @ below_x)
            stand_ins = [*stand_ins, pulls]
            given = [*given, force]
            force = ca.densify(step.T @ force)
        (half,) = ca.substitute([half], stand_ins, given)
        gradient, jacobian, half = self.in_x([u_x.T @ pull, g_u @ u_x, half])
        return gradient, jacobian, ca.triu2symm(half)
