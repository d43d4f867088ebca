"""How much clearance is worth: the largest weight of contact at which errors grow by no more than a given part."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ctr_nlp.formulations.wall import Wall
from ctr_nlp.models import Model
from ctr_nlp.plan.metrics import rms_over_sigma, root_mean_square
from ctr_nlp.plan.plan import elsewhere
from ctr_nlp.plan.verdicts import largest_e3
from ctr_nlp.simulation.forward import simulated
from ctr_nlp.steer.attempts import Attempt
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Pass, run_again
from ctr_nlp.steer.realised import SAME, held
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array, Flags

LIGHTEST = 1e-3
"""Least weight of contact that is tried, as a part of the one asked for."""
BISECTIONS = 6
MOST = 4
"""Motions that are brought within a wall."""

Found = TypeVar("Found")


def affordable(
    wall: Wall, solve: Callable[[Wall], Found], will_do: Callable[[Found], bool], stop: Callable[[], bool]
) -> tuple[Wall, Found] | None:
    """What solve finds, and the wall with the weight that it was found with: the whole one where that will do;
    else the largest that does, by bisection. None where none of those tried will do.
    """
    whole = solve(wall)
    if will_do(whole):
        return wall, whole
    kept, low, high = None, math.log(LIGHTEST * wall.weight), math.log(wall.weight)
    for k in range(BISECTIONS + 1):
        if stop() or (k == 1 and kept is None):
            break
        tried = replace(wall, weight=math.exp((low + high) / 2 if k else low))
        found = solve(tried)
        if will_do(found):
            low, kept = math.log(tried.weight), (tried, found)
        else:
            high = math.log(tried.weight)
    return kept


@dataclass(frozen=True)
class Outcome:
    """What a plan would tell of a motion. failed: frames not solved, or in which the robot would be elsewhere.

    e2: (T,) mm, NaN where no shape is known.
    """

    failed: int
    e2: Array

    @classmethod
    def of(cls, problem: Problem, model: Model, q: Array, x: Array, success: Flags) -> Outcome:
        """That of configurations q (T, 2d + 2) found with unknowns x (T, n) and success (T,)."""
        moved = simulated(problem.robot, q, model)
        away = moved.shape - np.array([frame.points for frame in problem.samples])
        failed = ~success | elsewhere(moved.x, x, moved.snaps)
        return cls(int(failed.sum()), rms_over_sigma(np.linalg.norm(away, axis=-1)))

    def affords(self, free: Outcome, cost: float) -> bool:
        """Whether no more frames fail than in a motion free of the wall, and e3 is at most larger by this part."""
        known = np.isfinite(self.e2)
        found, least = root_mean_square(self.e2), root_mean_square(free.e2[known])
        if found is None or least is None or self.failed > free.failed:
            return False
        return found <= largest_e3(least, cost)


def distinct(attempts: Sequence[Attempt]) -> list[Attempt]:
    """The best attempts, best first, without those met before."""
    ranked = sorted(attempts, key=lambda one: (not one.solution.success, one.solution.objective))
    objectives = [one.solution.objective for one in ranked]
    found = [
        one
        for k, one in enumerate(ranked)
        if k == 0 or abs(objectives[k] - objectives[k - 1]) > SAME * (1 + abs(objectives[k]))
    ]
    return found[:MOST]


def kept_inside(frames: NlpFrames, free: Pass, stop: Callable[[], bool]) -> tuple[Pass, Wall | None]:
    """A run through all frames again, within the wall, from the first answer of one that is free of it; the wall.

    That one, and None, where none within the wall keeps e3 and its frames, as far as was tried.
    """
    problem, wall, first = frames.problem, frames.wall, free.order[0]
    if wall is None or first not in free.results:
        return free, None

    def solve(tried: Wall) -> Pass:
        within = replace(frames, near=tried)
        one = run_again(free, within, stop)
        return one if stop() else held(within, one, stop)[0]

    def outcome(one: Pass) -> Outcome:
        success = np.array([j in one.results and one.results[j].success for j in range(problem.frames)])
        return Outcome.of(problem, wall.model, one.motion(problem), one.unknowns(problem), success)

    least = outcome(free)
    cost = frames.settings.affordable()
    found = affordable(wall, solve, lambda one: outcome(one).affords(least, cost), stop)
    return (free, None) if found is None else (found[1], found[0])
