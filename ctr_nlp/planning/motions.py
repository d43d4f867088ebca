"""Initial guesses of a horizon: motions solved frame by frame, and smooth random changes of them.

Frame by frame, eq. (6), each target is met as well as possible from the frame before. That is fast and gives good
guesses, which the horizon then smooths and ranks by its own objective.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import Target
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.last_frame import solve_last_frame
from ctr_nlp.planning.marching import Pass, Progress, run_passes
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Index

MAX_PER_FRAME_START_FRAMES = 200
"""Largest number of frames that are solved one by one for a start; of longer motions every second, third, ...
frame is solved, and the others are interpolated.
"""
MAX_LAST_FRAMES_WITHIN_WALL = 2
"""Largest number of solutions of the last frame within a wall from which a motion is made."""
SAMPLING_RMS_RELATIVE_DIFFERENCE = 0.2
"""Relative difference between a run's RMS error at the samples of plans (101) and at those of programs (21)."""
MOTION_TERM_BOUND_MM2 = 1e-3
"""Approximate upper bound of what the motion term adds to the objective of a run, mm^2."""
PERTURBATION_WAVES = 5
"""Number of cosine waves, of 0, 1, 2, .. half periods over the duration, of which a random change is the sum."""
PERTURBATION_STD_RAD_MM_RAD = 1.0, 25.0, 0.2
"""Standard deviation of the amplitude of the first wave of a random change: alpha in rad, beta in mm, theta in
rad.
"""


def per_frame_motions(
    problem: Problem,
    ends: EndConfigurations,
    settings: Settings,
    progress: Progress | None,
    model: Model,
    terms: Sequence[Term] = (),
    most: int = MAX_PER_FRAME_START_FRAMES,
) -> list[Array]:
    """Solve motions frame by frame without walls, forwards and backwards; return unknowns (T, 2d + 2), best first.

    problem: robot and target. ends: configurations at time 0 and in the last frame, where given. settings, terms:
    of the objective; walls are ignored. progress: callback, or None. model: kinematic model. most: largest number
    of frames that are solved; the others are interpolated. Where Ctrl-C, deferred by the caller, ended the work
    early, the robot stands still in frames that were not reached.
    """
    coarse, picked = _with_at_most(problem, most)
    solver = NlpFrames.of(coarse, model=model, settings=replace(settings, contact_weight=0.0), terms=terms)
    passes, _ = run_passes(coarse, solver, "best", ends.start, ends.end, progress)
    # Further terms of a user may have any size, so that objectives are no measure of errors: with an infinite
    # tolerance no bound excludes a pass, and all are simulated.
    ranked = _best_first(passes, coarse, model, math.inf if terms else SAMPLING_RMS_RELATIVE_DIFFERENCE)
    return [interpolate_frames(one.unknowns(coarse), picked, problem.frames) for one in ranked]


def motions_within_wall(
    problem: Problem,
    settings: Settings,
    model: Model,
    terms: Sequence[Term],
    stop: Callable[[], bool],
    most: int = MAX_PER_FRAME_START_FRAMES,
) -> list[Array]:
    """Solve motions frame by frame within the wall, backwards; return unknowns (T, 2d + 2).

    They begin at the best solutions of the last frame within the wall, at most MAX_LAST_FRAMES_WITHIN_WALL, in
    which the tip arrives without more contact than is allowed: from any other no motion ends well. A search that
    looks at the wall only after it has chosen a motion without it may end on the wrong side of a bifurcation, from
    which no small change leads back.

    Parameters
    ----------
    problem : Problem
        Robot and target, within a wall.
    settings : Settings
        Weights and margins.
    model : Model
        Kinematic model.
    terms : sequence of Term
        Further terms of the objective.
    stop : callable
        Returns whether to end; motions that were not finished are left out.
    most : int
        Largest number of frames that are solved; the others are interpolated.

    Returns
    -------
    list of ndarray
        The motion of the best last frame first. Motions of which a frame was not solved are left out.
    """
    coarse, picked = _with_at_most(problem, most)
    frames = NlpFrames.of(coarse, model=model, settings=settings, terms=terms)
    within = replace(frames, active_wall=frames.wall)
    *others, last = range(coarse.frames)
    arriving = [one.result for one in solve_last_frame(frames) if one.excess == 0]
    motions = list[Array]()
    for one in arriving[:MAX_LAST_FRAMES_WITHIN_WALL]:
        march = Pass("backward", [last, *reversed(others)], results={last: one})
        for _ in march.run(within):
            if stop():
                return motions
        if march.cost(coarse)[0] == 0:
            motions.append(interpolate_frames(march.unknowns(coarse), picked, problem.frames))
    return motions


