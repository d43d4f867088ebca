"""A program's functions in parts: the rows of alike sample points as one function, evaluated in vectors.

The rest of the program (other rows, shared quantities) is evaluated with its slopes over the unknowns by forward
differentiation (codegen/forward_mode.py), and then joined with the sums and rows of the sample points
(sample_derivatives.py). The order of evaluation is: shared quantities, sample points, rest, join.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ctr_nlp.codegen.forward_mode import FunctionWithJacobian
from ctr_nlp.codegen.sample_points import FunctionInParts
from ctr_nlp.codegen.vector import EARLY_OUTPUT_PREFIX
from ctr_nlp.ocp.expressions import FrameFunctions, ProgramExpressions
from ctr_nlp.ocp.sample_derivatives import SampleConstraintRows, SampleInputs, SampleSums, SampleTerms
from ctr_nlp.ocp.sample_groups import depends, group_samples

FRAME_FUNCTION_NAMES = FrameFunctions._fields[:3]
"""Value, slopes and expansion: the index of a name is the order of the derivatives that are computed."""


def partition_program(written: ProgramExpressions) -> list[FunctionInParts]:
    """Return the three functions of a program (written) for one frame, in parts, to be compiled."""
    parts = _Partition.of(written)
    return [parts.whole(order) for order in range(len(FRAME_FUNCTION_NAMES))]


@dataclass(frozen=True, eq=False)
class _Partition:
    """The sample points of a program, and the rest: the program without their rows.

    values: of the quantities that sample points share, which come first in the rest's first layer.
    rest_constraints: numbers of the constraints in the rest; order: position of each constraint among these and
    then those of sample points.
    """

    places: tuple[SampleTerms, ...]
    rest: ProgramExpressions
    common: SampleInputs
    values: ca.SX
    order: list[int]
    rest_constraints: list[int]

    @classmethod
    def of(cls, written: ProgramExpressions) -> _Partition:
        """Split a program into sample points and the rest."""
        groups, indices = group_samples(written)
        # Without groups nothing is shared, and the whole program is the rest.
        shared, (symbols, values) = indices.tolist() if groups else [], written.first_layer
        residuals = written.residual.numel()
        pattern = ca.jacobian_sparsity(values[shared], written.x)
        entries = ca.SX.sym("slopes", pattern.nnz())
        multipliers = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", written.g.numel())
        common = SampleInputs(written.x, written.p, symbols[shared], entries, pattern, *multipliers)
        # Residuals come before constraints among the rows: a negative number is a residual.
        firsts = [(group.rows[0] - residuals).tolist() for group in groups]
        places = (
            SampleTerms(common, group, first if first[0] >= 0 else None)
            for group, first in zip(groups, firsts, strict=True)
        )
        taken = np.concatenate([np.zeros(0, int), *(group.rows.ravel(order="F") for group in groups)])
        left = np.setdiff1d(np.arange(written.rows.numel()), taken)
        kept = (left[left >= residuals] - residuals).tolist()
        rest = replace(written, residual=written.residual[left[left < residuals].tolist()], g=written.g[kept])
        # argsort inverts the permutation: entry i of the result is where constraint i stands in the list.
        order = np.argsort([*kept, *(taken[taken >= residuals] - residuals)]).tolist()
        return cls(tuple(places), _without_unused(rest, shared), common, values[shared], order, kept)

    def whole(self, order: int) -> FunctionInParts:
        """Return the function with derivatives up to an order, in parts."""
        functions = [
            place.function(order, f"{FRAME_FUNCTION_NAMES[order]}_{k}") for k, place in enumerate(self.places)
        ]
        ends = np.cumsum([0, *(each.numbers for each in functions)]).tolist()
        found = ca.SX.sym("found", ends[-1])
        slices = (found[begin:end] for begin, end in itertools.pairwise(ends))
        taken = [place.split_results(order, own) for place, own in zip(self.places, slices, strict=True)]
        total = SampleSums.of(self.common, [sums for sums, _ in taken])
        directed = self._differentiate_rest(order, found, total.pull)
        joined = self._join_results(order, directed, found, total, [rows for _, rows in taken])
        return FunctionInParts(FRAME_FUNCTION_NAMES[order], directed, tuple(functions), joined)

    def _differentiate_rest(self, order: int, found: ca.SX, pull: ca.SX) -> FunctionWithJacobian:
        """Return the function of shared quantities, objective, constraints and, for order 2, the gradient of the
        rest.

        Slopes of that gradient over x are half of the Hessian of lam_f objective + lam_g g + pull . values, where
        pull is computed at the sample points in between. found: results of the sample points, as symbols.
        """
        n = self.common.x.numel()
        inputs = self.common.inputs(order)
        # Substituted, not nested: forward differentiation needs no layers.
        residual, cost, g = self.rest.terms_in_x
        f = ca.sumsqr(residual) + cost
        outputs = [self.values, f, g]
        patterns = [self.common.pattern, ca.Sparsity.dense(1, n), ca.Sparsity.dense(len(self.rest_constraints), n)]
        if order == 2:
            # The sample points' `pull` multiplies second derivatives of shared quantities: adding pull . values to
            # the Lagrangian gives these in the same sweep.
            lagrangian = self.common.lam_f * f + ca.dot(self.common.lam_g[self.rest_constraints], g)
            outputs.append(ca.gradient(lagrangian + ca.dot(pull, self.values), self.common.x))
            patterns.append(ca.Sparsity.upper(n))
        function = ca.Function(
            f"{FRAME_FUNCTION_NAMES[order]}_directed",
            [*inputs, found],
            [ca.densify(output) for output in outputs],
            [*(f"given_{k}" for k in range(len(inputs))), "found"],
            [f"{EARLY_OUTPUT_PREFIX}values", *(f"output_{k}" for k in range(1, len(outputs)))],
        )
        return FunctionWithJacobian(function, dict(enumerate(patterns)) if order else {})

    def _join_results(
        self,
        order: int,
        directed: FunctionWithJacobian,
        found: ca.SX,
        total: SampleSums,
        rows: Sequence[SampleConstraintRows],
    ) -> ca.Function:
        """Return the function of the whole program's results, from those at sample points and those of the
        rest.
        """
        function = directed.function
        patterns = list(directed.slopes.values())
        results = [ca.SX.sym("result", *function.size_out(k)) for k in range(function.n_out())]
        entries = [ca.SX.sym("entries", pattern.nnz()) for pattern in patterns]
        _, f, g, *_ = results
        outputs = [f + total.f, ca.vertcat(g, *(each.value for each in rows))[self.order]]
        if order:
            values_x, f_x, g_x, *half = map(ca.SX, patterns, entries)
            jacobian = ca.vertcat(g_x, *(each.jacobian for each in rows))[self.order, :]
            outputs = [outputs[0], f_x.T + total.gradient, outputs[1], jacobian]
            # b_x' bend b_x: second derivatives over (shared, x), summed over sample points, transformed to x once.
            base_x = ca.vertcat(values_x, ca.SX.eye(self.common.x.numel()))
            bent = ca.triu(base_x.T @ ca.triu2symm(total.bend) @ base_x)
            outputs += [ca.triu2symm(each + total.half + bent) for each in half]
        inputs = [found, *results, *entries]
        return ca.Function(f"{FRAME_FUNCTION_NAMES[order]}_joined", inputs, [ca.densify(each) for each in outputs])


def _without_unused(written: ProgramExpressions, first: list[int]) -> ProgramExpressions:
    """Return the program without inner quantities that nothing needs.

    Quantities of the first layer that are in `first` come first.
    """
    needed = ca.vertcat(written.rows, written.cost)
    inner = list[tuple[ca.SX, ca.SX]]()
    for number, (symbols, values) in reversed(list(enumerate(written.inner))):
        used = np.flatnonzero(depends(needed, symbols).any(axis=0)).tolist()
        picked = used if number else [*first, *(k for k in used if k not in first)]
        inner.insert(0, (symbols[picked], values[picked]))
        # Values of a layer are written in earlier layers, which are therefore looked at afterwards.
        needed = ca.vertcat(needed, values[picked])
    return replace(written, inner=tuple(inner))
