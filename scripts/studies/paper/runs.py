"""Runs of methods on the paper's problems, and fits with different numbers of sample points."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from methods.comparison import comparison_row, parse_variant
from reference.paper_two_stage import paper_two_stage

from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame import fill_parameters, program
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Order, ShapeDistance
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.metrics import rms_over_sigma
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.simulation import shapes
from ctr_nlp.solvers import SOLVERS, default_chain_solver, default_solver
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.pool import run_in_parallel
from ctr_nlp.typing import Array

OUR_HORIZON, OUR_JOINT, OUR_ELASTIC_HORIZON = "horizon", "joint", "elastic"
"""Our methods: all frames at once, frame by frame, all frames at once on the elastic model."""
PAPER_TWO_STAGE, EUCLIDEAN_BASELINE, TIP_ONLY = "paper-two-stage", "euclidean", "tip-jacobian"
"""Re-implemented: the paper's method, its Euclidean baseline, its control of the tip alone."""
S2J_PROJECTED = "s2j-projected"
"""The paper's [7], clipped to the limits; only where `python scripts/studies/learn.py` has trained a network."""
OUR_METHODS = OUR_HORIZON, OUR_JOINT, OUR_ELASTIC_HORIZON
"""Our own methods."""
TASK_START_ORDER = {OUR_ELASTIC_HORIZON: 0, OUR_HORIZON: 1}
"""Order of methods that start first: they are compiled, and a long task that starts last would delay the end."""
PAPER_METHOD_LABELS = {
    OUR_HORIZON: "ours (all frames at once)",
    OUR_JOINT: "ours (frame by frame)",
    OUR_ELASTIC_HORIZON: "ours (planned on the compliant model)",
    PAPER_TWO_STAGE: "the paper's method (re-implemented)",
    EUCLIDEAN_BASELINE: "its baseline (re-implemented)",
    TIP_ONLY: "tip only (re-implemented)",
    S2J_PROJECTED: "S2J-IK (re-implemented)",
}
"""Names of methods in figures and on the page."""
NO_WALL_SETTINGS = Settings(contact_weight=0.0, arrival_weight=0.0)
"""Default settings without wall and arrival, which the paper's methods do not know."""

ProblemLoader = Callable[[str], Problem]
"""Function that returns the problem of a name; it must be picklable."""


@dataclass(frozen=True)
class MotionTask:
    """Task of running a method on a problem."""

    problem: str
    method: str


@dataclass(frozen=True)
class FittingTask:
    """Task of fitting the frames of a method's motion with different numbers of sample points, for Fig. 3."""

    problem: str
    method: str


Task = MotionTask | FittingTask


class MotionResult(NamedTuple):
    """A plan and its comparison_row: errors on both models, times, failures, snaps."""

    plan: Plan
    row: dict[str, Any]


@dataclass(frozen=True)
class PaperResults:
    """Results of all tasks.

    frames: number of frames of each motion. jobs: number of parallel processes. seconds: of the whole run;
    task_seconds: of each task.
    """

    motion_results: Mapping[MotionTask, MotionResult]
    fit_results: Mapping[FittingTask, tuple[PointCountFit, ...]]
    frames: int
    jobs: int
    seconds: float
    task_seconds: Mapping[Task, float]

    def plan(self, problem: str, method: str) -> Plan:
        """Return the plan of a method for a problem."""
        return self.motion_results[MotionTask(problem, method)].plan

    def plans_by_label(self, problem: str, methods: Sequence[str]) -> dict[str, Plan]:
        """Return plans of methods for a problem, by the methods' labels."""
        return {PAPER_METHOD_LABELS[method]: self.plan(problem, method) for method in methods}

    def row(self, problem: str, method: str) -> dict[str, Any]:
        """Return the comparison_row of the plan of a method for a problem."""
        return self.motion_results[MotionTask(problem, method)].row

    def failures(self) -> list[str]:
        """Say in which motions and fits our own methods did not solve all frames."""
        frames = [
            f"{task.problem}, {PAPER_METHOD_LABELS[task.method]}: {each.row['failed']} of {self.frames} frames"
            for task, each in self.motion_results.items()
            if task.method in OUR_METHODS and each.row["failed"]
        ]
        refits = [
            f"{task.problem}, fit with {fit.points} points: {fit.failed} of {self.frames} frames"
            for task, some in self.fit_results.items()
            for fit in some
            if task.method in OUR_METHODS and fit.failed
        ]
        return frames + refits


