"""Solvers of chains against closed forms, scipy and each other, and what every motion they find must keep."""

import functools
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from frames import horizon
from hypothesis import given
from hypothesis import strategies as st
from rows import bent, central, whole_jacobian
from scipy.optimize import isotonic_regression, nnls
from strategies import seeds

from ctr_nlp import Limits, Problem, Robot, Tube, curve_from_formula, growing, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.expressions import FrameFunctions
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.links import FrameLink, differences
from ctr_nlp.ocp.nlp import Constraint, Nlp, Residual
from ctr_nlp.solvers import CHAIN_SOLVERS, FEASIBILITY_TOLERANCE, Iterate, Solution, Watch
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.motion import banded
from ctr_nlp.solvers.motion import ipopt as chain_ipopt
from ctr_nlp.solvers.motion.banded import BANDED_KKT_TOLERANCE, BandedSolver
from ctr_nlp.solvers.motion.chain_solution import LOCAL_START_BARRIER_MM2

INF = np.inf
EVERY_SOLVER = pytest.mark.parametrize("solver", CHAIN_SOLVERS)


def drawn(n=2, bound=3.0, constraints=()):
    """One frame that is drawn to its target (n,) within +-bound."""
    x, to = ca.SX.sym("x", n), ca.SX.sym("to", n)
    made = tuple(constraint(x) for constraint in constraints)
    low = np.full(n, -bound)
    return Nlp("drawn", x, low, -low, {"to": to}, (Residual("distance", x - to),), constraints=made)


def linked(nlp, to, links, end=None):
    """A chain of frames drawn to targets (T, n), between links."""
    lower, upper = (np.tile(bound, (len(to), 1)) for bound in (nlp.lower, nlp.upper))
    if end is not None:
        lower[-1] = upper[-1] = end
    axes = tuple(f"x{i}" for i in range(to.shape[1]))
    to = np.ascontiguousarray(to.T)
    return Chain(nlp, axes, np.ones(len(axes)), to, lower, upper, tuple(links), lambda: nlp.functions)


def link(frames, n, order=1, low=-INF, high=INF, weight=0.0, before=(), after=()):
    """Differences of an order within bounds, at a weight times their square."""
    matrix, offset, frame, axis = differences(frames, order, before, after, n)
    one = np.ones(len(offset))
    return FrameLink(f"order {order}", matrix, offset, low * one, high * one, weight * one, frame, axis)


def solved(chain, solver="banded", x0=None):
    x0 = np.zeros(chain.lower.size) if x0 is None else x0
    return CHAIN_SOLVERS[solver](chain)(x0, Watch())


def assert_solved(chain, solution, start=None, kkt=1e-4):
    """Feasible and a KKT point by the chain's own word, and what the solution says of itself is true."""
    objective, value = chain.evaluate(solution.x)
    assert solution.success, solution
    assert chain.violation(value) <= FEASIBILITY_TOLERANCE
    assert solution.objective == objective
    assert solution.kkt == chain.kkt(solution.x, np.concatenate([solution.lam_x, solution.lam_g])).max()
    assert solution.kkt <= kkt
    if start is not None:
        assert objective < chain.evaluate(start)[0]


def test_from_the_multipliers_of_a_neighbouring_chain_few_iterations_are_left():
    """Rows that these hold stay held, so that only what has changed is left to find."""
    to = np.cumsum(np.random.default_rng(5).normal(size=(30, 2)), axis=0)
    links = [link(30, 2, low=-0.3, high=0.3)]
    known = solved(linked(drawn(), to, links))
    chain = linked(drawn(), to + 1e-3, links)
    multipliers = np.concatenate([known.lam_x, known.lam_g])
    alone, helped = (
        BandedSolver(chain)(known.x, Watch(), LOCAL_START_BARRIER_MM2, each) for each in (None, multipliers)
    )
    for found in (alone, helped):
        assert_solved(chain, found)
    np.testing.assert_allclose(helped.x, alone.x, atol=1e-4)
    assert helped.iterations < alone.iterations / 2


