"""Chains against numpy: values, first and second derivatives, names of rows, and the residual that judges them."""

from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from frames import horizon
from hypothesis import given
from hypothesis import strategies as st
from rows import END, START, alpha, bent, central, configuration, links_hessian, times, whole_jacobian
from strategies import seeds

from ctr_nlp import Limits, Problem, Robot, Tube, curve_from_formula, growing, shapes, table_i_robot
from ctr_nlp.models.inner import Inner
from ctr_nlp.ocp.chain import Chain, Excess, Slopes
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.links import FrameLink, differences
from ctr_nlp.ocp.nlp import Constraint, CostTerm, Nlp, Residual
from ctr_nlp.paths.target import SIGMA_GRID

FRAMES, WEIGHT, DURATION = 4, 3e-3, 5.0
SLOW = {"alpha_acceleration": 1.5, "beta_acceleration": [40.0, 50.0, 60.0], "theta_acceleration": 0.7}
ROBOTS = {
    "lone": Robot((Tube(120, 100, 0.01, 2, 1),)),
    "seed": table_i_robot(),
    "slow": table_i_robot().with_limits(**SLOW),
    "gap": Robot(table_i_robot().tubes, Limits(beta=[(0, 80), (0, 150), (0, 300)], carriage_gap=20.0)),
    "four": Robot((Tube(70, 40, 1 / 150, 7.7, 6.3), *table_i_robot().tubes)),
}


class Case(NamedTuple):
    problem: Problem
    ends: EndConfigurations
    chain: Chain

    def padded(self, q, order):
        """Motion q (T, n) with the known configurations around it that differences of an order see."""
        before = [] if self.ends.start is None else [self.ends.start] * order
        after = [] if self.ends.end is None or order == 1 else [self.ends.end]
        return np.vstack([*before, q, *after])

    def motion(self, seed):
        """A motion (T n,) strictly within limits and order, that ends where it has to."""
        q = np.array([inside(self.problem.robot, 10 * seed + k) for k in range(FRAMES)])
        if self.ends.end is not None:
            q[-1] = self.ends.end
        return q.ravel()

    def multipliers(self, seed):
        return np.random.default_rng(seed).normal(size=len(self.chain.bounds[0]))


def inside(robot, seed):
    """A q (2d + 2,) strictly within limits and order."""
    rng, d = np.random.default_rng(seed), robot.d
    part = np.sort(rng.uniform(0.05, 0.95, d))
    beta = np.maximum.accumulate(part * robot.upper[d : 2 * d]) + 0.3 * np.arange(d)
    return np.concatenate([rng.uniform(-2, 2, d), beta, rng.uniform(-1, 1, 2)])


def case_of(kind, given_ends):
    robot = ROBOTS[kind]
    path = curve_from_formula(lambda u: (100 * ca.cos(u) - 100, 0, 100 * ca.sin(u)), 0.0, 0.95)
    problem = Problem(kind, robot, growing(path, FRAMES), DURATION)
    ends = EndConfigurations(inside(robot, 901), inside(robot, 902)) if given_ends else EndConfigurations()
    return Case(problem, ends, horizon(robot, problem.target_frames, problem.dt, WEIGHT, ends))


@pytest.fixture(
    scope="module",
    params=[(kind, given_ends) for kind in ROBOTS for given_ends in (False, True)],
    ids=lambda param: f"{param[0]}-{'given' if param[1] else 'free'}",
)
def case(request):
    return case_of(*request.param)


@pytest.fixture(scope="module")
def slow():
    return case_of("slow", True)


@pytest.fixture(scope="module")
def free():
    return case_of("seed", False)


def standing():
    """Every frame at the same q, which is allowed."""
    return np.tile([0.1, 0.2, 0.3, 20, 60, 90, 0, 0], (FRAMES, 1))


def toy(frames=4, start=None, end=None, weight=0.7):
    """Two unknowns a frame, drawn to targets, with constraints that are not linear and one that is."""
    x, to = ca.SX.sym("x", 2), ca.SX.sym("to", 2)
    pull = Residual("pull", ca.vertcat(x[0] - to[0], ca.sin(x[1]) * x[0] - to[1]))
    curved = Constraint("curved", ca.vertcat(x[0] * x[1], x[0] - x[1] ** 3), np.full(2, -9.0), np.full(2, 9.0))
    straight = Constraint("straight", x[0] + 2 * x[1], np.array([-9.0]), np.array([9.0]))
    nlp = Nlp("toy", x, np.full(2, -3.0), np.full(2, 3.0), {"to": to}, (pull,), constraints=(curved, straight))
    to = np.random.default_rng(5).normal(size=(2, frames))
    return linked(nlp, to, 0.5, weight, start, end)


