"""What solvers of chains have in common."""

from __future__ import annotations

import numpy as np

from ctr_nlp.nlp.chain import Chain
from ctr_nlp.solvers.frame.adapter import FEASIBLE, OPTIMAL, Solution
from ctr_nlp.typing import Array

WIDE, CLOSE, NEAR = 1e-2, 1e-4, 1e-6
"""First barriers, mm^2: one that lets the objective decide which limits become active, one for starts at which
most of these are known, and one that stays in the basin of the start."""


def judged(chain: Chain, x: Array, multipliers: Array, status: str, iterations: int) -> Solution:
    """A point as a Solution: success is what the chain itself says of it, whatever the solver does."""
    objective, value = chain.evaluate(x)
    kkt = float(chain.kkt(x, multipliers).max())
    success = chain.violation(value) <= FEASIBLE and kkt <= OPTIMAL
    of_x, of_g = np.split(multipliers, [x.size])
    return Solution(
        x, objective, kkt, success, status, iterations, of_x, of_g, chain.configurations(value).ravel()
    )
