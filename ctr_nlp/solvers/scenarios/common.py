"""Unknowns p that all frames have in common: their effect on frames, their cost, and their own rows.

The program over p (ocp.scenarios.CommonUnknowns) has rows g: the first k are further unknowns of the first
scenario in every frame, y_1 = g_{1..k}(p), and those of scenario s are y_s = factors_s y_1, entry by entry. They
serve the design of tubes: p are curvatures, lengths and diameters, y the numbers of the tubes in the model
(ocp/shared/design.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.scenarios import CommonUnknowns, SharedMotion
from ctr_nlp.typing import Array

NO_COMMON_UNKNOWNS = np.zeros(0)
"""The common unknowns p of a motion that has none."""


class CommonQuantities(NamedTuple):
    """Values at p (P,): the further unknowns (S, k) of scenarios; the cost, mm^2; the rows (c,) that concern p
    alone.
    """

    values: Array
    cost: float
    rows: Array


class CommonDerivatives(NamedTuple):
    """Derivatives over p: of the further unknowns (S, k, P), the cost (P,) and the rows (c, P).

    hessian (P, P): second derivatives of the cost, and of the Lagrangian as far as it depends on p through these.
    """

    values: Array
    cost: Array
    rows: Array
    hessian: Array


class CommonValues:
    """Values and derivatives over the common unknowns of a shared motion; all empty where it has none."""

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare."""
        (_, count, *_), common = motion.sizes, motion.common
        self.factors = np.zeros((count, 0)) if common is None else common.factors
        self.lower, self.upper = (
            (NO_COMMON_UNKNOWNS, NO_COMMON_UNKNOWNS) if common is None else (common.lower, common.upper)
        )
        k = self.factors.shape[1]
        # Row bounds of p's own rows alone; the first k rows are values for frames and have none.
        bounds = (NO_COMMON_UNKNOWNS, NO_COMMON_UNKNOWNS) if common is None else common.program.g_bounds
        self.row_lower, self.row_upper = (bound[k:] for bound in bounds)
        self._common: CommonUnknowns | None = common

    def __call__(self, p: Array) -> CommonQuantities:
        """Return further unknowns, cost and rows at p (P,)."""
        # Arrays without entries let all formulas be the same with and without common unknowns.
        if self._common is None:
            return CommonQuantities(self.factors, 0.0, NO_COMMON_UNKNOWNS)
        cost, g = (out.full().ravel() for out in self._common.program.functions.value(p, self._common.parameters))
        k = self.factors.shape[1]
        return CommonQuantities(self.factors * g[:k], float(cost[0]), g[k:])

    def slopes(self, p: Array, pulls: Array, rows: Array) -> CommonDerivatives:
        """Return the derivatives at p (P,).

        pulls (S, k): the Lagrangian's slopes over the further unknowns, summed over frames; rows (c,): multipliers
        of p's own rows.
        """
        if self._common is None:
            return CommonDerivatives(
                np.zeros((*self.factors.shape, 0)), NO_COMMON_UNKNOWNS, np.zeros((0, 0)), np.zeros((0, 0))
            )
        # Chain rule: y_s = factors_s g(p), so the curvature of g counts with sum_s factors_s dL/dy_s.
        # Passed as the multipliers of g's first rows, these factors make one expansion give it all.
        k = self.factors.shape[1]
        multipliers = np.append((self.factors * pulls).sum(axis=0), rows)
        expansion = self._common.program.functions.expansion
        found = expansion(p, self._common.parameters, 1.0, multipliers)
        gradient, jacobian, hessian = (found[i].full() for i in (1, 3, 4))
        return CommonDerivatives(self.factors[:, :, None] * jacobian[:k], gradient.ravel(), jacobian[k:], hessian)