def test_a_rough_solve_ends_sooner_and_leaves_nothing_to_the_next():
    to = np.cumsum(np.random.default_rng(5).normal(size=(30, 2)), axis=0)
    chain = linked(drawn(), to, [link(30, 2, low=-0.3, high=0.3)])
    solver, x0 = BandedSolver(chain), np.zeros(chain.lower.size)
    exact, rough, again = (solver(x0, Watch(), tolerance=each) for each in (None, 5e-3, None))
    assert 1e-6 < rough.kkt <= 5e-3
    assert rough.iterations < exact.iterations
    assert exact.kkt <= 2e-6
    np.testing.assert_array_equal(again.x, exact.x)


# Convex chains, whose solutions are known


@EVERY_SOLVER
def test_springs_come_to_rest_where_their_normal_equations_say(solver):
    """Nothing is active: each axis solves (I + w D'D) x = target, with a known frame before the first."""
    rng = np.random.default_rng(2)
    to, start, weight = rng.uniform(-1, 1, (6, 2)), np.array([0.5, -0.5]), 0.8
    rows = np.diff(np.eye(7), axis=0)
    pull = np.outer(rows[:, 0], start)
    expected = np.linalg.solve(
        np.eye(6) + weight * rows[:, 1:].T @ rows[:, 1:], to - weight * rows[:, 1:].T @ pull
    )
    solution = solved(linked(drawn(), to, [link(6, 2, weight=weight, before=[start])]), solver)
    np.testing.assert_allclose(solution.x.reshape(6, 2), expected, atol=1e-5)
    assert solution.success


@given(seeds)
def test_frames_that_may_only_grow_are_the_isotonic_regression_of_their_targets(seed):
    """Strong convexity: a gap of at most BANDED_KKT_TOLERANCE a row leaves x within its root of the solution."""
    to = np.random.default_rng(seed).uniform(-2, 2, (8, 1))
    solution = solved(linked(drawn(1), to, [link(8, 1, low=0.0)]))
    assert solution.success
    np.testing.assert_allclose(
        solution.x, isotonic_regression(to.ravel()).x, atol=np.sqrt(15 * BANDED_KKT_TOLERANCE)
    )


def test_frames_that_may_hardly_differ_meet_at_the_mean_of_their_targets():
    """Links leave an interior of 2e-7 to the differences."""
    to = np.random.default_rng(4).uniform(-2, 2, (5, 2))
    solution = solved(linked(drawn(), to, [link(5, 2, low=-1e-7, high=1e-7)]))
    np.testing.assert_allclose(solution.x.reshape(5, 2), np.tile(to.mean(axis=0), (5, 1)), atol=1e-5)
    assert solution.success


def rising(x):
    return Constraint("rising", x[1] - x[0], np.array([0.0]), np.array([1.5]))


@given(seeds, st.booleans(), st.booleans())
def test_a_convex_chain_is_solved_as_by_least_distance(seed, given_start, given_end):
    """All kinds of rows at once: bounds, a constraint of frames, speeds with a cost, and accelerations."""
    rng, frames = np.random.default_rng(seed), 6
    to = rng.uniform(-3, 3, (frames, 2))
    start, end = (np.sort(rng.uniform(-0.5, 0.5, 2)) if known else None for known in (given_start, given_end))
    before, after = ([] if known is None else [known] for known in (start, end))
    links = [
        link(frames, 2, 1, -0.8, 0.8, 0.3, before),
        link(frames, 2, 2, -0.5, 0.5, 0.0, before * 2, after),
    ]
    chain = linked(drawn(bound=1.2, constraints=[rising]), to, links, end)
    solution = solved(chain, x0=rng.uniform(-1, 1, chain.lower.size))
    assert_solved(chain, solution)
    best = by_least_distance(to, before, after)
    gap = BANDED_KKT_TOLERANCE * len(chain.bounds[0])
    assert chain.violation(chain.evaluate(best)[1]) <= FEASIBILITY_TOLERANCE
    assert abs(solution.objective - chain.evaluate(best)[0]) <= gap
    np.testing.assert_allclose(solution.x, best, atol=2 * np.sqrt(gap))


