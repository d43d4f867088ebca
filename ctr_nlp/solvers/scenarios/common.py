"""What unknowns that all frames have in common give each frame, and what they cost and keep themselves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import Common, SharedMotion
from ctr_nlp.typing import Array

NONE = np.zeros(0)
"""Common unknowns of a motion that has none."""


class Given(NamedTuple):
    """At p (P,): the further unknowns (S, k) of scenarios; the cost, mm^2; the rows (c,) that are p's own."""

    values: Array
    cost: float
    rows: Array


class GivenSlopes(NamedTuple):
    """At p: derivatives over p of the further unknowns (S, k, P), the cost (P,) and the rows (c, P); the second
    ones (P, P) of the cost, and of the Lagrangian as far as it depends on p through these.
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
        self.lower, self.upper = (NONE, NONE) if common is None else (common.lower, common.upper)
        k = self.factors.shape[1]
        bounds = (NONE, NONE) if common is None else common.program.g_bounds
        self.row_lower, self.row_upper = (bound[k:] for bound in bounds)
        self._common: Common | None = common

    def __call__(self, p: Array) -> Given:
        """The values at p (P,)."""
        if self._common is None:
            return Given(self.factors, 0.0, NONE)
        cost, g = (out.full().ravel() for out in self._common.program.functions.value(p, self._common.parameters))
        k = self.factors.shape[1]
        return Given(self.factors * g[:k], float(cost[0]), g[k:])

    def slopes(self, p: Array, pulls: Array, rows: Array) -> GivenSlopes:
        """The derivatives at p (P,).

        pulls (S, k): the Lagrangian's slopes over the further unknowns; rows (c,): multipliers of p's own.
        """
        if self._common is None:
            return GivenSlopes(np.zeros((*self.factors.shape, 0)), NONE, np.zeros((0, 0)), np.zeros((0, 0)))
        k, multipliers = self.factors.shape[1], np.append((self.factors * pulls).sum(axis=0), rows)
        expansion = self._common.program.functions.expansion
        found = expansion(p, self._common.parameters, 1.0, multipliers)
        gradient, jacobian, hessian = (found[i].full() for i in (1, 3, 4))
        return GivenSlopes(self.factors[:, :, None] * jacobian[:k], gradient.ravel(), jacobian[k:], hessian)
