"""The last rounds of a robust plan: corners of the tolerances as guards, in place of robots that joined before."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import Guards, Scenarios
from ctr_nlp.solvers.motion.judged import CLOSE
from ctr_nlp.solvers.scenarios import SharedSolution
from ctr_nlp.steer.robust.corners import Corners
from ctr_nlp.steer.robust.rounds import Judge, Round, solved_again
from ctr_nlp.steer.robust.search import RobustSearch, Tried
from ctr_nlp.typing import Array, Index

GUARDINGS = 4
"""Times that corners which are lost join, at most."""
DEARER = 0.08
"""By which part of itself the objective may grow for them."""
IDLE = 1e-4
"""A guard is left out in frames where it costs less than this part of what the dearest costs."""
BEYOND, MORE = 1.0, 0.05
"""How many times its difference a guard has at first; and by how much more where it is lost all the same, between
frames that hold it."""


class Placed(NamedTuple):
    """Which corners guard each frame, (T, K), and their tips (T, K, k)."""

    corners: Index
    tips: Array

    @classmethod
    def none(cls, phi: Array) -> Placed:
        """Of a motion with tips phi (T, S, k)."""
        return cls(np.zeros((len(phi), 0), dtype=int), phi[:, :0])

    def beside(self, new: Index, first: Array) -> Placed:
        """These, and new corners in all frames, with tips as the first robot's, (T, 1, k)."""
        corners = np.concatenate([self.corners, np.tile(new, (len(first), 1))], axis=1)
        return Placed(corners, np.concatenate([self.tips, np.repeat(first, len(new), axis=1)], axis=1))

    def busy(self, found: SharedSolution) -> Placed:
        """Those that cost something at a solution of which they are the last robots, and others to fill up frames.

        What it is that a corner costs differs from frame to frame, and few do so in any one.
        """
        count = self.corners.shape[1]
        burdens, tips = found.burdens[:, -count:], found.phi[:, -count:]
        most = int((burdens > IDLE * burdens.max()).sum(axis=1).max())
        kept, frames = np.argsort(-burdens, axis=1, kind="stable")[:, :most], np.arange(len(tips))[:, None]
        return Placed(self.corners[frames, kept], tips[frames, kept])


def guarded(held: Round, scenarios: Scenarios, corners: Corners, lost: Judge, number: int) -> list[Round]:
    """The motion of a round, planned again so that fewer corners are lost; none where few are, or it cannot be.

    held: a round over all frames on whose motion few robots are lost; the first of its scenarios are these, which
    were planned for from the beginning. Those corners that bear least of their difference are given up, as many as
    may be lost; others that are lost, or nearly, join as guards until no more are lost than may be. lost: is asked
    of the motion that comes of it, the number-th.
    """
    found, tried, best = held.tried.solution, held.tried, list[Round]()
    least, dearest = int(corners.lost(found.q).sum()), (1 + DEARER) * found.objective
    if not held.lost.few or least <= corners.allowed:
        return []
    borne, placed = corners.borne(found.q), Placed.none(found.phi)
    spared = np.argsort(borne, kind="stable")[: corners.allowed]
    new, parts = np.setdiff1d(np.flatnonzero(np.isfinite(borne)), spared), np.full(len(borne), BEYOND)
    for _ in range(GUARDINGS):
        if least <= corners.allowed or not len(new) or held.search.stop():
            break
        placed = placed.beside(new, tried.solution.phi[:, :1])
        search, tried = _solved(held.search, tried, scenarios, corners, placed, parts)
        if not tried.shared or tried.solution.objective > dearest:
            break
        placed, gone = placed.busy(tried.solution), np.flatnonzero(corners.lost(tried.solution.q))
        new = np.setdiff1d(gone, spared)
        parts[np.intersect1d(new, placed.corners)] += MORE
        if len(gone) < least:
            least = len(gone)
            best = [held._replace(search=search, tried=tried, scenarios=scenarios, corners=least)]
    return [one._replace(lost=lost(one.tried.solution.q, number, False)) for one in best]


def _solved(
    search: RobustSearch, before: Tried, scenarios: Scenarios, corners: Corners, placed: Placed, parts: Array
) -> tuple[RobustSearch, Tried]:
    """A motion solved again with guards that have so many times (C,) their difference; the search that did so."""
    robots, found = corners.with_part(placed.corners, parts[placed.corners]), before.solution
    of_robots = robots.numbers, robots.offsets, robots.forces
    each = (values.reshape(*placed.corners.shape, *values.shape[1:]) for values in of_robots)
    search = replace(search, guards=Guards(*each))
    tips = np.concatenate([found.phi[:, : len(scenarios)], placed.tips], axis=1)
    known = replace(before, solution=replace(found, phi=tips))
    return search, solved_again(search, known, scenarios, barrier=CLOSE)
