"""Single frames: every method on the same frames from the same past, and what the elastic model costs."""

from __future__ import annotations

import ctypes
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from ctr_nlp.formulations.frame import filled
from ctr_nlp.formulations.frame import program as built
from ctr_nlp.formulations.frames import FrameResult, reachable
from ctr_nlp.formulations.joint import joint
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.stage import Stage
from ctr_nlp.formulations.terms import Order, ShapeDistance
from ctr_nlp.models import MODELS
from ctr_nlp.models.protocol import SUBSTEPS
from ctr_nlp.plan.metrics import summary
from ctr_nlp.reference import reference_frames
from ctr_nlp.solvers import SOLVERS, NlpSolver, Solution
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.steer import solve_horizon, solve_per_frame
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.studies.benchmarks import RATIO, Record
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

Found = TypeVar("Found", Solution, FrameResult)

EVERY = 5
"""The methods that take much longer are asked for every EVERY-th frame only."""
REFERENCES = ("paper-two-stage", "euclidean")
ROUNDS = 3
"""Times that solvers have their turn on all frames."""
EVALUATIONS = 2000
"""Evaluations that the time of one is the mean of."""


@dataclass
class Times:
    """Of one method: seconds and iterations (or evaluations) of every frame, and how many were not solved."""

    seconds: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    failed: int = 0

    def take(self, work: Callable[..., Found], *arguments: Any) -> Found:
        """Do the work of one frame and note what it took."""
        begin = time.perf_counter()
        found = work(*arguments)
        self.seconds.append(time.perf_counter() - begin)
        self.iterations.append(found.iterations)
        self.failed += not found.success
        return found


def frames(problem: Problem) -> Iterator[Record]:
    """Times of a frame by compiled SQP, interpreted IPOPT and the reference methods, and their ratios."""
    times = race(problem)
    median = {name: statistics.median(taken.seconds) for name, taken in times.items()}
    for name, taken in times.items():
        which = f"{problem.name}, a frame, {name}"
        work = sum(taken.iterations)
        yield Record(f"{which}: median", 1e6 * median[name], "us", "less")
        yield Record(
            f"{which}: 99 % over median", float(np.quantile(taken.seconds, 0.99)) / median[name], "", "less"
        )
        yield Record(f"{which}: iterations or evaluations, mean", work / len(taken.seconds), "", "less")
        yield Record(f"{which}: time of one", 1e6 * sum(taken.seconds) / max(work, 1), "us", "less")
        yield Record(f"{which}: not solved", taken.failed, "", "less", 0.0 if name == "sqp" else None)
    for name in list(times)[1:]:
        yield Record(f"{problem.name}, a frame: {name} / sqp", median[name] / median["sqp"], "", "more", RATIO)
    e3 = {name: summary(solve_per_frame(problem, solver=name))["e3"] for name in ("sqp", "ipopt")}
    yield Record(f"{problem.name}, joint: e3 of sqp / ipopt", e3["sqp"] / e3["ipopt"], "", "less", 0.02)
    yield from _floor(problem, times["sqp"], median["sqp"])


def race(problem: Problem) -> dict[str, Times]:
    """Every method in turn on the same frames of a problem, each from where compiled SQP stood before it."""
    settings = Settings()
    (stage,) = joint(problem.robot, settings, MODELS["dominant"])
    solvers: dict[str, NlpSolver] = {name: SOLVERS[name](stage.nlp) for name in ("sqp", "ipopt")}
    path = _path(problem, stage, solvers["sqp"])
    times = {name: Times() for name in (*solvers, *REFERENCES)}
    for _ in range(ROUNDS):
        for name, solve in solvers.items():
            warm: Solution | None = None
            for given in path:
                warm = times[name].take(solve, *given, warm)
    for name in REFERENCES:
        method = reference_frames(problem, name, settings)
        for number in range(EVERY, problem.frames, EVERY):
            times[name].take(method.step, number, FrameResult(path[number - 1][0]))
    return times


def _path(problem: Problem, stage: Stage, solve: NlpSolver) -> list[tuple[Array, Array, Array, Array]]:
    """Start, parameters and bounds of the frames' NLPs after the first, each from the solution before it."""
    settings, warm = Settings(), None
    path: list[tuple[Array, Array, Array, Array]] = []
    q = NlpFrames.of(problem, settings=settings).search(0)[0].q
    for frame in problem.samples[1:]:
        given = {"previous": q, "motion_root": math.sqrt(settings.motion_weight) / problem.dt}
        path.append(
            (q, stage.nlp.pack({**stage.fill(frame, q), **given}), *reachable(problem.robot, q, problem.dt))
        )
        warm = solve(*path[-1], warm)
        q = warm.x
    return path


