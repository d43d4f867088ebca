"""Rounds of robust planning: samples that are lost on a motion join the scenarios, and it is planned again.

Scenarios have the mean and covariance of the tolerances, but they are few. The samples that snap or leave the
branch show where the motion has too little stability; as scenarios whose errors do not count (weight 0), they only
have to stay stable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.planning.motions import interpolate_frames
from ctr_nlp.planning.stability_refinement import BRANCH_LOSS_MARGIN_INCREASE, MAX_FRAME_MARGIN
from ctr_nlp.robust.search import BARRIER, RobustSearch, StartResult
from ctr_nlp.robust.trials import CERTIFICATION_SAMPLES, MAX_JOINING_SAMPLES, FailedSamples
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.solvers.scenarios.interior_point import COARSE_LAST_BARRIER_MM2
from ctr_nlp.typing import Array, Index

JOINING_SCALES = 1.5, 1.2, 1.0
"""Multiples of its difference from the nominal robot with which a lost sample joins; the first that leads to a
motion is taken. With more than its own difference it represents similar robots as well.
"""
RELAXATION_FACTOR, MIN_RELAXATION_GAIN, MAX_RELAXATIONS = 0.8, 0.03, 2
"""Factor by which these differences are reduced once few robots are lost, relative decrease of the objective that
makes that worthwhile, and largest number of reductions.
"""
AFFECTED = 0.1
"""Estimate of how far, in rad and in margin, a reduction moves joined robots away from their limits. Times the
multipliers of these limits, it estimates the decrease of the objective.
"""
FAILING_ALLOWED = 2
"""Number of CERTIFICATION_SAMPLES robots that may fail on a motion: with 4 of 200 fresh ones a plan is just
certified.
"""

FailureJudge = Callable[[Array, int, bool], FailedSamples]
"""(q (T, 2d + 2), number of a motion, whether it is a draft) -> the samples that are lost on it."""


class FailingSamples(NamedTuple):
    """Samples that stay on the branch but do not arrive or press into the wall, the worst first.

    Attributes
    ----------
    numbers, offsets, forces : ndarray
        Of these F samples: numbers of the tubes (F, d, 8), motors' zeros (F, d) in rad, forces at the tips (F, 3)
        in N.
    holding_share : float
        Share of all samples that stay on the branch, arrive, and keep off the wall.
    """

    numbers: Array
    offsets: Array
    forces: Array
    holding_share: float

    @property
    def enough(self) -> bool:
        """Whether so many samples pass that the motion will most likely be certified."""
        return self.holding_share >= 1 - FAILING_ALLOWED / CERTIFICATION_SAMPLES


class Round(NamedTuple):
    """A motion, the search and the scenarios that it comes from, and the samples that are lost on it."""

    search: RobustSearch
    tried: StartResult
    scenarios: Scenarios
    lost: FailedSamples
    corners: int | None = None
    """Number of vertices of the tolerances that fail; None where that was not checked."""
    failing: FailingSamples | None = None
    """Samples that do not arrive or press into the wall; None where that was not checked."""

    def to_meta(self) -> dict[str, float | None]:
        """Return the entry of the round in a plan's meta; the objective is a mean over frames, mm^2."""
        found = self.tried.solution
        return {
            "scenarios": len(self.scenarios),
            "guards": self.tried.solution.phi.shape[1] - len(self.scenarios),
            "frames": self.tried.frames,
            "objective": found.objective / self.tried.frames,
            "iterations": found.iterations,
            "lost": len(self.lost.frames),
            "drawn": self.lost.sample_count,
            "corners_lost": self.corners,
            "held": None if self.failing is None else self.failing.holding_share,
            "contact_weight": 0.0 if self.search.wall is None else self.search.wall.weight,
        }

    @property
    def rank(self) -> tuple[bool, bool, float, float]:
        """Sort key of rounds, best first: few lost robots, constraint scenarios, share that passes, objective."""
        # Where too many are lost, the motion that loses fewest is the best compromise, whatever it costs.
        least = self.tried.solution.objective if self.lost.few else self.lost.share
        fails = 1.0 if self.failing is None else 1 - self.failing.holding_share
        return not self.lost.few, self.corners is None, fails, least


def best_round(rounds: Sequence[Round], frames: int) -> Round | None:
    """Return the best of the rounds that cover all `frames`, the last of equal ones; None where there is none."""
    whole = [one for one in rounds if one.tried.frames == frames]
    return min(reversed(whole), key=lambda one: one.rank, default=None)


