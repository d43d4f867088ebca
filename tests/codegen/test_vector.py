"""C and tapes that evaluate several frames at once, against CasADi's own evaluation, and chains and solvers."""

import functools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from every_operation import OPERATIONS, ROUNDED, X, Y
from frames import alone, horizon

from ctr_nlp import Limits, Robot, curve_from_formula, growing, table_i_robot
from ctr_nlp.codegen import background, cache, language, sample_points, vector
from ctr_nlp.codegen.tape import tape_code
from ctr_nlp.codegen.vector import VECTOR_LANES, vector_code
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.nlp import Nlp, Residual
from ctr_nlp.solvers import CHAIN_SOLVERS, Watch, compiled_functions

INF, NAN = np.inf, np.nan
SPECIAL = [-INF, -1e300, -2.5, -1.0, -0.5, 0.0, 1e-300, 0.5, 1.0, 2.0, 3.0, 1e300, INF]


def loaded(*functions, lanes=VECTOR_LANES):
    """Functions from a library made of all of them, by name; lanes: None for tapes, whose functions have LANES."""
    code = tape_code(functions) if lanes is None else vector_code(functions, lanes)
    path = str(cache.library(code, lambda: code))
    return {function.name(): ca.external(function.name(), path) for function in functions}


def evaluated(function, *inputs):
    """All outputs as arrays."""
    return [np.asarray(value.full()) for value in function.call([ca.DM(value) for value in inputs])]


def random_inputs(function, rng, draw, lanes=VECTOR_LANES):
    """Inputs of so many evaluations side by side."""
    shapes = [function.size_in(i) for i in range(function.n_in())]
    return [draw(rng, (rows, (lanes or VECTOR_LANES) * columns)) for rows, columns in shapes]


def whole_numbers(rng, shape):
    return rng.integers(-9, 10, shape) + 0.0


