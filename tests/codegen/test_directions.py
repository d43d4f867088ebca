"""Functions with their slopes in vectors, against the Jacobians that CasADi finds."""

import ctypes
import functools
import itertools

import casadi as ca
import numpy as np
import pytest
from every_operation import OPERATIONS, X, Y

from ctr_nlp.codegen import cache, forward_mode
from ctr_nlp.codegen.forward_mode import DERIVATIVE_FACTORS, FunctionWithJacobian, forward_mode_code
from ctr_nlp.codegen.vector import EARLY_OUTPUT_PREFIX, VECTOR_LANES

pytestmark = pytest.mark.skipif(cache.unavailable_reason() is not None, reason="no C compiler")
NUMBERS = ctypes.POINTER(ctypes.c_double)
CALL = """\
int call_{name}(const double **arg, double **res) {{
    {name}(arg, res);
    return 0;
}}
"""


def compiled(*functions, before=""):
    """A library of functions, each called as call_NAME."""
    names = (each.function.name() for each in functions)
    code = before + forward_mode_code(functions) + "".join(CALL.format(name=name) for name in names)
    return ctypes.CDLL(str(cache.library(code, lambda: code)))


def found(library, directed, inputs, left_out=()):
    """Outputs as they lie in memory, and then slopes; NaN where nothing was written. left_out: not asked for."""
    function = directed.function
    given = [np.asarray(each, dtype=float).ravel(order="F") for each in inputs]
    sizes = [function.numel_out(k) for k in range(function.n_out())]
    sizes += [directed.slopes[k].nnz() for k in sorted(directed.slopes)]
    results = [np.full(max(size, 1), np.nan)[:size] for size in sizes]
    pointers = [None if k in left_out else each.ctypes.data_as(NUMBERS) for k, each in enumerate(results)]
    arg = (NUMBERS * len(given))(*(each.ctypes.data_as(NUMBERS) for each in given))
    assert library[f"call_{function.name()}"](arg, (NUMBERS * len(results))(*pointers)) == 0
    return results


def expected(directed, inputs):
    """The same by CasADi."""
    function = directed.function
    symbols = [ca.SX.sym(f"in_{k}", *function.size_in(k)) for k in range(function.n_in())]
    outputs = function.call(symbols)
    slopes = [ca.jacobian(ca.vec(outputs[k]), symbols[0]) for k in sorted(directed.slopes)]
    patterns = (directed.slopes[k] for k in sorted(directed.slopes))
    parts = [ca.project(each, pattern).nz[:] for each, pattern in zip(slopes, patterns, strict=True)]
    every = [*(ca.vec(ca.densify(each)) for each in outputs), *parts]
    values = ca.Function("expected", symbols, every).call(inputs)
    return [np.asarray(each.full()).ravel() for each in values]


def assert_right(directed, *inputs, library=None):
    library = library or compiled(directed)
    wanted = expected(directed, [ca.DM(np.asarray(each, dtype=float)) for each in inputs])
    for mine, casadi in zip(found(library, directed, inputs), wanted, strict=True):
        np.testing.assert_allclose(mine, casadi, rtol=1e-13, atol=1e-13)


def dense(function, *numbers):
    """All slopes of some outputs."""
    n = function.numel_in(0)
    return FunctionWithJacobian(function, {k: ca.Sparsity.dense(function.numel_out(k), n) for k in numbers})


@functools.cache
def operations():
    """Every operation of two unknowns, and their library."""
    both = ca.vertcat(X, Y)
    made = {name: dense(ca.Function(f"f_{name}", [both], [value]), 0) for name, (_, value) in OPERATIONS.items()}
    return made, compiled(*made.values())


def test_every_operation_that_is_written_has_slopes():
    assert DERIVATIVE_FACTORS.keys() == {operation for operation, _ in OPERATIONS.values()}


@pytest.mark.parametrize("name", OPERATIONS)
def test_slopes_of_an_operation_are_those_of_casadi(name):
    """At random numbers, and where one changes over: two that are equal, and 0."""
    made, library = operations()
    rng = np.random.default_rng(0)
    special = list(itertools.product((-0.5, 0.0, 0.5), repeat=2))
    for point in [*rng.uniform(-0.9, 0.9, (20, 2)), *rng.uniform(0.1, 0.9, (20, 2)), *special]:
        with np.errstate(all="ignore"):
            value, *slopes = expected(made[name], [ca.DM(point)])
        if np.isfinite(value).all() and np.isfinite(slopes[0]).all():
            assert_right(made[name], point, library=library)


