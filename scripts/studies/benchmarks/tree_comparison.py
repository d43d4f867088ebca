"""Two trees of the library beside each other: turns in the order A B B A, and what their ratios say."""

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
"""Part of unchanged rows whose interval may lie beside the true ratio."""
MAX_RELATIVE_TIME_CHANGE = 0.15
"""Part by which a row may differ before anything is said."""
MIN_BENCHMARK_TURN_S = 0.05
"""Least seconds of a turn: rows of small pieces are repeated for so long."""
LEAST_BLOCKS = 7
"""Fewer blocks cannot tell a change at ROW_SIGNIFICANCE_LEVEL."""


class Worker:
    """A process that repeats one row of work.py for a tree; for a with block. Raises BenchmarkError."""

    def __init__(self, tree: Path, row: str, libraries: Path | None = None) -> None:
        """Start the process. tree: a checkout. libraries: where what it compiles is kept; the user's own cache
        where None.
        """
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
        """Return the seconds of each piece of the row's work, over `count` turns; factor: see work.timer."""
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
    """Comparison of a row between two trees: medians before and after, s, and the ratio after / before with its
    interval.
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
        """`slower` or `faster` where the whole interval is beyond the tolerance, else `same`."""
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
    """Compare a row in blocks of turns before, after, after, before, every second block in opposite order;
    `factor` slows the later tree down on purpose.
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
    """Return how many turns take about MIN_BENCHMARK_TURN_S seconds."""
    begin = time.perf_counter()
    worker.turns(1)
    return max(1, math.ceil(MIN_BENCHMARK_TURN_S / (time.perf_counter() - begin)))


def median_confidence_interval(
    values: Sequence[float], level: float = ROW_SIGNIFICANCE_LEVEL
) -> tuple[float, float]:
    """Return an interval for the median of the distribution of values (n,), by the sign test.

    Nothing is assumed of how they are distributed. Raises BenchmarkError where there are too few of them.
    """
    n = len(values)
    ordered = sorted(values)
    tails = np.cumsum([math.comb(n, k) for k in range(n + 1)]) / 2.0**n
    rank = int((tails <= level / 2).sum())
    if rank < 1:
        raise BenchmarkError(f"{n} blocks are too few; {LEAST_BLOCKS} are needed")
    return ordered[rank - 1], ordered[n - rank]


def measure_row(worker: Worker, seconds: float, least: int = 5) -> Array:
    """Return times (n,) in s of a row's pieces, over at least `least` turns and `seconds`."""
    found: list[float] = []
    begin = time.perf_counter()
    turns = 0
    while turns < least or time.perf_counter() - begin < seconds:
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
    """Compare every row between two trees, before and after; `report` is called with each result."""
    found = []
    for row in rows:
        with Worker(trees[0], row, libraries[0]) as before, Worker(trees[1], row, libraries[1]) as after:
            found.append(compare_row(row, before, after, blocks, tolerance))
            report(found[-1])
    return found
