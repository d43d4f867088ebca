"""Constraint scenarios: vertices of the tolerance box that only have to stay stable, in the last rounds.

They replace the failed samples that joined before. A constraint scenario (the option `guards`) has a small
stability margin and tips near the nominal robot's branch, and its errors do not count. Its constraints are active
in few frames only. Each frame therefore has constraint scenarios of its own, and the program does not grow with
the number of vertices.
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
"""Largest number of rounds in which failing vertices join the constraint scenarios."""
CONSTRAINT_SCENARIO_MAX_COST_GROWTH = 0.08
"""Relative growth of the objective that constraint scenarios may cost."""
ACTIVE_CONSTRAINT_SCENARIO_SHARE = 1e-4
"""A scenario is dropped in frames where its multipliers are below this part of the largest of all scenarios."""
CONSTRAINT_SCENARIO_START_SCALE, CONSTRAINT_SCENARIO_SCALE_STEP = 1.0, 0.05
"""Multiple of a vertex's difference from the nominal robot that its scenario has at first, and what is added where
the vertex still fails, between the frames in which it is constrained.
"""


class FrameVertices(NamedTuple):
    """Vertices that are constraint scenarios in each frame, corners (T, K), and their tips (T, K, k), rad."""

    corners: Index
    tips: Array

    @classmethod
    def none(cls, phi: Array) -> FrameVertices:
        """Return no vertices, for a motion with tips phi (T, S, k), rad."""
        return cls(np.zeros((len(phi), 0), dtype=int), phi[:, :0])

    def with_vertices(self, new: Index, first: Array) -> FrameVertices:
        """Add vertices in all frames; new: their indices. first: tips (T, 1, k) of the nominal robot, rad."""
        corners = np.concatenate([self.corners, np.tile(new, (len(first), 1))], axis=1)
        return FrameVertices(corners, np.concatenate([self.tips, np.repeat(first, len(new), axis=1)], axis=1))

    def keep_active(self, found: SharedSolution) -> FrameVertices:
        """Keep the vertices whose constraints are active at a solution; all frames keep equally many.

        found: a solution, whose last robots are these vertices.
        """
        count = self.corners.shape[1]
        burdens = found.constraint_multipliers[:, -count:]
        tips = found.phi[:, -count:]
        # Arrays need the same number in each frame: that of the frame with most active ones. The others are filled
        # up with the next largest multipliers.
        most = int((burdens > ACTIVE_CONSTRAINT_SCENARIO_SHARE * burdens.max()).sum(axis=1).max())
        kept = np.argsort(-burdens, axis=1, kind="stable")[:, :most]
        frames = np.arange(len(tips))[:, None]
        return FrameVertices(self.corners[frames, kept], tips[frames, kept])


def plan_with_constraint_scenarios(
    held: Round, scenarios: Scenarios, corners: ToleranceVertices, lost: FailureJudge, number: int
) -> list[Round]:
    """Re-plan a motion so that fewer vertices fail; an empty list where few do, or where that is not possible.

    held: a round over all frames with few lost robots. scenarios: the first ones of that round, which were planned
    for from the beginning. corners: vertices of the tolerances. lost: finds the robots that are lost on the
    resulting motion, as motion number `number`. The vertices that fail at the smallest part of their difference
    are given up, as many as may fail; others that fail, or nearly, become constraint scenarios.
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
    # Vertices that fail at the smallest part of their difference would cost most to keep stable.
    spared = np.argsort(borne, kind="stable")[: corners.allowed_failures]
    # Finite: failing within MAX_VERTEX_SCALE times their difference. Vertices that are barely stable now would
    # fail on a slightly different motion.
    new = np.setdiff1d(np.flatnonzero(np.isfinite(borne)), spared)
    parts = np.full(len(borne), CONSTRAINT_SCENARIO_START_SCALE)
    for _ in range(MAX_CONSTRAINT_SCENARIO_ROUNDS):
        if least <= corners.allowed_failures or not len(new) or held.search.stop():
            break
        # The tips of a new scenario start on the nominal robot's branch, where they are to stay.
        placed = placed.with_vertices(new, tried.solution.phi[:, :1])
        search, tried = _solve_with_constraints(held.search, tried, scenarios, corners, placed, parts)
        if not tried.is_shared or tried.solution.objective > dearest:
            break
        placed = placed.keep_active(tried.solution)
        gone = np.flatnonzero(corners.find_failing_vertices(tried.solution.q))
        new = np.setdiff1d(gone, spared)
        # A vertex that fails though it is constrained does so between frames. With a larger difference in the
        # frames it stays stable between them.
        parts[np.intersect1d(new, placed.corners)] += CONSTRAINT_SCENARIO_SCALE_STEP
        # Only the best round is returned, and only where fewer vertices fail than in all before.
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
    """Solve a motion again with constraint scenarios; return the search with these, and the result.

    before: the result so far. corners: all vertices. placed: those of each frame. parts: (C,), the multiple of its
    difference that each vertex has as a scenario.
    """
    robots = corners.with_part(placed.corners, parts[placed.corners])
    found = before.solution
    of_robots = robots.numbers, robots.offsets, robots.forces
    each = (values.reshape(*placed.corners.shape, *values.shape[1:]) for values in of_robots)
    search = replace(search, guards=ConstraintScenarios(*each))
    tips = np.concatenate([found.phi[:, : len(scenarios)], placed.tips], axis=1)
    known = replace(before, solution=replace(found, phi=tips))
    return search, solve_with_scenarios(search, known, scenarios, barrier=WARM_START_BARRIER_MM2)
