"""Parts that all solvers of chains share: first barriers, and how a point becomes a Solution."""

from __future__ import annotations

import numpy as np

from ctr_nlp.nlp.chain import Chain
from ctr_nlp.solvers.frame.adapter import FEASIBLE, OPTIMAL, Solution
from ctr_nlp.typing import Array

WIDE, CLOSE, NEAR = 1e-2, 1e-4, 1e-6
"""First barriers, mm^2: WIDE lets the objective decide which limits become active, CLOSE is for starts at which
most active limits are known, and NEAR stays in the basin of the start.
"""


def judged(chain: Chain, x: Array, multipliers: Array, status: str, iterations: int) -> Solution:
    """A point x (T n,) as a Solution; success depends on the chain itself, whatever the solver reports.

    multipliers: of all rows. status, iterations: the solver's.
    """
    objective, value = chain.evaluate(x)
    # The worst frame decides: a horizon is solved only if all its frames are.
    kkt = float(chain.kkt(x, multipliers).max())
    # Feasible to FEASIBLE (rad, mm) and a KKT point to OPTIMAL, from the chain alone.
    success = chain.violation(value) <= FEASIBLE and kkt <= OPTIMAL
    of_x, of_g = np.split(multipliers, [x.size])
    return Solution(
        x, objective, kkt, success, status, iterations, of_x, of_g, chain.configurations(value).ravel()
    )
