"""Refinement of motions on the elastic model until they can be realised: no snaps, and stable between frames, too.

A program constrains frames only: each is an equilibrium with a stability margin mu (1 where no tube acts on
another, 0 at the snap). Whether a robot reaches it shows only in a simulation from the first frame on. Where mu is
violated between frames, the frames on both sides are given a larger margin, and the motion is solved again; the
objective can only grow with that.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.plan.plan import find_off_branch_frames
from ctr_nlp.plan.simulation import Simulation, Simulator
from ctr_nlp.planning.marching import Pass
from ctr_nlp.planning.multistart import SAME_SOLUTION_RELATIVE_TOLERANCE, SolvedStart, solve_from_motion
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.robot import Robot
from ctr_nlp.solvers import FEASIBILITY_TOLERANCE, ChainSolver
from ctr_nlp.solvers.motion.chain_solution import WARM_START_BARRIER_MM2
from ctr_nlp.typing import Array

SIMULATED_STARTS = 3
"""Number of best solved starts that are simulated; more where none of them can be realised."""
MAX_MARGIN_ROUNDS = 6
"""Largest number of times that the margins of frames are raised."""
MAX_MARGIN_SHORTFALL = 0.005
"""Shortfall of the stability margin between frames that is accepted."""
BRANCH_LOSS_MARGIN_INCREASE, MAX_FRAME_MARGIN = 0.1, 0.9
"""Margin that is added where the robot left the planned branch, and the largest margin of a frame."""
MAX_WHOLE_TURNS = 2
"""Largest number of whole turns of a tube, to either side, with which a motion's first equilibrium is sought."""


T = TypeVar("T")


class MarginShortfall(NamedTuple):
    """Shortfall of the stability margin.

    by_frame (T,): in the sub-steps to each frame. left_branch: whether the robot left the planned branch.
    """

    by_frame: Array
    left_branch: bool


class RealisedStart(NamedTuple):
    """A solved start on whose branch the simulated robot stays, and the largest shortfall of its margin."""

    attempt: SolvedStart
    shortfall: float


def select_realisable_starts(
    simulator: Simulator,
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    attempts: Sequence[SolvedStart],
    margin: float | None,
    stop: Callable[[], bool],
) -> list[SolvedStart]:
    """Return the best solved start on whose branch the robot stays, alone in a list; else all, marked accordingly.

    simulator: of the robot. chain: of all frames. solver: builds a solver for a chain. attempts: the solved
    starts. margin: the least stability margin, None for any. stop: returns whether to end. Where the margin is
    violated between frames, those on both sides get a larger one: the result then has parameters of its own.
    """
    made: list[RealisedStart] = []
    tried: list[float] = []
    for one in sorted(attempts, key=lambda one: one.solution.objective):
        objective = one.solution.objective
        # Starts are sorted by objective, so that equal solutions are neighbours and only the first is simulated.
        if not one.solution.success or (
            tried and objective - tried[-1] <= SAME_SOLUTION_RELATIVE_TOLERANCE * (1 + abs(objective))
        ):
            continue
        # Objectives of motions that satisfy the margin between frames: no start with a larger one can be better.
        kept = [one.attempt.solution.objective for one in made if one.shortfall <= MAX_MARGIN_SHORTFALL]
        if stop() or (made and len(tried) >= SIMULATED_STARTS) or min(kept, default=np.inf) <= objective:
            break  # with higher margins its objective would only grow
        tried.append(objective)
        found = _refine_start_margins(simulator, chain, solver, one, margin, stop, min(kept, default=np.inf))
        made += [] if found is None else [found]
    if not made:
        return [replace(one, on_planned_branch=False) for one in attempts]
    # Shortfalls up to MAX_MARGIN_SHORTFALL are as good as none; among these the objective decides.
    return [
        min(
            made, key=lambda one: (max(one.shortfall, MAX_MARGIN_SHORTFALL), one.attempt.solution.objective)
        ).attempt
    ]


