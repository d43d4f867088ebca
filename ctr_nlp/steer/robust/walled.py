"""Robust motions within a lumen: from one that is free of its wall, with the largest weight of contact that errors
afford.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctr_nlp.formulations.wall import Wall
from ctr_nlp.simulation.forward import simulated
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.steer.inside import Outcome
from ctr_nlp.steer.robust.rounds import BARRIER, Judge, Round, planned_again
from ctr_nlp.steer.robust.search import RobustSearch, Tried
from ctr_nlp.typing import Array, Index

FIRST, STEP = 0.1, 4.0
"""The first weight that is tried, as a part of the one asked for; by which factor the next is larger at most."""
NEAR, AIM, FULL = 0.8, 0.9, 0.98
"""Parts of what errors may grow by: a weight is taken where they grow by something between the first and the last,
which is not all, since programs integrate in fewer steps than a plan is judged with; and what is aimed at."""
LEAST = 1e-6
"""What stands for no growth."""
TRIES = 8
"""Weights that are tried on the frames of a draft."""
LIGHTER, AGAIN = 0.8, 4
"""By which factor a weight is less where it turns out to cost too much over all frames, and how often."""


@dataclass(frozen=True)
class Walled:
    """Motions within a wall, from a round that is free of it, over all frames.

    cost: by what part of itself the root mean square of all scenarios' errors may grow, and the nominal robot's e3
    too. lost, most: as planned_again.
    """

    wall: Wall
    free: Round
    cost: float
    lost: Judge
    most: int

    @property
    def search(self) -> RobustSearch:
        """As the round was found."""
        return self.free.search

    def rounds(self, first: int) -> list[Round]:
        """Rounds over all frames from this number on; none where none that was tried will do."""
        found = self._on_draft()
        if found is None:
            return []
        weight, draft = found
        whole = self._search(weight).refined(draft, self.free.scenarios)
        for _ in range(AGAIN):
            search = self._search(weight)
            if self._affords(whole):
                made = planned_again(search, whole, self.free.scenarios, self.lost, self.most, first)
                if kept := [one for one in made if self._affords(one.tried) and self._survives(one)]:
                    return kept
            if self.search.stop():
                break
            weight *= LIGHTER
            motion, known = self._search(weight).motion(self.free.scenarios), whole.solution
            again = SharedSolver(motion)(known.q, known.phi, BARRIER, self.search.stop)
            whole = self.search.looked_at(replace(whole, solution=again))
        return []

    def _survives(self, one: Round) -> bool:
        """Whether few robots are lost, unless more are without the wall, too."""
        return one.lost.few or not self.free.lost.few

    def _search(self, weight: float) -> RobustSearch:
        return replace(self.search, wall=replace(self.wall, weight=weight))

    def _on_draft(self) -> tuple[float, Tried] | None:
        """The largest weight at which errors grow by little enough on the frames of a draft, and the motion there.

        Weights grow from one that hardly counts, each from the motion before, which is near.
        """
        picked = slice(None) if self.search.picked is None else self.search.picked
        most, known = self.wall.weight, self.free.tried.solution
        q, phi, found = known.q[picked], known.phi[picked], None
        low, high, weight = (0.0, -1.0), (math.inf, math.inf), FIRST * most
        for _ in range(TRIES):
            motion = self._search(weight).motion(self.free.scenarios, self.search.picked)
            solution = SharedSolver(motion)(q, phi, BARRIER, self.search.stop)
            growth = self._growth(solution, picked) if solution.success else math.inf
            if solution.success and growth <= FULL * self.cost:
                q, phi, low = solution.q, solution.phi, (weight, growth)
                found = weight, Tried(self.free.tried.start, len(q), solution)
                if weight == most or growth >= NEAR * self.cost:
                    break
            else:
                high = weight, growth
            if self.search.stop():
                break
            weight = self._between(low, high)
        return found

    def _between(self, low: tuple[float, float], high: tuple[float, float]) -> float:
        """The weight to try next, from one at which errors grow too little and one at which they grow too much."""
        least, aim = max(low[1], LEAST), max(AIM * self.cost, LEAST)
        if math.isinf(high[0]):
            more = low[0] * min(STEP, aim / least)
            return more if more < NEAR * self.wall.weight else self.wall.weight
        if not low[0]:
            return high[0] / STEP
        part = math.log(aim / least) / math.log(high[1] / least) if math.isfinite(high[1]) else 0.5
        return float(low[0] * (high[0] / low[0]) ** min(max(part, 0.1), 0.9))

    def _growth(self, solution: SharedSolution, picked: Index | slice) -> float:
        """By what part errors have grown: of all scenarios together, or of the nominal robot if that is more."""
        known = self.free.tried.solution
        before = self._errors(known.q[picked], known.phi[picked])
        return float((self._errors(solution.q, solution.phi) / before).max() - 1)

    def _errors(self, q: Array, phi: Array) -> Array:
        """Root mean squares over frames, mm: of the scenarios that were planned for, and of the nominal robot."""
        picked = None if len(q) == self.search.problem.frames else self.search.picked
        motion = replace(self.search, guards=None).motion(self.free.scenarios, picked)
        squares = Condensed(motion).by_robot(q, phi[:, : len(self.free.scenarios)]).mean(axis=0)
        return np.sqrt([squares @ motion.weights, squares[0]])

    def _affords(self, tried: Tried) -> bool:
        """Whether a motion over all frames is one, and costs no more than it may."""
        if not tried.shared or self._growth(tried.solution, slice(None)) > self.cost:
            return False
        return self._outcome(tried).growth(self._free) <= self.cost

    @cached_property
    def _free(self) -> Outcome:
        return self._outcome(self.free.tried)

    def _outcome(self, tried: Tried) -> Outcome:
        problem, found = self.search.problem, tried.solution
        solved = np.full(problem.frames, found.success)
        return Outcome.of(problem, simulated(problem.robot, found.q, self.search.model), found.x, solved)
