"""A program's functions in parts: what places do that are alike is a function of one of them, for many at once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ctr_nlp.codegen.places import Whole
from ctr_nlp.codegen.vector import EARLY
from ctr_nlp.nlp.alike import Alike, alike, depends
from ctr_nlp.nlp.at_place import Common, Place, Rows, Sums
from ctr_nlp.nlp.written import Beside, FrameFunctions, Written

NAMES = FrameFunctions._fields[:3]
"""Value, slopes and expansion: the number of a name is the order of the derivatives that are found."""


def parted(written: Written) -> Sequence[ca.Function | Whole]:
    """The three functions of a program for one frame, to be compiled."""
    groups, shared = alike(written)
    if not groups:
        return written.functions[:3]
    parts = _Parts.of(written, groups, shared.tolist())
    return [parts.whole(order) for order in range(len(NAMES))]


@dataclass(frozen=True, eq=False)
class _Parts:
    """Places, and the rest: the program without their rows.

    values, slopes: of the quantities that places share, the first of the rest's first layer, and theirs over x.
    kept: which constraints the rest has; order: where each one is among these and then those of places.
    """

    places: tuple[Place, ...]
    rest: Written
    common: Common
    values: ca.SX
    slopes: ca.SX
    order: list[int]
    kept: list[int]

    @classmethod
    def of(cls, written: Written, groups: Sequence[Alike], shared: list[int]) -> _Parts:
        """shared: which symbols of the first layer places take as given."""
        symbols, values = (part[shared] for part in written.inner[0])
        slopes, residuals = ca.jacobian(values, written.x), written.residual.numel()
        entries = ca.SX.sym("slopes", slopes.nnz())
        multipliers = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", written.g.numel())
        common = Common(written.x, written.p, symbols, entries, slopes.sparsity(), *multipliers)
        firsts = [(group.rows[0] - residuals).tolist() for group in groups]
        places = (
            Place(common, group, first if first[0] >= 0 else None)
            for group, first in zip(groups, firsts, strict=True)
        )
        taken = np.concatenate([group.rows.ravel(order="F") for group in groups])
        left = np.setdiff1d(np.arange(written.rows.numel()), taken)
        kept = (left[left >= residuals] - residuals).tolist()
        rest = replace(written, residual=written.residual[left[left < residuals].tolist()], g=written.g[kept])
        order = np.argsort([*kept, *(taken[taken >= residuals] - residuals)]).tolist()
        return cls(tuple(places), _without_unused(rest, shared), common, values, slopes, order, kept)

    def whole(self, order: int) -> Whole:
        """The function with derivatives up to an order."""
        inputs = self.common.inputs(order)
        functions = [place.function(order, f"{NAMES[order]}_{k}") for k, place in enumerate(self.places)]
        ends = np.cumsum([0, *(each.numbers for each in functions)]).tolist()
        found = ca.SX.sym("found", ends[-1])
        slices = (found[begin:end] for begin, end in itertools.pairwise(ends))
        taken = [place.taken(order, own) for place, own in zip(self.places, slices, strict=True)]
        early = [self.values, self.slopes.nz[:]][: len(self.common.early(order))]
        outputs = self._outputs(order, *zip(*taken, strict=True))
        function = ca.Function(
            f"{NAMES[order]}_whole",
            [*inputs, found],
            [*early, *outputs],
            [*(f"given_{k}" for k in range(len(inputs))), "found"],
            [*(f"{EARLY}{k}" for k in range(len(early))), *(f"output_{k}" for k in range(len(outputs)))],
        )
        return Whole(NAMES[order], function, len(early), tuple(functions))

    def _outputs(self, order: int, sums: Sequence[Sums], rows: Sequence[Rows]) -> list[ca.SX]:
        """Of the whole program."""
        residual, cost, g = self.rest.outright
        total = Sums(*(sum(parts) for parts in zip(*sums, strict=True)))
        f = ca.sumsqr(residual) + cost + total.f
        values = ca.vertcat(g, *(each.value for each in rows))[self.order]
        if not order:
            return [f, ca.densify(values)]
        lam_g = self.common.lam_g[self.kept]
        gradient, jacobian, hessian = self.rest.derivatives(self.common.lam_f, lam_g, self._beside(total))
        outputs = [
            *(f, gradient + total.gradient, values),
            ca.vertcat(jacobian, *(each.jacobian for each in rows))[self.order, :],
            *[hessian + ca.triu2symm(total.half)] * (order - 1),
        ]
        return [ca.densify(output) for output in outputs]

    def _beside(self, total: Sums) -> Beside:
        """What places add over the rest's first layer, whose first symbols are shared, and x."""
        symbols, n = self.rest.inner[0][0].numel(), self.common.x.numel()
        shared = self.common.shared.numel()
        more = symbols - shared
        bend = ca.triu2symm(total.bend)
        parts = (bend[:shared, :shared], bend[:shared, shared:], bend[shared:, :shared], bend[shared:, shared:])
        first = ca.horzcat(parts[0], ca.SX(shared, more), parts[1])
        last = ca.horzcat(parts[2], ca.SX(n, more), parts[3])
        pull = ca.vertcat(total.pull, ca.SX(more + n, 1))
        return Beside(pull, ca.vertcat(first, ca.SX(more, symbols + n), last))


def _without_unused(written: Written, first: list[int]) -> Written:
    """The same without inner quantities that nothing needs; those of the first layer that are named come first."""
    needed, inner = ca.vertcat(written.rows, written.cost), list[tuple[ca.SX, ca.SX]]()
    for number, (symbols, values) in reversed(list(enumerate(written.inner))):
        used = np.flatnonzero(depends(needed, symbols).any(axis=0)).tolist()
        picked = used if number else [*first, *(k for k in used if k not in first)]
        inner.insert(0, (symbols[picked], values[picked]))
        needed = ca.vertcat(needed, values[picked])
    return replace(written, inner=tuple(inner))