def _refine_start_margins(
    simulator: Simulator,
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    one: SolvedStart,
    margin: float | None,
    stop: Callable[[], bool],
    least: float,
) -> RealisedStart | None:
    """Raise margins of a solved start until the robot stays on its branch and satisfies the margin between frames.

    Returns the best that was reached, None where the robot always leaves the branch. least: objective, mm^2, above
    which the start is given up, as the objective only grows with margins.
    """
    robot = simulator.robot

    def find_shortfall(tried: SolvedStart) -> MarginShortfall:
        q = tried.solution.q.reshape(chain.frames, -1)[:, : len(robot.axes)]
        return find_margin_shortfall(simulator(q), tried.motion, margin, robot.d)

    def solve_with_margins(tried: SolvedStart, margins: Array) -> SolvedStart | None:
        firmer = chain.with_parameters({"margin": margins})
        # The motion is near its old solution: most active limits are known, and the barrier begins small.
        found = solve_from_motion(firmer, solver, tried.motion, None, stop, WARM_START_BARRIER_MM2)
        return found if found.solution.success and found.solution.objective < least else None

    asked = None if margin is None else np.full(chain.frames, margin)
    found = refine_margins(
        _align_tube_turns(robot, simulator.model, chain, one), asked, find_shortfall, solve_with_margins, stop
    )
    return None if found is None else RealisedStart(*found)


def refine_margins(
    first: T,
    margins: Array | None,
    find_shortfall: Callable[[T], MarginShortfall],
    solve_with_margins: Callable[[T, Array], T | None],
    stop: Callable[[], bool],
) -> tuple[T, float] | None:
    """Solve a motion again with raised margins until the robot stays on its branch with its margin between frames.

    first: the motion as solved. margins: (T,) of its frames; None where none are asked for. find_shortfall:
    returns the shortfall of a motion. solve_with_margins: solves a motion with other margins; None where that
    fails. stop: returns whether to end. Returns the motion of least shortfall, and that; None where the robot
    always leaves the branch.
    """
    tried = first
    best = None
    for _ in range(MAX_MARGIN_ROUNDS + 1):
        by_frame, lost = find_shortfall(tried)
        short = float(by_frame.max())
        # The best so far is kept: a later round may fail, or lead to another branch.
        if not lost and (best is None or short < best[1]):
            best = tried, short
        if margins is None or stop() or not (lost or short > MAX_MARGIN_SHORTFALL):
            break
        margins = raise_margins(margins, by_frame)
        solved = solve_with_margins(tried, margins)
        if solved is None:
            break
        tried = solved
    return best


def _align_tube_turns(robot: Robot, model: Model, chain: Chain, one: SolvedStart) -> SolvedStart:
    """Return the motion with tubes turned by whole turns, so that its first frame is the robot's rest equilibrium.

    robot, model: that are simulated. chain: of the solved start `one`. A tube turned by a whole turn together with
    its motor leaves the shape as it is, but only one of these configurations has the equilibrium that is reached
    from aligned tubes.
    """
    chain = replace(chain, parameters=one.parameters)
    x = one.solution.x.reshape(chain.frames, -1).copy()
    q = one.solution.q.reshape(chain.frames, -1)[0, : len(robot.axes)]
    turns = _find_whole_turns(robot, model, q, one.motion[0])
    # All frames are turned alike: between frames nothing changes, neither speeds nor the motion term.
    x[:, : robot.d - 1] += turns
    value = chain.evaluate(x.ravel())[1]
    if not turns.any() or chain.violation(value) > FEASIBILITY_TOLERANCE:
        return one
    solution = replace(one.solution, x=x.ravel(), q=chain.configurations(value).ravel())
    return replace(one, solution=solution, motion=chain.robot_of(x.ravel()))


def refine_pass_margins(
    frames: NlpFrames, one: Pass, simulator: Simulator, stop: Callable[[], bool]
) -> tuple[Pass, NlpFrames]:
    """Repeat a pass until its margin is satisfied between frames, too; return it with a solver of its margins.

    frames: solver of single frames. one: the pass. simulator: of the problem's robot. stop: returns whether to
    end. The pass is returned as it is on models that cannot snap, and where the robot always leaves the branch.
    """
    if not frames.model.can_snap:
        return one, frames
    margin = None if np.isnan(frames.margins[0]) else float(frames.margins[0])

    def find_shortfall(tried: _Run) -> MarginShortfall:
        made = tried.frame_run
        problem = tried.frames.problem
        return find_margin_shortfall(
            simulator(made.motion(problem)), made.unknowns(problem), margin, problem.robot.d
        )

    def solve_with_margins(tried: _Run, margins: Array) -> _Run | None:
        # Raised margins change the first solved frame, too: it is solved again, near what it was, and the pass
        # continues from there. A given start is not a frame, and stays.
        made = tried.frame_run
        first = tried.frame_run.order[0]
        within = replace(frames, margins=margins)
        known = {} if made.before else {first: made.results[first]}
        if known and margins[first] > tried.frames.margins[first]:
            known = {first: within.search_near(first, made.results[first])}
        return _Run.through(
            within, Pass(made.direction, made.order, made.before, known, {first: made.seconds[first]})
        )

    first = _Run.from_pass(frames, one)
    asked = None if margin is None else frames.margins
    best = None if first is None else refine_margins(first, asked, find_shortfall, solve_with_margins, stop)
    return (one, frames) if best is None else (best[0].frame_run, best[0].frames)