def _floor(problem: Problem, taken: Times, median: float) -> Iterator[Record]:
    """How near a frame is to the time of its evaluations of residuals and Jacobian alone."""
    (stage,) = joint(problem.robot, Settings(), MODELS["dominant"])
    program = Program(stage.nlp, wait=True)
    program.p[:] = stage.nlp.pack(stage.fill(problem.samples[-1], np.zeros(0)))
    one = evaluation(program)
    needed = one * (statistics.median(taken.iterations) + 1)
    yield Record(f"{problem.name}: first derivatives once, in C", 1e6 * one, "us", "less")
    yield Record(f"{problem.name}, a frame, sqp: median over these", median / needed, "", "less", RATIO)


def evaluation(program: Program, function: str = "slopes") -> float:
    """Seconds that one evaluation of objective and constraints takes: their values, or first derivatives too."""
    run = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)(program.functions[function])
    n, m = len(program.x), len(program.lower) - len(program.x)
    results = [np.zeros(max(count, 1)) for count in ((1, m) if function == "value" else (1, n, m, m * n))]
    pointers = ctypes.c_void_p * 4
    arg = pointers(program.x.ctypes.data, program.p.ctypes.data)
    res = pointers(*(result.ctypes.data for result in results))
    begin = time.perf_counter()
    for _ in itertools.repeat(None, EVALUATIONS):
        run(arg, res, None, None, 0)
    return (time.perf_counter() - begin) / EVALUATIONS


ELASTIC_ROUNDS = 5
"""Times that forward solutions have their turn."""


def planned(problem: Problem) -> Iterator[Record]:
    """Times of an elastic frame by compiled SQP and by interpreted IPOPT, each from where SQP stood before."""
    solvers = {name: NlpFrames.of(problem, "joint", name, "elastic") for name in ("sqp", "ipopt")}
    times = {name: Times() for name in solvers}
    before = solvers["sqp"].search(0)[0]
    for frame in range(1, problem.frames):
        found: dict[str, FrameResult] = {}
        for name in solvers if frame % EVERY == 0 else ("sqp",):
            found[name] = times[name].take(solvers[name].step, frame, before)
        before = found["sqp"]
    median = {name: statistics.median(taken.seconds) for name, taken in times.items()}
    for name, taken in times.items():
        which = f"{problem.name}, an elastic frame, {name}"
        yield Record(f"{which}: median", 1e6 * median[name], "us", "less")
        yield Record(f"{which}: not solved", taken.failed, "", "less", 0.0 if name == "sqp" else None)
    ratio = median["ipopt"] / median["sqp"]
    yield Record(f"{problem.name}, an elastic frame: ipopt / sqp", ratio, "", "more", RATIO)


def forward(problem: Problem) -> Iterator[Record]:
    """A forward solution with margin and shape along a motion, beside the dominant model's compiled shape."""
    robot, q = problem.robot, solve_horizon(problem, model="elastic").q
    model, elastic, rigid = MODELS["elastic"], [], []
    terms = ShapeDistance(stride=1), Order(robot.carriage_gap)
    program = Program(built("frame", robot.structure, MODELS["dominant"], terms), wait=True)
    program.p[:] = program.nlp.pack(filled(robot, terms, problem.samples[-1]))
    program.x[:] = q[-1]
    for _ in range(ELASTIC_ROUNDS):
        begin = time.perf_counter()
        found = model.follow(robot, q)
        model.points(robot, np.repeat(found.x, SUBSTEPS, axis=0), SIGMA)
        elastic.append((time.perf_counter() - begin) / (len(q) * SUBSTEPS))
        rigid.append(evaluation(program, "value"))
    times = min(elastic), min(rigid)
    yield Record(f"{problem.name}, elastic: a forward solution, margin and shape", 1e6 * times[0], "us", "less")
    yield Record(f"{problem.name}, dominant: the same samples, in C", 1e6 * times[1], "us", "less")
    yield Record(f"{problem.name}: elastic / dominant", times[0] / times[1], "", "less", RATIO)
