"""The loops over rows against numpy: whole Newton systems, measures, steps, the merit, and absolute Hessians."""

import functools
import subprocess
from importlib.resources import files
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from rows import central, links_hessian, whole_jacobian
from strategies import seeds

from ctr_nlp.codegen import cache
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.links import FrameLink, differences
from ctr_nlp.ocp.nlp import Constraint, Nlp, Residual
from ctr_nlp.solvers.barrier import BOUND_RELAXATION, INFINITE_BOUND
from ctr_nlp.solvers.motion.rows import ChainRows

INF = np.inf
ORDERS = st.sampled_from([(1,), (2,), (1, 2)])


@functools.cache
def frame(n, constrained, picks=None):
    """A frame drawn to a target (n,) along curves, without or with two constraints that are not linear and one
    that is; `shift` moves a value of the first, and no derivative. picks: where its configuration stands.
    """
    x, to, shift = ca.SX.sym("x", n), ca.SX.sym("to", n), ca.SX.sym("shift")
    residual = Residual("pull", ca.vertcat(x - to, ca.sin(x[0]) * x[-1]))
    curved = ca.vertcat(ca.sumsqr(x - to) + shift, x[0] * x[-1] ** 2 + ca.cos(x[0]))
    constraints = (
        Constraint("curved", curved, np.array([-INF, -4.0]), np.array([20.0, 4.0])),
        Constraint("straight", ca.sum1(x), np.array([-9.0]), np.array([INF])),
    )
    parameters = {"to": to, "shift": shift}
    low = np.full(n, -3.0)
    constraints = constraints if constrained else ()
    return Nlp("frame", x, low, -low, parameters, (residual,), constraints=constraints, picks=picks)


def link(rng, frames, n, order, before, mixed):
    """Differences of an order with weights and bounds at random, a third of which is infinite; mixed: of sums of
    neighbouring entries.
    """
    matrix, offset, last, axis = differences(frames, order, before, [], n)
    if mixed:
        matrix = sp.csr_array(matrix @ sp.kron(sp.identity(frames), np.eye(n) + np.eye(n, k=1)))
    low, high = -rng.uniform(0.5, 3, len(offset)), rng.uniform(0.5, 3, len(offset))
    low[rng.random(len(low)) < 0.3], high[rng.random(len(high)) < 0.3] = -INF, INF
    return FrameLink(f"order {order}", matrix, offset, low, high, rng.uniform(0, 2, len(offset)), last, axis)


def chain_of(
    rng, orders=(1, 2), frames=5, n=2, constrained=True, started=True, fixed=0.25, picks=None, mixed=False
):
    """A chain with a part of its x fixed, and some x without bounds."""
    nlp = frame(n, constrained, picks)
    count = len(nlp.configuration)
    before = [rng.normal(size=count)] if started else []
    links = tuple(link(rng, frames, count, order, before * order, mixed) for order in orders)
    lower, upper = np.tile(nlp.lower, (frames, 1)), np.tile(nlp.upper, (frames, 1))
    lower[rng.random(lower.shape) < 0.2], upper[rng.random(upper.shape) < 0.2] = -INF, INF
    still = rng.random(lower.shape) < fixed
    still[0, 0] = False
    lower[still] = upper[still] = rng.normal(size=still.sum())
    parameters = np.vstack([rng.normal(size=(n, frames)), np.zeros(frames)])
    axes = tuple(f"q{i}" for i in range(count))
    return Chain(nlp, axes, np.ones(count), parameters, lower, upper, links, lambda: nlp.functions)


@st.composite
def chains(draw):
    """Some of them too short for links of their order to have rows; some with any configuration and links."""
    rng = np.random.default_rng(draw(seeds))
    orders, frames, n = draw(ORDERS), draw(st.integers(1, 9)), draw(st.integers(1, 3))
    constrained = draw(st.booleans())
    rows = st.lists(st.integers(0, n - 1 + 3 * constrained), min_size=1, max_size=4, unique=True)
    picks, mixed = draw(st.tuples(st.none() | rows.map(tuple), st.booleans()))
    return chain_of(rng, orders, frames, n, constrained, draw(st.booleans()), picks=picks, mixed=mixed)


