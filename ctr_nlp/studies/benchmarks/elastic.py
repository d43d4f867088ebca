"""What the elastic model costs: a forward solution with its margin, and a planned frame."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator

import numpy as np

from ctr_nlp.formulations.frame import filled
from ctr_nlp.formulations.frame import program as built
from ctr_nlp.formulations.frames import FrameResult
from ctr_nlp.formulations.terms import Order, ShapeDistance
from ctr_nlp.models import MODELS
from ctr_nlp.models.protocol import SUBSTEPS
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.steer import solve_horizon
from ctr_nlp.steer.nlp_frames import NlpFrames
from ctr_nlp.studies.benchmarks.frames import evaluation
from ctr_nlp.studies.benchmarks.records import RATIO, Record
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA

EVERY = 5
"""Every so many-th frame is also solved by interpreted IPOPT."""
ROUNDS = 5


def planned(problem: Problem) -> Iterator[Record]:
    """Times of an elastic frame by compiled SQP and by interpreted IPOPT, each from where SQP stood before."""
    solvers = {name: NlpFrames.of(problem, "joint", name, "elastic") for name in ("sqp", "ipopt")}
    seconds: dict[str, list[float]] = {name: [] for name in solvers}
    failed = dict.fromkeys(solvers, 0)
    before = solvers["sqp"].search(0)[0]
    for frame in range(1, problem.frames):
        found: dict[str, FrameResult] = {}
        for name in solvers if frame % EVERY == 0 else ("sqp",):
            begin = time.perf_counter()
            found[name] = solvers[name].step(frame, before)
            seconds[name].append(time.perf_counter() - begin)
            failed[name] += not found[name].success
        before = found["sqp"]
    median = {name: statistics.median(taken) for name, taken in seconds.items()}
    for name in solvers:
        which = f"{problem.name}, an elastic frame, {name}"
        yield Record(f"{which}: median", 1e6 * median[name], "us", "less")
        yield Record(f"{which}: not solved", failed[name], "", "less", 0.0 if name == "sqp" else None)
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
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        found = model.follow(robot, q)
        model.points(robot, np.repeat(found.x, SUBSTEPS, axis=0), SIGMA)
        elastic.append((time.perf_counter() - begin) / (len(q) * SUBSTEPS))
        rigid.append(evaluation(program, "value"))
    times = min(elastic), min(rigid)
    yield Record(f"{problem.name}, elastic: a forward solution, margin and shape", 1e6 * times[0], "us", "less")
    yield Record(f"{problem.name}, dominant: the same samples, in C", 1e6 * times[1], "us", "less")
    yield Record(f"{problem.name}: elastic / dominant", times[0] / times[1], "", "less", RATIO)
