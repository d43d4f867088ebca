"""Solvers on problems with known answers, and the residual that judges them."""

from __future__ import annotations

import functools
import math
import os
import shutil
import subprocess
from dataclasses import replace
from importlib.resources import files

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, example
from hypothesis import given as drawn
from hypothesis import strategies as st
from scipy.optimize import nnls
from strategies import seeds

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp import FORMULATIONS, Settings
from ctr_nlp.ocp.nlp import Constraint, CostTerm, Nlp, Residual, kkt_residual
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.solvers import FEASIBILITY_TOLERANCE, SOLVERS, Solution
from ctr_nlp.solvers.frame import sqp
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.frame.program import MAX_SQP_ITERATIONS, SQP_KKT_TOLERANCE, Program
from ctr_nlp.solvers.frame.sqp import SQP_STATUS_TEXTS, Sqp

INF = np.inf
EVERY_SOLVER = pytest.mark.parametrize("solver", SOLVERS)
FORMS = pytest.mark.parametrize("form", ["residual", "cost"])


def nearest_point(form="residual", constraints=(), bound=10.0):
    """The point x (2,) nearest to the parameter `to` (2, 1) within +-bound."""
    x, to = ca.SX.sym("x", 2), ca.SX.sym("to", 2)
    residuals = (Residual("distance", x - to),) if form == "residual" else ()
    costs = () if residuals else (CostTerm("distance", ca.sumsqr(x - to)),)
    made = tuple(constraint(x) for constraint in constraints)
    return Nlp("nearest", x, np.full(2, -bound), np.full(2, bound), {"to": to}, residuals, costs, made)


def on_a_line(x):
    return Constraint("sum", x[0] + x[1], np.array([2.0]), np.array([2.0]))


def in_the_unit_disc(x):
    return Constraint("disc", ca.sumsqr(x), np.array([-INF]), np.array([1.0]))


def beyond_the_bounds(x):
    return Constraint("far", x[0] + x[1], np.array([30.0]), np.array([INF]))


def solved(nlp, solver, to, x0=(0.1, -0.2), **options):
    return SOLVERS[solver](nlp)(np.array(x0), nlp.pack({"to": to}), **options)


@EVERY_SOLVER
@FORMS
@pytest.mark.parametrize(
    ("constraints", "to", "expected"),
    [
        ((), (3, -4), (3, -4)),
        ((), (30, -4), (10, -4)),
        ((), (-30, 40), (-10, 10)),
        ((on_a_line,), (3, 3), (1, 1)),
        ((in_the_unit_disc,), (3, 4), (0.6, 0.8)),
        ((in_the_unit_disc,), (0.3, 0.4), (0.3, 0.4)),
        ((on_a_line,), (40, 0), (10, -8)),
    ],
    ids=["free", "upper bound", "corner", "equality", "active", "inactive", "equality and bound"],
)
def test_the_known_solution_is_found_and_verified(solver, form, constraints, to, expected):
    solution = solved(nearest_point(form, constraints), solver, to)
    np.testing.assert_allclose(solution.x, expected, atol=1e-5)
    assert solution.objective == pytest.approx(np.sum((np.array(expected) - to) ** 2), abs=1e-4)
    assert solution.kkt < 1e-4
    assert solution.success


@EVERY_SOLVER
def test_a_curved_valley_is_followed_to_its_end(solver):
    """Rosenbrock's function as two residuals, with its minimum at (1, 1)."""
    x, none = ca.SX.sym("x", 2), ca.SX.sym("none")
    valley = Residual("valley", ca.vertcat(10 * (x[1] - x[0] ** 2), 1 - x[0]))
    nlp = Nlp("rosenbrock", x, np.full(2, -INF), np.full(2, INF), {"none": none}, (valley,))
    solution = SOLVERS[solver](nlp)(np.array([-1.2, 1.0]), np.zeros(1))
    assert solution.success
    np.testing.assert_allclose(solution.x, 1, atol=1e-4)


@EVERY_SOLVER
def test_bounds_may_be_tightened_from_solve_to_solve(solver):
    nlp = nearest_point()
    solve, p = SOLVERS[solver](nlp), nlp.pack({"to": (3, -4)})
    tight = solve(np.zeros(2), p, np.array([-1.0, -1]), np.array([1.0, 1]))
    np.testing.assert_allclose(tight.x, [1, -1], atol=1e-6)
    np.testing.assert_allclose(solve(np.zeros(2), p).x, [3, -4], atol=1e-6)


@EVERY_SOLVER
def test_a_start_outside_the_bounds_is_allowed(solver):
    assert solved(nearest_point(bound=2.0), solver, (1, 1), x0=(50, -50)).success