def by_least_distance(to, before, after):
    """X (T n,) of the same chain from differences of the padded sequence of frames, after Lawson and Hanson.

    With H = L L' and u = L' x - c, the objective is |u|^2 and a constant; the least u that keeps rows u >= right
    comes from non-negative least squares.
    """
    shape = to.shape

    def steps(x):
        return np.diff(np.vstack([*before, x.reshape(shape)]), axis=0).ravel()

    def turns(x):
        return np.diff(np.vstack([*before * 2, x.reshape(shape), *after]), 2, axis=0).ravel()

    def growth(x):
        return np.diff(x.reshape(shape), axis=1).ravel()

    lower, upper = np.full(shape, -1.2), np.full(shape, 1.2)
    if after:
        lower[-1] = upper[-1] = after[0]
    limited = [(np.ravel, lower.ravel(), upper.ravel()), (steps, -0.8, 0.8), (turns, -0.5, 0.5), (growth, 0, 1.5)]
    known = [function(np.zeros(to.size)) for function, _, _ in limited]
    parts = [np.stack([f(e) - f(0 * e) for e in np.eye(to.size)], axis=-1) for f, _, _ in limited]
    low = np.concatenate([low - at for (_, low, _), at in zip(limited, known, strict=True)])
    high = np.concatenate([high - at for (_, _, high), at in zip(limited, known, strict=True)])
    root = np.linalg.cholesky(np.eye(to.size) + 0.3 * parts[1].T @ parts[1])
    centre = np.linalg.solve(root, to.ravel() - 0.3 * parts[1].T @ known[1])
    rows = np.linalg.solve(root, np.vstack(parts).T).T
    rows, right = np.vstack([rows, -rows]), np.concatenate([low - rows @ centre, rows @ centre - high])
    weights, _ = nnls(np.vstack([rows.T, right]), np.eye(to.size + 1)[-1], maxiter=10_000)
    residual = np.vstack([rows.T, right]) @ weights - np.eye(to.size + 1)[-1]
    return np.linalg.solve(root.T, centre - residual[:-1] / residual[-1])


# Chains that are not convex


def in_the_unit_disc(x):
    return Constraint("disc", ca.sumsqr(x), np.array([-INF]), np.array([1.0]))


def out_of_the_unit_disc(x):
    return Constraint("disc", ca.sumsqr(x), np.array([1.0]), np.array([INF]))


@EVERY_SOLVER
def test_frames_without_links_are_the_nearest_points_of_a_disc(solver):
    to = np.array([[3.0, 4], [0.3, 0.4], [-2, 0], [0.5, -2]])
    chain = linked(drawn(constraints=[in_the_unit_disc]), to, [link(4, 2)])
    solution = solved(chain, solver)
    expected = to / np.maximum(1, np.linalg.norm(to, axis=1, keepdims=True))
    np.testing.assert_allclose(solution.x.reshape(4, 2), expected, atol=1e-4)
    assert solution.success


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_a_way_around_an_obstacle_is_the_one_ipopt_finds(weight):
    """Targets straight through the disc, starting above it: what is allowed is not convex, nor are Hessians."""
    to = np.column_stack([np.linspace(-2, 2, 9), np.full(9, 0.1)])
    chain = linked(drawn(constraints=[out_of_the_unit_disc]), to, [link(9, 2, 1, -0.9, 0.9, weight)])
    above = (to + np.array([0, 1.5])).ravel()
    solution, other = (solved(chain, solver, above) for solver in ("banded", "ipopt"))
    assert_solved(chain, solution, above)
    assert np.linalg.norm(solution.x.reshape(9, 2), axis=1).min() >= 1 - FEASIBILITY_TOLERANCE
    assert solution.objective == pytest.approx(other.objective, rel=1e-4)
    assert abs(chain.evaluate(solution.x)[1]).min() < 1 + 1e-4, "the obstacle is not in the way"


