"""Motions on the elastic model that a robot really makes: without snaps, and stable between frames too."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.plan.plan import elsewhere
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.forward import Simulation, Simulator
from ctr_nlp.solvers import FEASIBLE, ChainSolver
from ctr_nlp.solvers.motion.judged import CLOSE
from ctr_nlp.steer.attempts import SAME, Attempt, attempt
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Pass
from ctr_nlp.typing import Array

TRIED = 3
"""Best attempts that are looked at; more where none of them is made."""
ROUNDS = 6
"""Times that margins of frames are raised for what is missing between them."""
SHORT = 0.005
"""By how much the margin may be missed between frames."""
GIVEN, MOST = 0.1, 0.9
"""What is added to margins where the robot loses its way; frames are given no more than that."""
TURNS = 2
"""Whole turns of a tube that are tried to find the robot where its motion begins."""


T = TypeVar("T")


class Missed(NamedTuple):
    """What the margin is missed by on the way to every frame, by_frame (T,); lost: the robot is elsewhere."""

    by_frame: Array
    lost: bool


class Made(NamedTuple):
    """An attempt whose motion the robot makes, and what the margin is missed by at most."""

    attempt: Attempt
    missing: float


def realised(
    simulator: Simulator,
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    attempts: Sequence[Attempt],
    margin: float | None,
    stop: Callable[[], bool],
) -> list[Attempt]:
    """The attempt of least objective among the best whose motion the robot makes; else all, which it does not.

    Where the margin is missed between frames, those beside must hold more: an attempt has its own parameters.
    """
    made: list[Made] = []
    tried: list[float] = []
    for one in sorted(attempts, key=lambda one: one.solution.objective):
        objective = one.solution.objective
        if not one.solution.success or (tried and objective - tried[-1] <= SAME * (1 + abs(objective))):
            continue
        kept = [one.attempt.solution.objective for one in made if one.missing <= SHORT]
        if stop() or (made and len(tried) >= TRIED) or min(kept, default=np.inf) <= objective:
            break  # with higher margins its objective would only grow
        tried.append(objective)
        found = _made(simulator, chain, solver, one, margin, stop, min(kept, default=np.inf))
        made += [] if found is None else [found]
    if not made:
        return [replace(one, made=False) for one in attempts]
    return [min(made, key=lambda one: (max(one.missing, SHORT), one.attempt.solution.objective)).attempt]


def _made(
    simulator: Simulator,
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    one: Attempt,
    margin: float | None,
    stop: Callable[[], bool],
    least: float,
) -> Made | None:
    """An attempt changed until its motion is made and the margin held between frames, or as nearly as it goes.

    least: an objective from which on a change is not worth following, as it only grows with margins.
    """
    robot = simulator.robot

    def missed(tried: Attempt) -> Missed:
        q = tried.solution.q.reshape(chain.frames, -1)[:, : len(robot.axes)]
        return missing(simulator(q), tried.motion, margin, robot.d)

    def again(tried: Attempt, margins: Array) -> Attempt | None:
        firmer = chain.with_parameters({"margin": margins})
        found = attempt(firmer, solver, tried.motion, None, stop, CLOSE)
        return found if found.solution.success and found.solution.objective < least else None

    asked = None if margin is None else np.full(chain.frames, margin)
    found = held_between(_found(robot, simulator.model, chain, one), asked, missed, again, stop)
    return None if found is None else Made(*found)


def held_between(
    first: T,
    margins: Array | None,
    missed: Callable[[T], Missed],
    again: Callable[[T, Array], T | None],
    stop: Callable[[], bool],
) -> tuple[T, float] | None:
    """A motion that the robot makes, and what its margin is missed by at most; None where none is found.

    margins (T,): of the frames of the first motion, None where none are asked for; they are raised where more
    is missed between frames than SHORT. missed: what a motion misses; again: a motion solved again with other
    margins, None where that fails.
    """
    tried, best = first, None
    for _ in range(ROUNDS + 1):
        by_frame, lost = missed(tried)
        short = float(by_frame.max())
        if not lost and (best is None or short < best[1]):
            best = tried, short
        if margins is None or stop() or not (lost or short > SHORT):
            break
        margins = raised(margins, by_frame)
        solved = again(tried, margins)
        if solved is None:
            break
        tried = solved
    return best


def _found(robot: Robot, model: Model, chain: Chain, one: Attempt) -> Attempt:
    """The same motion with tubes turned by whole turns, so that the robot is found where it begins."""
    chain = replace(chain, parameters=one.parameters)
    x = one.solution.x.reshape(chain.frames, -1).copy()
    q = one.solution.q.reshape(chain.frames, -1)[0, : len(robot.axes)]
    turns = _turns(robot, model, q, one.motion[0])
    x[:, : robot.d - 1] += turns
    value = chain.evaluate(x.ravel())[1]
    if not turns.any() or chain.violation(value) > FEASIBLE:
        return one
    solution = replace(one.solution, x=x.ravel(), q=chain.configurations(value).ravel())
    return replace(one, solution=solution, motion=chain.robot_of(x.ravel()))


def held(frames: NlpFrames, one: Pass, simulator: Simulator, stop: Callable[[], bool]) -> tuple[Pass, NlpFrames]:
    """A run through all frames, repeated until the margin is held between frames too; frames with its margins.

    As it is on models of which nothing can be unstable, and where no run is found that the robot makes.
    """
    if not frames.model.can_snap:
        return one, frames
    margin = None if np.isnan(frames.margins[0]) else float(frames.margins[0])

    def missed(tried: _Run) -> Missed:
        made, problem = tried.made, tried.frames.problem
        return missing(simulator(made.motion(problem)), made.unknowns(problem), margin, problem.robot.d)

    def again(tried: _Run, margins: Array) -> _Run | None:
        made, first, within = tried.made, tried.made.order[0], replace(frames, margins=margins)
        known = {} if made.before else {first: made.results[first]}
        if known and margins[first] > tried.frames.margins[first]:
            known = {first: within.again(first, made.results[first])}
        return _Run.through(
            within, Pass(made.direction, made.order, made.before, known, {first: made.seconds[first]})
        )

    first = _Run.found(frames, one)
    asked = None if margin is None else frames.margins
    best = None if first is None else held_between(first, asked, missed, again, stop)
    return (one, frames) if best is None else (best[0].made, best[0].frames)


class _Run(NamedTuple):
    """A run all of whose frames are solved, with tubes turned so that the robot is found where it begins."""

    frames: NlpFrames
    made: Pass

    @classmethod
    def through(cls, frames: NlpFrames, one: Pass) -> _Run | None:
        """A run that is gone through now."""
        for _ in one.run(frames):
            pass
        return cls.found(frames, one)

    @classmethod
    def found(cls, frames: NlpFrames, one: Pass) -> _Run | None:
        """None where a frame is not solved."""
        if any(j not in one.results or not one.results[j].success for j in one.order):
            return None
        return cls(frames, _found_pass(frames, one))


def _found_pass(frames: NlpFrames, one: Pass) -> Pass:
    """As _found, for a run without a given start."""
    turns = _turns(frames.problem.robot, frames.model, one.results[0].q, one.unknowns(frames.problem)[0])
    if one.before is not None or not turns.any():
        return one
    turned = {}
    for j, result in one.results.items():
        assert result.x is not None
        q, x = (np.append(values[: len(turns)] + turns, values[len(turns) :]) for values in (result.q, result.x))
        turned[j] = replace(result, q=q, x=x, warm=None)
    return replace(one, results=turned)


def raised(margins: Array, missing: Array) -> Array:
    """Margins of frames (T,), raised by what is missing on the way to them and from them."""
    more = np.maximum(missing, np.append(missing[1:], 0.0))
    return np.where(more > SHORT, np.maximum(margins, np.minimum(margins + more, MOST)), margins)


def missing(moved: Simulation, x: Array, margin: float | None, d: int) -> Missed:
    """What a motion misses whose unknowns are meant to be x (T, n), as the robot is moved through it.

    After a snap that leads nobody knows where, nothing is missed: that the robot is elsewhere is what counts.
    """
    away = elsewhere(moved.x, x, moved.snaps, d)
    by_frame = np.maximum(np.nan_to_num((margin or 0.0) - moved.stability_between), 0.0)
    by_frame[away.argmax()] += GIVEN * away.any()
    return Missed(by_frame, bool(away.any()))


def _turns(robot: Robot, model: Model, q: Array, x: Array) -> Array:
    """Whole turns (d - 1,) of outer tubes, rad, with which the robot settled at q has the unknowns x; or none."""
    d = robot.d
    outer = slice(d - 1)
    turns = np.array(list(itertools.product(range(-TURNS, TURNS + 1), repeat=d - 1)))
    for turn in 2 * np.pi * turns[np.argsort(np.abs(turns).sum(axis=1), kind="stable")]:
        there, to = q.copy(), x.copy()
        there[outer] += turn
        to[outer] += turn
        allowed = (robot.lower[outer] <= there[outer]).all() and (there[outer] <= robot.upper[outer]).all()
        if allowed and not elsewhere(model.rest(robot, there)[None], to[None], (), d).any():
            return turn
    return np.zeros(d - 1)