class Point(NamedTuple):
    x: np.ndarray
    slack: np.ndarray
    at_lower: np.ndarray
    at_upper: np.ndarray


def finite(rows):
    """Which rows have a lower, and which an upper bound."""
    return rows.low > -INFINITE_BOUND, rows.high < INFINITE_BOUND


def put(rows, chain, rng, barrier):
    """The point somewhere within all bounds, with multipliers unlike barrier over distance; a copy of it."""
    below, above = finite(rows)
    count = len(below)
    slack = rng.normal(size=count)
    slack = np.where(below, rows.low + rng.uniform(0.1, 2, count), slack)
    slack = np.where(above, rows.high - rng.uniform(0.1, 2, count), slack)
    between = rows.low + rng.uniform(0.05, 0.95, count) * (rows.high - rows.low)
    slack = np.where(below & above, between, slack)
    x = np.where(chain.free, rng.normal(size=chain.lower.size), chain.lower.ravel())
    lower, upper = np.exp(rng.uniform(-3, 1, (2, count)))
    lower = np.where(below, lower, barrier / (slack - rows.low))
    upper = np.where(above, upper, barrier / (rows.high - slack))
    for array, values in zip(rows._at, (x, slack, lower, upper), strict=True):
        array[:] = values
    return Point(x, slack, lower, upper)


def placed(chain, rng, barrier=0.3):
    """Rows at some point within all bounds, and a copy of it."""
    rows = ChainRows(chain)
    return rows, put(rows, chain, rng, barrier)


def copied(arrays):
    return Point(*(array.copy() for array in arrays))


def whole_hessian(chain, jacobian, blocks, damping=0.0):
    """The frames' and the links' Hessians, and damping; jacobian: of all rows."""
    whole = scipy.linalg.block_diag(*blocks) + links_hessian(chain, jacobian)
    return whole + damping * np.eye(len(whole))


def reduced(chain, rows, point, blocks, damping=0.0):
    """The Newton matrix without slacks and multipliers, and the identity where x is fixed."""
    below, above = finite(rows)
    sigma = np.where(below, point.at_lower / (point.slack - rows.low), 0.0)
    sigma += np.where(above, point.at_upper / (rows.high - point.slack), 0.0)
    jacobian = whole_jacobian(chain, chain.slopes(point.x).jacobian)
    matrix = whole_hessian(chain, jacobian, blocks, damping) + jacobian.T @ (sigma[:, None] * jacobian)
    return np.where(np.outer(chain.free, chain.free), matrix, np.diag(~chain.free))


def least_eigenvalue(chain, matrix):
    return np.linalg.eigvalsh(matrix[np.ix_(chain.free, chain.free)])[0]


def newton_step(chain, rows, point, blocks, barrier, damping):
    """The step from the whole system in x, slacks and the multipliers of both bounds; infinite bounds have none.

    The problem: minimise the objective less barrier times the logarithms of slacks' distances to their bounds,
    where every row equals its slack. A row's multiplier is that of its upper less that of its lower bound.
    """
    below, above = finite(rows)
    slopes = chain.slopes(point.x)
    jacobian = whole_jacobian(chain, slopes.jacobian)
    size, count, lows, highs = point.x.size, len(below), below.sum(), above.sum()
    to_lower, to_upper = np.eye(count)[below], np.eye(count)[above]
    at_lower, at_upper = point.at_lower[below], point.at_upper[above]
    distance, other = (point.slack - rows.low)[below], (rows.high - point.slack)[above]
    zero = np.zeros
    matrix = np.block(
        [
            [
                whole_hessian(chain, jacobian, blocks, damping),
                zero((size, count)),
                -jacobian.T @ to_lower.T,
                jacobian.T @ to_upper.T,
            ],
            [jacobian, -np.eye(count), zero((count, lows)), zero((count, highs))],
            [zero((lows, size)), at_lower[:, None] * to_lower, np.diag(distance), zero((lows, highs))],
            [zero((highs, size)), -at_upper[:, None] * to_upper, zero((highs, lows)), np.diag(other)],
        ]
    )
    pulls = jacobian.T @ (to_upper.T @ at_upper - to_lower.T @ at_lower)
    right = np.concatenate(
        [
            -slopes.gradient - pulls,
            point.slack - slopes.value,
            barrier - at_lower * distance,
            barrier - at_upper * other,
        ]
    )
    still = np.flatnonzero(~chain.free)
    matrix[still], right[still] = np.eye(len(matrix))[still], 0.0
    step = np.linalg.solve(matrix, right)
    return np.split(step, np.cumsum([size, count, lows]))