def test_a_start_where_the_hessian_is_indefinite_leads_down():
    """(x^2 - 1)^2 has its minima at +-1, and second derivative -4 at 0."""
    x, none = ca.SX.sym("x"), ca.SX.sym("none")
    nlp = Nlp("wells", x, np.full(1, -3.0), np.full(1, 3.0), {"none": none}, (Residual("wells", x**2 - 1),))
    chain = linked(nlp, np.zeros((6, 1)), [link(6, 1, weight=0.1)])
    start = np.full(6, 0.05)
    assert (chain.frame_expansion(start, np.zeros(len(chain.bounds[0])))[4] < 0).all()
    solution = solved(chain, x0=start)
    assert_solved(chain, solution, start)
    np.testing.assert_allclose(solution.x, 1, atol=1e-4)


def test_equations_are_refused_by_the_solver_that_cannot_take_them():
    on_a_line = functools.partial(lambda x: Constraint("line", ca.sum1(x), np.ones(1), np.ones(1)))
    chain = linked(drawn(constraints=[on_a_line]), np.zeros((3, 2)), [link(3, 2)])
    with pytest.raises(OptionError, match=r"solver is 'banded' and drawn has equations"):
        BandedSolver(chain)
    np.testing.assert_allclose(solved(chain, "ipopt").x, 0.5, atol=1e-6)


# Links through constraints


