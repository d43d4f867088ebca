"""Whole motions: both solvers from the same starts, interpreted and compiled, and how they grow with frames."""

from __future__ import annotations

import itertools
import statistics
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ctr_nlp.formulations.horizon import Ends, horizon
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.models import MODELS
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.solvers import ChainSolver, Iterate, Solution, Watch
from ctr_nlp.solvers.compiled import compiled
from ctr_nlp.solvers.motion.banded import BandedSolver
from ctr_nlp.solvers.motion.ipopt import IpoptSolver
from ctr_nlp.steer import Horizon
from ctr_nlp.steer.motions import per_frame_motions
from ctr_nlp.studies.benchmarks import RATIO, Record
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

REPEATS = 5
SAME = 1e-4, 1e-6
"""Objectives that differ by less than this part, or this many mm^2 a frame, are the same optimum."""


def chain_of(problem: Problem) -> tuple[Chain, Array]:
    """A compiled horizon with its default weight, and the best motion to start from."""
    motions = per_frame_motions(problem, Ends(), Settings(), None, MODELS["dominant"])
    weight = Horizon(problem, settings=Settings(contact_weight=0.0)).balanced_weight(motions[0])
    at = problem.robot, problem.samples, problem.dt, weight, Ends(), MODELS["dominant"]
    return horizon(*at, lambda nlp: lambda: compiled(nlp)), motions[0].ravel()


def horizons(problem: Problem) -> Iterator[Record]:
    """Times of both solvers, interpreted and compiled, from the same start, alternating; and their ratios."""
    chain, start = chain_of(problem)
    plain = replace(chain, functions=lambda: chain.frame.functions)
    solvers: dict[str, ChainSolver] = {
        "banded, compiled": BandedSolver(chain),
        "ipopt, compiled": IpoptSolver(chain, follow=False),
        "banded, interpreted": BandedSolver(plain),
        "ipopt, interpreted": IpoptSolver(plain, follow=False),
    }
    times, solutions = _alternating(solvers, start)
    for name, found in solutions.items():
        which = f"{problem.name}, horizon, {name}"
        yield Record(f"{which}: time", 1e3 * times[name], "ms", "less")
        yield Record(f"{which}: iterations", found.iterations, "", "less")
        yield Record(f"{which}: an iteration", 1e3 * times[name] / max(found.iterations, 1), "ms", "less")
        yield Record(f"{which}: objective", found.objective / chain.frames, "mm²", "less", 1e-3)
        yield Record(f"{which}: solved", float(found.success), "", "more", 0.0)
    best, other = (solutions[f"{name}, compiled"].objective / chain.frames for name in ("banded", "ipopt"))
    same = abs(best - other) <= max(SAME[1], SAME[0] * abs(other))
    which = f"{problem.name}, horizon: banded's optimum is ipopt's (0), better (1), worse (-1)"
    yield Record(which, 0.0 if same else float(np.sign(other - best)), "", "more")
    for name in list(solutions)[1:]:
        ratio = times[name] / times["banded, compiled"]
        yield Record(f"{problem.name}, horizon: {name} / banded, compiled", ratio, "", "more", RATIO)


def _alternating(solvers: dict[str, ChainSolver], start: Array) -> tuple[dict[str, float], dict[str, Solution]]:
    """Median times in s over REPEATS rounds in which every solver has its turn, and the solutions."""
    times: dict[str, list[float]] = {name: [] for name in solvers}
    solutions: dict[str, Solution] = {}
    for _ in range(REPEATS):
        for name, solve in solvers.items():
            begin = time.perf_counter()
            solutions[name] = solve(start, Watch())
            times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in times.items()}, solutions


def growth(problems: list[Problem]) -> Iterator[Record]:
    """Time and memory of an iteration of the banded solver, a frame, over those of the first problem."""
    first: dict[str, float] = {}
    for problem in problems:
        chain, start = chain_of(problem)
        found, iteration, seconds = _followed(BandedSolver(chain), start)
        which = f"{problem.name}, {problem.frames} frames"
        yield Record(f"{which}: iterations", found.iterations, "", "less")
        yield Record(f"{which}: time", seconds, "s", "less")
        for key, unit, value in (
            ("an iteration, median", "s", iteration),
            ("memory", "MB", _memory(chain, start)),
        ):
            share = value / problem.frames
            over = share / first.setdefault(key, share)
            yield Record(f"{which}: {key}", value, unit, "less")
            yield Record(f"{which}: {key}, a frame, over {problems[0].frames} frames'", over, "", "less", RATIO)


def _followed(solver: BandedSolver, start: Array) -> tuple[Solution, float, float]:
    """A solution, the median time of an iteration and the whole time, s."""
    moments = [time.perf_counter()]
    found = solver(start, Watch(lambda _: moments.append(time.perf_counter())))
    steps = [after - before for before, after in itertools.pairwise(moments)]
    return found, statistics.median(steps), moments[-1] - moments[0]


def _memory(chain: Chain, start: Array) -> float:
    """The most memory that Python and numpy hold while a solver is built and makes three iterations, MB."""
    tracemalloc.start()
    seen: list[Iterate] = []
    BandedSolver(replace(chain))(start, Watch(seen.append, lambda: len(seen) > 3))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak / 2**20
