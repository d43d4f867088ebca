"""The last rounds of a robust plan: corners of the tolerances as guards, in place of robots that joined before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.steer.robust.corners import Corners
from ctr_nlp.steer.robust.rounds import Judge, Round, solved_again
from ctr_nlp.steer.robust.search import Tried
from ctr_nlp.typing import Array, Index

GUARDINGS = 3
"""Times that corners which are lost join, at most."""
DEARER = 0.08
"""By which part of itself the objective may grow for them."""
IDLE = 1e-4
"""A guard that costs less than this part of what the dearest costs is left out."""


def guarded(held: Round, count: int, corners: Corners, lost: Judge, number: int) -> list[Round]:
    """The motion of a round, planned again so that fewer corners are lost; none where few are, or it cannot be.

    held: a round over all frames on whose motion few robots are lost; the first `count` of its scenarios were
    planned for from the beginning. Those corners that bear least of their difference are given up, as many as may
    be lost; others that are lost, or nearly, join as guards until no more are lost than may be, or none is left to
    join. lost: is asked of the motion that comes of it, the number-th.
    """
    search, (tried, scenarios) = held.search, _first(held, count)
    if not held.lost.few:
        return []
    borne, busy, best = corners.borne(held.tried.solution.q), np.zeros(0, dtype=int), list[Round]()
    least, dearest = int((borne <= 1.0).sum()), (1 + DEARER) * held.tried.solution.objective
    spared = np.argsort(borne, kind="stable")[: corners.allowed]
    new = np.setdiff1d(np.flatnonzero(np.isfinite(borne)), spared)
    for _ in range(GUARDINGS):
        if least <= corners.allowed or not len(new) or search.stop():
            break
        busy = np.append(busy, new)
        tried = solved_again(search, tried, scenarios.guarded(*corners.guards(busy)))
        if not tried.shared or tried.solution.objective > dearest:
            break
        gone = np.flatnonzero(corners.lost(tried.solution.q))
        tried, busy = _without_idle(tried, busy)
        new = np.setdiff1d(gone, np.append(spared, busy))
        if len(gone) < least:
            least, guards = len(gone), scenarios.guarded(*corners.guards(busy))
            best = [held._replace(tried=tried, scenarios=guards, corners=least)]
    return [one._replace(lost=lost(one.tried.solution.q, number, False)) for one in best]


def _first(held: Round, count: int) -> tuple[Tried, Scenarios]:
    """The motion of a round with the first of its scenarios."""
    found = held.tried.solution
    return replace(held.tried, solution=replace(found, phi=found.phi[:, :count])), held.scenarios.first(count)


def _without_idle(tried: Tried, guards: Index) -> tuple[Tried, Index]:
    """The same solution without guards, the last scenarios, that cost nothing."""
    found = tried.solution
    burdens = found.burdens[-len(guards) :]
    busy = burdens > IDLE * burdens.max()
    kept: Array = np.append(np.ones(len(found.burdens) - len(guards), dtype=bool), busy)
    fewer = replace(found, phi=found.phi[:, kept], burdens=found.burdens[kept])
    return replace(tried, solution=fewer), guards[busy]