@given(seeds, st.booleans())
def test_ipopt_s_derivatives_through_constraints_match_finite_differences(seed, ends):
    """Of every function it is given; the Hessian with any factor of the objective."""
    chain, rng = twisted(ends), np.random.default_rng(seed)
    x = rng.uniform([-2, 1, -0.5], [2, 14, 0.5], chain.lower.shape).ravel()
    lam_f, lam_g = rng.uniform(-2, 2), rng.normal(size=len(chain.bounds[0]) - x.size)
    functions = ipopt_functions(ends)

    def first(at):
        (_, gradient), (_, jacobian) = functions["grad_f"](at, []), functions["jac_g"](at, [])
        return lam_f * gradient.full().ravel() + jacobian.full().T @ lam_g

    at, multipliers = chain.slopes(x), np.concatenate([np.zeros(x.size), lam_g])
    jacobian = whole_jacobian(chain, at.jacobian)
    for name, value, slope in (
        ("grad_f", at.objective, at.gradient),
        ("jac_g", at.value[x.size :], jacobian[x.size :]),
    ):
        found = [part.full().squeeze() for part in functions[name](x, [])]
        np.testing.assert_allclose(found[0], value, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found[1], slope, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(first(x), lam_f * at.gradient + jacobian.T @ multipliers, rtol=1e-9, atol=1e-9)
    upper = functions["hess_lag"](x, [], lam_f, lam_g).full()
    expected = central(first, x)
    np.testing.assert_allclose(upper, np.triu(expected), rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@functools.cache
def twisted(ends):
    return bent(ends)


@functools.cache
def ipopt_functions(ends):
    return chain_ipopt._derivatives(twisted(ends))


@pytest.fixture
def to_the_last_digit(monkeypatch):
    """Solvers that go on as far as they can."""
    monkeypatch.setattr(banded, "BANDED_KKT_TOLERANCE", 1e-9)
    monkeypatch.setattr(banded, "BANDED_LAST_BARRIER_MM2", 1e-11)
    monkeypatch.setitem(chain_ipopt.CHAIN_IPOPT_OPTIONS, "tol", 1e-10)


@pytest.mark.parametrize("ends", [True, False])
def test_through_constraints_every_solver_finds_what_it_finds_with_the_configuration_as_unknowns(
    to_the_last_digit, ends
):
    """With equations, which only IPOPT takes."""
    chain, other = bent(ends), bent(ends, as_unknown=True)
    start = np.tile([0.4, 3.0, 0.1], 6)
    found = {solver: solved(chain, solver, start) for solver in CHAIN_SOLVERS}
    equations = solved(other, "ipopt", np.tile([0.4, 3.0, 0.1, 0.4], 6))
    expected = equations.x.reshape(6, 4)[:, :3].ravel()
    assert equations.success
    for solution in found.values():
        assert_solved(chain, solution, None)
        assert solution.objective == pytest.approx(equations.objective, rel=1e-8)
        np.testing.assert_allclose(solution.x, expected, atol=1e-7)
    limits = felt(chain, found["banded"])
    assert {"bowl", "order 1 of alpha", "order 2 of alpha" if ends else "limits of alpha"} <= limits
    assert felt(chain, found["ipopt"]) == limits


def felt(chain, solution):
    """Names of rows that hold against the objective, where something can move."""
    multipliers = np.concatenate([solution.lam_x, solution.lam_g])
    return {
        chain.describe_row(int(row))[0]
        for row in np.flatnonzero(chain.changeable_rows & (np.abs(multipliers) > 1e-3))
    }


# Horizons


SLOW = {"beta_speed": 15.0, "alpha_acceleration": 0.5, "beta_acceleration": 8.0, "theta_acceleration": 0.2}
PUSHED_OUT = Robot(table_i_robot().tubes, Limits(beta=[(0, 80), (0, 150), (0, 300)], carriage_gap=110.0))
REST = np.array([3, 3, 3, 10, 20, 30, 0, 0.0])
OUT = np.array([3.3, 2.9, 3.1, 40, 85, 130, 0.1, -0.1])
CASES = {
    "seed": (table_i_robot(), EndConfigurations()),
    "one tube": (Robot((Tube(160, 150, 0.01, 2, 1),)), EndConfigurations()),
    "two tubes": (Robot(table_i_robot().tubes[1:]), EndConfigurations()),
    "four tubes": (Robot((Tube(70, 40, 1 / 150, 7.7, 6.3), *table_i_robot().tubes)), EndConfigurations()),
    "locked tilt": (table_i_robot().with_locked_tilt(), EndConfigurations()),
    "carriage gap": (PUSHED_OUT, EndConfigurations()),
    "any speed": (
        table_i_robot().with_limits(alpha_speed=INF, beta_speed=INF, theta_speed=INF),
        EndConfigurations(),
    ),
    "start": (table_i_robot(), EndConfigurations(start=REST)),
    "end": (table_i_robot(), EndConfigurations(end=OUT)),
    "both ends": (table_i_robot(), EndConfigurations(REST, OUT)),
    "slow": (table_i_robot().with_limits(**SLOW), EndConfigurations()),
    "slow between ends": (table_i_robot().with_limits(**SLOW), EndConfigurations(REST, OUT)),
}
EVERY_CASE = pytest.mark.parametrize("case", CASES)


class Solved(NamedTuple):
    problem: Problem
    ends: EndConfigurations
    chain: Chain
    start: np.ndarray
    solution: Solution

    @property
    def q(self):
        return self.solution.x.reshape(self.problem.frames, -1)


@functools.cache
def along_an_arc(case, solver="banded"):
    """Six frames along an arc of radius 100 mm towards -x, from where every frame is turned that way."""
    robot, ends = CASES[case]
    path = curve_from_formula(lambda u: (100 * ca.cos(u) - 100, 0, 100 * ca.sin(u)), 0.0, 1.4)
    problem = Problem(case, robot, growing(path, 6), 9.0)
    chain = horizon(robot, problem.target_frames, problem.dt, 1e-3, ends)
    beta = np.minimum(np.array(problem.target.lengths)[:, None], robot.upper[robot.d : 2 * robot.d] * 0.9)
    start = np.hstack([np.full_like(beta, 3.0), beta, np.zeros((6, 2))]).ravel()
    return Solved(problem, ends, chain, start, CHAIN_SOLVERS[solver](chain)(start, Watch()))


@EVERY_CASE
@EVERY_SOLVER
def test_a_horizon_is_solved(case, solver):
    found = along_an_arc(case, solver)
    assert_solved(found.chain, found.solution)


@EVERY_CASE
def test_both_solvers_find_the_same_motion(case):
    """From one start in one basin."""
    banded, ipopt = (along_an_arc(case, solver) for solver in ("banded", "ipopt"))
    assert banded.solution.objective == pytest.approx(ipopt.solution.objective, rel=1e-4)


@EVERY_CASE
@EVERY_SOLVER
def test_a_motion_keeps_what_the_robot_allows(case, solver):
    """Limits, order and carriage gap by the robot's own check; speeds and accelerations by differences.

    The robot rests where an end is given: it stands there one frame longer.
    """
    found = along_an_arc(case, solver)
    robot, dt = found.problem.robot, found.problem.dt
    for q in found.q:
        robot.check(q)
    before, after = ([] if end is None else [end] for end in (found.ends.start, found.ends.end))
    steps = np.diff(np.vstack([*before, found.q]), axis=0)
    turns = np.diff(np.vstack([*before * 2, found.q, *after]), 2, axis=0)
    assert (np.abs(steps) <= robot.speed * dt + FEASIBILITY_TOLERANCE).all()
    assert (np.abs(turns) <= robot.acceleration * dt**2 + FEASIBILITY_TOLERANCE).all()


@EVERY_CASE
@EVERY_SOLVER
def test_what_is_fixed_is_kept_exactly(case, solver):
    found = along_an_arc(case, solver)
    fixed = ~found.chain.free
    np.testing.assert_array_equal(found.solution.x[fixed], found.chain.lower.ravel()[fixed])
    if found.ends.end is not None:
        np.testing.assert_array_equal(found.q[-1], found.ends.end)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        ("carriage gap", "carriage gap"),
        ("slow", "speed of beta_3"),
        ("slow between ends", "speed of beta_3"),
        ("slow between ends", "acceleration of beta_3"),
    ],
)
def test_limits_of_the_cases_are_felt(case, name):
    """At their upper bounds, and rooms between carriages at their lower; else keeping them would say nothing."""
    _, _, chain, _, solution = along_an_arc(case)
    felt = np.concatenate([solution.lam_x, solution.lam_g]) * (-1 if name == "carriage gap" else 1) > 1e-3
    assert name in [chain.describe_row(int(row))[0] for row in np.flatnonzero(felt)]