def replan_for_failures(
    search: RobustSearch,
    tried: StartResult,
    scenarios: Scenarios,
    lost: FailureJudge,
    most: int,
    first: int = 0,
) -> list[Round]:
    """Re-plan a motion for the samples that are lost on it; return all rounds.

    search, tried, scenarios: of the motion so far. lost: finds the samples lost on each round's motion. most:
    largest number of rounds after the first. first: number of the first motion.
    """
    rounds = list[Round]()
    frames = search.problem.frames
    picked = search.draft_frames if tried.frames < frames else None
    for number in range(most + 1):
        # Robots are simulated on all frames; a draft's motion is interpolated.
        q = tried.solution.q if picked is None else interpolate_frames(tried.solution.q, picked, frames)
        search.report_step(f"round {first + number + 1}: robots within the tolerances are simulated")
        found = lost(q, first + number, picked is not None)
        rounds.append(Round(search, tried, scenarios, found))
        if found.few or number == most or search.stop():
            break
        # Robots that are lost although others have joined are lost between frames: more margin in the frames on
        # both sides helps.
        if number:
            search = replace(search, margins=raise_margins_near_failures(search.margins, found.frames, picked))
        # A robot too different may have no stable motion in common with the others: then a smaller difference is
        # tried.
        search.report_step(f"round {first + number + 1}: planned again for robots that fail")
        for push in JOINING_SCALES:
            more = add_failed_samples(scenarios, found, push)
            again = _replan_once(search, tried, more, picked)
            if again.is_shared or search.stop():
                break
        if not again.is_shared:
            break
        tried = again
        scenarios = more
    return rounds


def relax_scenarios(held: Round, first: int, lost: FailureJudge, number: int) -> list[Round]:
    """Reduce the differences of robots that joined, scenarios from `first` on, while few samples are lost.

    held: a round with few lost samples. lost: finds the samples lost on each round's motion. number: of the first
    new motion.
    """
    rounds = list[Round]()
    search = held.search
    while len(held.scenarios) > first and held.lost.few and len(rounds) < MAX_RELAXATIONS and not search.stop():
        # A multiplier is the decrease of the objective per unit by which a limit is relaxed. Solving again takes
        # long, so that the gain is estimated first.
        burden = held.tried.solution.constraint_multipliers[:, first : len(held.scenarios)].sum()
        if AFFECTED * burden <= MIN_RELAXATION_GAIN * held.tried.solution.objective:
            break
        scenarios = held.scenarios.shrink_differences(RELAXATION_FACTOR, first)
        tried = _replan_once(search, held.tried, scenarios, None)
        if (
            not tried.is_shared
            or tried.solution.objective > (1 - MIN_RELAXATION_GAIN) * held.tried.solution.objective
        ):
            break
        held = Round(search, tried, scenarios, lost(tried.solution.q, number + len(rounds), False))
        rounds.append(held)
    return rounds


def _replan_once(
    search: RobustSearch, before: StartResult, scenarios: Scenarios, picked: Index | None
) -> StartResult:
    """Solve a motion again with scenarios that have joined; on a draft, where that fails, by homotopy.

    before: the result so far. picked: the draft's frames, None for all frames.
    """
    tried = solve_with_scenarios(search, before, scenarios, picked)
    if tried.is_shared or picked is None or search.stop():
        return tried
    known = before.solution
    return search.grow_scenarios(before.start, known.q, known.phi[:, :1], scenarios, picked)


def solve_with_scenarios(
    search: RobustSearch,
    before: StartResult,
    scenarios: Scenarios,
    picked: Index | None = None,
    barrier: float = BARRIER,
) -> StartResult:
    """Solve a motion again with scenarios of which the last have joined, starting from the nominal robot's tips.

    search: of the problem. before: the result so far. picked: frames of a draft, None for all. barrier: the first
    barrier parameter, mm^2.
    """
    known = before.solution
    motion = search.motion(scenarios, picked)
    # Tips are those of the scenarios, then of constraint scenarios; sizes[1] counts both. New scenarios come in
    # between.
    old = known.phi.shape[1] - (motion.sizes[1] - len(scenarios))
    joining = np.repeat(known.phi[:, :1], len(scenarios) - old, axis=1)
    tips = np.concatenate([known.phi[:, :old], joining, known.phi[:, old:]], axis=1)
    found = SharedSolver(motion, COARSE_LAST_BARRIER_MM2)(
        known.q, tips, barrier, search.stop, rough=picked is not None
    )
    return search.with_branch_check(StartResult(before.start, before.frames, found))


def add_failed_samples(scenarios: Scenarios, lost: FailedSamples, push: float = JOINING_SCALES[0]) -> Scenarios:
    """Return scenarios with the first MAX_JOINING_SAMPLES lost samples added, whose errors do not count.

    lost: the samples. push: multiple of its difference from the nominal robot that each has as a scenario.
    """
    numbers, offsets, _, forces = (each[0] for each in scenarios.arrays)
    pairs = (numbers, lost.numbers), (offsets, lost.offsets), (forces, lost.forces)
    return scenarios.append_robots(*(first + push * (each[:MAX_JOINING_SAMPLES] - first) for first, each in pairs))


def raise_margins_near_failures(margins: Array | None, frames: Index, picked: Index | None = None) -> Array | None:
    """Return margins (T,) raised in the frames in which robots were lost, and in the frames before these.

    frames: their numbers, from 1. picked: frames of a draft, of which the nearest on both sides are raised; None
    for all.
    """
    if margins is None:
        return None
    found = margins.copy()
    known = np.arange(len(margins)) if picked is None else picked
    # Frame numbers count from 1; searchsorted finds the first known frame at or after the loss.
    after = np.searchsorted(known, np.unique(frames) - 1)
    beside = known[np.unique(np.concatenate([after, np.maximum(after - 1, 0)]))]
    found[beside] = np.maximum(
        found[beside], np.minimum(found[beside] + BRANCH_LOSS_MARGIN_INCREASE, MAX_FRAME_MARGIN)
    )
    return found
