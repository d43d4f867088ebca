"""What is run: methods on the paper's problems, and fits with more and fewer points."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.plan.plan import Plan
from ctr_nlp.solvers import default_chain_solver, default_solver
from ctr_nlp.studies.comparison import parse_variant, row
from ctr_nlp.studies.paper.fits import Fit, fits
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.pool import side_by_side
from ctr_nlp.target.problem import Problem

HORIZON, JOINT, ELASTIC = "horizon", "joint", "elastic"
"""Ours: all frames at once, frame by frame, all frames at once on the elastic model."""
SEED, BASELINE, TIP = "seed-two-stage", "euclidean", "tip-jacobian"
"""Re-implemented: the paper's method, its Euclidean baseline, its control of the tip alone."""
OURS = HORIZON, JOINT, ELASTIC
NAMES = {
    HORIZON: "ours (all frames at once)",
    JOINT: "ours (frame by frame)",
    ELASTIC: "ours (planned on the compliant model)",
    SEED: "the paper's method (re-implemented)",
    BASELINE: "its baseline (re-implemented)",
    TIP: "tip only (re-implemented)",
}
"""What methods are called in pictures and on the page."""
SETTINGS = Settings(contact_weight=0.0)
"""Defaults, and no wall: the paper's methods know of none."""

Load = Callable[[str], Problem]
"""The problem of a name; fit for pickling."""


@dataclass(frozen=True)
class Motion:
    """A method to be run on a problem."""

    problem: str
    method: str


@dataclass(frozen=True)
class Fitting:
    """The frames of a method's motion to be fitted again with more and fewer points, for Fig. 3."""

    problem: str
    method: str


Task = Motion | Fitting


class Moved(NamedTuple):
    """A plan and what study.row says of it: errors on both models, times, failures, snaps."""

    plan: Plan
    row: dict[str, Any]


@dataclass(frozen=True)
class Found:
    """Results of tasks; frames: T; jobs: processes side by side; seconds: of the whole run, then of each task."""

    moved: Mapping[Motion, Moved]
    fitted: Mapping[Fitting, tuple[Fit, ...]]
    frames: int
    jobs: int
    seconds: float
    task_seconds: Mapping[Task, float]

    def plan(self, problem: str, method: str) -> Plan:
        """The plan of a method for a problem."""
        return self.moved[Motion(problem, method)].plan

    def named(self, problem: str, methods: Sequence[str]) -> dict[str, Plan]:
        """Plans of methods for a problem, by what the methods are called."""
        return {NAMES[method]: self.plan(problem, method) for method in methods}

    def row(self, problem: str, method: str) -> dict[str, Any]:
        """What study.row says of that plan."""
        return self.moved[Motion(problem, method)].row

    def failures(self) -> list[str]:
        """What of our own methods was not solved, in words."""
        frames = [
            f"{task.problem}, {NAMES[task.method]}: {each.row['failed']} of {self.frames} frames"
            for task, each in self.moved.items()
            if task.method in OURS and each.row["failed"]
        ]
        refits = [
            f"{task.problem}, fit with {fit.points} points: {fit.failed} of {self.frames} frames"
            for task, some in self.fitted.items()
            for fit in some
            if task.method in OURS and fit.failed
        ]
        return frames + refits


def study(
    load: Load,
    tasks: Iterable[Task],
    frames: int,
    jobs: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> Found:
    """Results of all tasks, each once; progress: (tasks done, all, the last one's name).

    jobs: in how many processes. Raises OptionError, and after Ctrl-C KeyboardInterrupt: half of a figure is none.
    """
    wanted, begin = sorted(dict.fromkeys(tasks), key=_length), time.perf_counter()
    results: dict[Task, Any] = {}
    seconds: dict[Task, float] = {}
    with deferred_interrupt() as interrupted:
        for number, (result, taken) in side_by_side(functools.partial(_timed, load), wanted, jobs):
            task = wanted[number]
            results[task], seconds[task] = result, taken
            if progress is not None:
                progress(len(results), len(wanted), f"{task.problem}, {task.method}")
        if interrupted():
            raise KeyboardInterrupt
    return Found(
        {task: result for task, result in results.items() if isinstance(task, Motion)},
        {task: result for task, result in results.items() if isinstance(task, Fitting)},
        frames,
        jobs,
        time.perf_counter() - begin,
        seconds,
    )


def _length(task: Task) -> int:
    """Sorts what has to be compiled first, that nothing long is begun last."""
    return [ELASTIC, HORIZON].index(task.method) if task.method in (ELASTIC, HORIZON) else 2


def _timed(load: Load, task: Task) -> tuple[Any, float]:
    begin = time.perf_counter()
    problem = load(task.problem)
    result: Any = moved(problem, task.method)
    if isinstance(task, Fitting):
        result = fits(problem, result.plan, task.method)
    return result, time.perf_counter() - begin


def moved(problem: Problem, method: str) -> Moved:
    """The plan of a method for a problem; raises OptionError."""
    solver = default_chain_solver()
    variants = {
        HORIZON: f"horizon:{solver}",
        JOINT: f"joint:{default_solver()}",
        ELASTIC: f"horizon:{solver}:elastic",
    }
    variant = variants.get(method, method)
    plan = parse_variant(variant).plan(problem, SETTINGS, (), None)
    return Moved(plan, row(problem.name, variant, plan))