def assert_close(found, expected, relative=1e-8):
    """Relative to the largest entry."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=relative * np.abs(expected).max(initial=1e-3))


# Newton steps


@given(chains(), seeds, st.sampled_from([1e-6, 1e-2, 1.0]))
def test_a_newton_step_solves_the_whole_primal_dual_system(chain, seed, barrier):
    """With exact Hessians, and as much damping as makes the system positive definite."""
    rng = np.random.default_rng(seed)
    rows, point = placed(chain, rng, barrier)
    _, blocks = rows.expand()
    blocks = blocks.copy()
    damping = max(0.0, -least_eigenvalue(chain, reduced(chain, rows, point, blocks))) + rng.uniform(0.1, 1)
    step = rows.newton(blocks, barrier, damping)
    x, slack, at_lower, at_upper = newton_step(chain, rows, point, blocks, barrier, damping)
    below, above = finite(rows)
    found = copied(rows._step)
    assert_close(found.x, x)
    assert not found.x[~chain.free].any()
    assert_close(found.slack, slack)
    assert_close(found.at_lower[below], at_lower)
    assert_close(found.at_upper[above], at_upper)
    after_lower, after_upper = point.at_lower + found.at_lower, point.at_upper + found.at_upper
    assert max(np.abs(after_lower[~below]).max(initial=0), np.abs(after_upper[~above]).max(initial=0)) < 1e-15
    assert step.multiplier == pytest.approx(np.abs(after_upper - after_lower).max(), rel=1e-9)
    assert step.gap == pytest.approx(np.abs(chain.evaluate(point.x)[1] - point.slack).sum(), rel=1e-12)
    for one, other in zip(rows._at, point, strict=True):
        np.testing.assert_array_equal(one, other)


@given(chains(), seeds)
def test_the_band_is_factored_as_the_dense_sum_and_the_identity_where_x_is_fixed(chain, seed):
    """Of any Hessians of frames."""
    rng, n = np.random.default_rng(seed), chain.unknowns
    rows, point = placed(chain, rng)
    rows.expand()
    root = rng.normal(size=(chain.frames, n, n))
    blocks = root @ root.transpose(0, 2, 1)
    assert rows.newton(blocks, 0.3, 0.05) is not None
    assert_close(factored(rows), reduced(chain, rows, point, blocks, 0.05), 1e-12)


def factored(rows):
    """The matrix whose factors stand in the band."""
    band = rows._band.T
    factor = sum(np.diag(entries[: entries.size - k], -k) for k, entries in enumerate(band) if k < entries.size)
    return factor @ factor.T


@pytest.mark.parametrize("picks", [None, (3, 0), (2, 3), (4, 1, 2, 0)])
@pytest.mark.parametrize("mixed", [True, False])
@given(seeds, ORDERS)
def test_the_band_has_all_of_the_lagrangian_s_second_derivatives(picks, mixed, seed, orders):
    """By central differences of its gradient; with the rows' weights, and as much damping as it takes."""
    rng = np.random.default_rng(seed)
    chain = chain_of(rng, orders, picks=picks, mixed=mixed)
    rows, point = placed(chain, rng)
    _, blocks = rows.expand()
    damping = 1 + max(0.0, -least_eigenvalue(chain, reduced(chain, rows, point, blocks)))
    assert rows.newton(blocks, 0.3, damping) is not None

    def gradient(x):
        at = chain.slopes(x)
        return at.gradient + chain.multiply_transposed_jacobian(at.jacobian, point.at_upper - point.at_lower)

    jacobian = central(lambda x: chain.evaluate(x)[1], point.x)
    sigma = point.at_lower / (point.slack - rows.low) + point.at_upper / (rows.high - point.slack)
    matrix = central(gradient, point.x) + jacobian.T @ (sigma[:, None] * jacobian) + damping * np.eye(point.x.size)
    assert_close(factored(rows), np.where(np.outer(chain.free, chain.free), matrix, np.diag(~chain.free)), 1e-6)


