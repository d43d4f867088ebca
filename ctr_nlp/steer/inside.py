"""How much clearance is worth: the weight of contact at which errors grow by a given part."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from ctr_nlp.formulations.contact import Wall
from ctr_nlp.forward import points_of
from ctr_nlp.metrics import rms_over_sigma
from ctr_nlp.problem import Problem
from ctr_nlp.steer.attempts import Attempt
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Pass
from ctr_nlp.steer.realised import SAME, held
from ctr_nlp.target import SIGMA, Frame

Array = npt.NDArray[np.float64]

LIGHTEST = 1e-3
"""Least weight of contact that is tried, as a part of the one asked for."""
BISECTIONS = 6
MOST = 4
"""Motions that are brought within a wall."""

Found = TypeVar("Found")


def affordable(
    wall: Wall,
    limit: float,
    solve: Callable[[Wall], Found],
    error: Callable[[Found], float],
    stop: Callable[[], bool],
) -> tuple[Wall, Found]:
    """What solve finds, and the wall with the weight that it was found with: the whole one where that keeps errors
    within a limit; else the largest that does, by bisection. An error is inf where what was found will not do.
    """
    kept, limit = (wall, solve(wall)), min(limit, sys.float_info.max)
    if stop() or error(kept[1]) <= limit:
        return kept
    low, high = math.log(LIGHTEST * wall.weight), math.log(wall.weight)
    for k in range(BISECTIONS + 1):
        tried = replace(wall, weight=math.exp((low + high) / 2 if k else low))
        found = solve(tried)
        if k == 0 or error(found) <= limit:
            low, kept = math.log(tried.weight), (tried, found)
        else:
            high = math.log(tried.weight)
        if stop():
            break
    return kept


def errors(wall: Wall, frames: Sequence[Frame], motion: Array) -> Array:
    """The error e2 (T,) in mm of a motion (T, n)."""
    away = points_of(wall.robot, motion, SIGMA, wall.model) - np.array([frame.points for frame in frames])
    return rms_over_sigma(np.linalg.norm(away, axis=-1))


def distinct(attempts: Sequence[Attempt]) -> list[Array]:
    """The best motions of attempts, best first, without those met before."""
    ranked = sorted(attempts, key=lambda one: (not one.solution.success, one.solution.objective))
    objectives = [one.solution.objective for one in ranked]
    found = [
        one.motion
        for k, one in enumerate(ranked)
        if k == 0 or abs(objectives[k] - objectives[k - 1]) > SAME * (1 + abs(objectives[k]))
    ]
    return found[:MOST]


def kept_inside(problem: Problem, frames: NlpFrames, free: Pass, stop: Callable[[], bool]) -> Pass:
    """A run through all frames again, within the wall, from the first answer of one that is free of it.

    That one where fewer frames are solved within the wall.
    """
    wall, first = frames.wall, free.order[0]
    if wall is None or first not in free.results:
        return free

    def solve(tried: Wall) -> Pass:
        frames.near, begin = tried, time.perf_counter()
        known = {} if free.before else {first: frames.again(first, free.results[first])}
        seconds = dict.fromkeys(known, time.perf_counter() - begin)
        one = Pass(free.direction, free.order, free.before, known, seconds)
        for _ in one.run(frames):
            if stop():
                return one
        return held(problem, frames, one, stop)

    def error(one: Pass) -> float:
        failed, square = one.badness(problem, wall.model)
        return math.sqrt(square) if failed <= most else math.inf

    most = free.badness(problem, wall.model)[0]
    frames.near, found = affordable(wall, (1 + frames.clearance_cost) * error(free), solve, error, stop)
    if math.isfinite(error(found)) or stop():
        return found
    frames.near = None
    return free
