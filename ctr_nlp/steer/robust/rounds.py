"""Rounds: robots that were tried and lost join the scenarios, and the motion is planned again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.steer.motions import filled
from ctr_nlp.steer.realised import GIVEN, MOST
from ctr_nlp.steer.robust.search import RobustSearch, Tried
from ctr_nlp.steer.robust.trials import JOINING, Lost, Trial
from ctr_nlp.typing import Array, Flags, Index

DEAR, SPARINGS = 0.05, 6
"""A robot that joined is dear where its burden is more than so much of the objective, a unit; how often such
robots are given up, as far as extreme ones may be lost."""
IDLE = 0.01
"""Of the largest burden: what robots with a smaller one add on a draft tells nothing about all frames."""
BARRIER = 1e-3
"""First barrier, mm^2, of a motion that is planned again."""


Judge = Callable[[Array, int, bool], Trial]
"""(q (T, 2d + 2), number of a motion, whether it is a draft) -> the robots lost on it of those tried."""


class Round(NamedTuple):
    """A motion, the search and the scenarios that it comes from, and what became of the robots tried then."""

    search: RobustSearch
    tried: Tried
    scenarios: Scenarios
    trial: Trial

    def described(self) -> dict[str, float]:
        """For a plan's meta; the objective as mean over frames, mm^2."""
        found = self.tried.solution
        return {
            "scenarios": len(self.scenarios),
            "frames": self.tried.frames,
            "objective": found.objective / self.tried.frames,
            "iterations": found.iterations,
            "lost": len(self.trial.draws.frames),
            "drawn": self.trial.draws.tried,
            "extremes_lost": len(self.trial.extremes.frames),
            "extremes": self.trial.extremes.tried,
            "contact_weight": 0.0 if self.search.wall is None else self.search.wall.weight,
        }

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        """The least is the best: of those in which few robots were lost the one of least objective."""
        return *self.trial.rank, self.tried.solution.objective

    def only(self, chosen: Flags) -> tuple[Tried, Scenarios]:
        """To go on from: the motion with those scenarios that are chosen (S,), the first among them."""
        found = self.tried.solution
        fewer = replace(found, phi=found.phi[:, chosen], burdens=found.burdens[chosen])
        return replace(self.tried, solution=fewer), self.scenarios.only(chosen)

    def lean(self) -> tuple[Tried, Scenarios]:
        """To go on from: without robots that joined and were idle."""
        burdens = self.tried.solution.burdens
        return self.only(~self.scenarios.guards | (burdens > IDLE * burdens.max()))


def best_of(rounds: Sequence[Round], frames: int) -> Round | None:
    """The best of rounds over so many frames, the last of equals; None without any."""
    whole = [one for one in rounds if one.tried.frames == frames]
    return min(reversed(whole), key=lambda one: one.rank, default=None)


def planned_again(
    search: RobustSearch,
    tried: Tried,
    scenarios: Scenarios,
    lost: Judge,
    most: int,
    first: int = 0,
) -> list[Round]:
    """A motion and what becomes of it over at most so many rounds, until few are lost.

    lost: what is asked of every round, which are numbered from `first` on. Where robots are lost though they have
    joined, or others like them, frames are not near enough to each other there to tell of the way between them;
    more margin does.
    """
    rounds, frames = list[Round](), search.problem.frames
    picked = search.picked if tried.frames < frames else None
    for number in range(most + 1):
        q = tried.solution.q if picked is None else filled(tried.solution.q, picked, frames)
        trial = lost(q, first + number, picked is not None)
        rounds.append(Round(search, tried, scenarios, trial))
        if trial.few or number == most or search.stop():
            break
        new = trial.worst.beside(scenarios)
        if not len(new.frames) or (trial.extremes.few and number):
            search = replace(search, margins=firmer(search.margins, trial.worst.frames, picked))
        scenarios = joined(scenarios, new)
        tried = _again(search, tried, scenarios, picked)
        if not tried.shared:
            break
    return rounds


def spared(held: Round, lost: Judge, first: int) -> list[Round]:
    """Rounds in which the dearest of the robots that joined are given up, as many as may be lost in all; others
    that are lost join in their place.

    held: a round on whose motion few are. lost: asked of every round, which are numbered from `first` on.
    """
    rounds, search, given_up = list[Round](), held.search, held.scenarios.only(~held.scenarios.guards)
    while (held.trial.few or rounds) and len(rounds) < SPARINGS and not search.stop():
        left = held.trial.extremes.allowed - int(given_up.guards.sum())
        burdens = held.tried.solution.burdens * held.scenarios.guards
        worth = left > 0 and burdens.max() >= DEAR * held.tried.solution.objective
        if held.trial.few and not worth:
            break
        dear = worth & (burdens >= max(np.sort(burdens)[-(left // 2 + 1)], IDLE * burdens.max()))
        given_up = given_up.joined(held.scenarios.numbers[dear], held.scenarios.offsets[dear])
        before, scenarios = held.only(~dear)
        scenarios = joined(scenarios, held.trial.extremes.beside(given_up))
        tried = _again(search, before, scenarios, None)
        if not tried.shared:
            break
        held = Round(search, tried, scenarios, lost(tried.solution.q, first + len(rounds), False))
        rounds.append(held)
    return rounds


def _again(search: RobustSearch, before: Tried, scenarios: Scenarios, picked: Index | None) -> Tried:
    """A motion solved again with scenarios that have joined, or fewer; these grow where nothing comes of that."""
    known = before.solution
    joining = np.repeat(known.phi[:, :1], len(scenarios) - known.phi.shape[1], axis=1)
    tips = np.concatenate([known.phi, joining], axis=1)
    found = SharedSolver(search.motion(scenarios, picked))(known.q, tips, BARRIER, search.stop)
    tried = search.looked_at(Tried(before.start, before.frames, found))
    if tried.shared or search.stop():
        return tried
    return search.grown(before.start, known.q, known.phi[:, :1], scenarios, picked)


def joined(scenarios: Scenarios, lost: Lost) -> Scenarios:
    """Scenarios, and the first of lost robots that are not among them, which count nothing."""
    new = lost.beside(scenarios)
    return scenarios.joined(new.numbers[:JOINING], new.offsets[:JOINING])


def firmer(margins: Array | None, frames: Index, picked: Index | None = None) -> Array | None:
    """Margins (T,) that are larger in frames, from 1, where robots were lost on the way, and in those before.

    picked: the frames that a draft has, of which the nearest on both sides count.
    """
    if margins is None:
        return None
    found, known = margins.copy(), np.arange(len(margins)) if picked is None else picked
    after = np.searchsorted(known, np.unique(frames) - 1)
    beside = known[np.unique(np.concatenate([after, np.maximum(after - 1, 0)]))]
    found[beside] = np.maximum(found[beside], np.minimum(found[beside] + GIVEN, MOST))
    return found