def test_the_band_is_as_wide_as_the_links_reach():
    for orders, width in (((1,), 3), ((2,), 6), ((1, 2), 6)):
        chain = chain_of(np.random.default_rng(0), orders, frames=6, n=3)
        assert ChainRows(chain)._band.shape == (18, width + 1)


@pytest.mark.parametrize("picks", [(3, 0), (2, 5, 4)])
def test_the_band_is_as_wide_as_whole_frames_that_links_reach_through_constraints(picks):
    for orders, width in (((1,), 5), ((2,), 8), ((1, 2), 8)):
        chain = chain_of(np.random.default_rng(0), orders, frames=6, n=3, picks=picks)
        assert ChainRows(chain)._band.shape == (18, width + 1)


def test_the_band_has_room_for_a_frame_that_is_linked_to_known_ones_only():
    chain = chain_of(np.random.default_rng(0), (1,), frames=1, n=3)
    assert ChainRows(chain)._band.shape == (3, 3)


@pytest.mark.parametrize("orders", [(1,), (2,), (1, 2)])
@pytest.mark.parametrize("constrained", [True, False])
def test_links_without_rows_add_nothing(orders, constrained):
    """A frame that is linked to nothing has a Newton step all the same, and its own block for a band."""
    chain = chain_of(np.random.default_rng(0), orders, 1, 3, constrained, started=False, fixed=0.0)
    assert len(chain.offset) == 0
    rows, point = placed(chain, np.random.default_rng(0))
    assert rows._band.shape == (3, 3)
    found, blocks = rows.expand()
    assert np.isfinite(found).all()
    assert found.objective == pytest.approx(float(chain.by_frame(point.x)[0].sum()), rel=1e-12)
    least = least_eigenvalue(chain, reduced(chain, rows, point, blocks))
    step = rows.newton(blocks.copy(), 0.3, max(0.0, -least) + 1.0)
    assert np.isfinite(step).all()
    rows.advance(step.primal, step.dual, 0.3, 1.0)
    rows.accept()


@given(chains(), seeds, st.sampled_from([1e-6, 1e-2, 1.0]))
def test_a_newton_step_is_found_exactly_where_the_reduced_matrix_is_positive_definite(chain, seed, margin):
    """Damping moves its least eigenvalue to either side of zero."""
    rows, point = placed(chain, np.random.default_rng(seed))
    _, blocks = rows.expand()
    blocks = blocks.copy()
    least = least_eigenvalue(chain, reduced(chain, rows, point, blocks))
    assert rows.newton(blocks, 0.3, margin - least) is not None
    assert rows.newton(blocks, 0.3, -margin - least) is None


def test_a_hessian_that_is_not_a_number_has_no_step():
    chain = chain_of(np.random.default_rng(1), fixed=0.0)
    rows, _ = placed(chain, np.random.default_rng(1))
    _, blocks = rows.expand()
    assert rows.newton(blocks, 0.3, 1e3) is not None
    for k in (0, 2, chain.frames - 1):
        broken = blocks.copy()
        broken[k] = np.nan
        assert rows.newton(broken, 0.3, 1e3) is None


