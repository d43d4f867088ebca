"""Fig. 3: how the fit of frames depends on the number of points that it is asked at."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ctr_nlp.formulations.frame import filled, program
from ctr_nlp.formulations.terms import Order, ShapeDistance
from ctr_nlp.models import MODELS
from ctr_nlp.plan.metrics import rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.reference.seed_two_stage import seed_two_stage
from ctr_nlp.simulation.forward import shapes
from ctr_nlp.solvers import SOLVERS
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

ON_SEGMENT = (1, 2, 3, 4, 6, 8, 12)
"""Points on each tube's segment for the paper's method; the last at its end."""
ALONG = (2, 4, 5, 10, 20, 50, 100)
"""Points along the whole robot for ours, evenly spread, the last at the tip; they divide 100."""


class Fit(NamedTuple):
    """points: how many; e3: over all frames in mm, always at 101 samples; failed: frames not solved."""

    points: int
    e3: float
    failed: int


def fits(problem: Problem, plan: Plan, method: str) -> tuple[Fit, ...]:
    """Fits of every frame by itself, from where a plan has it, with each number of points.

    method: "joint", or "seed-two-stage" for the paper's. Without a motion term and with the same starts
    throughout, only the number of points makes a difference.
    """
    found = _joint(problem, plan.q) if method == "joint" else _two_stage(problem, plan.q)
    return tuple(Fit(points, _e3(plan, q), failed) for points, q, failed in found)


def _two_stage(problem: Problem, q: Array) -> Iterator[tuple[int, Array, int]]:
    for points in ON_SEGMENT:
        solve = seed_two_stage(problem, 0.0, points)
        results = [solve(frame, guess, None) for frame, guess in zip(problem.samples, q, strict=True)]
        yield points, np.array([r.q for r in results]), sum(not r.success for r in results)


def _joint(problem: Problem, q: Array) -> Iterator[tuple[int, Array, int]]:
    robot = problem.robot
    for points in ALONG:
        terms = ShapeDistance(stride=100 // points), Order(robot.carriage_gap)
        nlp = program("frame", robot.structure, MODELS["dominant"], terms)
        solve = SOLVERS["ipopt"](nlp)  # to compile each size would take longer than to solve it
        results = [
            solve(guess, nlp.pack(filled(robot, terms, frame)), robot.lower, robot.upper)
            for frame, guess in zip(problem.samples, q, strict=True)
        ]
        yield points, np.array([r.q for r in results]), sum(not r.success for r in results)


def _e3(plan: Plan, q: Array) -> float:
    distance = np.linalg.norm(shapes(plan.robot, q) - plan.target, axis=-1)
    return float(np.sqrt((rms_over_sigma(distance) ** 2).mean()))