def long_function(unknowns, instructions=700):
    """Of unknowns and parameters: many operations, of which later ones take early results."""
    rng = np.random.default_rng(1)
    x, p = ca.SX.sym("x", unknowns), ca.SX.sym("p", 3)
    known = [*ca.vertsplit(x), *ca.vertsplit(p)]
    for _ in range(instructions):
        one, other = (known[rng.integers(len(known))] for _ in range(2))
        known.append((ca.sin(one) * other + 0.5 * one) / (2 + ca.cos(other)))
    return ca.Function("long_one", [x, p], [ca.vertcat(*known[-4:]), known[-5], ca.vertcat(*known[-9:-6]).T])


@pytest.mark.parametrize(
    "unknowns", [1, 2, 7, VECTOR_LANES, VECTOR_LANES + 1, VECTOR_LANES + 2, 2 * VECTOR_LANES + 5]
)
def test_any_number_of_unknowns(unknowns):
    function = long_function(unknowns)
    rng = np.random.default_rng(2)
    assert_right(dense(function, 0, 1, 2), rng.normal(size=unknowns), rng.normal(size=3))


@pytest.mark.parametrize("part", [1, 2, 30, 10**6])
def test_values_and_slopes_go_on_to_later_parts(part, monkeypatch):
    monkeypatch.setattr(forward_mode, "FORWARD_MODE_PART_INSTRUCTIONS", part)
    rng = np.random.default_rng(3)
    assert_right(dense(long_function(9, 60), 0, 2), rng.normal(size=9), rng.normal(size=3))


def test_only_entries_of_the_pattern_are_told():
    x = ca.SX.sym("x", 3)
    function = ca.Function("few", [x], [ca.vertcat(x[0] * x[1], x[2] ** 2, 7.0)])
    pattern = ca.Sparsity.triplet(3, 3, [0, 1, 2, 0], [1, 2, 2, 2])
    directed = FunctionWithJacobian(function, {0: pattern})
    assert_right(directed, [2.0, 3.0, 5.0])
    _, slopes = found(compiled(directed), directed, [[2.0, 3.0, 5.0]])
    np.testing.assert_array_equal(sorted(slopes), [0.0, 0.0, 2.0, 10.0])


def test_what_does_not_follow_the_unknowns_has_no_slopes():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    function = ca.Function("apart", [x, p], [ca.vertcat(p**2, 3.0, ca.floor(x[0]), x[1])])
    assert_right(dense(function, 0), [1.5, -2.5], [4.0])


def test_an_unknown_that_is_passed_on_as_it_is_and_twice():
    x = ca.SX.sym("x", 2)
    assert_right(dense(ca.Function("passed", [x], [ca.vertcat(x[1], x[0], x[1])]), 0), [1.0, 2.0])


def test_results_that_nobody_asks_for_are_not_written():
    directed = dense(long_function(3, 20), 0, 1)
    numbers = np.ones(3), np.ones(3)
    results = found(compiled(directed), directed, numbers, left_out=(0, 4))
    wanted = expected(directed, [ca.DM(each) for each in numbers])
    for k, (mine, casadi) in enumerate(zip(results, wanted, strict=True)):
        if k in (0, 4):
            assert np.isnan(mine).all()
        else:
            np.testing.assert_allclose(mine, casadi, rtol=1e-13)


def test_without_slopes_it_is_the_function():
    directed = FunctionWithJacobian(long_function(4, 30), {})
    assert_right(directed, np.ones(4), np.ones(3))


def test_early_results_can_be_read_and_inputs_filled_before_the_rest():
    """Between, the last input is made from what was found early: here the square of its slope."""
    x, given = ca.SX.sym("x", 2), ca.SX.sym("given")
    function = ca.Function(
        "waits", [x, given], [x[0] * x[1], given * x[0]], ["x", "given"], [f"{EARLY_OUTPUT_PREFIX}first", "last"]
    )
    pause = """\
static void waits_pause(const double **arg, double **res) {
    *(double *)arg[1] = res[2][0] * res[2][0];
}
"""
    directed = dense(function, 0, 1)
    early, last, early_slopes, last_slopes = found(
        compiled(directed, before=pause), directed, [[3.0, 5.0], [np.nan]]
    )
    np.testing.assert_array_equal([*early, *last, *early_slopes, *last_slopes], [15, 75, 5, 3, 25, 0])


def test_an_operation_without_c_is_named_with_its_function():
    x = ca.SX.sym("x")
    with pytest.raises(NotImplementedError, match="unwritten uses operations"):
        forward_mode_code((dense(ca.Function("unwritten", [x], [ca.erf(x)]), 0),))
