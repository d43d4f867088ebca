"""Solvers on problems with known answers, and the residual that judges them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ctr_nlp.errors import OptionError
from ctr_nlp.formulations import FORMULATIONS, Settings
from ctr_nlp.nlp import Constraint, Cost, Nlp, Residual, kkt_residual
from ctr_nlp.solvers import SOLVERS
from ctr_nlp.solvers.sqp import Sqp
from ctr_nlp.steer.nlp_frames import NlpFrames

INF = np.inf
EVERY_SOLVER = pytest.mark.parametrize("solver", SOLVERS)
FORMS = pytest.mark.parametrize("form", ["residual", "cost"])


def nearest_point(form="residual", constraints=(), bound=10.0):
    """The point x (2,) nearest to the parameter `to` (2, 1) within +-bound."""
    x, to = ca.SX.sym("x", 2), ca.SX.sym("to", 2)
    residuals = (Residual("distance", x - to),) if form == "residual" else ()
    costs = () if residuals else (Cost("distance", ca.sumsqr(x - to)),)
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
    nlp = Nlp("down", x, np.array([-INF]), np.array([INF]), {"none": none}, costs=(Cost("down", x**3),))
    assert not SOLVERS[solver](nlp)(np.array([-1.0]), np.zeros(1)).success


def test_both_solvers_agree_on_a_frame(arc_problem):
    """Not only on toys: the joint frame from one start, objectives within a thousandth of a square mm."""
    (stage,) = FORMULATIONS["joint"](arc_problem.robot, Settings())
    q0 = np.array([3.0, 3, 3, 30, 70, 105, 0, 0])
    frame = arc_problem.samples[2]
    p = stage.nlp.pack(dict(stage.parameters(frame, q0)) | {"previous": q0, "motion_root": 0.01})
    found = [SOLVERS[solver](stage.nlp)(q0, p) for solver in SOLVERS]
    assert all(solution.success for solution in found)
    assert np.ptp([solution.objective for solution in found]) < 1e-3


def test_an_unknown_solver_is_refused_with_the_names_of_the_known(arc_problem):
    with pytest.raises(OptionError, match=r"'snopt'.*ipopt, sqp"):
        NlpFrames(arc_problem, solver="snopt")


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
    (stage,) = FORMULATIONS["joint"](arc_problem.robot, Settings())
    solve, q = Sqp(stage.nlp), np.array([3.0, 3, 3, 30, 70, 105, 0, 0])
    for frame in arc_problem.samples:
        p = stage.nlp.pack(dict(stage.parameters(frame, q)) | {"previous": q, "motion_root": 0.01})
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