class _Run(NamedTuple):
    """A pass all of whose frames are solved, with tubes turned so that it starts from the rest equilibrium."""

    frames: NlpFrames
    frame_run: Pass

    @classmethod
    def through(cls, frames: NlpFrames, one: Pass) -> _Run | None:
        """Solve all frames of a pass now; None where one is not solved."""
        for _ in one.run(frames):
            pass
        return cls.from_pass(frames, one)

    @classmethod
    def from_pass(cls, frames: NlpFrames, one: Pass) -> _Run | None:
        """Return a pass whose tubes are turned to the rest equilibrium; None where a frame is not solved."""
        if any(j not in one.results or not one.results[j].success for j in one.order):
            return None
        return cls(frames, _align_pass_turns(frames, one))


def _align_pass_turns(frames: NlpFrames, one: Pass) -> Pass:
    """Return a pass with tubes turned by whole turns, so that its first frame is the robot's rest equilibrium.

    A pass from a given start is left as it is: the start defines how tubes are turned.
    """
    turns = _find_whole_turns(
        frames.problem.robot, frames.model, one.results[0].q, one.unknowns(frames.problem)[0]
    )
    if one.before is not None or not turns.any():
        return one
    turned = {}
    for j, result in one.results.items():
        assert result.x is not None
        q, x = (np.append(values[: len(turns)] + turns, values[len(turns) :]) for values in (result.q, result.x))
        turned[j] = replace(result, q=q, x=x, warm=None)
    return replace(one, results=turned)


def raise_margins(margins: Array, missing: Array) -> Array:
    """Return margins of frames (T,), raised by the shortfall in the sub-steps to each frame and from it.

    missing: (T,), shortfall in the sub-steps to each frame.
    """
    # The margin between two frames depends on both: both are raised.
    more = np.maximum(missing, np.append(missing[1:], 0.0))
    return np.where(
        more > MAX_MARGIN_SHORTFALL, np.maximum(margins, np.minimum(margins + more, MAX_FRAME_MARGIN)), margins
    )


def find_margin_shortfall(simulation: Simulation, x: Array, margin: float | None, d: int) -> MarginShortfall:
    """Return the shortfall of a simulated motion.

    simulation: of the motion. x: (T, n), planned unknowns. margin: the least one, None for any. d: number of
    tubes. After a snap to an unknown equilibrium the margin is NaN and counts as satisfied: what matters is that
    the robot left the branch.
    """
    away = find_off_branch_frames(simulation.x, x, simulation.snaps, d)
    by_frame = np.maximum(np.nan_to_num((margin or 0.0) - simulation.stability_between), 0.0)
    # argmax is the first frame on another branch: the planned one was left in the sub-steps to it, and later
    # frames follow from that. A larger margin there keeps away from the bifurcation.
    by_frame[away.argmax()] += BRANCH_LOSS_MARGIN_INCREASE * away.any()
    return MarginShortfall(by_frame, bool(away.any()))


def _find_whole_turns(robot: Robot, model: Model, q: Array, x: Array) -> Array:
    """Return whole turns (d - 1,), rad, of the outer tubes with which x is the robot's rest equilibrium at q.

    Zeros where none of them fits; fewest turns first.
    """
    d = robot.d
    outer = slice(d - 1)
    turns = np.array(list(itertools.product(range(-MAX_WHOLE_TURNS, MAX_WHOLE_TURNS + 1), repeat=d - 1)))
    for turn in 2 * np.pi * turns[np.argsort(np.abs(turns).sum(axis=1), kind="stable")]:
        # Turning motor and tip together leaves the twist of the tube, and with it the equilibrium, as it is; what
        # changes is the configuration from which a robot at rest would have come.
        there = q.copy()
        to = x.copy()
        there[outer] += turn
        to[outer] += turn
        allowed = (robot.lower[outer] <= there[outer]).all() and (there[outer] <= robot.upper[outer]).all()
        if allowed and not find_off_branch_frames(model.rest(robot, there)[None], to[None], (), d).any():
            return turn
    return np.zeros(d - 1)
