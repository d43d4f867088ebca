"""Parts that all solvers of chains share: first barriers, and how a point becomes a Solution."""

from __future__ import annotations

import numpy as np

from ctr_nlp.ocp.chain import Chain
from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE, KKT_TOLERANCE, Solution
from ctr_nlp.typing import Array

WALL_START_BARRIER_MM2 = 0.1
"""First barrier for starts far beyond a wall, mm^2. Contact costs tens of mm^2 a mm: with a smaller barrier steps
would creep along the wall.
"""
COLD_START_BARRIER_MM2, WARM_START_BARRIER_MM2, LOCAL_START_BARRIER_MM2 = 1e-2, 1e-4, 1e-6
"""First barriers, mm^2: COLD_START_BARRIER_MM2 lets the objective decide which limits become active,
WARM_START_BARRIER_MM2 is for starts at which most active limits are known, and LOCAL_START_BARRIER_MM2 stays in
the basin of the start.
"""


def evaluate_chain_solution(chain: Chain, x: Array, multipliers: Array, status: str, iterations: int) -> Solution:
    """Return a point x (T n,) as a Solution; success depends on the chain itself, whatever the solver reports.

    multipliers: of all rows. status, iterations: the solver's.
    """
    objective, value = chain.evaluate(x)
    # The worst frame decides: a horizon is solved only if all its frames are.
    kkt = float(chain.kkt(x, multipliers).max())
    # Feasible to FEASIBILITY_TOLERANCE (rad, mm) and a KKT point to KKT_TOLERANCE, from the chain alone.
    success = chain.violation(value) <= FEASIBILITY_TOLERANCE and kkt <= KKT_TOLERANCE
    of_x, of_g = np.split(multipliers, [x.size])
    return Solution(
        x, objective, kkt, success, status, iterations, of_x, of_g, chain.configurations(value).ravel()
    )
