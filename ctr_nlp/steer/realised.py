"""Motions on the elastic model that a robot really makes: without snaps, and stable between frames too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from ctr_nlp import tracking
from ctr_nlp.chain import Chain
from ctr_nlp.formulations.horizon import with_margins
from ctr_nlp.plan import ELSEWHERE
from ctr_nlp.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.solvers import ChainSolver
from ctr_nlp.steer.attempts import Attempt, attempt
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Pass

Array = npt.NDArray[np.float64]

TRIED = 3
"""Best attempts that are looked at."""
ROUNDS = 6
"""Times that margins of frames are raised for what is missing between them."""
SHORT = 0.005
"""By how much the margin may be missed between frames."""
GIVEN, MOST = 0.1, 0.9
"""What is added to margins where the robot loses its way; the largest that a frame is given."""


def realised(
    robot: Robot,
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    attempts: Sequence[Attempt],
    margin: float | None,
    stop: Callable[[], bool],
) -> tuple[Chain, list[Attempt]]:
    """The chain and attempt of least objective among the best whose motion the robot makes, as the first of all.

    Where the margin is missed between frames, those beside must hold more: then the chain is another.
    """
    solved = sorted((one for one in attempts if one.solution.success), key=lambda one: one.solution.objective)
    held = [found for one in solved[:TRIED] if (found := _held(robot, chain, solver, one, margin, stop))]
    if not held:
        return chain, list(attempts)
    chain, best = min(held, key=lambda found: found[1].solution.objective)
    return chain, [best]


def _held(
    robot: Robot,
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    found: Attempt,
    margin: float | None,
    stop: Callable[[], bool],
) -> tuple[Chain, Attempt] | None:
    """An attempt changed until its motion is made, with the margin also between frames; None where it never is."""
    margins = np.full(chain.frames, np.nan if margin is None else margin)
    for _ in range(ROUNDS + 1):
        q = found.solution.q.reshape(chain.frames, -1)[:, : len(robot.axes)]
        more, lost = _needed(robot, q, found.solution.x.reshape(chain.frames, -1), margin)
        if margin is None or not (lost or more.any()) or stop():
            return None if lost else (chain, found)
        margins = np.minimum(margins + more, MOST)
        chain = with_margins(chain, margins)
        found = attempt(chain, solver(chain), found.solution.x, None, stop)
        if not found.solution.success:
            break
    return None


def held(problem: Problem, frames: NlpFrames, one: Pass) -> Pass:
    """A run through all frames on the elastic model, repeated until the margin is held between frames too."""
    robot, margin = problem.robot, frames.margins[0]
    for _ in range(ROUNDS):
        if any(j not in one.results or not one.results[j].success for j in one.order):
            break
        more, lost = _needed(robot, one.motion(problem), one.unknowns(problem), margin)
        if lost or not more.any():
            break
        frames.margins = np.minimum(frames.margins + more, MOST)
        first = one.order[0]
        again = Pass(one.direction, one.order, one.before, {} if one.before else {first: one.results[first]})
        for _ in again.run(frames):
            pass
        one = again
    return one


def _needed(robot: Robot, q: Array, x: Array, margin: float | None) -> tuple[Array, bool]:
    """By how much margins of frames (T,) have to grow for what is missing between them; whether the robot moved
    through q is not where x says.
    """
    moved = tracking.follow(robot, q)
    away = np.abs(moved.x - x).max(axis=1) > ELSEWHERE
    missing = np.maximum((margin or 0.0) - moved.stability_between, 0.0)
    missing[missing <= SHORT] = 0.0
    missing[away.argmax()] += GIVEN * away.any()
    return np.maximum(missing, np.append(missing[1:], 0.0)), bool(away.any())