@EVERY_SOLVER
def test_rows_that_nothing_can_change_do_not_hinder(solver):
    """An end with beta_1 beyond beta_2 by less than counts: no unknown of the last frame is free."""
    problem, _, _, start, _ = along_an_arc("seed")
    end = np.array([3, 3, 3, 40 + 5e-7, 40, 130, 0, 0])
    problem.robot.check(end)
    chain = horizon(problem.robot, problem.target_frames, problem.dt, 1e-3, EndConfigurations(end=end))
    solution = solved(chain, solver, start)
    assert_solved(chain, solution)
    np.testing.assert_array_equal(solution.x[-8:], end)


# Starts that are not allowed


@EVERY_SOLVER
@pytest.mark.parametrize("case", ["seed", "start", "both ends", "slow between ends"])
def test_a_start_that_exceeds_limits_becomes_a_solution(case, solver):
    """Speeds, order and bounds are all exceeded at random. Now and then rounding stops the line search of banded
    between slow ends, at residuals such as 2e-4: there a solution is what solvers promise.
    """
    chain = along_an_arc(case).chain
    rng = np.random.default_rng(7)
    start = along_an_arc(case).start + rng.normal(size=chain.lower.size) * 5
    clipped = np.clip(start, chain.lower.ravel(), chain.upper.ravel())
    assert chain.violation(chain.evaluate(clipped)[1]) > 1
    promised = case == "slow between ends" and solver == "banded"
    assert_solved(chain, solved(chain, solver, start), kkt=KKT_TOLERANCE if promised else 1e-4)


