"""Floating-point operations of elastic shapes with margins, beside what the processor could do at most.

Operations are those of the instructions of the generated functions, times the calls that are counted while robots
come to rest. Hand-written C is counted for the margin's eigenvalue problem alone, so that shares are lower bounds.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import casadi as ca

from benchmarks.growth import min_thread_seconds
from benchmarks.work import random_poses
from ctr_nlp.codegen import cache
from ctr_nlp.codegen.language import C_LIBRARY_FUNCTIONS, OPERATIONS
from ctr_nlp.codegen.vector import eliminate_common_subexpressions
from ctr_nlp.models import model_named
from ctr_nlp.models.elastic.compiled import FUNCTIONS, get_compiled_elastic, symbolic
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot, table_i_robot

LIBRARY_FUNCTION_OPERATIONS = 20
"""Operations that a sine, cosine or root counts for: about the terms of its polynomial, twice."""
PEAK_LOOPS = 200_000
"""Loops of the measurement of the peak, of 32 fused operations on vectors each."""
PEAK_C = """\
typedef double V __attribute__((vector_size(8 * LANES)));
void peak(long loops, double *to) {
    V a[16], factor = {0};
    for (int k = 0; k < 16; ++k) a[k] = factor + 1.0 + 1e-9 * k;
    factor += 0.999;
    for (long i = 0; i < loops; ++i) {
#pragma GCC unroll 16
        for (int k = 0; k < 16; ++k) a[k] = a[k] * factor + 1e-3;
#pragma GCC unroll 16
        for (int k = 0; k < 16; ++k) a[k] = a[k] * factor + 1e-3;
    }
    for (int k = 1; k < 16; ++k) a[0] += a[k];
    *to = a[0][0];
}
"""
"""A loop of fused multiplications and additions that depend on each other only from loop to loop."""


@dataclass(frozen=True)
class Roof:
    """One elastic shape with its margin, of a robot at rest.

    operations: floating-point operations. bytes: read and written in main memory. seconds: on one core. peak:
    operations that this core does in a second at most. calls: of each generated function.
    """

    operations: float
    bytes: float
    seconds: float
    peak: float
    calls: dict[str, float]

    @property
    def share(self) -> float:
        """Part of the peak that is used."""
        return self.operations / self.seconds / self.peak


def count_operations(function: ca.Function) -> int:
    """Return the floating-point operations of one evaluation of a function as it is written in C."""
    function = eliminate_common_subexpressions(function)
    ids = [function.instruction_id(k) for k in range(function.n_instructions())]
    library = sum(each in C_LIBRARY_FUNCTIONS for each in ids)
    return sum(each in OPERATIONS for each in ids) + LIBRARY_FUNCTION_OPERATIONS * library


def count_eigenvalue_operations(size: int) -> int:
    """Return the operations that make a symmetric matrix tridiagonal: a product and an update for each column."""
    return sum(6 * rest**2 for rest in range(1, size))


def measure_peak() -> float:
    """Return the floating-point operations that one core does in a second at most."""
    lanes = cache.vector_lanes()
    code = f"#define LANES {lanes}\n{PEAK_C}"
    run = ctypes.CDLL(str(cache.library(code, lambda: code))).peak
    to = ctypes.c_double()
    seconds = min_thread_seconds(lambda: run(ctypes.c_long(PEAK_LOOPS), ctypes.byref(to)))
    return 2 * 32 * lanes * PEAK_LOOPS / seconds


def measure_roof(robot: Robot | None = None) -> Roof:
    """Measure shapes of a robot, by default the paper's, at random configurations without a history."""
    robot = robot or table_i_robot()
    q = random_poses(robot)
    code = get_compiled_elastic(robot.structure)
    assert code is not None
    calls = code.count_calls(robot.numbers.ravel(order="F")[None], q)
    # Counted with one call of `points` a shape; the grid takes more.
    calls["points"] *= -(-len(SIGMA_GRID) // code.lanes)
    made = symbolic(robot.structure)
    each = {
        function.name(): count_operations(function)
        for function in (*made.scalar_functions, *made.vector_functions)
    }
    # Lanes without a robot are not counted as work.
    lanes = {name: 1 if name == FUNCTIONS[0] else code.lanes for name in FUNCTIONS}
    operations = sum(calls[name] * lanes[name] * each[name] for name in FUNCTIONS)
    size = made.of.second.shape[0]
    operations += calls["second"] * code.lanes * count_eigenvalue_operations(size)
    elastic = model_named("elastic")
    seconds = min_thread_seconds(lambda: elastic.rest_states(robot, q, SIGMA_GRID))
    # q and x, the tip's direction and the margin, and the points, which are written to memory and read before.
    moved = 8 * (2 * q.shape[1] + 4 + 2 * 3 * len(SIGMA_GRID))
    per = {name: count / len(q) for name, count in calls.items()}
    return Roof(operations / len(q), float(moved), seconds / len(q), measure_peak(), per)