@EVERY_SOLVER
def test_a_warm_start_from_the_solution_stays_there(solver):
    nlp = nearest_point(constraints=(in_the_unit_disc,))
    solve, p = SOLVERS[solver](nlp), nlp.pack({"to": (3, 4)})
    first = solve(np.array([0.1, 0.2]), p)
    again = solve(first.x, p, warm=first)
    assert again.success
    assert again.iterations <= first.iterations
    np.testing.assert_allclose(again.x, first.x, atol=1e-5)


@EVERY_SOLVER
@FORMS
def test_an_infeasible_problem_is_no_success(solver, form):
    assert not solved(nearest_point(form, (beyond_the_bounds,)), solver, (0, 0)).success


class Claims:
    """A solver that returns x and a status whatever it is asked."""

    def __init__(self, x, status):
        self.x, self.status = ca.DM(x), status

    def __call__(self, **arguments):
        nothing = ca.DM.zeros(2)
        return {"x": self.x, "f": 0.0, "g": ca.sumsqr(self.x), "lam_x": nothing, "lam_g": ca.DM(0)}

    def stats(self):
        return {"return_status": self.status, "iter_count": 1}


@pytest.mark.parametrize(
    ("x", "status", "success"),
    [
        ([0.6, 0.8], "Maximum_Iterations_Exceeded", True),
        ([0.6, 0.8 + 1e-4], "Solve_Succeeded", False),
        ([0.6, 0.7], "Solve_Succeeded", False),
        ([np.nan, 0.8], "Solve_Succeeded", False),
    ],
    ids=["silent", "infeasible", "not optimal", "not a number"],
)
def test_success_is_judged_by_the_point_and_not_by_the_solvers_word(monkeypatch, x, status, success):
    """The point of the unit disc nearest to (0.6, 0.8), which is optimal without any multiplier."""
    monkeypatch.setattr(ca, "nlpsol", lambda *arguments: Claims(x, status))
    solution = solved(nearest_point(constraints=(in_the_unit_disc,)), "ipopt", (0.6, 0.8))
    assert solution.success is success
    assert solution.status == status


@EVERY_SOLVER
@FORMS
def test_a_parameter_that_is_not_a_number_is_no_success(solver, form):
    assert not solved(nearest_point(form), solver, (np.nan, 0)).success


@EVERY_SOLVER
def test_an_unbounded_problem_is_no_success(solver):
    x, none = ca.SX.sym("x"), ca.SX.sym("none")
    nlp = Nlp("down", x, np.array([-INF]), np.array([INF]), {"none": none}, costs=(CostTerm("down", x**3),))
    assert not SOLVERS[solver](nlp)(np.array([-1.0]), np.zeros(1)).success


def test_both_solvers_agree_on_a_frame(arc_problem):
    """Not only on toys: the joint frame from one start, objectives within a thousandth of a square mm."""
    (stage,) = FORMULATIONS["joint"](arc_problem.robot, Settings(), KINEMATIC_MODELS["dominant"])
    q0 = np.array([3.0, 3, 3, 30, 70, 105, 0, 0])
    frame = arc_problem.target_frames[2]
    p = stage.nlp.pack(dict(stage.fill(frame, q0)) | {"previous": q0, "motion_root": 0.01})
    found = [SOLVERS[solver](stage.nlp)(q0, p) for solver in SOLVERS]
    assert all(solution.success for solution in found)
    assert np.ptp([solution.objective for solution in found]) < 1e-3


def test_an_unknown_solver_is_refused_with_the_names_of_the_known(arc_problem):
    with pytest.raises(OptionError, match=r"'snopt'.*ipopt, sqp"):
        NlpFrames.of(arc_problem, model="dominant", solver="snopt")


# Sequential quadratic programming


def given(seed, n=6, m=4):
    """A convex quadratic problem in n unknowns with m rows, and the multipliers and bounds of a known solution."""
    rng = np.random.default_rng(seed)
    root, rows = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    x, sign = rng.normal(size=n), rng.integers(-1, 2, n + m)
    if np.count_nonzero(sign) > n:
        sign[n:] = 0
    multipliers = sign * rng.uniform(0.1, 2, n + m)
    values = np.concatenate([x, rows @ x])
    upper = values + np.where(sign > 0, 0, rng.uniform(0.1, 1, n + m))
    lower = values - np.where(sign < 0, 0, rng.uniform(0.1, 1, n + m))
    to = x + np.linalg.solve(2 * root.T @ root, multipliers[:n] + rows.T @ multipliers[n:])
    return root, rows, x, multipliers, lower, upper, to