OFF_TO_THE_SIDE = np.array([0, -1.5, 1, 40, 80, 140, -0.4, 0.2])
HALF_OUT = np.array([0, 0, 0, 30, 60, 100, 0, 0.0])
FAR, CLOSE = np.array([3, 3, 3, 40, 90, 140, 0, 0.0]), np.array([3, 3, 3, 5, 10, 20, 0.5, 0.5])


@functools.cache
def slow_from(name):
    """Ten frames in 2 s from rest at a given q, with slow carriages that also start slowly."""
    robot = table_i_robot().with_limits(
        alpha_speed=0.2, beta_speed=20.0, theta_speed=0.05, beta_acceleration=100.0, theta_acceleration=0.1
    )
    path = curve_from_formula(lambda u: (100 * ca.cos(u) - 100, 0, 100 * ca.sin(u)), 0.0, 1.4)
    problem = Problem(name, robot, growing(path, 10), 2.0)
    start = {"half out": HALF_OUT, "side": OFF_TO_THE_SIDE, "home": np.zeros(8)}[name]
    return horizon(robot, problem.target_frames, problem.dt, 1e-4, EndConfigurations(start=start)), np.tile(
        start, 10
    )


@pytest.mark.parametrize("first", [FAR, CLOSE], ids=["far", "close"])
@pytest.mark.parametrize("name", ["half out", "side", "home"])
def test_a_start_far_from_what_slow_carriages_can_reach_becomes_feasible(name, first):
    """To stand still is allowed, so that a feasible motion exists; all rows are linear."""
    chain, still = slow_from(name)
    assert chain.violation(chain.evaluate(still)[1]) <= 0
    solution = solved(chain, x0=np.tile(first, 10))
    assert chain.violation(chain.evaluate(solution.x)[1]) <= FEASIBILITY_TOLERANCE, solution.status


@EVERY_SOLVER
def test_where_nothing_is_feasible_there_is_no_success_and_no_warning(solver):
    """Steps of at most 0.1 cannot bridge 2 in four frames."""
    chain = linked(drawn(), np.zeros((4, 2)), [link(4, 2, 1, -0.1, 0.1, before=[np.full(2, -1.0)])], np.ones(2))
    assert not solved(chain, solver).success


# Following a solver


