"""Rounds: robots that were drawn and lost join the scenarios, and the motion is planned again."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.steer.motions import filled
from ctr_nlp.steer.robust.search import RobustSearch, Tried
from ctr_nlp.typing import Array, Index

JOINING = 6
"""Lost robots that join the scenarios in one round, at most."""
WEIGHT = 0.2
"""What each of them counts, as a part of what others do: where robots are lost, few are."""

BARRIER = 1e-3
"""First barrier, mm^2, of a motion that is planned again."""


class Lost(NamedTuple):
    """Robots that were drawn and lost: numbers (L, d, 6) of their tubes and offsets (L, d) of their
    motors, rad.
    """

    numbers: Array
    offsets: Array


class Round(NamedTuple):
    """A motion, the scenarios that it was planned for, and how many robots were lost of those drawn then."""

    tried: Tried
    scenarios: Scenarios
    lost: int

    def described(self) -> dict[str, float]:
        """For a plan's meta; the objective as mean over frames, mm^2."""
        found = self.tried.solution
        return {
            "scenarios": len(self.scenarios),
            "frames": self.tried.frames,
            "objective": found.objective / self.tried.frames,
            "iterations": found.iterations,
            "lost": self.lost,
        }


def planned_again(
    search: RobustSearch,
    tried: Tried,
    scenarios: Scenarios,
    lost: Callable[[Array, int], Lost],
    most: int,
    first: int = 0,
) -> list[Round]:
    """A motion and what became of it over at most so many rounds, until none is lost.

    lost: (q (T, 2d + 2), number of the round, from `first` on) -> robots lost of those drawn in that round.
    """
    rounds, frames = list[Round](), search.problem.frames
    picked = search.picked if tried.frames < frames else None
    for number in range(most + 1):
        q = tried.solution.q if picked is None else filled(tried.solution.q, picked, frames)
        found = lost(q, first + number)
        rounds.append(Round(tried, scenarios, len(found.offsets)))
        if not len(found.offsets) or number == most or search.stop():
            break
        scenarios = _joined(scenarios, found)
        tried = _again(search, tried, scenarios, picked)
        if not tried.solved:
            break
    return rounds


def _again(search: RobustSearch, before: Tried, scenarios: Scenarios, picked: Index | None) -> Tried:
    """A motion solved again with scenarios that have joined; these grow where nothing comes of that."""
    known = before.solution
    joining = np.repeat(known.phi[:, :1], len(scenarios) - known.phi.shape[1], axis=1)
    tips = np.concatenate([known.phi, joining], axis=1)
    found = SharedSolver(search.motion(scenarios, picked))(known.q, tips, BARRIER, search.stop)
    tried = search.looked_at(Tried(before.start, before.frames, found))
    if tried.solved or search.stop():
        return tried
    alike = np.repeat(known.phi[:, :1], len(scenarios), axis=1)
    return search.looked_at(search.grown(before.start, known.q, alike, scenarios, picked))


def _joined(scenarios: Scenarios, lost: Lost) -> Scenarios:
    """Scenarios, and the first of lost robots."""
    numbers, offsets = (each[:JOINING] for each in lost)
    share = WEIGHT * float(scenarios.weights.max())
    return scenarios.joined(Scenarios(numbers, offsets, np.full(len(offsets), share)))