def linked(nlp, parameters, most, weight, start=None, end=None):
    """A chain whose frames may differ by most from one to the next, at a weight."""
    frames, n = parameters.shape[1], len(nlp.lower)
    matrix, offset, frame, axis = differences(frames, 1, [] if start is None else [start], [], n)
    size = np.ones(len(offset))
    link = FrameLink("step", matrix, offset, -most * size, most * size, weight * size, frame, axis)
    lower, upper = np.tile(nlp.lower, (frames, 1)), np.tile(nlp.upper, (frames, 1))
    if end is not None:
        lower[-1] = upper[-1] = end
    axes = tuple(f"x{i}" for i in range(n))
    return Chain(nlp, axes, np.ones(n), parameters, lower, upper, (link,), lambda: nlp.functions)


# Values


def shape_costs(case, q):
    """The distance (8) of every frame at the 21 samples, mm^2, by numpy alone."""
    sigma = SIGMA_GRID[::5]
    targets = np.stack([frame.points[::5] for frame in case.problem.target_frames])
    square = ((shapes(case.problem.robot, q, sigma) - targets) ** 2).sum(axis=-1)
    return np.trapezoid(square, sigma, axis=1)


def motion_costs(case, q):
    """Lambda |W step|^2 / dt^2 of every step, mm^2; none into the first frame where the start is free."""
    steps = np.diff(case.padded(q, 1), axis=0) * case.problem.robot.mm_per_unit / case.problem.dt
    costs = WEIGHT * (steps**2).sum(axis=1)
    return np.concatenate([np.zeros(FRAMES - len(costs)), costs])


def test_the_objective_is_the_distance_and_the_motion_of_the_design(case):
    x = case.motion(1)
    q = x.reshape(FRAMES, -1)
    expected = shape_costs(case, q).sum() + motion_costs(case, q).sum()
    assert case.chain.evaluate(x)[0] == pytest.approx(expected, rel=1e-12)


def test_what_frames_add_is_their_distance_and_the_step_into_them(case):
    x = case.motion(2)
    q = x.reshape(FRAMES, -1)
    own, linked_costs = case.chain.by_frame(x)
    np.testing.assert_allclose(own, shape_costs(case, q), rtol=1e-12)
    np.testing.assert_allclose(linked_costs, motion_costs(case, q), rtol=1e-12, atol=1e-12)
    assert own.sum() + linked_costs.sum() == pytest.approx(case.chain.evaluate(x)[0], rel=1e-12)


def test_rows_are_unknowns_order_and_differences(case):
    x, robot = case.motion(3), case.problem.robot
    q = x.reshape(FRAMES, -1)
    growth = np.diff(robot.split(q)[1], axis=1)
    rooms = [growth] if robot.carriage_gap is None else [growth, robot.max_extension_differences - growth]
    expected = [x, np.hstack(rooms).ravel(), np.diff(case.padded(q, 1), axis=0).ravel()]
    if np.isfinite(robot.acceleration).any():
        expected.append(np.diff(case.padded(q, 2), 2, axis=0).ravel())
    for value in (case.chain.evaluate(x)[1], case.chain.slopes(x).value):
        np.testing.assert_allclose(value, np.concatenate(expected), rtol=0, atol=1e-12)