@EVERY_SOLVER
def test_every_iterate_is_reported_in_order_and_as_the_chain_sees_it(solver):
    chain, seen = along_an_arc("start").chain, []
    solution = CHAIN_SOLVERS[solver](chain)(along_an_arc("start").start, Watch(seen.append))
    assert [iterate.number for iterate in seen] == list(range(len(seen)))
    assert len(seen) >= solution.iterations
    for iterate in seen[:: len(seen) // 5]:
        objective, value = chain.evaluate(iterate.x)
        assert iterate.objective == pytest.approx(objective, rel=1e-12)
        assert iterate.violation == pytest.approx(chain.violation(value), rel=1e-6, abs=1e-9)
    assert seen[-1].error <= 1e-4
    np.testing.assert_allclose(seen[-1].x, solution.x, atol=1e-6)


@pytest.mark.parametrize(("solver", "status"), [("banded", "Interrupted"), ("ipopt", "User_Requested_Stop")])
def test_a_watch_can_stop_the_work(solver, status):
    found, seen = along_an_arc("start"), []
    watch = Watch(seen.append, lambda: len(seen) == 4)
    solution = CHAIN_SOLVERS[solver](found.chain)(found.start, watch)
    assert len(seen) == 4
    assert solution.status == status
    assert not solution.success
    np.testing.assert_allclose(solution.x, seen[-1].x, atol=1e-6)


@EVERY_SOLVER
def test_a_solver_can_be_used_again(solver):
    """Nothing of an interrupted solve is left to the next."""
    found = along_an_arc("start", solver)
    solve = CHAIN_SOLVERS[solver](found.chain)
    solve(found.start + 0.1, Watch(stop=lambda: True))
    seen = []
    again = solve(found.start, Watch(seen.append))
    assert seen[0].number == 0
    assert again.iterations == found.solution.iterations
    np.testing.assert_array_equal(again.x, found.solution.x)


def iterate(number, objective, violation=0.0):
    return Iterate(number, objective, violation, 1.0, np.array([number]))


def test_functions_may_be_compiled_while_a_chain_is_solved():
    """Every time that they are asked for they are others, at other places in memory."""
    to = np.cumsum(np.random.default_rng(3).normal(size=(200, 2)), axis=0)
    nlp = drawn(bound=20.0)
    links = [link(200, 2, low=-0.3, high=0.3)]
    expected = solved(linked(nlp, to, links))

    def others():
        return FrameFunctions(*(each.wrap() for each in nlp.functions[:3]))

    chain = replace(linked(nlp, to, links), functions=others)
    solver, x0 = BandedSolver(chain), np.zeros(chain.lower.size)
    for again in range(3):
        chain.evaluate(x0 + again)
        found = solver(x0, Watch())
        np.testing.assert_array_equal(found.x, expected.x)
        assert found.iterations == expected.iterations


def test_a_watch_keeps_the_first_best_feasible_iterate():
    watch = Watch()
    assert watch.best is None
    given_ = [
        (5.0, 1e-3),
        (4.0, 0.0),
        (1.0, 2 * FEASIBILITY_TOLERANCE),
        (3.0, FEASIBILITY_TOLERANCE),
        (3.0, 0.0),
        (3.5, -1.0),
    ]
    for number, (objective, violation) in enumerate(given_):
        assert watch(iterate(number, objective, violation)) is False
    assert watch.best.number == 3


def test_a_watch_may_end_the_work_after_so_many_iterations():
    watch = Watch(most=3)
    assert [watch(iterate(number, 1.0)) for number in (0, 2, 3, 4)] == [False, False, True, True]


def test_a_watch_may_know_where_the_work_began():
    assert Watch(first=iterate(0, 2.0)).best.number == 0
    assert Watch(first=iterate(0, 2.0, 1.0)).best is None
    watch = Watch(first=iterate(0, 2.0))
    watch(iterate(1, 2.5))
    assert watch.best.number == 0


@pytest.mark.parametrize(("objective", "violation"), [(np.nan, 0.0), (1.0, np.nan)])
def test_a_watch_ignores_what_is_not_a_number(objective, violation):
    watch = Watch(first=iterate(0, 2.0))
    watch(iterate(1, objective, violation))
    assert watch.best.number == 0
    bare = Watch()
    bare(iterate(1, objective, violation))
    bare(iterate(2, 7.0))
    assert bare.best.number == 2


def test_a_watch_reports_before_it_asks_whether_to_stop():
    order = []
    watch = Watch(lambda at: order.append(at.number), lambda: order.append("stop?") or True)
    assert watch(iterate(1, 1.0)) is True
    assert order == [1, "stop?"]


def test_links_that_hold_differences_still_are_solved():
    """Lower and upper bounds that meet leave slacks no room but what bounds are relaxed by."""
    to = np.random.default_rng(2).normal(size=(5, 2))
    solution = solved(linked(drawn(), to, [link(5, 2, low=0.0, high=0.0)]))
    np.testing.assert_allclose(np.diff(solution.x.reshape(5, 2), axis=0), 0.0, atol=1e-6)