def run_tasks(
    load: ProblemLoader,
    tasks: Iterable[Task],
    frames: int,
    jobs: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> PaperResults:
    """Do all tasks, each once, and return their results.

    load: returns the problem of a name. frames: number of frames, for the results. jobs: number of processes.
    progress: called with (tasks done, tasks in all, name of the last one). Raises OptionError, and
    KeyboardInterrupt after Ctrl-C, since half of a figure is of no use.
    """
    # Sections share tasks: dict.fromkeys drops duplicates and keeps the order.
    wanted = sorted(dict.fromkeys(tasks), key=lambda task: TASK_START_ORDER.get(task.method, 2))
    begin = time.perf_counter()
    results: dict[Task, Any] = {}
    seconds: dict[Task, float] = {}
    with deferred_interrupt() as interrupted:
        for number, (result, taken) in run_in_parallel(functools.partial(_time_task, load), wanted, jobs):
            task = wanted[number]
            results[task], seconds[task] = result, taken
            if progress is not None:
                progress(len(results), len(wanted), f"{task.problem}, {task.method}")
        if interrupted():
            raise KeyboardInterrupt
    return PaperResults(
        {task: result for task, result in results.items() if isinstance(task, MotionTask)},
        {task: result for task, result in results.items() if isinstance(task, FittingTask)},
        frames,
        jobs,
        time.perf_counter() - begin,
        seconds,
    )


def _time_task(load: ProblemLoader, task: Task) -> tuple[Any, float]:
    begin = time.perf_counter()
    problem = load(task.problem)
    result: Any = plan_by_method(problem, task.method)
    if isinstance(task, FittingTask):
        result = fit_point_counts(problem, result.plan, task.method)
    return result, time.perf_counter() - begin


def plan_by_method(problem: Problem, method: str) -> MotionResult:
    """Plan a problem by a method, a key of PAPER_METHOD_LABELS; raises OptionError."""
    solver = default_chain_solver()
    variants = {
        OUR_HORIZON: f"horizon:{solver}",
        OUR_JOINT: f"joint:{default_solver()}",
        OUR_ELASTIC_HORIZON: f"horizon:{solver}:elastic",
    }
    variant = variants.get(method, method)
    plan = parse_variant(variant).plan(problem, NO_WALL_SETTINGS, (), None)
    return MotionResult(plan, comparison_row(problem.name, variant, plan))


POINTS_ON_SEGMENT = (1, 2, 3, 4, 6, 8, 12)
"""Points on each tube's segment for the paper's method; the last at its end."""
POINTS_ALONG_ROBOT = (2, 4, 5, 10, 20, 50, 100)
"""Points along the whole robot for ours, evenly spread, the last at the tip; divisors of 100, the grid's cells."""


class PointCountFit(NamedTuple):
    """Result of a fit with a number of points; e3: mm, always at 101 samples; failed: number of failed frames."""

    points: int
    e3: float
    failed: int


def fit_point_counts(problem: Problem, plan: Plan, method: str) -> tuple[PointCountFit, ...]:
    """Fit every frame of a problem by itself, with each number of points.

    plan: whose configurations are the initial guesses. method: "joint", or "paper-two-stage" for the paper's.
    Without a motion term and with equal starts, only the number of points makes a difference.
    """
    found = _joint(problem, plan.q) if method == "joint" else _two_stage(problem, plan.q)
    return tuple(PointCountFit(points, _e3(plan, q), failed) for points, q, failed in found)


def _two_stage(problem: Problem, q: Array) -> Iterator[tuple[int, Array, int]]:
    for points in POINTS_ON_SEGMENT:
        solve = paper_two_stage(problem, 0.0, points)
        results = [solve(frame, guess, None) for frame, guess in zip(problem.target_frames, q, strict=True)]
        yield points, np.array([r.q for r in results]), sum(not r.success for r in results)


def _joint(problem: Problem, q: Array) -> Iterator[tuple[int, Array, int]]:
    robot = problem.robot
    for points in POINTS_ALONG_ROBOT:
        terms = ShapeDistance(stride=100 // points), Order(robot.carriage_gap)
        nlp = program("frame", robot.structure, KINEMATIC_MODELS["dominant"], terms)
        solve = SOLVERS["ipopt"](nlp)  # to compile each size would take longer than to solve it
        results = [
            solve(guess, nlp.pack(fill_parameters(robot, terms, frame)), robot.lower, robot.upper)
            for frame, guess in zip(problem.target_frames, q, strict=True)
        ]
        yield points, np.array([r.q for r in results]), sum(not r.success for r in results)


def _e3(plan: Plan, q: Array) -> float:
    distance = np.linalg.norm(shapes(plan.robot, q) - plan.target, axis=-1)
    return float(np.sqrt((rms_over_sigma(distance) ** 2).mean()))
