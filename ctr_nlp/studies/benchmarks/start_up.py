"""What a user waits for before the first frame: the import, the first build and one from the cache."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator

from ctr_nlp.codegen import cache
from ctr_nlp.studies.benchmarks.records import Record

REPEATS = 5
IMPORT = """
import time; begin = time.perf_counter()
import ctr_nlp, sys
print(time.perf_counter() - begin, int("matplotlib" in sys.modules))
"""
BUILD = """
import time, numpy, ctr_nlp, ctr_nlp.steer
begin = time.perf_counter()
robot = ctr_nlp.table_i_robot()
ctr_nlp.Steerer(robot, numpy.zeros(8), 0.1)
print(time.perf_counter() - begin)
"""


def start_up() -> Iterator[Record]:
    """Seconds in processes of their own."""
    imports = [_told(IMPORT, None) for _ in range(REPEATS)]
    yield Record("import ctr_nlp", statistics.median(seconds for seconds, _ in imports), "s", "less")
    yield Record("import ctr_nlp: matplotlib with it", imports[0][1], "", "less", 0.0)
    with tempfile.TemporaryDirectory() as empty:
        first, *others = (_told(BUILD, empty)[0] for _ in range(1 + REPEATS))
    yield Record("a frame's NLP, first build", first, "s", "less")
    yield Record("a frame's NLP, from the cache", statistics.median(others), "s", "less")


def _told(program: str, folder: str | None) -> list[float]:
    environment = os.environ | ({} if folder is None else {cache.FOLDER: folder})
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    return [float(word) for word in done.stdout.split()]