@given(chains(), seeds)
def test_the_slope_is_that_of_the_merit_along_the_step(chain, seed):
    """By central differences; gaps shrink in proportion, and so do not cross zero near the point. Slacks go along
    the step here; where they settle, gaps vanish at once.
    """
    rng, barrier, penalty, h = np.random.default_rng(seed), 0.3, 0.7, 1e-6
    rows, point = placed(chain, rng, barrier)
    _, blocks = rows.expand()
    blocks = blocks.copy()
    least = least_eigenvalue(chain, reduced(chain, rows, point, blocks))
    step = rows.newton(blocks, barrier, max(0.0, -least) + 1.0)
    x, slack = (array.copy() for array in rows._step[:2])
    scale = h / (1 + np.abs(x).max() + np.abs(slack).max())
    along = (point._replace(x=point.x + part * x, slack=point.slack + part * slack) for part in (scale, -scale))
    ahead, behind = (merit(chain, rows, at, barrier, penalty) for at in along)
    expected = step.slope - penalty * step.gap
    assert (ahead - behind) / (2 * scale) == pytest.approx(expected, rel=1e-4, abs=1e-3 * (1 + step.gap))


# Parts of steps


def test_parts_of_steps_keep_slacks_and_multipliers_positive_and_leave_a_hundredth():
    """Whole steps where that is enough, else such that the nearest distance is a hundredth of what it was, before
    slacks settle; these leave a hundredth too.
    """
    seen = set()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        chain = chain_of(rng, constrained=bool(seed % 2), fixed=0.2)
        barrier = 10.0 ** rng.uniform(-3, 2)
        rows, before = placed(chain, rng, barrier)
        if seed % 4 > 1:
            rows.start(before.x, barrier, 0.5)
            before = copied(rows._at)
        rows.expand()
        step = rows.newton(np.tile(np.eye(chain.unknowns), (chain.frames, 1, 1)), barrier, 10.0)
        rows.advance(step.primal, step.dual, barrier, 1.0)
        after, stepped = copied(rows._trial), before.slack + step.primal * rows._step[1]
        was, left, settled = (
            np.concatenate([slack - rows.low, rows.high - slack]) for slack in (before.slack, stepped, after.slack)
        )
        multipliers = [np.concatenate([at.at_lower, at.at_upper]) for at in (before, after)]
        for part, (was_, left_) in ((step.primal, (was, left)), (step.dual, multipliers)):
            least = (left_ / was_).min()
            assert 0 < part <= 1
            assert least >= 0.01 * (1 - 1e-6)
            assert part == 1 or least == pytest.approx(0.01, rel=1e-6)
        assert (settled / was).min() >= 0.01 * (1 - 1e-6)
        seen |= {("primal", step.primal == 1), ("dual", step.dual == 1)}
    assert len(seen) == 4, "some kind of step was not seen"


# Measures


@given(chains(), seeds)
def test_the_measures_of_a_point_are_those_of_the_chain_in_numpy(chain, seed):
    rows, point = placed(chain, np.random.default_rng(seed))
    found, blocks = rows.expand()
    slopes, multipliers = chain.slopes(point.x), point.at_upper - point.at_lower
    lagrangian = slopes.gradient + whole_jacobian(chain, slopes.jacobian).T @ multipliers
    products = point.at_lower * (point.slack - rows.low), point.at_upper * (rows.high - point.slack)
    expected = (
        slopes.objective,
        chain.violation(slopes.value),
        np.abs(slopes.value - point.slack).max(),
        np.abs(lagrangian[chain.free]).max(),
        np.min(products),
        np.max(products),
    )
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    for barrier in (0.0, 0.3, 9.0):
        error = max(found.stationarity, found.gap, *np.abs(np.ravel(products) - barrier))
        assert found.error(barrier) == pytest.approx(error, rel=1e-10)
    np.testing.assert_array_equal(rows.multipliers, multipliers)
    exact = chain.frame_expansion(point.x, multipliers)[4].reshape(blocks.shape)
    np.testing.assert_array_equal(blocks, exact)