@pytest.mark.parametrize("seed", range(20))
def test_sqp_solves_quadratic_problems_in_one_step(seed):
    root, rows, x, multipliers, lower, upper, to = given(seed % 4 + 100)
    rng, n = np.random.default_rng(seed), len(x)
    symbol = ca.SX.sym("x", n)
    limits = Constraint("rows", ca.DM(rows) @ symbol, lower[n:], upper[n:])
    parameter = ca.SX.sym("to", n)
    distance = Residual("distance", ca.DM(root) @ (symbol - parameter))
    nlp = Nlp("qp", symbol, lower[:n], upper[:n], {"to": parameter}, (distance,), constraints=(limits,))
    solution = Sqp(nlp)(rng.normal(size=n), to)
    assert solution.success
    assert solution.iterations <= 2, "from the clipped start, one step reaches it"
    np.testing.assert_allclose(solution.x, x, atol=1e-6)
    np.testing.assert_allclose(np.concatenate([solution.lam_x, solution.lam_g]), multipliers, atol=1e-5)


def test_sqp_says_of_itself_what_the_residual_says(arc_problem):
    (stage,) = FORMULATIONS["joint"](arc_problem.robot, Settings(), KINEMATIC_MODELS["dominant"])
    solve, q = Sqp(stage.nlp), np.array([3.0, 3, 3, 30, 70, 105, 0, 0])
    for frame in arc_problem.target_frames:
        p = stage.nlp.pack(dict(stage.fill(frame, q)) | {"previous": q, "motion_root": 0.01})
        at = solve(q, p)
        own = kkt_residual(stage.nlp, at.x, p, stage.nlp.lower, stage.nlp.upper, at.lam_x, at.lam_g)
        assert at.success
        assert "IPOPT" not in at.status
        assert own == pytest.approx(at.kkt, abs=1e-7)
        q = at.x


def test_what_sqp_cannot_solve_is_left_to_ipopt_and_said():
    nlp = nearest_point(constraints=(beyond_the_bounds,))
    solution = solved(nlp, "sqp", (0, 0))
    assert not solution.success
    assert "by IPOPT after" in solution.status


def test_sqp_leaves_a_saddle_point():
    """(x^2 - 1)^2 + y^2 from beside x = 0, where its second derivative is negative."""
    x, none = ca.SX.sym("x", 2), ca.SX.sym("none")
    residuals = (Residual("wells", x[0] ** 2 - 1), Residual("bowl", x[1]))
    nlp = Nlp("wells", x, np.full(2, -3.0), np.full(2, 3.0), {"none": none}, residuals)
    solution = Sqp(nlp)(np.array([1e-3, 1.0]), np.zeros(1))
    assert solution.success
    np.testing.assert_allclose(solution.x, [1, 0], atol=1e-5)


@pytest.mark.parametrize("fixed", [0, 1])
def test_sqp_keeps_an_unknown_whose_bounds_meet(fixed):
    nlp = nearest_point(constraints=(in_the_unit_disc,))
    low, high = np.full(2, -10.0), np.full(2, 10.0)
    low[fixed] = high[fixed] = 0.25
    solution = Sqp(nlp)(np.zeros(2), nlp.pack({"to": (3, 4)}), low, high)
    assert solution.success
    assert solution.x[fixed] == 0.25
    assert solution.x[1 - fixed] == pytest.approx(np.sqrt(1 - 0.25**2), abs=1e-6)


SIZES = ((1, 0), (1, 2), (2, 3), (3, 6), (4, 0), (6, 4), (8, 5), (10, 6))
"""Unknowns and rows of quadratic problems whose numbers are parameters: each is compiled once."""


@functools.cache
def quadratic_problem(n, m):
    x, root, to, rows = (ca.SX.sym(*of) for of in (("x", n), ("root", n, n), ("to", n), ("rows", m, n)))
    limits = (Constraint("rows", rows @ x, np.full(m, -INF), np.full(m, INF)),) if m else ()
    parameters = {"root": root, "to": to} | ({"rows": rows} if m else {})
    distance = Residual("distance", root @ (x - to))
    nlp = Nlp("quadratic", x, np.full(n, -INF), np.full(n, INF), parameters, (distance,), constraints=limits)
    return nlp, Program(nlp)


def random_rows(rng, n, m):
    """Some are new; others are the one before, turned round, a bound of one unknown, or the sum of two."""
    rows = rng.normal(size=(m, n))
    for i in range(1, m):
        others = rows[i - 1], -2 * rows[i - 1], np.eye(n)[rng.integers(n)], rows[i - 1] + rows[i - 2]
        rows[i] = [*others, rows[i]][rng.integers(5)]
    return rows