def _with_at_most(problem: Problem, most: int) -> tuple[Problem, Index]:
    """Return a problem of at most `most` evenly spaced frames, and their numbers from 0."""
    # Ceiling division: no more than `most` frames are left.
    stride = -(-problem.frames // most)
    picked = thin_frames(problem.frames, stride)
    return problem if stride == 1 else at_frames(problem, picked, stride), picked


def _best_first(passes: Sequence[Pass], problem: Problem, model: Model, relative_difference: float) -> list[Pass]:
    """Return passes with the one of least simulated error first, and the others in the order of their objectives.

    relative_difference: between the RMS error of a pass and the root of its objective. Simulating a pass is slow;
    lower bounds from the objectives decide which passes need it.
    """
    ranked = sorted(passes, key=lambda one: one.cost(problem))
    costs = [one.cost(problem) for one in ranked]
    # Passes with more failed frames, or with an objective beyond this, cannot be the best.
    most = costs[0][0], costs[0][1] * (1 + relative_difference) ** 2 + MOTION_TERM_BOUND_MM2
    bounds = [  # each a lower bound of the simulated error
        # Planned errors are a lower bound for likely passes, since a robot on another branch is farther from its
        # target. For the rest the objective gives a bound.
        one.planned_error(problem, model)
        if cost <= most
        else (cost[0], cost[1] / (1 + relative_difference) - MOTION_TERM_BOUND_MM2)
        for one, cost in zip(ranked, costs, strict=True)
    ]
    simulator = Simulator(problem.robot, model)
    best = 0
    least = (problem.frames + 1, math.inf)
    # Branch and bound: in the order of lower bounds, only passes that might still be better are simulated.
    for k in sorted(range(len(bounds)), key=bounds.__getitem__):
        if bounds[k] < least:
            # With one equilibrium for each q, the robot is always on the planned branch: the bound is exact.
            known = costs[k] <= most and not model.several_equilibria
            badness = bounds[k] if known else ranked[k].simulated_error(problem, simulator)
            best, least = (k, badness) if badness < least else (best, least)
    return [ranked[best], *ranked[:best], *ranked[best + 1 :]]


def at_frames(problem: Problem, picked: Index, stride: int) -> Problem:
    """Return a problem of some frames only: picked, their numbers from 0, evenly spaced by `stride`."""
    curves = problem.target.curves
    lengths = problem.target.lengths
    target = Target(tuple(curves[i] for i in picked), tuple(lengths[i] for i in picked))
    # dt grows with the stride, so that speeds and the motion term keep their meaning.
    return replace(problem, target=target, duration=problem.dt * stride * len(picked), truth=None)


def thin_frames(frames: int, stride: int) -> Index:
    """Return the numbers, from 0, of every `stride`-th of `frames` frames, counted back from the last one."""
    # The end of a motion is what it is for; a first frame may be skipped, the last may not.
    return np.arange(frames)[::-1][::stride][::-1]


def interpolate_frames(motion: Array, picked: Index, frames: int) -> Array:
    """Interpolate a motion known at picked frames linearly over all frames, (frames, n).

    Rows with NaN count as unknown. Before the first known frame and after the last one the robot stands still.
    """
    known = np.isfinite(motion).all(axis=1)
    return np.column_stack([np.interp(np.arange(frames), picked[known], column) for column in motion[known].T])


def perturb_motion(robot: Robot, motion: Array, seed: int) -> Iterator[Array]:
    """Yield smooth random changes of a motion (T, 2d + 2) that keep the order of tubes and limits of position.

    robot: with its limits. seed: of the random numbers. Speeds and gaps between carriages are left to
    multistart.project_to_limits, as are extensions whose order and limits conflict.
    """
    rng = np.random.default_rng(seed)
    frames = len(motion)
    d = robot.d
    t = np.linspace(0.0, 1.0, frames)[:, None]
    spread = np.concatenate(
        [
            np.full(d, PERTURBATION_STD_RAD_MM_RAD[0]),
            np.full(d, PERTURBATION_STD_RAD_MM_RAD[1]),
            np.full(2, PERTURBATION_STD_RAD_MM_RAD[2]),
        ]
    )
    most = robot.upper.copy()
    # A tube may have a longer limit than one within it, which it must not pass.
    most[d : 2 * d] = robot.max_extensions
    while True:
        # Amplitudes fall as 1 / (1 + k): most of a change is a slow drift, so that the motion stays smooth.
        # Uncorrelated noise would be taken out by the motion term at once.
        waves = (
            rng.normal(size=motion.shape[1]) * np.cos(np.pi * k * t) / (1 + k) for k in range(PERTURBATION_WAVES)
        )
        q = np.clip(motion + spread * sum(waves), robot.lower, most)
        # Eq. (2): an inner tube is out at least as far as the tube around it.
        q[:, d : 2 * d] = np.maximum.accumulate(q[:, d : 2 * d], axis=1)
        yield np.clip(q, robot.lower, most)