@pytest.mark.parametrize("k", [0, 2, 4])
def test_a_constraint_that_is_not_a_number_is_no_small_violation(k):
    """Whatever frames come after it."""
    chain = chain_of(np.random.default_rng(3))
    rows, _ = placed(chain, np.random.default_rng(3))
    before, _ = rows.expand()
    assert np.isfinite(before).all()
    shifts = np.zeros(chain.frames)
    shifts[k] = np.nan
    for mapped in map(chain._evaluators, range(3)):
        mapped.inputs[1][:, -1] = shifts
    after, _ = rows.expand()
    assert np.isnan([after.violation, after.gap, after.error(0.0), after.error(0.3)]).all()
    assert (after.objective, after.stationarity) == (before.objective, before.stationarity)
    assert (after.least, after.most) == (before.least, before.most)
    assert np.isnan(rows.merit(0.3, 1.0))


@pytest.mark.parametrize("constrained", [True, False])
@pytest.mark.parametrize("k", [0, 2, 4])
def test_an_objective_that_is_not_a_number_is_none(k, constrained):
    chain = chain_of(np.random.default_rng(4), constrained=constrained, fixed=0.0)
    rows, _ = placed(chain, np.random.default_rng(4))
    chain.parameters[0, k] = np.nan
    for mapped in map(chain._evaluators, range(3)):
        mapped.inputs[1][:] = chain.parameters.T
    found, _ = rows.expand()
    assert np.isnan([found.objective, found.stationarity, found.error(0.0)]).all()
    assert np.isnan(rows.merit(0.3, 1.0))
    assert np.isnan([found.violation, found.gap]).all() == constrained


@pytest.mark.parametrize("k", [0, 5, -1])
def test_an_unknown_that_is_not_a_number_is_seen_in_every_measure_of_x(k):
    chain = chain_of(np.random.default_rng(5), fixed=0.0)
    rows, _ = placed(chain, np.random.default_rng(5))
    rows.x[k] = np.nan
    found, _ = rows.expand()
    assert np.isnan(found[:4]).all()
    assert np.isnan(found.error(0.0))


# Starts


@given(chains(), seeds)
def test_a_start_is_within_bounds_and_its_products_are_the_barrier(chain, seed):
    rng, rows, push, barrier = np.random.default_rng(seed), ChainRows(chain), 1e-3, 0.2
    x = np.clip(3 * rng.normal(size=chain.lower.size), chain.lower.ravel(), chain.upper.ravel())
    rows.start(x, barrier, push)
    found, _ = rows.expand()
    at, value = copied(rows._at), chain.evaluate(x)[1]
    np.testing.assert_array_equal(at.x, x)
    assert found.least == pytest.approx(barrier, rel=1e-12)
    assert found.most == pytest.approx(barrier, rel=1e-12)
    room = np.minimum(at.slack - rows.low, rows.high - at.slack)
    assert room.min() >= push * (1 - 1e-9)
    inside = np.minimum(value - rows.low, rows.high - value) >= push
    np.testing.assert_allclose(at.slack[inside], value[inside], rtol=1e-14, atol=1e-14)
    assert found.gap == pytest.approx(np.abs(at.slack - value).max(), rel=1e-12, abs=1e-12)


def test_bounds_are_relaxed_and_absent_where_nothing_can_move():
    """Of three frames the second is fixed, and with it all its rows but the links to its neighbours."""
    chain = chain_of(np.random.default_rng(6), (1,), frames=3, started=False, fixed=0.0)
    chain.lower[1] = chain.upper[1] = 0.5
    rows, (low, high) = ChainRows(chain), chain.bounds
    of_second = np.zeros(len(low), bool)
    of_second[[2, 3, 9, 10, 11]] = True
    for found, given_, outwards in ((rows.low, low, -1), (rows.high, high, 1)):
        absent = of_second | np.isinf(given_)
        assert (found[absent] == outwards * INFINITE_BOUND).all()
        np.testing.assert_allclose(found[~absent] - given_[~absent], outwards * BOUND_RELAXATION, rtol=1e-5)


# Trials


def merit(chain, rows, point, barrier, penalty):
    """The l1 merit function, by its definition."""
    objective, value = chain.evaluate(point.x)
    distances = np.concatenate([point.slack - rows.low, rows.high - point.slack])
    return objective - barrier * np.log(distances).sum() + penalty * np.abs(value - point.slack).sum()


