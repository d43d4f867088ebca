"""What a user waits for before the first frame, and how a frame grows with samples and with tubes."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.formulations.frame import program
from ctr_nlp.formulations.terms import Order, ShapeDistance
from ctr_nlp.models import MODELS
from ctr_nlp.robot import Robot, Tube, table_i_robot
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.studies.benchmarks import Record
from ctr_nlp.studies.benchmarks.frames import evaluation

STRIDES = (20, 10, 5, 2, 1)
TUBES = (2, 3, 4, 5, 6)


def sizes() -> Iterator[Record]:
    """Operations and compiled time of a frame's first derivatives, and the time of its build."""
    robot = table_i_robot()
    for stride in STRIDES:
        yield from _measured(robot, stride, f"{100 // stride + 1} samples")
    for count in TUBES:
        yield from _measured(_nested(count), 5, f"{count} tubes")


def _measured(robot: Robot, stride: int, which: str) -> Iterator[Record]:
    terms = ShapeDistance(stride=stride), Order(robot.carriage_gap)
    nlp = program("frame", robot.structure, MODELS["dominant"], terms)
    begin = time.perf_counter()
    frame = Program(nlp, wait=True)
    built = time.perf_counter() - begin
    frame.x[:] = np.clip(np.linspace(0.1, 100, len(frame.x)), robot.lower, robot.upper)
    frame.p[nlp.place("tubes")] = robot.numbers.ravel(order="F")
    operations = [function.n_instructions() for function in nlp.functions[:3]]
    yield Record(f"{which}: build, or load where it was built before", built, "s", "less")
    yield Record(f"{which}: operations of first derivatives", operations[1], "", "less", 0.1)
    yield Record(f"{which}: operations with the Hessian", operations[2], "", "less", 0.1)
    yield Record(f"{which}: first derivatives once", 1e6 * evaluation(frame), "us", "less")


def _nested(count: int) -> Robot:
    """Tubes like the paper's, each inside the one before and longer."""
    tubes = (
        Tube(90.0 + 60 * i, 50.0 + 20 * i, 0.006 + 0.001 * i, 6.0 - 0.9 * i, 5.3 - 0.9 * i) for i in range(count)
    )
    return Robot(tuple(tubes))


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
