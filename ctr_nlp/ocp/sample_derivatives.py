"""The contribution of one of many alike sample points to a program: its rows, and their derivatives over x.

With b = (shared quantities, x), the point's own quantities z(b) and its rows r(z, b), the chain rule is applied in
three steps, r over u = (z, b), z over b, and b over x:

    r_x  = r_u u_x,      u_x = (z_b b_x, b_x)
    L_xx = u_x' (L_uu) u_x + b_x' (sum_k force_k d2z_k/db2) b_x + sum_k pull_k d2b_k/dx2

with L = lam_f |r|^2 for residuals and lam_g . r for constraints (objective in mm^2), force = L_z and pull = L_b.
The middle sum (`bend`) and `pull` are summed over all sample points before they are multiplied by b_x and d2b/dx2,
so that these products are formed once, not once a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.codegen.sample_points import SamplePointFunction
from ctr_nlp.codegen.vector import ADJACENT_LANES_PREFIX, SHARED_INPUT_PREFIX
from ctr_nlp.ocp.sample_groups import SampleGroup

SUMS = 1, 2, 5
"""Number of entries of SampleSums that are needed, by the order of derivatives: f; with its gradient; all five."""


class SampleInputs(NamedTuple):
    """The symbols that all sample points are given.

    x, p: unknowns and parameters. shared: quantities of the first layer that sample points share. slopes: entries
    of their Jacobian over x that may differ from 0, with the sparsity `pattern`. lam_f, lam_g: multipliers of
    objective and constraints.
    """

    x: ca.SX
    p: ca.SX
    shared: ca.SX
    slopes: ca.SX
    pattern: ca.Sparsity
    lam_f: ca.SX
    lam_g: ca.SX

    def inputs(self, order: int) -> list[ca.SX]:
        """Return the inputs of functions with derivatives up to an order."""
        return [self.x, self.p, *([self.lam_f, self.lam_g] if order == 2 else [])]

    def early(self, order: int) -> list[ca.SX]:
        """Return the results that are passed to sample points, for derivatives up to an order."""
        return [self.shared, *([self.slopes] if order else [])]

    @property
    def base(self) -> ca.SX:
        """b: shared quantities, then x."""
        return ca.vertcat(self.shared, self.x)

    @property
    def base_x(self) -> ca.SX:
        """The Jacobian of b over x."""
        return ca.vertcat(ca.SX(self.pattern, self.slopes), ca.SX.eye(self.x.numel()))


class SampleSums(NamedTuple):
    """Sums over sample points: f, of squares, and over x its gradient (n, 1) and half of the Hessian (n, n).

    That half is the upper triangle. pull: factors of the second derivatives of shared quantities. bend: second
    derivatives over b, the shared quantities and x, upper triangle.
    """

    f: ca.SX
    gradient: ca.SX
    half: ca.SX
    pull: ca.SX
    bend: ca.SX

    @classmethod
    def of(cls, common: SampleInputs, every: Sequence[SampleSums]) -> SampleSums:
        """Add up the sums of several groups of sample points (every).

        common: the symbols that all of them are given.
        """
        n = common.x.numel()
        base = common.base.numel()
        none = cls(ca.SX(1, 1), ca.SX(n, 1), ca.SX(n, n), ca.SX(base - n, 1), ca.SX(base, base))
        return cls(*(sum(parts[1:], parts[0]) for parts in zip(none, *every, strict=True)))


class SampleConstraintRows(NamedTuple):
    """Values of constraints, and their Jacobian over x."""

    value: ca.SX
    jacobian: ca.SX


@dataclass(frozen=True, eq=False)
class SampleTerms:
    """A sample point of a group of alike ones, with its rows and derivatives as expressions.

    first: the constraints of the group's first point; None if rows are residuals.
    """

    common: SampleInputs
    group: SampleGroup
    first: list[int] | None

    @cached_property
    def _value_u(self) -> ca.SX:
        """r_u, the Jacobian of the rows over u = (z, b)."""
        return ca.jacobian(self.group.value, ca.vertcat(self.group.z, self.common.base))

    @cached_property
    def _u_x(self) -> ca.SX:
        """u_x, the Jacobian of u = (z, b) over x."""
        z_base = ca.jacobian(self.group.z_value, self.common.base)
        return ca.vertcat(z_base @ self.common.base_x, self.common.base_x)

    def _sums(self, counts: ca.SX, lam_g: ca.SX) -> SampleSums:
        """Return the sample point's part of SampleSums.

        counts: 1, or 0 for a point that fills up the last vector and has been counted before. lam_g: multipliers
        of constraints, from the point's own on.
        """
        value = self.group.value
        z = self.group.z
        base = self.common.base
        n = self.common.x.numel()
        value_x = self._value_u @ self._u_x
        u = ca.vertcat(z, base)
        # push = L_r, the slope of the Lagrangian over the rows: lam_g for constraints, 2 lam_f r for
        # residuals.
        push = counts * lam_g[self.first or []]
        f = ca.SX(0)
        gradient = ca.SX(n, 1)
        half = ca.SX(n, n)
        if self.first is None:
            push = 2 * counts * self.common.lam_f * value
            f = counts * ca.sumsqr(value)
            # Only residuals have a Gauss-Newton part, 2 lam_f r_x' r_x.
            gradient = 2 * counts * value_x.T @ value
            half = 2 * counts * self.common.lam_f * value_x.T @ value_x
        # Stand-ins keep the factors constant while second derivatives are taken (as in
        # ProgramExpressions.derivatives).
        pushes = ca.SX.sym("pushes", value.numel())
        pulls = ca.SX.sym("pulls", z.numel())
        half += self._u_x.T @ ca.hessian(ca.dot(pushes, value), u)[0] @ self._u_x
        force = self._value_u.T @ push
        # L_b: through z, and directly.
        pull = ca.jacobian(self.group.z_value, base).T @ force[: z.numel()] + force[z.numel() :]
        bend = ca.triu(ca.hessian(ca.dot(pulls, self.group.z_value), base)[0])
        half, bend = ca.substitute(
            [half, bend], [pushes, pulls], [ca.densify(push), ca.densify(force[: z.numel()])]
        )
        return SampleSums(f, gradient, ca.triu(half), pull[: self.common.shared.numel()], bend)

    @cached_property
    def _patterns(self) -> tuple[ca.Sparsity, ...]:
        """Sparsity of each entry of SampleSums: the entries that may differ from 0."""
        n = self.common.x.numel()
        m = self.common.shared.numel()
        bend = self._sums(ca.SX.sym("counts"), self.common.lam_g).bend.sparsity()
        return ca.Sparsity.dense(1), ca.Sparsity.dense(n), ca.Sparsity.upper(n), ca.Sparsity.dense(m), bend

    def function(self, order: int, name: str) -> SamplePointFunction:
        """Return the function, called name, of one sample point: its part of the sums, and its rows.

        order: of the derivatives.
        """
        common = self.common
        group = self.group
        places = len(self.group.rows)
        shared = common.inputs(order) + common.early(order)
        # Every input a second time, read with an offset of as many entries as the sample point is after the first:
        # that is where a point finds parameters and multipliers of its own.
        apart = [ca.SX.sym("apart", each.numel()) for each in common.inputs(order)]
        constants = np.array([values for _, values in group.constants]).reshape(-1, places)
        fixed = ca.SX.sym("fixed", constants.size)
        counts = ca.SX.sym("counts")
        sums = self._sums(counts, apart[3] if order == 2 else common.lam_g)
        added = [ca.project(part, pattern).nz[:] for part, pattern in zip(sums, self._patterns, strict=True)]
        rows = [] if self.first is None else [group.value, ca.vec(ca.densify(self._value_u @ self._u_x))]
        results = [ca.vertcat(*added[: SUMS[order]]), ca.vertcat(ca.SX(0, 1), *rows[: 1 + order])]
        results = ca.substitute(results, [group.z], [group.z_value])
        # Parameters of the first sample point at p[first], constants of all points in one column, constant after
        # constant. The next lane of either is the next sample point.
        numbers = [(symbol, apart[1][first]) for symbol, first in group.parameters]
        numbers += [(symbol, fixed[k * places]) for k, (symbol, _) in enumerate(group.constants)]
        symbols, values = (ca.vertcat(ca.SX(0, 1), *(pair[k] for pair in numbers)) for k in range(2))
        inputs = [*shared, *apart, fixed, counts]
        names = [
            f"{SHARED_INPUT_PREFIX if k < len(shared) else ADJACENT_LANES_PREFIX}{k}" for k in range(len(inputs))
        ]
        results = ca.substitute(results, [symbols], [values])
        function = ca.Function(
            name, inputs, results, names, [f"{ADJACENT_LANES_PREFIX}sums", f"{ADJACENT_LANES_PREFIX}rows"]
        )
        return SamplePointFunction(function, constants)

    def split_results(self, order: int, numbers: ca.SX) -> tuple[SampleSums, SampleConstraintRows]:
        """Split the numbers found at all sample points into sums and constraint rows; order: of derivatives.

        numbers: sums, then rows entry by entry and then point by point.
        """
        patterns = self._patterns
        constraints = 0 if self.first is None else self.group.rows.size
        ends = np.cumsum([0, *(pattern.nnz() for pattern in patterns[: SUMS[order]])]).tolist()
        parts = [ca.SX(*pattern.shape) for pattern in patterns]
        for k in range(SUMS[order]):
            parts[k] = ca.SX(patterns[k], numbers[ends[k] : ends[k + 1]])
        found = numbers[ends[-1] :]
        n = self.common.x.numel()
        # Entries come column by column of the Jacobian; within a column, row r of all sample points and then row r
        # + 1 of all, which is the order of SampleGroup.rows read by columns.
        jacobian = ca.reshape(found[constraints:], constraints if order else 0, n)
        return SampleSums(*parts), SampleConstraintRows(ca.reshape(found[:constraints], constraints, 1), jacobian)
