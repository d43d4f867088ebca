"""Rounds: robots that were drawn and lost join the scenarios, and the motion is planned again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.solvers.scenarios.interior import COARSE
from ctr_nlp.steer.motions import filled
from ctr_nlp.steer.realised import GIVEN, MOST
from ctr_nlp.steer.robust.search import BARRIER, RobustSearch, Tried
from ctr_nlp.steer.robust.trials import JOINING, Lost
from ctr_nlp.typing import Array, Index

PUSHES = 1.5, 1.2, 1.0
"""How many times its difference from the described robot a lost one joins with, the first that leads to a motion.
Beyond what is asked for, it stands for others like it; it need only be stable, and not near to the target."""
NEARER, GAIN, RELAXATIONS = 0.8, 0.03, 2
"""By which factor these differences are made smaller once few robots are lost, where that lowers the objective by
more than the second part of it; and how often."""
AFFECTED = 0.1
"""About how far, rad and of the margin, robots that joined are moved away from their limits by that: times what
these limits cost, it is what may be gained."""


SAMPLES = 200
"""Robots that a motion is judged on."""
FAILING_ALLOWED = 2
"""Of these: with 4 of 200 fresh robots that fail, a plan is just certified."""

Judge = Callable[[Array, int, bool], Lost]
"""(q (T, 2d + 2), number of a motion, whether it is a draft) -> the robots lost on it of those drawn for it."""


class Failing(NamedTuple):
    """Robots that fail on a motion, the worst first, and how many hold.

    Attributes
    ----------
    numbers, offsets, forces : ndarray
        Of the F failing robots that keep the branch: (F, d, 8) of the tubes, (F, d) of the motors' zeros in rad,
        (F, 3) N at the tips.
    held : float
        Share of all robots that keep the branch, arrive, and keep off the wall.
    """

    numbers: Array
    offsets: Array
    forces: Array
    held: float

    @property
    def enough(self) -> bool:
        """Whether so many hold that the motion will most likely be certified."""
        return self.held >= 1 - FAILING_ALLOWED / SAMPLES


class Round(NamedTuple):
    """A motion, the search and the scenarios that it comes from, and what became of the robots drawn then."""

    search: RobustSearch
    tried: Tried
    scenarios: Scenarios
    lost: Lost
    corners: int | None = None
    """How many corners of the tolerances are lost; None where that was not looked at."""
    failing: Failing | None = None
    """Robots that do not arrive or press into the wall; None where that was not looked at."""

    def described(self) -> dict[str, float | None]:
        """For a plan's meta; the objective as mean over frames, mm^2."""
        found = self.tried.solution
        return {
            "scenarios": len(self.scenarios),
            "guards": self.tried.solution.phi.shape[1] - len(self.scenarios),
            "frames": self.tried.frames,
            "objective": found.objective / self.tried.frames,
            "iterations": found.iterations,
            "lost": len(self.lost.frames),
            "drawn": self.lost.drawn,
            "corners_lost": self.corners,
            "held": None if self.failing is None else self.failing.held,
            "contact_weight": 0.0 if self.search.wall is None else self.search.wall.weight,
        }

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        """The least is the best: of those in which few robots were lost one with guards, then by what holds, or of
        least objective.
        """
        least = self.tried.solution.objective if self.lost.few else self.lost.share
        fails = 1.0 if self.failing is None else 1 - self.failing.held
        return not self.lost.few, self.corners is None, fails, least


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

    lost: what is asked of every round, which are numbered from `first` on. Where robots are lost though some have
    joined, frames are not near enough to each other there to tell of the way between them; more margin does.
    """
    rounds, frames = list[Round](), search.problem.frames
    picked = search.picked if tried.frames < frames else None
    for number in range(most + 1):
        q = tried.solution.q if picked is None else filled(tried.solution.q, picked, frames)
        found = lost(q, first + number, picked is not None)
        rounds.append(Round(search, tried, scenarios, found))
        if found.few or number == most or search.stop():
            break
        if number:
            search = replace(search, margins=firmer(search.margins, found.frames, picked))
        for push in PUSHES:
            more = joined(scenarios, found, push)
            again = _again(search, tried, more, picked)
            if again.shared or search.stop():
                break
        if not again.shared:
            break
        tried, scenarios = again, more
    return rounds


def relaxed(held: Round, first: int, lost: Judge, number: int) -> list[Round]:
    """Rounds in which robots that joined, scenarios from `first` on, differ less, while few robots are lost.

    held: a round on whose motion few are. lost: asked of every round, which are numbered from `number` on.
    """
    rounds, search = list[Round](), held.search
    while len(held.scenarios) > first and held.lost.few and len(rounds) < RELAXATIONS and not search.stop():
        burden = held.tried.solution.burdens[:, first : len(held.scenarios)].sum()
        if AFFECTED * burden <= GAIN * held.tried.solution.objective:
            break
        scenarios = held.scenarios.shrunk(NEARER, first)
        tried = _again(search, held.tried, scenarios, None)
        if not tried.shared or tried.solution.objective > (1 - GAIN) * held.tried.solution.objective:
            break
        held = Round(search, tried, scenarios, lost(tried.solution.q, number + len(rounds), False))
        rounds.append(held)
    return rounds


def _again(search: RobustSearch, before: Tried, scenarios: Scenarios, picked: Index | None) -> Tried:
    """A motion solved again with scenarios that have joined; on a draft these grow where nothing comes of that."""
    tried = solved_again(search, before, scenarios, picked)
    if tried.shared or picked is None or search.stop():
        return tried
    known = before.solution
    return search.grown(before.start, known.q, known.phi[:, :1], scenarios, picked)


def solved_again(
    search: RobustSearch,
    before: Tried,
    scenarios: Scenarios,
    picked: Index | None = None,
    barrier: float = BARRIER,
) -> Tried:
    """A motion solved again with scenarios of which the last have joined, from tips as the first one's."""
    known, motion = before.solution, search.motion(scenarios, picked)
    old = known.phi.shape[1] - (motion.sizes[1] - len(scenarios))
    joining = np.repeat(known.phi[:, :1], len(scenarios) - old, axis=1)
    tips = np.concatenate([known.phi[:, :old], joining, known.phi[:, old:]], axis=1)
    found = SharedSolver(motion, COARSE)(known.q, tips, barrier, search.stop, rough=picked is not None)
    return search.looked_at(Tried(before.start, before.frames, found))


def joined(scenarios: Scenarios, lost: Lost, push: float = PUSHES[0]) -> Scenarios:
    """Scenarios, and the first of lost robots with so many times their difference, which count nothing."""
    numbers, offsets, _, forces = (each[0] for each in scenarios.each)
    pairs = (numbers, lost.numbers), (offsets, lost.offsets), (forces, lost.forces)
    return scenarios.joined(*(first + push * (each[:JOINING] - first) for first, each in pairs))


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
