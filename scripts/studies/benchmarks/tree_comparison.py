"""Comparison of the speed of two source trees of the library.

Turns of both trees alternate in blocks A B B A, in which a linear drift of the machine's speed cancels. The ratio
of a row is the median over blocks of mean log t_B - mean log t_A, and its interval is that of the sign test.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import BenchmarkError
from ctr_nlp.typing import Array

BENCHMARK_SCRIPT = Path(__file__).with_name("work.py")
ROW_SIGNIFICANCE_LEVEL = 0.02
"""Probability that the interval of a row misses the true ratio."""
MAX_RELATIVE_TIME_CHANGE = 0.15
"""Relative change of a row's time below which it counts as unchanged."""
MIN_BENCHMARK_TURN_S = 0.05
"""Least duration of a turn, s; shorter rows are repeated."""
MAX_ROW_TIME_FACTOR = 12
"""How many times as long as it should be measured a row may take to be repeated often enough."""
LEAST_BLOCKS = 7
"""Least number of blocks at which the sign test can reach ROW_SIGNIFICANCE_LEVEL: 2 / 2^7 < 0.02."""


class Worker:
    """A process that repeats one row of work.py for a source tree; used in a with block. Raises BenchmarkError."""

    def __init__(self, tree: Path, row: str, libraries: Path | None = None) -> None:
        """Start the process.

        tree: a checkout. row: of work.BENCHMARK_ROWS. libraries: folder of compiled code; None for the user's own
        cache.
        """
        # Compiled before the first turn, and one thread of linear algebra: both would be measured otherwise.
        given = {
            "PYTHONPATH": str(tree),
            cache.COMPILE_VARIABLE: "now",
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        given |= {} if libraries is None else {cache.CACHE_FOLDER_VARIABLE: str(libraries)}
        self.tree = tree
        self.row = row
        self._process = subprocess.Popen(
            [sys.executable, str(BENCHMARK_SCRIPT), row],
            env=os.environ | given,
            cwd=tree,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Worker:
        """Wait until everything is built."""
        try:
            self._answer()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.communicate()

    def turns(self, count: int, factor: float = 1.0) -> list[list[float]]:
        """Return the seconds of each piece of the row's work in each of `count` turns; factor: see work.timer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([count, factor]) + "\n")
        self._process.stdin.flush()
        found: list[list[float]] = self._answer()
        return found

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            told = self._process.communicate()[1].strip().splitlines() or ["it said nothing"]
            raise BenchmarkError(f"row {self.row} of {self.tree} ended early: {told[-1]}")
        return json.loads(line)


@dataclass(frozen=True)
class RowComparison:
    """Comparison of a row between two trees.

    before, after: median times, s. ratio: after / before, with its interval from low to high. tolerance: relative
    change that counts as none.
    """

    row: str
    before: float
    after: float
    ratio: float
    low: float
    high: float
    tolerance: float = MAX_RELATIVE_TIME_CHANGE

    @property
    def verdict(self) -> str:
        """Verdict: "slower" or "faster" where the whole interval is beyond the tolerance, else "same"."""
        if self.low > 1 + self.tolerance:
            return "slower"
        return "faster" if self.high < 1 / (1 + self.tolerance) else "same"


def compare_row(
    row: str,
    before: Worker,
    after: Worker,
    blocks: int,
    tolerance: float = MAX_RELATIVE_TIME_CHANGE,
    factor: float = 1.0,
) -> RowComparison:
    """Compare a row in blocks of turns before, after, after, before; every second block in opposite order.

    before, after: processes of the two trees. blocks: number of blocks. tolerance: relative change that counts as
    none. factor: by which the later tree is slowed down on purpose, to test the benchmark.
    """
    count = turns_for_min_duration(before)
    times: dict[bool, list[float]] = {False: [], True: []}
    logs = []
    for number in range(blocks):
        block: dict[bool, list[float]] = {False: [], True: []}
        for later in (False, True, True, False) if number % 2 == 0 else (True, False, False, True):
            found = after.turns(count, factor) if later else before.turns(count)
            block[later].append(mean_of_least_times(found))
        logs.append(float(np.mean(np.log(block[True])) - np.mean(np.log(block[False]))))
        for later, values in block.items():
            times[later] += values
    ratio, low, high = np.exp([np.median(logs), *median_confidence_interval(logs)])
    medians = [float(np.median(times[later])) for later in (False, True)]
    return RowComparison(row, medians[0], medians[1], float(ratio), float(low), float(high), tolerance)


def mean_of_least_times(turns: Sequence[Sequence[float]]) -> float:
    """Return the mean over pieces of work of the least time of each piece over turns, s."""
    return float(np.min(turns, axis=0).mean())


def turns_for_min_duration(worker: Worker) -> int:
    """Return how many turns of `worker` take about MIN_BENCHMARK_TURN_S seconds; at least 1."""
    begin = time.perf_counter()
    worker.turns(1)
    return max(1, math.ceil(MIN_BENCHMARK_TURN_S / (time.perf_counter() - begin)))


def median_confidence_interval(
    values: Sequence[float], level: float = ROW_SIGNIFICANCE_LEVEL
) -> tuple[float, float]:
    """Return a confidence interval for the median of the distribution of values (n,), by the sign test.

    level: probability that it misses the median. No distribution is assumed. Raises BenchmarkError where there are
    too few values.
    """
    n = len(values)
    ordered = sorted(values)
    # The number of values below the median is binomial (n, 1/2). The interval from the rank-th smallest to the
    # rank-th largest misses it with probability 2 P(B <= rank - 1).
    tails = np.cumsum([math.comb(n, k) for k in range(n + 1)]) / 2.0**n
    rank = int((tails <= level / 2).sum())
    if rank < 1:
        raise BenchmarkError(f"{n} blocks are too few; {LEAST_BLOCKS} are needed")
    return ordered[rank - 1], ordered[n - rank]


def measure_row(worker: Worker, seconds: float, least: int = 5) -> Array:
    """Return times (n,) in s of the pieces of a worker's row, over at least `least` turns and `seconds` s.

    Turns that together take MAX_ROW_TIME_FACTOR times as long as `seconds` are enough, however few they are.
    """
    found: list[float] = []
    begin = time.perf_counter()
    turns = 0
    while (taken := time.perf_counter() - begin) < seconds or (
        turns < least and taken < MAX_ROW_TIME_FACTOR * seconds
    ):
        found += worker.turns(1)[0]
        turns += 1
    return np.array(found)


def compare_trees(
    rows: Sequence[str],
    trees: tuple[Path, Path],
    libraries: tuple[Path | None, Path | None],
    blocks: int,
    tolerance: float,
    report: Callable[[RowComparison], None] = lambda _: None,
) -> list[RowComparison]:
    """Compare every row between two trees.

    rows: names, of work.BENCHMARK_ROWS. trees: checkouts before and after. libraries: folders of compiled code,
    see Worker. blocks: number of blocks of each row. tolerance: relative change that counts as none. report:
    called with each result.
    """
    found = []
    for row in rows:
        with Worker(trees[0], row, libraries[0]) as before, Worker(trees[1], row, libraries[1]) as after:
            found.append(compare_row(row, before, after, blocks, tolerance))
            report(found[-1])
    return found