def random_quadratic(rng, n, m):
    """Root and target of |root (x - to)|^2, all rows (n + m, n), and bounds that a random point keeps.

    At that point rows are free at one side or both, touch one bound, or are equations.
    """
    left, right = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    root = left * np.exp(rng.uniform(-1, 1, n)) @ right
    rows = np.vstack([np.eye(n), random_rows(rng, n, m)])
    values, kind = rows @ rng.normal(size=n), rng.integers(0, 7, n + m)
    below, above = rng.uniform(0, 1, (2, n + m))
    below[np.isin(kind, (0, 1))], above[np.isin(kind, (1, 2))] = INF, INF
    below[np.isin(kind, (3, 4))], above[np.isin(kind, (4, 5))] = 0, 0
    return root, rng.normal(size=n) * 3, rows, values - below, values + above


def by_least_distance(root, to, rows, lower, upper):
    """The x that keeps bounds of rows with the least |root (x - to)|, after Lawson and Hanson."""
    sides = np.vstack([rows, -rows]) @ np.linalg.inv(root)
    right = np.concatenate([lower - rows @ to, rows @ to - upper])
    held = np.isfinite(right)
    if not held.any():
        return to
    system, unit = np.vstack([sides[held].T, right[held]]), np.eye(len(to) + 1)[-1]
    residual = system @ nnls(system, unit, maxiter=10_000)[0] - unit
    return to - np.linalg.solve(root, residual[:-1] / residual[-1])


def run_quadratic(n, m, root, to, rows, lower, upper, x0, multipliers=0.0):
    """What was found, and the program that found it."""
    nlp, program = quadratic_problem(n, m)
    program.p[:] = nlp.pack({"root": root, "to": to} | ({"rows": rows[n:]} if m else {}))
    program.lower[:], program.upper[:] = lower, upper
    program.x[:], program.multipliers[:] = x0, multipliers
    return program.run(), program


def stationarity(root, to, rows, x, multipliers):
    return np.abs(2 * root.T @ root @ (x - to) + rows.T @ multipliers).max()


@pytest.mark.parametrize(("n", "m"), SIZES)
@drawn(seed=seeds, wrong=st.sampled_from([0.0, 1.0, 1e3]))
def test_sqp_finds_the_least_distance_within_random_rows_whatever_multipliers_it_starts_from(n, m, seed, wrong):
    rng = np.random.default_rng(seed)
    root, to, rows, lower, upper = random_quadratic(rng, n, m)
    start, multipliers = rng.normal(size=n) * 3, wrong * rng.normal(size=n + m)
    found, program = run_quadratic(n, m, root, to, rows, lower, upper, start, multipliers)
    x, values, lam = program.x, rows @ program.x, program.multipliers
    best = by_least_distance(root, to, rows, lower, upper)
    assert SQP_STATUS_TEXTS[found.status] == "Solve_Succeeded"
    assert found.kkt <= SQP_KKT_TOLERANCE
    assert found.iterations <= 3, "one step, and another where multipliers were wrong by far"
    np.testing.assert_allclose(x, best, atol=1e-5)
    assert found.objective == pytest.approx(np.sum((root @ (best - to)) ** 2), abs=1e-5)
    assert (values >= lower - 1e-8).all()
    assert (values <= upper + 1e-8).all()
    assert stationarity(root, to, rows, x, lam) <= 1e-5
    assert (lam[np.isinf(upper)] <= 1e-9).all(), "a positive multiplier belongs to an upper bound"
    assert (lam[np.isinf(lower)] >= -1e-9).all()


@pytest.mark.parametrize(("n", "m"), [size for size in SIZES if size[1]])
@drawn(seed=seeds)
def test_rows_that_exclude_each_other_are_no_success_and_no_step(n, m, seed):
    """The first row and the same among the bounds of a later one, a unit apart."""
    rng = np.random.default_rng(seed)
    root, to, rows, _, _ = random_quadratic(rng, n, m)
    rows[-1], rows[n - 1 if m == 1 else -2] = np.eye(n)[0], np.eye(n)[0]
    rows[:n] = np.eye(n)
    lower, upper = np.full(n + m, -INF), np.full(n + m, INF)
    upper[0], lower[-1] = 1.0, 2.0
    found, _ = run_quadratic(n, m, root, to, rows, lower, upper, rng.normal(size=n))
    assert SQP_STATUS_TEXTS[found.status] == "Infeasible_Step"
    assert found.violation > 0.4
    assert found.kkt > 0.4


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_unknowns_that_are_all_fixed_stay_and_take_the_whole_slope(n, m):
    rng = np.random.default_rng(n)
    root, to, rows, _, _ = random_quadratic(rng, n, m)
    fixed = rng.normal(size=n)
    lower, upper = np.append(fixed, np.full(m, -INF)), np.append(fixed, np.full(m, INF))
    found, program = run_quadratic(n, m, root, to, rows, lower, upper, np.zeros(n))
    assert SQP_STATUS_TEXTS[found.status] == "Solve_Succeeded"
    np.testing.assert_allclose(program.x, fixed, atol=1e-8)
    np.testing.assert_allclose(program.multipliers[:n], -2 * root.T @ root @ (fixed - to), atol=1e-5)
    np.testing.assert_array_equal(program.multipliers[n:], 0)