def settled(chain, rows, point, x, slack):
    """Slacks on the way to x: where constraints are curved the rows' values, if these leave a hundredth of the
    point's distances to both bounds.
    """
    value = chain.evaluate(x)[1]
    far = (value - rows.low >= 0.01 * (point.slack - rows.low)) & (
        rows.high - value >= 0.01 * (rows.high - point.slack)
    )
    return np.where(chain.has_nonlinear_constraints & far, value, slack)


@given(chains(), seeds, st.sampled_from([0.01, 1.0, 3.0, 1e3]))
def test_a_trial_is_the_point_and_parts_of_a_step_and_its_slacks_stay_within_bounds(chain, seed, size):
    """Or are the rows' values, where constraints are curved."""
    rng, barrier, penalty = np.random.default_rng(seed), 0.2, 1.7
    rows, point = placed(chain, rng, barrier)
    rows.expand()
    before = rows.merit(barrier, penalty)
    assert before == pytest.approx(merit(chain, rows, point, barrier, penalty), rel=1e-10, abs=1e-8)
    for array in rows._step:
        array[:] = size * rng.normal(size=array.size)
    step, (primal, dual) = copied(rows._step), rng.uniform(0.1, 1, 2)
    found = rows.advance(primal, dual, barrier, penalty)
    trial = copied(rows._trial)
    np.testing.assert_allclose(trial.x, point.x + primal * step.x, rtol=1e-14, atol=1e-14)
    for one, at, change in zip(trial[2:], point[2:], step[2:], strict=True):
        np.testing.assert_allclose(one, at + dual * change, rtol=1e-14, atol=1e-14)
    slack = np.clip(point.slack + primal * step.slack, rows.low, rows.high)
    expected = settled(chain, rows, point, trial.x, slack)
    np.testing.assert_allclose(trial.slack, expected, rtol=1e-14, atol=1e-12 * (1 + size))
    assert (trial.slack > rows.low).all()
    assert (trial.slack < rows.high).all()
    assert found == pytest.approx(merit(chain, rows, trial, barrier, penalty), rel=1e-10, abs=1e-8)
    for one, other in zip(rows._at, point, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("bound", [0.0, 1e-3, 1.0, 500.0, 1e4])
def test_slacks_stay_strictly_within_bounds_of_any_size(bound):
    """Bounds of x that lie far from zero, and bounds of links that meet there."""
    rng = np.random.default_rng(7)
    chain = chain_of(rng, (1,), frames=4, n=1, started=False, fixed=0.0)
    chain.lower[:], chain.upper[:] = bound, bound + 1.0
    chain.links[0].lower[:] = chain.links[0].upper[:] = bound
    rows = ChainRows(chain)
    rows.start(np.full(4, bound + 0.5), 0.1, 1e-3)
    rows.expand()
    for direction in (-1, 1):
        rows._step[1][:] = direction * 10.0
        merits = rows.advance(1.0, 0.0, 0.1, 1.0)
        slack = rows._trial[1]
        assert (slack > rows.low).all()
        assert (slack < rows.high).all()
        assert np.isfinite(merits)


def test_an_accepted_trial_is_the_point():
    """For the arrays as for the loops, and however often they change places."""
    rng, barrier = np.random.default_rng(8), 0.2
    chain = chain_of(rng, fixed=0.0)
    rows, point = placed(chain, rng, barrier)
    for _ in range(3):
        before, _ = rows.expand()
        rows.newton(np.tile(5 * np.eye(2), (5, 1, 1)), barrier, 10.0)
        found = rows.advance(0.3, 0.2, barrier, 1.7)
        trial = copied(rows._trial)
        rows.accept()
        for one, other, old, was in zip(rows._at, trial, rows._trial, point, strict=True):
            np.testing.assert_array_equal(one, other)
            np.testing.assert_array_equal(old, was)
        np.testing.assert_array_equal(rows.x, trial.x)
        after, _ = rows.expand()
        assert after.objective == pytest.approx(chain.evaluate(trial.x)[0], rel=1e-12)
        assert after.objective != before.objective
        assert rows.merit(barrier, 1.7) == pytest.approx(found, rel=1e-12)
        point = trial


# Absolute Hessians


KINDS = ("random", "zero", "diagonal", "huge", "nearly singular", "rank one", "alike", "small")


def symmetric(kind, rng, frames, n):
    """Symmetric matrices (T, n, n) of a kind."""
    basis = np.linalg.qr(rng.normal(size=(frames, n, n)))[0]
    eigenvalues = rng.normal(size=(frames, n))
    if kind == "zero":
        eigenvalues[:] = 0.0
    elif kind == "diagonal":
        basis[:] = np.eye(n)
    elif kind == "huge":
        eigenvalues *= 1e8
    elif kind == "nearly singular":
        eigenvalues[:, ::2] *= 1e-13
    elif kind == "rank one":
        eigenvalues[:, 1:] = 0.0
    elif kind == "alike":
        eigenvalues = rng.choice([-1.0, 1.0], (frames, n)) * (1 + 1e-12 * eigenvalues)
    elif kind == "small":
        eigenvalues *= 1e-9
    found = (basis * eigenvalues[:, None, :]) @ basis.transpose(0, 2, 1)
    return np.ascontiguousarray((found + found.transpose(0, 2, 1)) / 2)


@pytest.fixture(scope="module")
def any_rows():
    return ChainRows(chain_of(np.random.default_rng(9)))


@given(st.lists(st.sampled_from(KINDS), min_size=1, max_size=20), st.integers(1, 10), seeds)
def test_absolute_hessians_are_those_of_eigh(any_rows, kinds, n, seed):
    """Kinds in any mixture, as frames go through the loops side by side; eight at once, with some left over."""
    rng = np.random.default_rng(seed)
    given_ = np.concatenate([symmetric(kind, rng, 1, n) for kind in kinds])
    before = given_.copy()
    found = any_rows.convex(given_)
    np.testing.assert_array_equal(given_, before)
    values, vectors = np.linalg.eigh(given_)
    expected = (vectors * np.abs(values)[:, None, :]) @ vectors.transpose(0, 2, 1)
    np.testing.assert_array_equal(found, found.transpose(0, 2, 1))
    for one, other, size in zip(found, expected, np.abs(values).max(axis=1), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 * size)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frames", [1, 7, 8, 9, 20])
def test_absolute_hessians_of_one_kind_are_those_of_eigh(any_rows, kind, frames):
    given_ = symmetric(kind, np.random.default_rng(frames), frames, 8)
    values, vectors = np.linalg.eigh(given_)
    expected = (vectors * np.abs(values)[:, None, :]) @ vectors.transpose(0, 2, 1)
    np.testing.assert_allclose(any_rows.convex(given_), expected, rtol=0, atol=1e-8 * np.abs(values).max())


def test_a_frame_that_is_not_a_number_leaves_the_others_as_they_are(any_rows):
    given_ = symmetric("random", np.random.default_rng(10), 9, 4)
    expected = any_rows.convex(given_)
    given_[3] = np.nan
    found = any_rows.convex(given_)
    assert np.isnan(found[3]).all()
    others = np.arange(9) != 3
    np.testing.assert_allclose(found[others], expected[others], rtol=0, atol=1e-8)


# The code itself


def test_the_loops_compile_without_a_warning(tmp_path):
    chosen = cache.compiler()
    if chosen is None:
        pytest.skip("no C compiler")
    strict = [*chosen.command, "-Wall", "-Wextra", "-Werror", "-std=gnu11", "-o", str(tmp_path / "library.so")]
    code = {
        "trial.c": cache.TRIAL_C_CODE,
        "rows.c": files("ctr_nlp.solvers.motion").joinpath("rows.c").read_text("utf-8"),
    }
    for name, text in code.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
        run = subprocess.run([*strict, str(tmp_path / name), "-lm"], capture_output=True, text=True, check=False)
        if name == "trial.c" and run.returncode:
            pytest.skip("the C compiler does not know these flags")
    assert run.returncode == 0, run.stderr
