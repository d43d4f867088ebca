"""The program behind scripts/benchmark.py: speed as ratios, all measured in one run."""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ctr_nlp.chain import Chain
from ctr_nlp.cli import problems
from ctr_nlp.cli.console import console, guarded, print_table
from ctr_nlp.formulations.horizon import Ends, horizon
from ctr_nlp.problem import Problem
from ctr_nlp.settings import Settings
from ctr_nlp.solvers import Iterate, Solution, Watch
from ctr_nlp.solvers.banded import BandedSolver
from ctr_nlp.solvers.chain_ipopt import IpoptSolver
from ctr_nlp.solvers.compiled import compiled
from ctr_nlp.steer import Horizon
from ctr_nlp.steer.motions import per_frame_motions

Array = npt.NDArray[np.float64]
REPEATS = 5
SIZES = (100, 1000, 5000)
"""Frames over which the time and memory of an iteration are followed."""


@dataclass(frozen=True)
class Record:
    """One figure: what it is, and whether more or less of it is better."""

    name: str
    value: float
    unit: str
    better: str


def main(folder: Path, argv: list[str] | None = None) -> int:
    """Measure and print; folder holds the named problems."""
    return guarded(lambda: _run(folder, _parser().parse_args(argv)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="benchmark.py",
        description="Times of the horizon's solvers, alternating in one run, interpreted and compiled, and how "
        "they grow with the number of frames. Needs a C compiler.",
        epilog="Exit status: 0 measured, 2 bad input.",
    )
    parser.add_argument("--json", metavar="FILE", help="also write the records to a file")
    return parser


def _run(folder: Path, arguments: argparse.Namespace) -> int:
    records = [*_solvers(folder), *_scaling(folder)]
    rows = [(r.name, f"{r.value:.4g}", r.unit, r.better) for r in records]
    print_table("benchmark", ("", "value", "unit", "better"), rows)
    if arguments.json:
        text = json.dumps([asdict(record) for record in records], indent=1)
        Path(arguments.json).write_text(text + "\n", encoding="utf-8")
        console().print(f"wrote {arguments.json}")
    return 0


def _solvers(folder: Path) -> Iterator[Record]:
    """Both solvers on every named problem, from the same start."""
    ratios: dict[str, list[float]] = {"interpreted": [], "compiled": []}
    for name in problems.names(folder):
        chain, start = _chain(problems.named(name, folder))
        for kind, functions in (("interpreted", chain.frame.functions), ("compiled", chain.functions)):
            times, solutions = _alternating(replace(chain, functions=functions), start)
            for solver, found in solutions.items():
                which = f"{name}, {solver}, {kind}"
                yield Record(f"{which}: time", times[solver], "s", "less")
                yield Record(f"{which}: iterations", found.iterations, "", "less")
                yield Record(f"{which}: objective", found.objective / chain.frames, "mm²", "less")
                yield Record(f"{which}: solved", float(found.success), "", "more")
            ratios[kind].append(times["ipopt"] / times["banded"])
            yield Record(f"{name}, {kind}: ipopt / banded", ratios[kind][-1], "", "more")
    for kind, values in ratios.items():
        yield Record(f"all, {kind}: ipopt / banded, geometric mean", statistics.geometric_mean(values), "", "more")


def _chain(problem: Problem) -> tuple[Chain, Array]:
    """A horizon with its default weight, and the start that solve_horizon takes."""
    motions = per_frame_motions(problem, Ends(), Settings())
    weight = Horizon(problem).balanced_weight(motions[0])
    return horizon(problem.robot, problem.samples, problem.dt, weight, Ends(), compiled), motions[0].ravel()


def _alternating(chain: Chain, start: Array) -> tuple[dict[str, float], dict[str, Solution]]:
    """Median times in s over REPEATS rounds in which every solver has its turn, and the solutions."""
    solvers: dict[str, BandedSolver | IpoptSolver] = {
        "banded": BandedSolver(chain),
        "ipopt": IpoptSolver(chain, follow=False),
    }
    times: dict[str, list[float]] = {name: [] for name in solvers}
    solutions: dict[str, Solution] = {}
    for _ in range(REPEATS):
        for name, solve in solvers.items():
            begin = time.perf_counter()
            solutions[name] = solve(start, Watch())
            times[name].append(time.perf_counter() - begin)
    return {name: statistics.median(values) for name, values in times.items()}, solutions


def _scaling(folder: Path) -> Iterator[Record]:
    """The banded solver on cos with more and more frames."""
    first: dict[str, float] = {}
    for frames in SIZES:
        chain, start = _chain(problems.named("cos", folder, frames))
        found, iteration, seconds = _followed(BandedSolver(chain), start)
        which = f"cos, {frames} frames"
        yield Record(f"{which}: iterations", found.iterations, "", "less")
        yield Record(f"{which}: time", seconds, "s", "less")
        for key, unit, value in (
            ("an iteration, median", "s", iteration),
            ("memory", "MB", _memory(chain, start)),
        ):
            share = value / frames
            yield Record(f"{which}: {key}", value, unit, "less")
            yield Record(
                f"{which}: {key}, a frame, over {SIZES[0]} frames'",
                share / first.setdefault(key, share),
                "",
                "less",
            )


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
