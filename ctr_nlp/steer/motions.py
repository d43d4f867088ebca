"""Motions that a horizon starts from: frame by frame, and changed at random."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ctr_nlp.formulations.horizon import Ends
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.models import Model
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.forward import Simulator
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.steer.passes import Pass, Progress, run_passes
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import Target
from ctr_nlp.typing import Array, Index

MOST_FRAMES = 200
"""Frames solved one by one for a start; of more, every second, third, ... is solved and the rest interpolated."""
ALIKE = 0.2
"""Part by which a run's mean square error may differ from its objective, as they are taken at other samples."""
MOVED = 1e-3
"""mm^2 that motion adds to the objective of a run at most, about."""
WAVES = 5
"""Half waves over the duration that a random change is made of."""
SPREAD = 1.0, 25.0, 0.2
"""Size of a random change: alpha in rad, beta in mm, theta in rad."""


def per_frame_motions(
    problem: Problem,
    ends: Ends,
    settings: Settings,
    progress: Progress | None,
    model: Model,
    terms: Sequence[Term] = (),
    most: int = MOST_FRAMES,
) -> list[Array]:
    """Unknowns (T, 2d + 2) of the joint formulation, far from any wall, run forwards and backwards, best first.

    most: how many frames are solved at most; others are interpolated. Where Ctrl-C, held back by the caller, ended
    the work early, the robot stands still in frames not reached.
    """
    stride = -(-problem.frames // most)
    picked = thinned(problem.frames, stride)
    coarse = problem if stride == 1 else at_frames(problem, picked, stride)
    solver = NlpFrames.of(coarse, model=model, settings=replace(settings, contact_weight=0.0), terms=terms)
    passes, _ = run_passes(coarse, solver, "best", ends.start, ends.end, progress)
    ranked = _best_first(passes, coarse, model, math.inf if terms else ALIKE)
    return [filled(one.unknowns(coarse), picked, problem.frames) for one in ranked]


def _best_first(passes: Sequence[Pass], problem: Problem, model: Model, alike: float) -> list[Pass]:
    """Runs, least bad first, the others by their objectives; alike: part by which errors differ from these."""
    ranked = sorted(passes, key=lambda one: one.cost(problem))
    costs = [one.cost(problem) for one in ranked]
    most = costs[0][0], costs[0][1] * (1 + alike) ** 2 + MOVED
    bounds = [  # a robot that is elsewhere than planned is no nearer to its target
        one.planned(problem, model) if cost <= most else (cost[0], cost[1] / (1 + alike) - MOVED)
        for one, cost in zip(ranked, costs, strict=True)
    ]
    simulator, best, least = Simulator(problem.robot, model), 0, (problem.frames + 1, math.inf)
    for k in sorted(range(len(bounds)), key=bounds.__getitem__):
        if bounds[k] < least:
            known = costs[k] <= most and not model.several_equilibria
            badness = bounds[k] if known else ranked[k].badness(problem, simulator)
            best, least = (k, badness) if badness < least else (best, least)
    return [ranked[best], *ranked[:best], *ranked[best + 1 :]]


def at_frames(problem: Problem, picked: Index, stride: int) -> Problem:
    """Every so many frames of a problem: those picked, from 0."""
    curves, lengths = problem.target.curves, problem.target.lengths
    target = Target(tuple(curves[i] for i in picked), tuple(lengths[i] for i in picked))
    return replace(problem, target=target, duration=problem.dt * stride * len(picked), truth=None)


def thinned(frames: int, stride: int) -> Index:
    """The numbers, from 0, of every so many frames; the last is one of them."""
    return np.arange(frames)[::-1][::stride][::-1]


def filled(motion: Array, picked: Index, frames: int) -> Array:
    """All frames (frames, n) of a motion known at picked ones, linear between them; NaN counts as not known."""
    known = np.isfinite(motion).all(axis=1)
    return np.column_stack([np.interp(np.arange(frames), picked[known], column) for column in motion[known].T])


def wandered(robot: Robot, motion: Array, seed: int) -> Iterator[Array]:
    """Smooth random changes of a motion (T, 2d + 2), in order and then within limits of position.

    Speeds, carriage gaps, and outer tubes that reach further than inner ones are left to within_limits.
    """
    rng = np.random.default_rng(seed)
    frames, d = len(motion), robot.d
    t = np.linspace(0.0, 1.0, frames)[:, None]
    spread = np.concatenate([np.full(d, SPREAD[0]), np.full(d, SPREAD[1]), np.full(2, SPREAD[2])])
    while True:
        waves = (rng.normal(size=motion.shape[1]) * np.cos(np.pi * k * t) / (1 + k) for k in range(WAVES))
        q = np.clip(motion + spread * sum(waves), robot.lower, robot.upper)
        q[:, d : 2 * d] = np.maximum.accumulate(q[:, d : 2 * d], axis=1)
        yield np.clip(q, robot.lower, robot.upper)