def assert_the_same(function, library, inputs, ulps=0):
    """All outputs within so many units in the last place of CasADi's."""
    whole = [each.map(inputs[0].shape[1] // each.size2_in(0)) for each in (function, library)]
    expected, found = (evaluated(each, *inputs) for each in whole)
    for one, other in zip(expected, found, strict=True):
        assert one.shape == other.shape
        np.testing.assert_array_equal(np.isnan(other), np.isnan(one))
        finite = np.isfinite(one) & np.isfinite(other)
        np.testing.assert_array_equal(other[~finite], one[~finite])
        away = np.abs(other[finite] - one[finite])
        assert (away <= ulps * np.spacing(np.abs(one[finite]))).all(), (away.max(), function.name())


EVERY_WIDTH = pytest.mark.parametrize("lanes", [1, 4, VECTOR_LANES, None])


# Operations


@functools.cache
def operations(lanes):
    """A function of x and y and its library an operation."""
    made = {name: ca.Function(f"f_{name}", [X, Y], [value]) for name, (_, value) in OPERATIONS.items()}
    libraries = loaded(*made.values(), lanes=lanes)
    return {name: (function, libraries[function.name()]) for name, function in made.items()}


def test_every_operation_that_is_written_is_tested():
    written = language.OPERATIONS.keys() | language.C_LIBRARY_FUNCTIONS.keys()
    assert {operation for operation, _ in OPERATIONS.values()} == written


@pytest.mark.parametrize("name", OPERATIONS)
def test_the_function_of_an_operation_has_it(name):
    """Else CasADi would have simplified it away, and nothing were tested."""
    function, _ = operations(VECTOR_LANES)[name]
    ids = {function.instruction_id(k) for k in range(function.n_instructions())}
    assert OPERATIONS[name][0] in ids


@pytest.mark.parametrize("name", OPERATIONS)
@EVERY_WIDTH
def test_an_operation_is_that_of_casadi_at_random_numbers(name, lanes):
    """Of three sizes, and some of them equal to others."""
    sizes = np.repeat([1.0, 30.0, 1e5], 400)

    def draw(rng, shape):
        return (
            np.where(rng.random(shape) < 0.2, rng.integers(-2, 3, shape), sizes * rng.uniform(-1, 1, shape)) + 0.0
        )

    rng = np.random.default_rng(7)
    function, library = operations(lanes)[name]
    inputs = random_inputs(function, rng, draw, sizes.size)
    assert_the_same(function, library, inputs, 4 if name in ROUNDED else 0)


@pytest.mark.parametrize("name", OPERATIONS)
@EVERY_WIDTH
def test_an_operation_is_that_of_casadi_at_special_numbers(name, lanes):
    function, library = operations(lanes)[name]
    pairs = np.resize([(x, y) for x in SPECIAL for y in SPECIAL], (22 * VECTOR_LANES, 2)).T
    assert_the_same(function, library, pairs[:, None], 4 if name in ROUNDED else 0)


@pytest.mark.parametrize("name", OPERATIONS)
@EVERY_WIDTH
def test_an_operation_is_that_of_casadi_where_something_is_not_a_number(name, lanes):
    function, library = operations(lanes)[name]
    x, y = np.repeat([[NAN, NAN, 1.0, -2.0], [NAN, 1.0, NAN, NAN]], lanes or VECTOR_LANES, axis=1)
    assert_the_same(function, library, (x[None], y[None]), 4 if name in ROUNDED else 0)


@pytest.mark.parametrize(
    "value",
    [
        pytest.param(ca.atan2(Y, X), id="zero"),
        pytest.param(ca.atan2(Y, -X), id="neg"),
        pytest.param(ca.atan2(Y, ca.copysign(Y, X)), id="copysign"),
        pytest.param(ca.atan2(Y, ca.fmin(X, 1)), id="fmin"),
        pytest.param(ca.atan2(Y, ca.fabs(X)), id="fabs"),
    ],
)
def test_signs_of_zeros_are_those_of_casadi(value):
    function = ca.Function("zeros", [X, Y], [value])
    library = loaded(function)["zeros"]
    x, y = np.resize([0.0, -0.0], VECTOR_LANES), np.resize([0.0, 0.0, -0.0, -0.0], VECTOR_LANES)
    assert_the_same(function, library, (x[None], y[None]), 4)


def test_without_sines_of_whole_vectors_functions_are_the_same(tmp_path, monkeypatch):
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "LINK_LIBRARY_CHOICES", cache.LINK_LIBRARY_CHOICES[1:])
    # Each on its own: a sum of both may cancel, and has the error of its terms.
    function = ca.Function("waves", [X, Y], [ca.sin(X), ca.cos(Y), ca.atan2(X, Y)])
    library, rng = loaded(function)["waves"], np.random.default_rng(8)
    for _ in range(20):
        assert_the_same(function, library, rng.normal(size=(2, 1, VECTOR_LANES)), 4)


def test_sines_and_cosines_of_one_angle_are_found_together():
    function = ca.Function("pair", [X, Y], [ca.sin(X), ca.cos(X), ca.cos(Y) * ca.sin(X * Y)])
    assert vector_code((function,)).count("= sine_and_cosine(") == 1
    x = np.concatenate([np.pi / 4 * np.arange(-40, 40), [1e-300, 999_999.5, 1e6, -3e7]])
    assert_the_same(function, loaded(function)["pair"], np.stack([x, np.cos(x)])[:, None, : len(x) // 8 * 8], 4)


@pytest.mark.parametrize("code", [vector_code, tape_code])
def test_an_operation_without_c_is_named_with_its_function(code):
    function = ca.Function("with_erf", [X], [ca.erf(X)])
    with pytest.raises(NotImplementedError, match=rf"with_erf uses operations .*\b{ca.OP_ERF}\b"):
        code((function,))


def test_assignments_need_no_c_as_casadi_keeps_none():
    function = ca.Function("assigned", [X], [ca.SX.unary(ca.OP_ASSIGN, X)])
    inputs = np.random.default_rng(4).normal(size=(1, VECTOR_LANES))
    assert_the_same(function, loaded(function)["assigned"], (inputs,))


def test_a_call_of_another_function_is_without_c():
    inner = ca.Function("inner", [X], [X * X, X + 1], {"never_inline": True})
    function = ca.Function("with_call", [X], [sum(inner(X))])
    with pytest.raises(NotImplementedError, match="with_call"):
        vector_code((function,))


# Functions of many parts


def small(value):
    """A whole number within +-9, so that sums and products of two are exact however they are rounded."""
    return ca.fmin(ca.fmax(value, -9), 9)


MIXERS = (
    lambda a, b: small(a + b),
    lambda a, b: small(a - b),
    lambda a, b: small(a * b),
    lambda a, b: small(2 * a),
    lambda a, b: small(b * b),
    lambda a, b: -a,
    lambda a, b: ca.sign(a) + ca.fabs(b),
    lambda a, b: ca.if_else(a < b, b, -3),
    lambda a, b: ca.if_else(a == b, a + 1, b),
    lambda a, b: ca.logic_and(a, b) - ca.logic_or(a - 2, b),
    lambda a, b: small(ca.floor(a / 2) + b),
)


def tangled(seed, count):
    """A function of six numbers in which values are used right away or much later."""
    rng, given = np.random.default_rng(seed), ca.SX.sym("given", 6)
    values = ca.vertsplit(given)
    for _ in range(count):
        recent, any_ = rng.integers(max(0, len(values) - 5), len(values)), rng.integers(len(values))
        picked = [values[recent], values[any_]]
        rng.shuffle(picked)
        values.append(MIXERS[rng.integers(len(MIXERS))](*picked))
    shown = rng.permutation(len(values))[: count // 8]
    return ca.Function(f"tangled_{seed}", [given], [ca.vertcat(*(values[k] for k in shown)), values[-1]])


@pytest.mark.parametrize(
    ("part", "count", "lanes"),
    [
        (1, 40, VECTOR_LANES),
        (2, 40, 1),
        (7, 80, VECTOR_LANES),
        (64, 120, 4),
        (vector.VECTOR_PART_INSTRUCTIONS, 420, VECTOR_LANES),
        (100, 200, 1),
    ],
)
def test_values_go_on_to_later_parts(part, count, lanes, monkeypatch):
    monkeypatch.setattr(vector, "VECTOR_PART_INSTRUCTIONS", part)
    made = [tangled(seed, count) for seed in range(2)]
    assert all(function.n_instructions() > 3 * part for function in made)
    rng, libraries = np.random.default_rng(9), loaded(*made, lanes=lanes)
    for function in made:
        for _ in range(20):
            inputs = random_inputs(function, rng, whole_numbers, lanes)
            assert_the_same(function, libraries[function.name()], inputs)


def test_a_part_more_or_less_by_one_instruction_loses_nothing(monkeypatch):
    """Results and outputs at the first and last instruction of a part."""
    made = tangled(11, 30)
    rng = np.random.default_rng(10)
    inputs = random_inputs(made, rng, whole_numbers)
    count = made.n_instructions()
    for part in (count - 1, count, count + 1):
        monkeypatch.setattr(vector, "VECTOR_PART_INSTRUCTIONS", part)
        assert_the_same(made, loaded(made)[made.name()], inputs)


# Inputs and outputs


@pytest.mark.parametrize("lanes", [VECTOR_LANES, None])
def test_outputs_that_are_constants(lanes):
    """The values of one evaluation once a lane; whole numbers, extremes, and what is no number."""
    values = [1.5, 0.0, -7.0, 1e22, 1 / 3, 1.7976931348623157e308, 5e-324, INF, -INF, NAN]
    function = ca.Function("constants", [X], [ca.SX(ca.DM(values)), ca.SX(2)])
    library = loaded(function, lanes=lanes)["constants"]
    first, second = evaluated(library, np.zeros((1, VECTOR_LANES)))
    np.testing.assert_array_equal(first, np.tile(np.array(values)[:, None], VECTOR_LANES))
    np.testing.assert_array_equal(second, np.full((1, VECTOR_LANES), 2.0))


def test_inputs_that_are_passed_on_as_they_are_and_twice():
    function = ca.Function("passed", [X, Y], [Y, X, X])
    x, y = np.random.default_rng(1).normal(size=(2, 1, VECTOR_LANES))
    found = evaluated(loaded(function)["passed"], x, y)
    for one, other in zip(found, (y, x, x), strict=True):
        np.testing.assert_array_equal(one, other)


@EVERY_WIDTH
def test_matrices_lie_by_columns_as_those_of_mapped_functions(lanes):
    """Against numpy: every lane has its own columns, and inputs that nothing uses are skipped."""
    a, b, unused = ca.SX.sym("a", 3, 2), ca.SX.sym("b", 2, 4), ca.SX.sym("unused", 2, 3)
    function = ca.Function("matrices", [a, unused, b], [a @ b, a.T, ca.vec(b) - 1, ca.SX(0, 1)])
    library, rng = loaded(function, lanes=lanes)["matrices"], np.random.default_rng(2)
    assert (library.n_in(), library.n_out()) == (3, 4)
    lanes = lanes or VECTOR_LANES
    assert [library.size_in(i) for i in range(3)] == [(3, 2 * lanes), (2, 3 * lanes), (2, 4 * lanes)]
    inputs = random_inputs(function, rng, whole_numbers, lanes)
    assert_the_same(function, library, inputs)
    lanes_a, _, lanes_b = (np.hsplit(value, lanes) for value in inputs)
    product, turned, column, nothing = evaluated(library, *inputs)
    np.testing.assert_array_equal(
        product, np.hstack([one @ two for one, two in zip(lanes_a, lanes_b, strict=True)])
    )
    np.testing.assert_array_equal(turned, np.hstack([one.T for one in lanes_a]))
    np.testing.assert_array_equal(column, np.column_stack([two.ravel(order="F") - 1 for two in lanes_b]))
    assert nothing.size == 0


@pytest.mark.parametrize("lanes", [VECTOR_LANES, None])
def test_lanes_do_not_mix(lanes):
    """What is not a number in one frame stays there."""
    function = ca.Function("alone", [X, Y], [ca.sin(X) * Y + ca.if_else(X < Y, ca.sqrt(X), Y)])
    library, rng = loaded(function, lanes=lanes)["alone"], np.random.default_rng(3)
    x, y = rng.uniform(1, 2, (2, 1, VECTOR_LANES))
    (before,) = evaluated(library, x, y)
    for lane in range(VECTOR_LANES):
        changed = x.copy()
        changed[0, lane] = NAN
        (after,) = evaluated(library, changed, y)
        assert np.flatnonzero(np.isnan(after)).tolist() == [lane]
        np.testing.assert_array_equal(np.delete(after, lane, 1), np.delete(before, lane, 1))


# Frames


def robot():
    """Two tubes that are arcs and one whose curvature grows: every kind of code in one library."""
    *arcs, last = table_i_robot().tubes
    return Robot((*arcs, replace(last, curvature=(1 / 120, 1 / 60))))


def inside(seed):
    """A q (2d + 2,) strictly within limits and order."""
    rng, d = np.random.default_rng(seed), robot().d
    part = np.sort(rng.uniform(0.05, 0.95, d))
    beta = np.maximum.accumulate(part * robot().upper[d : 2 * d]) + 0.3 * np.arange(d)
    return np.concatenate([rng.uniform(-2, 2, d), beta, rng.uniform(-1, 1, 2)])


def at_once(nlp):
    """A program's functions, compiled before anything is solved."""
    functions = compiled_functions.compile_functions(nlp)
    return lambda: functions


def chains(frames):
    """A horizon along an arc, interpreted and compiled."""
    path = curve_from_formula(lambda u: (100 * ca.cos(u) - 100, 0, 100 * ca.sin(u)), 0.0, 0.95)
    samples = growing(path, 20).sample()[:frames]
    ends = EndConfigurations(inside(901))
    return [horizon(robot(), samples, 0.1, 3e-3, ends, *how) for how in ((), (at_once,))]


def assert_close(found, expected):
    """To 1e-9 of the largest entry."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max(initial=0.0))


@pytest.mark.parametrize("frames", [1, VECTOR_LANES - 1, VECTOR_LANES, VECTOR_LANES + 1, 20])
def test_a_compiled_chain_is_the_interpreted_one(frames):
    interpreted, made = chains(frames)
    assert (interpreted.functions().lanes, made.functions().lanes) == (1, VECTOR_LANES)
    for seed in range(6):
        x = np.concatenate([inside(100 * seed + k) for k in range(frames)])
        multipliers = np.random.default_rng(seed).normal(size=len(made.bounds[0]))
        pairs = [
            *zip(made.evaluate(x), interpreted.evaluate(x), strict=True),
            *zip(made.by_frame(x), interpreted.by_frame(x), strict=True),
            *zip(made.slopes(x), interpreted.slopes(x), strict=True),
            *zip(made.frame_expansion(x, multipliers), interpreted.frame_expansion(x, multipliers), strict=True),
        ]
        for found, wanted in pairs:
            assert_close(found, wanted)


@pytest.mark.parametrize("solver", CHAIN_SOLVERS)
def test_a_solver_finds_on_the_compiled_chain_what_it_finds_on_the_interpreted_one(solver):
    start = np.tile([0.1, 0.2, 0.3, 20, 60, 90, 0, 0], VECTOR_LANES + 1)
    interpreted, made = (CHAIN_SOLVERS[solver](chain)(start, Watch()) for chain in chains(VECTOR_LANES + 1))
    assert interpreted.success
    assert made.success
    assert made.objective == pytest.approx(interpreted.objective, rel=1e-7)
    np.testing.assert_allclose(made.x, interpreted.x, rtol=0, atol=1e-4)


# Keys


def toy(factor):
    """One unknown that is drawn to a factor times its parameter."""
    return Nlp("toy", X, np.zeros(1), np.ones(1), {"y": Y}, (Residual("pull", X - factor * Y),))


def test_frames_of_equal_robots_share_a_library(monkeypatch):
    first = compiled_functions.library(alone(robot()), None).wait_for_path()
    monkeypatch.setattr(sample_points, "code", lambda *arguments: pytest.fail("written again"))
    assert compiled_functions.library(alone(robot()), None).wait_for_path().read_bytes() == first.read_bytes()


def test_another_number_of_lanes_is_another_library():
    paths = []
    for asked, lanes in ((1, 1), (None, VECTOR_LANES)):
        functions = compiled_functions.compile_functions(toy(2), asked)
        assert functions.lanes == lanes
        (found, _) = evaluated(functions.value, np.full((1, lanes), 5.0), np.full((1, lanes), 2.0))
        np.testing.assert_array_equal(found, np.ones((1, lanes)))
        paths.append(compiled_functions.library(toy(2), asked).wait_for_path())
    assert len(set(paths)) == 2


def test_robots_of_one_structure_share_a_key():
    """Numbers are parameters; what must be compiled anew is another number of tubes, kind, transmission or gap."""
    paper = table_i_robot()
    first, *others = paper.tubes
    deep = Limits(beta=[(0, tube.length) for tube in paper.tubes])
    same = [
        paper,
        replace(paper, tubes=(replace(first, curvature=first.curvature * 1.1), *others)),
        replace(paper, tubes=(replace(first, curved_length=45.0, length=100.0), *others)),
        replace(paper, tubes=(*paper.tubes[:2], replace(paper.tubes[2], inner_diameter=1.4))),
        paper.with_limits(beta=[(5, 40), (5, 90), (5, 140)], alpha=(-3, 3)),
    ]
    different = [
        replace(paper, tubes=(replace(first, curvature=(1 / 200, 1 / 100)), *others)),
        replace(paper, tubes=(replace(first, curvature=0.0), *others)),
        Robot(paper.tubes, deep),
        paper.with_limits(carriage_gap=5.0),
        Robot(paper.tubes[1:]),
    ]
    shared, own = (
        [compiled_functions.library(alone(robot), 1).key for robot in robots] for robots in (same, different)
    )
    assert len(set(shared)) == 1
    assert len({shared[0], *own}) == 1 + len(own)


def test_the_key_changes_with_constants_and_with_what_writes_the_code(monkeypatch):
    keys = [compiled_functions.library(toy(factor), 1).key for factor in (2, 3)]
    for room, source in ((compiled_functions, "_derivation_source"), (background, "_generator_source")):
        monkeypatch.setattr(room, source, lambda: "another writer")
        keys.append(compiled_functions.library(toy(2), 1).key)
    assert len(set(keys)) == 4