@pytest.mark.parametrize("bad", ["x", "p", "lower", "multipliers"])
@pytest.mark.parametrize(("n", "m"), [(1, 0), (1, 2), (6, 4)])
def test_what_is_not_a_number_ends_without_success(n, m, bad):
    rng = np.random.default_rng(1)
    _, program = run_quadratic(n, m, *random_quadratic(rng, n, m), rng.normal(size=n))
    program.x[:] = 30.0
    getattr(program, bad)[0 if bad != "p" else n * n] = np.nan
    found = program.run()
    assert not found.kkt <= KKT_TOLERANCE
    assert 0 <= found.iterations <= MAX_SQP_ITERATIONS


CURVED = pytest.mark.parametrize("curved", [False, True], ids=["linear", "curved"])


@functools.cache
def hills(curved):
    """Waves and a saddle in four unknowns between linear rows, and, where curved, on a ring and a hyperbola."""
    x, bend, to = ca.SX.sym("x", 4), ca.SX.sym("bend", 4, 4), ca.SX.sym("to", 4)
    rows = [Constraint("linear", ca.vertcat(ca.sum1(x), x[0] - x[1]), np.array([-1, -INF]), np.array([1.5, 0.8]))]
    if curved:
        value = ca.vertcat(ca.sumsqr(x), x[0] * x[3])
        rows.append(Constraint("curved", value, np.array([0.25, -0.5]), np.array([4, 0.5])))
    waves, saddle = Residual("waves", 2 * ca.sin(bend @ x) - to), CostTerm("saddle", x[0] * x[1] - x[2] ** 2)
    parameters = {"bend": bend, "to": to}
    nlp = Nlp("hills", x, np.full(4, -2.0), np.full(4, 2.0), parameters, (waves,), (saddle,), tuple(rows))
    return nlp, Sqp(nlp), ca.Function("at", [nlp.x, nlp.p], [nlp.objective, nlp.g])


def random_hills(rng, curved):
    nlp = hills(curved)[0]
    return nlp.pack({"bend": rng.normal(size=(4, 4)), "to": rng.normal(size=4)})


def assert_kkt_point(nlp, solution, p):
    own = kkt_residual(nlp, solution.x, p, nlp.lower, nlp.upper, solution.lam_x, solution.lam_g)
    assert solution.success, solution
    assert own <= KKT_TOLERANCE
    assert own == pytest.approx(solution.kkt, abs=1e-7)


@CURVED
@drawn(seed=seeds)
@example(seed=8).via("left to IPOPT where curved")
@example(seed=26).via("most iterations where curved")
def test_problems_that_are_not_convex_end_at_kkt_points_from_anywhere(curved, seed):
    nlp, solve, at = hills(curved)
    rng = np.random.default_rng(seed)
    p, x0 = random_hills(rng, curved), rng.uniform(-2, 2, 4)
    solution = solve(x0, p)
    assert_kkt_point(nlp, solution, p)
    objective, g = at(solution.x, p)
    assert solution.objective == pytest.approx(float(objective), abs=1e-6)
    low, high = nlp.g_bounds
    assert (
        (g.full().ravel() >= low - FEASIBILITY_TOLERANCE) & (g.full().ravel() <= high + FEASIBILITY_TOLERANCE)
    ).all()


@drawn(seed=seeds, wrong=st.sampled_from([0.0, 1.0, 100.0]))
def test_between_linear_rows_no_solution_is_worse_than_a_feasible_start(seed, wrong):
    """Every step is feasible, so that the merit function is the objective, which only falls."""
    nlp, solve, at = hills(False)
    rng = np.random.default_rng(seed)
    p, starts = random_hills(rng, False), rng.uniform(-2, 2, (40, 4))
    low, high = nlp.g_bounds
    values = np.array([at(x, p)[1].full().ravel() for x in starts])
    inside = starts[((values >= low) & (values <= high)).all(axis=1)]
    assume(len(inside))
    warm = Solution(
        inside[0], 0, 0, True, "", 0, wrong * rng.normal(size=4), wrong * rng.normal(size=2), inside[0]
    )
    solution = solve(inside[0], p, warm=warm)
    assert_kkt_point(nlp, solution, p)
    assert "IPOPT" not in solution.status
    before = float(at(inside[0], p)[0])
    assert solution.objective <= before + 1e-9 * (1 + abs(before))


