"""The last rounds of a robust plan: corners of the tolerances as guards, in place of robots that joined before.

A guard only needs not to be lost: it has a small stability margin and tips near the nominal robot's branch, and
its errors do not count. It costs something in few frames only, so that each frame has guards of its own: the
program does not grow with the number of corners.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.scenarios import ConstraintScenarios, Scenarios
from ctr_nlp.robust.rounds import FailureJudge, Round, solve_with_scenarios
from ctr_nlp.robust.search import RobustSearch, StartResult
from ctr_nlp.robust.tolerance_vertices import ToleranceVertices
from ctr_nlp.solvers.motion.chain_solution import WARM_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios import SharedSolution
from ctr_nlp.typing import Array, Index

MAX_CONSTRAINT_SCENARIO_ROUNDS = 4
"""Most times that corners which are lost join the guards."""
CONSTRAINT_SCENARIO_MAX_COST_GROWTH = 0.08
"""Relative growth of the objective that guards may cost."""
ACTIVE_CONSTRAINT_SCENARIO_SHARE = 1e-4
"""A guard is left out in frames where it costs less than this part of what the dearest guard costs."""
CONSTRAINT_SCENARIO_START_SCALE, CONSTRAINT_SCENARIO_SCALE_STEP = 1.0, 0.05
"""Multiple of its difference that a guard has at first, and what is added where it is lost all the same, between
frames in which it is constrained.
"""


class FrameVertices(NamedTuple):
    """Corners that guard each frame, (T, K), and their tips (T, K, k), rad."""

    corners: Index
    tips: Array

    @classmethod
    def none(cls, phi: Array) -> FrameVertices:
        """Return no guards, for a motion with tips phi (T, S, k)."""
        return cls(np.zeros((len(phi), 0), dtype=int), phi[:, :0])

    def with_vertices(self, new: Index, first: Array) -> FrameVertices:
        """Add new corners in all frames, with the tips of the first robot, (T, 1, k)."""
        corners = np.concatenate([self.corners, np.tile(new, (len(first), 1))], axis=1)
        return FrameVertices(corners, np.concatenate([self.tips, np.repeat(first, len(new), axis=1)], axis=1))

    def keep_active(self, found: SharedSolution) -> FrameVertices:
        """Keep the guards whose constraints are active at a solution; all frames keep equally many.

        found: a solution, whose last robots these guards are.
        """
        count = self.corners.shape[1]
        burdens = found.constraint_multipliers[:, -count:]
        tips = found.phi[:, -count:]
        # Arrays need as many guards in each frame: those of the frame with most active ones. Others are filled up
        # with the next dearest.
        most = int((burdens > ACTIVE_CONSTRAINT_SCENARIO_SHARE * burdens.max()).sum(axis=1).max())
        kept = np.argsort(-burdens, axis=1, kind="stable")[:, :most]
        frames = np.arange(len(tips))[:, None]
        return FrameVertices(self.corners[frames, kept], tips[frames, kept])


def plan_with_constraint_scenarios(
    held: Round, scenarios: Scenarios, corners: ToleranceVertices, lost: FailureJudge, number: int
) -> list[Round]:
    """Plan a motion again so that fewer corners are lost; an empty list where few are, or where that fails.

    held: a round over all frames on whose motion few robots are lost. scenarios: the first ones of that round,
    which were planned for from the beginning. corners: of the tolerances. lost: judges the resulting motion, as
    number `number`. Corners that bear least of their difference are given up, as many as may be lost; the others
    that are lost, or nearly, become guards, until no more are lost than may be.
    """
    found = held.tried.solution
    tried = held.tried
    best = list[Round]()
    least = int(corners.find_failing_vertices(found.q).sum())
    dearest = (1 + CONSTRAINT_SCENARIO_MAX_COST_GROWTH) * found.objective
    if not held.lost.few or least <= corners.allowed_failures:
        return []
    borne = corners.find_failure_scales(found.q)
    placed = FrameVertices.none(found.phi)
    # Those that are lost at the smallest part of their difference would cost most to keep.
    spared = np.argsort(borne, kind="stable")[: corners.allowed_failures]
    # Finite: lost within NEAR times their difference. Corners that are barely kept now would be lost on a slightly
    # different motion.
    new = np.setdiff1d(np.flatnonzero(np.isfinite(borne)), spared)
    parts = np.full(len(borne), CONSTRAINT_SCENARIO_START_SCALE)
    for _ in range(MAX_CONSTRAINT_SCENARIO_ROUNDS):
        if least <= corners.allowed_failures or not len(new) or held.search.stop():
            break
        # The tips of a new guard start on the nominal robot's branch, where they are to stay.
        placed = placed.with_vertices(new, tried.solution.phi[:, :1])
        search, tried = _solve_with_constraints(held.search, tried, scenarios, corners, placed, parts)
        if not tried.is_shared or tried.solution.objective > dearest:
            break
        placed = placed.keep_active(tried.solution)
        gone = np.flatnonzero(corners.find_failing_vertices(tried.solution.q))
        new = np.setdiff1d(gone, spared)
        # Lost though it is a guard: frames are apart too far to see it. Planned for with a larger difference, it
        # is kept between them.
        parts[np.intersect1d(new, placed.corners)] += CONSTRAINT_SCENARIO_SCALE_STEP
        # Only the best round counts, and a round counts only where it loses fewer corners than all before.
        if len(gone) < least:
            least = len(gone)
            best = [held._replace(search=search, tried=tried, scenarios=scenarios, corners=least)]
    return [one._replace(lost=lost(one.tried.solution.q, number, False)) for one in best]


def _solve_with_constraints(
    search: RobustSearch,
    before: StartResult,
    scenarios: Scenarios,
    corners: ToleranceVertices,
    placed: FrameVertices,
    parts: Array,
) -> tuple[RobustSearch, StartResult]:
    """Solve a motion again with guards; return the search with these guards, and the result.

    before: the result so far. parts (C,): multiple of its difference that each corner has as a guard.
    """
    robots = corners.with_part(placed.corners, parts[placed.corners])
    found = before.solution
    of_robots = robots.numbers, robots.offsets, robots.forces
    each = (values.reshape(*placed.corners.shape, *values.shape[1:]) for values in of_robots)
    search = replace(search, guards=ConstraintScenarios(*each))
    tips = np.concatenate([found.phi[:, : len(scenarios)], placed.tips], axis=1)
    known = replace(before, solution=replace(found, phi=tips))
    return search, solve_with_scenarios(search, known, scenarios, barrier=WARM_START_BARRIER_MM2)
