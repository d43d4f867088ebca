"""How much clearance is worth: the largest weight of contact at which errors grow by no more than a given part."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ctr_nlp.formulations.wall import Wall
from ctr_nlp.plan.metrics import rms_over_sigma, root_mean_square
from ctr_nlp.plan.plan import elsewhere
from ctr_nlp.simulation.forward import Simulation, Simulator
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Pass, run_again
from ctr_nlp.steer.realised import held
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array, Flags

LIGHTEST = 1e-3
"""Least weight of contact that is tried, as a part of the one asked for."""
LEAST = 1e-6
"""What stands for no growth of errors."""
NEAR, AIM = 0.96, 0.98
"""Parts of what errors may grow by: least with which a weight is kept without trying others; what is aimed at."""
TRIES = 8
"""Weights less than the whole one that are tried."""
ROUNDING = 1e-6
"""mm by which e3 may exceed its limit: rounding."""
TINY = 1e-12
"""mm: what stands for no error in a denominator."""

Found = TypeVar("Found")
Tried = tuple[float, float]
"""A weight of contact, mm^2 a mm, and by what part errors grow there; NaN where a motion will not do at all."""


def affordable(
    wall: Wall,
    solve: Callable[[Wall], Found],
    judge: Callable[[Wall, Found], Tried],
    cost: float,
    stop: Callable[[], bool],
) -> tuple[Wall, Found] | None:
    """What solve finds, and the wall with the weight that it was found with: the whole one where errors grow by no
    more than a part, cost; else the largest at which they do, or one at which they grow by nearly as much. None
    where they grow by more with whatever was tried.

    judge: the least weight that leads to what was found within a wall, and by what part errors grow there.
    """
    lightest, kept = LIGHTEST * wall.weight, None

    def judged(tried: Wall, found: Found) -> Tried:
        weight, grown = judge(tried, found)
        return tried.weight if math.isnan(grown) else max(weight, lightest), grown

    whole = solve(wall)
    high = judged(wall, whole)
    if high[1] <= cost:
        return wall, whole
    low, sides = (lightest, high[1] * lightest / high[0]), ""
    for _ in range(TRIES):
        if stop():
            break
        one_sided = kept is not None and sides[-2:] in ("++", "--")
        weight = lightest if math.isnan(low[1]) else between(low, high, AIM * cost, one_sided)
        tried = replace(wall, weight=weight)
        found = solve(tried)
        at = judged(tried, found)
        sides += "-" if at[1] <= cost else "+"
        if at[1] <= cost:
            low, kept = at, (tried, found)
            if at[1] >= NEAR * cost:
                break
        elif tried.weight <= lightest:
            break
        else:
            low, high = low if kept else (lightest, beyond(high, at, lightest)), at
    return kept


def between(low: Tried, high: Tried, aim: float, halfway: bool) -> float:
    """The weight between two at which errors should grow by what is aimed at, about a power of the weight; halfway
    where that is asked for, and where they do not grow by less at the first and by more at the second.
    """
    least, aim = max(low[1], LEAST), max(aim, LEAST)
    power = least < aim < high[1] and not halfway
    part = math.log(aim / least) / math.log(high[1] / least) if power else 0.5
    return float(low[0] * (high[0] / low[0]) ** min(max(part, 0.1), 0.9))


def beyond(one: Tried, other: Tried, weight: float) -> float:
    """By what part errors should grow at a weight, from two others: about a power of the weight."""
    power = math.log(one[1] / other[1]) / math.log(one[0] / other[0])
    return float(other[1] * (weight / other[0]) ** power)


def needed(wall: Wall, multipliers: Array) -> float:
    """The least weight of contact, mm^2 a mm, that leads to what was found with that of a wall: what clearance
    pulls with, where nothing touches. multipliers (T,): of the slacks, negative where these are 0.
    """
    return float(np.clip(wall.weight + multipliers, 0.0, wall.weight).max(initial=0.0))


@dataclass(frozen=True)
class Outcome:
    """What a plan would tell of a motion. failed: frames not solved, or in which the robot would be elsewhere.

    e2: (T,) mm, NaN where no shape is known.
    """

    failed: int
    e2: Array

    @classmethod
    def of(cls, problem: Problem, moved: Simulation, x: Array, success: Flags) -> Outcome:
        """That of a motion found with unknowns x (T, n) and success (T,), through which the robot is moved."""
        away = moved.shape - np.array([frame.points for frame in problem.samples])
        failed = ~success | elsewhere(moved.x, x, moved.snaps, problem.robot.d)
        return cls(int(failed.sum()), rms_over_sigma(np.linalg.norm(away, axis=-1)))

    def growth(self, free: Outcome) -> float:
        """By what part e3 is larger than in a motion free of the wall, rounding apart; NaN where more frames fail
        than there, and where no shape is known.
        """
        known = np.isfinite(self.e2)
        found, least = root_mean_square(self.e2), root_mean_square(free.e2[known])
        if found is None or least is None or self.failed > free.failed:
            return math.nan
        return (found - ROUNDING) / max(least, TINY) - 1


def kept_inside(
    frames: NlpFrames, free: Pass, simulator: Simulator, stop: Callable[[], bool]
) -> tuple[Pass, Wall | None]:
    """A run through all frames again, within the wall, from the first answer of one that is free of it; the wall.

    That one, and None, where none within the wall keeps e3 and its frames, as far as was tried.
    """
    problem, wall, first = frames.problem, frames.wall, free.order[0]
    if wall is None or first not in free.results:
        return free, None

    def solve(tried: Wall) -> Pass:
        within = replace(frames, near=tried)
        one = run_again(free, within, stop)
        return one if stop() else held(within, one, simulator, stop)[0]

    def outcome(one: Pass) -> Outcome:
        success = np.array([j in one.results and one.results[j].success for j in range(problem.frames)])
        return Outcome.of(problem, simulator(one.motion(problem)), one.unknowns(problem), success)

    def judge(tried: Wall, one: Pass) -> Tried:
        pulls = [each.warm[0].lam_x[-1] for each in one.results.values() if each.warm]
        return needed(tried, np.array(pulls)), outcome(one).growth(least)

    least, cost = outcome(free), frames.settings.affordable()
    found = affordable(wall, solve, judge, cost, stop)
    return (free, None) if found is None else (found[1], found[0])