@CURVED
@drawn(seed=seeds, size=st.sampled_from([0.1, 10.0, 1e4, 1e100]))
def test_a_warm_start_with_wrong_multipliers_ends_at_a_kkt_point_all_the_same(curved, seed, size):
    nlp, solve, _ = hills(curved)
    rng = np.random.default_rng(seed)
    p = random_hills(rng, curved)
    first = solve(np.full(4, 0.3), p)
    lam_x, lam_g = size * rng.normal(size=4), size * rng.normal(size=nlp.g.numel())
    assert_kkt_point(nlp, solve(first.x, p, warm=replace(first, lam_x=lam_x, lam_g=lam_g)), p)


@CURVED
@pytest.mark.parametrize("bad", ["x", "p"])
def test_a_start_or_parameter_that_is_not_a_number_spoils_neither_the_process_nor_the_next_solve(curved, bad):
    nlp, solve, _ = hills(curved)
    p, x0 = random_hills(np.random.default_rng(3), curved), np.full(4, 0.3)
    before = solve(x0, p)
    spoiled = {"x": x0.copy(), "p": p.copy()}
    spoiled[bad][0] = np.nan
    assert not solve(spoiled["x"], spoiled["p"]).success
    again = solve(x0, p)
    np.testing.assert_array_equal(again.x, before.x)
    assert_kkt_point(nlp, again, p)


def test_bounds_that_a_call_tightened_are_forgotten_by_the_next():
    _, solve, _ = hills(False)
    p, x0 = random_hills(np.random.default_rng(5), False), np.full(4, 0.1)
    free = solve(x0, p)
    held = solve(x0, p, x0, x0)
    np.testing.assert_array_equal(held.x, x0)
    assert held.success
    np.testing.assert_array_equal(solve(x0, p).x, free.x)


def test_one_unknown_between_two_maxima_goes_down_from_where_it_is():
    """Cos x has its minima at odd multiples of pi; at x = 0.1 its second derivative is negative."""
    x, none = ca.SX.sym("x"), ca.SX.sym("none")
    nlp = Nlp("waves", x, np.array([-INF]), np.array([INF]), {"none": none}, costs=(CostTerm("wave", ca.cos(x)),))
    solution = Sqp(nlp)(np.array([0.1]), np.zeros(1))
    assert solution.success
    assert solution.objective == pytest.approx(-1)
    assert solution.x[0] / math.pi == pytest.approx(round(solution.x[0] / math.pi), abs=1e-5)


@pytest.mark.parametrize("success", [False, True])
def test_what_the_fallback_finds_is_handed_on_as_it_is(monkeypatch, success):
    """Rows that exclude each other; the fallback claims something about the point (7, 7)."""
    asked = []

    def fallback(nlp):
        def solve(*arguments):
            asked.append(arguments)
            return Solution(
                np.full(2, 7.0), 5.0, 0.25, success, "Claimed", 40, np.ones(2), np.ones(1), np.full(2, 7.0)
            )

        return solve

    monkeypatch.setattr(sqp, "Ipopt", fallback)
    nlp = nearest_point(constraints=(beyond_the_bounds,))
    solve, p, x0 = Sqp(nlp), nlp.pack({"to": (0, 0)}), np.array([50.0, 1.0])
    low, high = np.full(2, -9.0), np.full(2, 9.0)
    solution = solve(x0, p, low, high)
    assert solution.success is success
    assert (solution.objective, solution.kkt) == (5.0, 0.25)
    assert solution.status == "Claimed by IPOPT after Infeasible_Step"
    assert solution.iterations >= 40
    np.testing.assert_array_equal(solution.x, 7)
    for given_on, expected in zip(asked[0], (x0, p, low, high, None), strict=True):
        assert given_on is expected


# Its C code alone