def test_bounds_are_those_of_the_robot_times_the_time_of_a_step(case):
    robot, dt = case.problem.robot, case.problem.dt
    low, high = case.chain.bounds
    size, links = FRAMES * len(robot.axes), len(case.chain.offset)
    steps = len(case.padded(np.zeros((FRAMES, len(robot.axes))), 1)) - 1
    speeds = np.tile(robot.speed * dt, steps)
    accelerations = np.tile(robot.acceleration * dt**2, (links - len(speeds)) // len(robot.axes))
    np.testing.assert_allclose(high[-links:], np.concatenate([speeds, accelerations]), rtol=1e-15)
    np.testing.assert_array_equal(low[-links:], -high[-links:])
    free = size if case.ends.end is None else size - len(robot.axes)
    np.testing.assert_array_equal(low[:free], np.resize(robot.lower, free))
    np.testing.assert_array_equal(high[:free], np.resize(robot.upper, free))
    if case.ends.end is not None:
        np.testing.assert_array_equal(low[free:size], case.ends.end)
        np.testing.assert_array_equal(high[free:size], case.ends.end)


def test_a_factor_changes_the_links_cost_and_nothing_else(slow):
    x = slow.motion(4)
    whole, (own, cost) = slow.chain.with_cost(2.5), slow.chain.by_frame(x)
    np.testing.assert_allclose(whole.by_frame(x), (own, 2.5 * cost), rtol=1e-12)
    assert whole.evaluate(x)[0] == pytest.approx(own.sum() + 2.5 * cost.sum(), rel=1e-12)
    np.testing.assert_array_equal(whole.evaluate(x)[1], slow.chain.evaluate(x)[1])
    np.testing.assert_array_equal(whole.bounds, slow.chain.bounds)


def test_what_was_returned_stays_when_the_chain_is_evaluated_again():
    """Buffers are shared between calls, so that results must be copies."""
    chain, rng = toy(), np.random.default_rng(6)
    x, y = rng.uniform(-1, 1, (2, 8))
    multipliers = rng.normal(size=len(chain.bounds[0]))
    calls = (
        lambda at: chain.evaluate(at)[1:],
        lambda at: chain.by_frame(at),
        lambda at: chain.slopes(at)[1:],
        lambda at: [chain.kkt(at, multipliers)],
    )
    for call in calls:
        found = call(x)
        before = [array.copy() for array in found]
        for array, copy, other in zip(found, before, call(y), strict=True):
            assert not np.array_equal(copy, other)
            np.testing.assert_array_equal(array, copy)


# Derivatives


def expanded(chain, x, multipliers):
    """What expansions of the frames say of the chain: its slopes, and the frames' Hessians (T, n, n)."""
    f, gradient, g, jacobian, blocks = (array.copy() for array in chain.frame_expansion(x, multipliers))
    n, own = chain.unknowns, np.concatenate([x, g.ravel()])
    jacobian = jacobian.reshape(chain.frames, n, -1).transpose(0, 2, 1)
    of_links = chain.linking @ own + chain.offset
    to_links = whole_jacobian(chain, jacobian)[own.size :]
    slopes = Slopes(
        f.sum() + chain.weight @ of_links**2,
        gradient.ravel() + 2 * to_links.T @ (chain.weight * of_links),
        np.concatenate([own, of_links]),
        jacobian,
    )
    return slopes, blocks.reshape(-1, n, n)


def assert_matches_differences(exact, found):
    """To 1e-6 of the largest entry: the truncation of a central difference at steps of 1e-5 is far below."""
    np.testing.assert_allclose(exact, found, rtol=1e-6, atol=1e-6 * max(1.0, np.abs(exact).max()))


def test_the_gradient_matches_finite_differences(case):
    x = case.motion(7)
    assert_matches_differences(case.chain.slopes(x).gradient, central(lambda at: case.chain.evaluate(at)[0], x))


@pytest.mark.parametrize("multiplied", [False, True])
def test_the_jacobian_of_all_rows_matches_finite_differences(case, multiplied):
    x = case.motion(8)
    jacobian = case.chain.slopes(x).jacobian
    if multiplied:
        jacobian = expanded(case.chain, x, case.multipliers(8))[0].jacobian
    exact = whole_jacobian(case.chain, jacobian)
    assert_matches_differences(exact, central(lambda at: case.chain.evaluate(at)[1], x))


def lagrangian_gradient(chain, multipliers):
    def gradient(x):
        at = chain.slopes(x)
        return at.gradient + chain.multiply_transposed_jacobian(at.jacobian, multipliers)

    return gradient


def hessian(chain, x, multipliers):
    """Blocks of the frames, and the links' part."""
    slopes, blocks = expanded(chain, x, multipliers)
    return scipy.linalg.block_diag(*blocks) + links_hessian(chain, whole_jacobian(chain, slopes.jacobian))


def test_blocks_and_links_are_the_hessian_of_the_lagrangian(case):
    x, multipliers = case.motion(9), case.multipliers(9)
    found = central(lagrangian_gradient(case.chain, multipliers), x)
    assert_matches_differences(hessian(case.chain, x, multipliers), found)


def test_multipliers_of_constraints_that_are_not_linear_enter_the_hessian():
    chain, rng = toy(), np.random.default_rng(3)
    x, multipliers = rng.uniform(-1, 1, 8), rng.normal(size=len(toy().bounds[0]))
    exact = hessian(chain, x, multipliers)
    assert_matches_differences(exact, central(lagrangian_gradient(chain, multipliers), x))
    assert np.abs(exact - hessian(chain, x, 0 * multipliers)).max() > 0.1


def test_multipliers_of_rows_that_are_linear_do_not_change_the_hessian(slow):
    x = slow.motion(10)
    none, some = (expanded(slow.chain, x, factor * slow.multipliers(10))[1] for factor in (0, 1))
    np.testing.assert_array_equal(none, some)


def test_expanding_gives_the_slopes(case):
    x = case.motion(11)
    for one, other in zip(case.chain.slopes(x), expanded(case.chain, x, case.multipliers(11))[0], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)


def test_frames_are_evaluated_as_they_are_expanded(case):
    x = case.motion(16)
    f, _, g, _, _ = (array.copy() for array in case.chain.frame_expansion(x, case.multipliers(16)))
    for one, other in zip(case.chain.frame_values(x), (f, g), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)


@given(seeds)
def test_times_and_transposed_are_adjoint(slow, seed):
    """<J x, r> = <x, J' r> for any Jacobians of frames."""
    rng, chain = np.random.default_rng(seed), slow.chain
    x, rows = rng.normal(size=chain.lower.size), rng.normal(size=len(chain.bounds[0]))
    jacobian = rng.normal(size=(FRAMES, chain.frame.g.numel(), chain.unknowns))
    product = times(chain, jacobian, x) @ rows
    assert product == pytest.approx(x @ chain.multiply_transposed_jacobian(jacobian, rows), rel=1e-9, abs=1e-9)


# Inner quantities


def through_inner():
    """One Nlp thrice: with terms in symbols of two layers of inner quantities and x, of one, and in x alone."""
    x, to = ca.SX.sym("x", 3), ca.SX.sym("to", 2)
    directions = ca.horzcat(ca.vertcat(ca.sin(x[0]), x[1] * x[2]), ca.vertcat(ca.cos(x[1]), ca.exp(x[0] / 2)))
    first = Inner.of((directions, ca.vertcat(ca.SX(1, 1), x[0] * to[1], x[2] ** 2)))
    u, v = first.symbols
    second = Inner.of((u @ ca.vertcat(v[1], x[2]),))
    (point,) = second.symbols
    terms = [
        point - to,
        ca.vertcat(u[0, 1] * v[2] * x[0], ca.sin(x[1]) + v[0], u[1, 0] ** 3),
        ca.sqrt(ca.sumsqr(point) + 1) * x[2] + v[1],
    ]
    found = []
    for layers in ((first, second), (first,), ()):
        for inner in (second, first)[: 2 - len(layers)]:
            terms = ca.substitute(terms, list(inner.symbols), list(inner.values))
        near, curved, deep = terms
        found.append(
            Nlp(
                "thrice",
                x,
                np.full(3, -2.0),
                np.full(3, 2.0),
                {"to": to},
                (Residual("near", near), Residual("curved", curved)),
                (CostTerm("bowl", to[0] * x[0] * x[1] ** 2 + x[2] ** 4), CostTerm("wave", ca.cos(x[0] * x[2]))),
                (
                    Constraint("ball", ca.vertcat(ca.sumsqr(x), x[0] * x[1] * x[2]), np.zeros(2), np.ones(2)),
                    Constraint("deep", deep, np.zeros(1), np.ones(1)),
                ),
                layers,
            )
        )
        terms = [near, curved, deep]
    return found


@given(seeds)
def test_derivatives_through_inner_quantities_are_those_in_x(seed):
    """The plain Nlp's by CasADi from its Lagrangian as a whole, with any factor of the objective."""
    rng, (*inward, plain) = np.random.default_rng(seed), through_inner()
    x, p, lam_f, lam_g = rng.normal(size=3), rng.normal(size=2), rng.uniform(-3, 3), rng.normal(size=3)
    factors = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", 3)
    whole = factors[0] * plain.objective + ca.dot(factors[1], plain.g)
    gradient, jacobian = ca.gradient(plain.objective, plain.x), ca.jacobian(plain.g, plain.x)
    out = [plain.objective, gradient, plain.g, jacobian, ca.hessian(whole, plain.x)[0]]
    expected = ca.Function("whole", [plain.x, plain.p, *factors], out)(x, p, lam_f, lam_g)
    for nlp in (*inward, plain):
        value, slopes, expansion, _ = nlp.functions
        for found in (value(x, p), slopes(x, p), expansion(x, p, lam_f, lam_g)):
            wanted = [expected[0], expected[2]] if len(found) == 2 else expected
            for one, other in zip(found, wanted, strict=False):
                np.testing.assert_allclose(one.full(), other.full(), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("layers", [2, 1])
def test_residual_and_objective_are_functions_of_x_and_parameters_alone(layers):
    *inward, plain = through_inner()
    inward = inward[2 - layers]
    x, p = np.array([0.3, -0.7, 1.1]), np.array([0.4, -1.3])
    found, expected = (
        ca.Function("terms", [nlp.x, nlp.p], [nlp.residual, nlp.objective, nlp.g])(x, p) for nlp in (inward, plain)
    )
    own = {ca.SX.element_hash(entry) for symbol in (inward.x, inward.p) for entry in ca.symvar(symbol)}
    for term in (inward.residual, inward.objective, inward.g):
        assert {ca.SX.element_hash(entry) for entry in ca.symvar(term)} <= own
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.full(), other.full(), rtol=1e-12)


# Configurations that constraints give


@pytest.fixture(scope="module", params=[True, False], ids=["given", "free"])
def twisted(request):
    """A chain of bent links, and whether its ends are given."""
    return bent(request.param), request.param


def wound(chain, seed):
    """Unknowns (T n,) at random, within their bounds, and multipliers of all rows."""
    rng = np.random.default_rng(seed)
    x = np.clip(rng.uniform([-2, 1, -0.5], [2, 14, 0.5], chain.lower.shape), chain.lower, chain.upper)
    return x.ravel(), rng.normal(size=len(chain.bounds[0]))


def test_rows_of_links_are_differences_of_the_configuration(twisted):
    chain, given_ = twisted
    x, _ = wound(chain, 1)
    frames = x.reshape(-1, 3)
    before, after = ([configuration(end)] * given_ for end in (START, END))
    q = configuration(frames)
    steps, turns = np.diff([*before, *q], axis=0), np.diff([*before * 2, *q, *after], 2, axis=0)
    own = np.column_stack([q[:, 0], frames[:, 0] ** 2 + frames[:, 1] * frames[:, 2] / 5])
    expected = np.concatenate([x, own.ravel(), steps.ravel(), turns.ravel()])
    costs = (steps**2 @ [2, 0.05, 1]).sum() + (turns**2 @ [2, 0.05, 1]).sum() / 4
    objective, value = chain.evaluate(x)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(chain.slopes(x).value, value)
    own_costs, linked_costs = chain.by_frame(x)
    assert linked_costs.sum() == pytest.approx(costs, rel=1e-12)
    assert own_costs.sum() + costs == pytest.approx(objective, rel=1e-12)
    assert len(chain.bounds[0]) == len(chain.bounds[1]) == value.size
    np.testing.assert_allclose(chain.configurations(value), q, rtol=0, atol=1e-14)


@given(seeds)
def test_first_derivatives_through_constraints_match_finite_differences(twisted, seed):
    chain, _ = twisted
    x, multipliers = wound(chain, seed)
    slopes, (other, _) = chain.slopes(x), expanded(chain, x, multipliers)
    for one, same in zip(slopes, other, strict=True):
        np.testing.assert_allclose(one, same, rtol=1e-12, atol=1e-9)
    assert_matches_differences(slopes.gradient, central(lambda at: chain.evaluate(at)[0], x))
    exact = whole_jacobian(chain, slopes.jacobian)
    assert_matches_differences(exact, central(lambda at: chain.evaluate(at)[1], x))
    np.testing.assert_allclose(
        exact.T @ multipliers, chain.multiply_transposed_jacobian(slopes.jacobian, multipliers), atol=1e-9
    )


@given(seeds)
def test_blocks_and_links_are_the_hessian_through_constraints(twisted, seed):
    chain, _ = twisted
    x, multipliers = wound(chain, seed)
    exact = hessian(chain, x, multipliers)
    assert_matches_differences(exact, central(lagrangian_gradient(chain, multipliers), x))


def test_a_row_is_reached_through_constraints():
    """Ends are given: the last frame's own rows are fixed, and all that links it to others is not."""
    chain, still = bent(frames=4), np.zeros(4, bool)
    still[-1] = True
    own = np.concatenate([np.repeat(~still, 3), np.repeat(~still, 2)])
    np.testing.assert_array_equal(chain.changeable_rows[: own.size], own)
    jacobian = whole_jacobian(chain, chain.slopes(wound(chain, 2)[0]).jacobian)
    np.testing.assert_array_equal(chain.changeable_rows, (jacobian[:, chain.free] != 0).any(axis=1))


def test_rows_are_named_after_axes_where_the_configuration_is_and_after_symbols_elsewhere():
    chain = bent(frames=2, ends=False)
    places = [chain.describe_row(row) for row in range(len(chain.bounds[0]))]
    limits = ["limits of x_0", "limits of beta", "limits of theta"] * 2 + ["limits of alpha", "bowl"] * 2
    assert [name for name, _ in places[:10]] == limits
    assert [frame for _, frame in places[:10]] == [1, 1, 1, 2, 2, 2, 1, 1, 2, 2]
    assert places[10:] == [(f"order 1 of {axis}", 2) for axis in ("alpha", "beta", "theta")]


def test_the_nearest_point_keeps_the_configuration(twisted):
    chain, _ = twisted
    (x, _), (y, _) = wound(chain, 3), wound(chain, 4)
    nearest = chain.nearest(x)
    objective, value = nearest.evaluate(y)
    assert objective == pytest.approx(((y - x).reshape(-1, 3) ** 2 @ [4, 1, 25]).sum(), rel=1e-12)
    np.testing.assert_allclose(value, chain.evaluate(y)[1], rtol=0, atol=1e-12)


def test_the_configuration_as_unknowns_has_the_same_rows_of_links():
    """Picked from x alone, whose entries are more than the axes."""
    chain, other = bent(), bent(as_unknown=True)
    x, _ = wound(chain, 5)
    frames = x.reshape(-1, 3)
    y = np.column_stack([frames, alpha(frames[:, 0], frames[:, 1])]).ravel()
    assert (chain.has_nonlinear_links, other.has_nonlinear_links) == (True, False)
    (objective, value), (same, rows) = chain.evaluate(x), other.evaluate(y)
    assert objective == pytest.approx(same, rel=1e-12)
    links = len(chain.offset)
    np.testing.assert_allclose(value[-links:], rows[-links:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows[y.size : -links : 2], 0, atol=1e-12)
    assert {other.describe_row(row)[0] for row in range(4)} == {
        f"limits of {a}" for a in ("alpha", "beta", "theta", "x_0")
    }


def test_evaluating_in_between_changes_no_expansion(twisted):
    """Expanding through constraints takes their values first, in buffers of their own."""
    chain, _ = twisted
    (x, multipliers), (y, _) = wound(chain, 6), wound(chain, 7)
    expected = [array.copy() for array in chain.frame_expansion(x, multipliers)]
    chain.evaluate(y)
    for one, other in zip(chain.frame_expansion(x, multipliers), expected, strict=True):
        np.testing.assert_array_equal(one, other)


# Differences


@st.composite
def sequences(draw):
    """Order, known values before, unknown ones and known ones after, of two entries each."""
    rng = np.random.default_rng(draw(seeds))
    counts = (draw(st.integers(0, 2)), draw(st.integers(1, 6)), draw(st.integers(0, 2)))
    return draw(st.sampled_from([1, 2])), *(rng.normal(size=(count, 2)) for count in counts)


@given(sequences())
def test_differences_are_those_of_the_whole_sequence_that_unknowns_enter(given_):
    order, before, x, after = given_
    matrix, offset, frame, axis = differences(len(x), order, list(before), list(after), 2)
    whole = np.diff(np.vstack([before, x, after]), order, axis=0)
    ends = np.arange(len(whole)) + order - len(before)
    entered = (ends >= 0) & (ends - order < len(x))
    np.testing.assert_allclose(matrix @ x.ravel() + offset, whole[entered].ravel(), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(frame, np.repeat(np.minimum(ends[entered], len(x) - 1), 2))
    np.testing.assert_array_equal(axis, np.tile([0, 1], entered.sum()))


# The nearest point


def test_the_nearest_point_is_sought_among_the_same_rows_by_distance_in_mm(case):
    x, y = case.motion(14), case.motion(15)
    nearest = case.chain.nearest(x)
    away = np.tile(case.problem.robot.mm_per_unit, FRAMES) * (y - x)
    objective, value = nearest.evaluate(y)
    assert objective == pytest.approx(away @ away, rel=1e-12)
    np.testing.assert_allclose(value, case.chain.evaluate(y)[1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(nearest.bounds, case.chain.bounds)


def test_a_point_that_is_allowed_is_its_own_nearest(free):
    x = standing().ravel()
    nearest = free.chain.nearest(x)
    assert nearest.evaluate(x)[0] == 0
    assert nearest.kkt(x, np.zeros(len(nearest.bounds[0]))).max() == 0


def test_constraints_that_take_parameters_keep_them_for_the_nearest_point():
    """x + to <= 1 in each of three frames."""
    x, to = ca.SX.sym("x"), ca.SX.sym("to")
    sum_ = Constraint("sum", x + to, np.array([-np.inf]), np.ones(1))
    nlp = Nlp("sum", x, np.full(1, -9.0), np.full(1, 9.0), {"shift": to}, (Residual("none", 0 * x),), (), (sum_,))
    nearest = linked(nlp, np.array([[0.0, 2, 4]]), 20.0, 0.0).nearest(np.array([5.0, 6, 7]))
    objective, value = nearest.evaluate(np.array([5.0, 5, 5]))
    assert objective == 1 + 4
    assert value[3:6].tolist() == [5, 7, 9]


# Names of rows


def test_every_row_is_named_after_what_it_limits_and_the_last_frame_it_reaches(case):
    """The names' kinds in order of rows; frame and axis from the unknowns that the row's Jacobian touches."""
    chain, robot = case.chain, case.problem.robot
    jacobian = chain.slopes(case.motion(12)).jacobian
    touches = whole_jacobian(chain, jacobian) != 0
    n, limited = len(robot.axes), ["speed"] + ["acceleration"] * bool(np.isfinite(robot.acceleration).any())
    own = ["order"] * (robot.d - 1) + ["carriage gap"] * (robot.d - 1) * (robot.carriage_gap is not None)
    kinds = ["limits"] * FRAMES * n + own * FRAMES
    for order, kind in enumerate(limited, start=1):
        kinds += [kind] * (len(case.padded(np.zeros((FRAMES, n)), order)) - order) * n
    assert len(kinds) == len(touches)
    for row, kind in enumerate(kinds):
        columns = np.flatnonzero(touches[row])
        name = kind if kind in own else f"{kind} of {robot.axes[columns[-1] % n]}"
        assert chain.describe_row(row) == (name, columns[-1] // n + 1)


def test_constraints_of_several_values_share_a_name():
    names = [toy(frames=2).describe_row(row) for row in range(4, 10)]
    assert names == [(name, frame) for frame in (1, 2) for name in ("curved", "curved", "straight")]


def test_there_is_no_name_beyond_the_last_row():
    chain = toy()
    with pytest.raises(IndexError):
        chain.describe_row(len(chain.bounds[0]))


# What is exceeded


def test_nothing_is_exceeded_where_the_robot_stands_still(free):
    _, value = free.chain.evaluate(standing().ravel())
    assert free.chain.excesses(value, 0.0) == []
    assert free.chain.violation(value) <= 0


def test_excesses_are_named_and_measured_worst_first(free):
    """alpha_1 jumps by 0.4 too much into frame 3; in frame 2, beta_1 is 3 mm too far out and 9 beyond beta_2."""
    q, most = standing(), free.problem.robot.speed * free.problem.dt
    q[2:, 0] += most[0] + 0.4
    q[1, 3:5] = 53, 44
    found = free.chain.excesses(free.chain.evaluate(q.ravel())[1], 1e-6)
    expected = [("order", 2, 9.0), ("limits of beta_1", 2, 3.0), ("speed of alpha_1", 3, 0.4)]
    assert [one[:2] for one in found] == [one[:2] for one in expected]
    assert [one.amount for one in found] == pytest.approx([one[2] for one in expected], abs=1e-12)


@given(seeds)
def test_the_violation_is_the_worst_excess(slow, seed):
    rng = np.random.default_rng(seed)
    x = slow.motion(13) + rng.normal(size=slow.chain.lower.size) * 10 ** rng.uniform(-2, 1.5)
    _, value = slow.chain.evaluate(x)
    excesses = slow.chain.excesses(value, 1e-6)
    amounts = [one.amount for one in excesses]
    assert amounts == sorted(amounts, reverse=True)
    assert slow.chain.violation(value) == amounts[0]
    low, high = slow.chain.bounds
    assert len(excesses) == ((value < low - 1e-6) | (value > high + 1e-6)).sum()


def test_excesses_up_to_the_tolerance_are_left_out(free):
    q = standing()
    q[1, 3] = 50 + 1e-3
    _, value = free.chain.evaluate(q.ravel())
    assert [one[:2] for one in free.chain.excesses(value, 9e-4)] == [("limits of beta_1", 2)]
    assert free.chain.excesses(value, 1.1e-3) == []


def test_values_that_are_not_numbers_exceed_everything(free):
    q = standing()
    q[1, 6] = np.nan
    value = np.concatenate([q.ravel(), free.chain.evaluate(standing().ravel())[1][q.size :]])
    assert free.chain.excesses(value, 1.0) == [Excess("limits of theta_x", 2, np.inf)]
    assert not free.chain.violation(value) <= 1.0


# The residual


def springs(start=None, end=None, to=None, weight=0.7):
    """One unknown a frame, drawn to 1, 5, 2 and -3 within +-10, steps within 6, at weight times their square."""
    x, target = ca.SX.sym("x"), ca.SX.sym("to")
    nlp = Nlp("spring", x, np.full(1, -10.0), np.full(1, 10.0), {"to": target}, (Residual("pull", x - target),))
    return linked(nlp, np.array([[1.0, 5, 2, -3]]) if to is None else to, 6.0, weight, start, end)


def at_rest(start=None, end=None):
    """Where the springs' forces cancel: the solution of their normal equations, (4,)."""
    rows = np.diff(np.eye(5 if start is not None else 4), axis=0)
    known = np.zeros(4)
    if start is not None:
        rows, known = rows[:, 1:], rows[:, 0] * start[0]
    matrix, right = np.eye(4) + 0.7 * rows.T @ rows, np.array([1.0, 5, 2, -3]) - 0.7 * rows.T @ known[: len(rows)]
    if end is not None:
        matrix[-1], right[-1] = np.eye(4)[-1], end[0]
    return np.linalg.solve(matrix, right)


ENDS = pytest.mark.parametrize(
    ("start", "end"), [(None, None), ([0.5], None), (None, [-1.0]), ([0.5], [-1.0])], ids=lambda end: str(end)
)


@ENDS
def test_the_residual_vanishes_where_forces_cancel(start, end):
    chain, x = springs(start, end), at_rest(start, end)
    np.testing.assert_allclose(chain.kkt(x, np.zeros(len(chain.bounds[0]))), 0, atol=1e-12)


@ENDS
def test_the_residual_is_the_force_on_each_frame_elsewhere(start, end):
    """One frame moved by 0.1 pulls itself by 2 (1 + 2 w) 0.1 and its neighbours by 2 w 0.1, but a fixed one."""
    chain, x = springs(start, end), at_rest(start, end)
    x[2] += 0.1
    found = chain.kkt(x, np.zeros(len(chain.bounds[0])))
    np.testing.assert_allclose(found, [0, 0.14, 0.48, 0.14 if end is None else 0], atol=1e-12)


def test_the_residual_is_the_excess_in_its_frame():
    """A step of 7 where 6 are allowed, and without weights and targets at x nothing else."""
    x = np.array([1.0, 1, 8, 8])
    chain = springs(to=x[None], weight=0.0)
    np.testing.assert_allclose(chain.kkt(x, np.zeros(len(chain.bounds[0]))), [0, 0, 1, 0], atol=1e-15)


def test_the_residual_sees_multipliers_of_rows_that_are_not_active():
    """A multiplier of 0.5 of the step into frame 3, which is 2 from its upper and 10 from its lower bound."""
    x = np.array([1.0, 1, 5, 5])
    chain = springs(to=x[None], weight=0.0)
    for multiplier, expected in ((0.5, [0, 0.5, 1.0, 0]), (-0.5, [0, 0.5, 5.0, 0])):
        rows = np.zeros(len(chain.bounds[0]))
        rows[-2] = multiplier
        np.testing.assert_allclose(chain.kkt(x, rows), expected, atol=1e-15)


def test_multipliers_of_active_rows_hold_against_the_objective():
    """Targets 8 apart and a step within 6: each of two frames is drawn by 2 away from the other."""
    chain, x = springs(to=np.array([[0.0, 8]]), weight=0.0), np.array([1.0, 7])
    rows = np.zeros(len(chain.bounds[0]))
    assert chain.kkt(x, rows).tolist() == [2, 2]
    rows[-1] = 2.0
    assert chain.kkt(x, rows).tolist() == [0, 0]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_the_residual_of_a_point_that_is_not_finite_is_not_small(value):
    chain, x = springs(), at_rest()
    x[1] = value
    with np.errstate(invalid="ignore"):
        assert not chain.kkt(x, np.zeros(len(chain.bounds[0]))).max() <= 1