MAIN = """
#include "sqp.c"
#include <stdio.h>

static long rows;

/* (x0 - p0)^2 + (x1 - p1)^2 + p2 x0 x2 + (x2^2 - 1)^2, with x.x and x0 + x1 + x2 where there are rows */
static int slopes(const double **arg, double **res, long long *iw, double *w, int memory) {
    const double *x = arg[0], *p = arg[1];
    double *g = res[2], *jacobian = res[3];
    (void)iw, (void)w, (void)memory;
    double a = x[0] - p[0], b = x[1] - p[1], c = x[2] * x[2] - 1;
    res[0][0] = a * a + b * b + p[2] * x[0] * x[2] + c * c;
    res[1][0] = 2 * a + p[2] * x[2], res[1][1] = 2 * b, res[1][2] = p[2] * x[0] + 4 * x[2] * c;
    if (rows == 0) return 0;
    g[0] = x[0] * x[0] + x[1] * x[1] + x[2] * x[2], g[1] = x[0] + x[1] + x[2];
    for (int j = 0; j < 3; ++j) jacobian[2 * j] = 2 * x[j], jacobian[2 * j + 1] = 1;
    return 0;
}

static int value(const double **arg, double **res, long long *iw, double *w, int memory) {
    double gradient[3], jacobian[6], *all[] = {res[0], gradient, res[1], jacobian};
    return slopes(arg, all, iw, w, memory);
}

static int expansion(const double **arg, double **res, long long *iw, double *w, int memory) {
    const double *x = arg[0], *p = arg[1], lam = arg[2][0];
    double *h = res[4];
    for (int i = 0; i < 9; ++i) h[i] = i % 4 == 0 && rows ? 2 * arg[3][0] : 0;
    h[0] += 2 * lam, h[4] += 2 * lam, h[8] += lam * (12 * x[2] * x[2] - 4);
    h[2] += lam * p[2], h[6] += lam * p[2];
    return slopes(arg, res, iw, w, memory);
}

static double drawn(void) {
    static unsigned long state = 7;
    state = (state * 1103515245 + 12345) % 2147483648;
    return (double)state / 1073741824 - 1;
}

int main(void) {
    int count[4] = {0}, lost = 0;
    for (int k = 0; k < 3000; ++k) {
        double p[3], lower[5], upper[5], x[3], multipliers[5] = {0}, found[5];
        for (int i = 0; i < 5; ++i) lower[i] = -INFINITY, upper[i] = INFINITY;
        for (int i = 0; i < 3; ++i) p[i] = 3 * drawn(), x[i] = 2 * drawn();
        for (int i = 0; i < 5; ++i) {
            double kind = drawn(), at = drawn();
            if (kind > 0) lower[i] = at - (kind > 0.7);
            if (kind < 0.3 && kind > -0.5) upper[i] = at + (kind > -0.1) - 0.2 * (kind > 0);
            if (k % 2) multipliers[i] = 10 * drawn();
        }
        if (k % 50 == 49) *(double *[]){p, x, lower, multipliers}[k / 50 % 4] = NAN;
        rows = k % 3 ? 2 : 0;
        Program o = {3, rows, value, slopes, expansion, p, lower, upper, 1e-6, 60, x, multipliers, found,
                     0, 0, 0, 0, 0, 0, 0};
        sqp(&o);
        ++count[o.status];
        if (o.iterations > o.most || (o.status == SOLVED && !(o.kkt <= 1e-6))) ++lost;
        double sum = rows ? x[0] + x[1] + x[2] - found[4] : 0;
        if (o.status == SOLVED && (memcmp(found, x, sizeof x) || fabs(sum) > 1e-12)) ++lost;
    }
    printf("%d %d %d %d %d\\n", count[SOLVED], count[STOPPED], count[STUCK], count[NO_STEP], lost);
    return 0;
}
"""


def c_compiler():
    command = next(filter(None, map(shutil.which, (os.environ.get("CC", "cc"), "gcc", "clang"))), None)
    return command or pytest.skip("no C compiler")


def source(folder):
    (folder / "sqp.c").write_text(files(sqp.__package__).joinpath("sqp.c").read_text(encoding="utf-8"))
    return folder / "sqp.c"


@pytest.mark.parametrize("level", ["-O0", "-O2"])
def test_the_c_code_compiles_without_any_warning(tmp_path, level):
    flags = ["-Wall", "-Wextra", "-Werror", "-std=gnu11", level, "-fPIC", "-shared"]
    command = [c_compiler(), *flags, "-o", str(tmp_path / "out.so"), str(source(tmp_path)), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


SANITIZED = "-g", "-O1", "-std=gnu11", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"


def test_the_c_code_runs_clean_under_sanitizers(tmp_path):
    """Random bounds and starts, some of which exclude each other or are not numbers, with and without rows."""
    source(tmp_path)
    trial = tmp_path / "trial.c"
    trial.write_text("int main(void) { return 0; }")
    command = [c_compiler(), *SANITIZED, "-o", str(tmp_path / "run")]
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    built = subprocess.run([*command, str(trial)], capture_output=True, check=False)
    if built.returncode or subprocess.run([tmp_path / "run"], env=environment, check=False).returncode:
        pytest.skip("no sanitizers")
    (tmp_path / "main.c").write_text(MAIN)
    subprocess.run([*command, "-Wall", "-Werror", str(tmp_path / "main.c"), "-lm"], check=True)
    done = subprocess.run(
        [tmp_path / "run"], env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    solved, stopped, stuck, no_step, lost = map(int, done.stdout.split())
    assert solved + stopped + stuck + no_step == 3000
    assert lost == 0
    assert solved > 1000
    assert no_step > 0, "some rows exclude each other"


# The residual


def residual(constraints, x, to, lam_x=(0, 0), lam_g=()):
    nlp = nearest_point(constraints=constraints)
    x, p, lam_x, lam_g = (np.array(values, dtype=float) for values in (x, to, lam_x, lam_g))
    return kkt_residual(nlp, x, p, nlp.lower, nlp.upper, lam_x, lam_g)


def test_the_residual_vanishes_at_hand_made_kkt_points():
    assert residual((), (3, 4), (3, 4)) == 0
    assert residual((), (10, 4), (13, 4), lam_x=(6, 0)) == pytest.approx(0)
    assert residual((), (-10, 4), (-13, 4), lam_x=(-6, 0)) == pytest.approx(0)
    assert residual((in_the_unit_disc,), (0.6, 0.8), (3, 4), lam_g=[4]) == pytest.approx(0, abs=1e-12)


def test_the_residual_is_the_gradient_where_nothing_is_active():
    assert residual((), (3, 4), (1, 3)) == pytest.approx(4)


def test_the_residual_is_the_violation_outside_the_feasible_set():
    assert residual((in_the_unit_disc,), (3, 4), (3, 4), lam_g=[0]) == pytest.approx(24)
    assert residual((), (12, 0), (12, 0)) == pytest.approx(2)


def test_the_residual_sees_a_multiplier_of_a_bound_that_is_not_active():
    """At x_1 = 9, a multiplier that cancels the gradient belongs to a bound 1 away."""
    assert residual((), (9, 4), (12, 4), lam_x=(6, 0)) == pytest.approx(6)


def test_the_residual_sees_a_multiplier_of_the_wrong_sign():
    """At the upper bound but pulled inwards: the multiplier's own bound, the lower one, is 20 away."""
    assert residual((), (10, 4), (7, 4), lam_x=(-6, 0)) == pytest.approx(120)


@pytest.mark.parametrize("x", [(np.nan, 0), (0, np.inf)])
def test_the_residual_of_a_point_that_is_not_finite_is_not_small(x):
    assert not residual((), x, (0, 0)) <= 1


# Parameters


def parametrised():
    x, a, b, c = ca.SX.sym("x"), ca.SX.sym("a"), ca.SX.sym("b", 3), ca.SX.sym("c", 2, 3)
    value = ca.vertcat(a, b, ca.vec(c.T))
    return Nlp("parametrised", x, np.zeros(1), np.ones(1), {"a": a, "b": b, "c": c}, (Residual("r", value),))


GIVEN = {"a": 7.0, "b": [1.0, 2, 3], "c": np.arange(6.0).reshape(2, 3)}


def test_packed_parameters_reach_their_symbols():
    nlp = parametrised()
    value = ca.Function("f", [nlp.x, nlp.p], [nlp.residual])(0, nlp.pack(GIVEN)).full().ravel()
    np.testing.assert_array_equal(value, [7, 1, 2, 3, 0, 1, 2, 3, 4, 5])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({k: GIVEN[k] for k in ("a", "c")}, r"\['a', 'b', 'c'\], not \['a', 'c'\]"),
        (GIVEN | {"d": 1}, r"not \['a', 'b', 'c', 'd'\]"),
        (GIVEN | {"b": 1.0}, r"parameter b .*shape \(\), not \(3, 1\)"),
        (GIVEN | {"b": [1.0, 2]}, r"parameter b .*\(2,\)"),
        (GIVEN | {"c": GIVEN["c"].T}, r"parameter c .*\(3, 2\), not \(2, 3\)"),
        (GIVEN | {"c": np.arange(6.0)}, r"parameter c .*\(6,\)"),
    ],
    ids=["missing", "unknown", "scalar for vector", "short", "transposed", "flat"],
)
def test_parameters_that_do_not_fit_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        parametrised().pack(values)


@EVERY_SOLVER
def test_a_problem_without_parameters_can_be_solved(solver):
    x = ca.SX.sym("x", 2)
    nlp = Nlp("plain", x, -np.ones(2), np.ones(2), {}, (Residual("r", x - 3),))
    np.testing.assert_allclose(SOLVERS[solver](nlp)(np.zeros(2), nlp.pack({})).x, 1, atol=1e-6)
