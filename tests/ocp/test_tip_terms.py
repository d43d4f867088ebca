"""Terms on tips and on depth: derivatives, values against numpy, and what they do to plans."""

import casadi as ca
import numpy as np
import pytest

from ctr_nlp import Problem, Robot, curve_from_formula, growing, solve_horizon, solve_per_frame, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.frame import fill_parameters, program
from ctr_nlp.ocp.terms import Order, ShapeDistance, TipDirection, TipPosition
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.metrics import by_frame, summary

ROBOT = Robot(table_i_robot().tubes[1:])
X = np.array([0.4, -0.9, 55.0, 120.0, 0.2, -0.3])
EVERY_MODEL = pytest.mark.parametrize("model", ["dominant", "elastic"])
TERMS = {
    "direction": TipDirection(30.0, [0.1, 0.5, 1.0]),
    "position": TipPosition(0.5, [5.0, -20.0, 100.0]),
    "depth": ShapeDistance(depth_weights=SIGMA_GRID**2),
}
EVERY_TERM = pytest.mark.parametrize("term", TERMS.values(), ids=TERMS.keys())


@pytest.fixture(scope="module")
def problem():
    path = curve_from_formula(lambda u: (10 * ca.cos(0.044 * u) - 10, 0, u), 0.0, 45.45 * ca.pi)
    return Problem("waves", table_i_robot(), growing(path, 6))


def built(model, *terms):
    """Terms as a program, and its residual as a function of x and p."""
    nlp = program("terms", ROBOT.structure, KINEMATIC_MODELS[model], (*terms, Order(None)))
    return nlp, ca.Function("residual", [nlp.x, nlp.p], [nlp.residual, ca.jacobian(nlp.residual, nlp.x)])


def parameters(nlp, problem, *terms):
    return nlp.pack(fill_parameters(ROBOT, terms, problem.target_frames[-1]))


@EVERY_MODEL
@EVERY_TERM
def test_derivatives_match_finite_differences(model, term, problem):
    nlp, value = built(model, term)
    p, h = parameters(nlp, problem, term), 1e-6
    found = [((value(X + e, p)[0] - value(X - e, p)[0]) / (2 * h)).full().ravel() for e in h * np.eye(len(X))]
    np.testing.assert_allclose(value(X, p)[1].full().T, found, atol=1e-5 * max(1, np.abs(found).max()))


@EVERY_MODEL
def test_the_direction_costs_its_angle_squared(model, problem):
    nlp, value = built(model, TERMS["direction"])
    found = float(ca.sumsqr(value(X, parameters(nlp, problem, TERMS["direction"]))[0]))
    wanted = np.array([0.1, 0.5, 1.0]) / np.linalg.norm([0.1, 0.5, 1.0])
    angle = np.arccos(KINEMATIC_MODELS[model].tangents(ROBOT, X[None], np.ones(1))[0, 0] @ wanted)
    assert found == pytest.approx(30 * angle**2, rel=1e-3)


@EVERY_MODEL
def test_the_position_costs_its_distance_squared(model, problem):
    nlp, value = built(model, TERMS["position"])
    found = float(ca.sumsqr(value(X, parameters(nlp, problem, TERMS["position"]))[0]))
    away = KINEMATIC_MODELS[model].points(ROBOT, X[None], np.ones(1))[0, 0] - [5, -20, 100]
    assert found == pytest.approx(0.5 * away @ away, rel=1e-3)


@EVERY_MODEL
def test_depth_weights_are_those_of_a_weighted_mean(model, problem):
    nlp, value = built(model, TERMS["depth"])
    found = float(ca.sumsqr(value(X, parameters(nlp, problem, TERMS["depth"]))[0]))
    sigma, weights = SIGMA_GRID[::5], np.r_[0.5, np.ones(19), 0.5] * SIGMA_GRID[::5] ** 2
    away = KINEMATIC_MODELS[model].points(ROBOT, X[None], sigma)[0] - problem.target_frames[-1].points[::5]
    assert found == pytest.approx(weights @ (away**2).sum(axis=1) / weights.sum(), rel=2e-3)


def test_a_direction_met_exactly_costs_nothing_and_has_a_slope(problem):
    term = TipDirection(1.0, KINEMATIC_MODELS["dominant"].tangents(ROBOT, X[None], np.ones(1))[0, 0])
    nlp, value = built("dominant", term)
    residual, slope = value(X, parameters(nlp, problem, term))
    assert float(ca.norm_2(residual)) < 1e-6
    assert np.isfinite(slope.full()).all()
    assert np.abs(slope.full()).max() > 0.1


@pytest.mark.parametrize("solve", [solve_per_frame, solve_horizon])
def test_plans_point_come_nearer_and_fit_deeper_where_that_is_asked(problem, solve):
    plain = solve(problem, model="dominant")
    pointed = solve(problem, model="dominant", terms=[TipDirection(300.0)])
    nearer = solve(problem, model="dominant", terms=[TipPosition(2.0)])
    deeper = solve(problem, model="dominant", terms=[ShapeDistance(depth_weights=SIGMA_GRID**4)])
    assert all(plan.complete for plan in (plain, pointed, nearer, deeper))
    assert by_frame(pointed)["tip_angle"].mean() < 0.3 * by_frame(plain)["tip_angle"].mean()
    assert by_frame(nearer)["tip"].mean() < 0.3 * by_frame(plain)["tip"].mean()
    assert by_frame(deeper)["tip"].mean() < by_frame(plain)["tip"].mean()
    assert pointed.options["terms"] == ["TipDirection(weight=300.0, wanted=None)"]
    assert deeper.options["terms"] == ["ShapeDistance(depth_weights=101 numbers, stride=5)"]
    assert all(summary(plan)["e3"] > summary(plain)["e3"] for plan in (pointed, nearer, deeper))


def test_weights_and_directions_may_differ_from_frame_to_frame(problem):
    weights = np.r_[np.zeros(4), 300.0, 0.0]
    first = solve_per_frame(problem, model="dominant", direction="forward").q[0]
    plain, pointed = (
        solve_per_frame(problem, model="dominant", direction="forward", start=first, terms=t)
        for t in ((), (TipDirection(weights),))
    )
    np.testing.assert_allclose(pointed.shape[:4], plain.shape[:4], atol=1e-3)
    assert by_frame(pointed)["tip_angle"][4] < 0.7 * by_frame(plain)["tip_angle"][4]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TipDirection(-1.0), "weight of tip_direction is -1; it must be at least 0"),
        (lambda: TipDirection(1.0, [0, 0, 0]), r"has the row \(0, 0, 0\)"),
        (lambda: TipPosition(1.0, [1, 2]), r"wanted tip_position has shape \(1, 2\)"),
        (lambda: ShapeDistance(depth_weights=np.ones(5)), "depth_weights has shape"),
        (lambda: ShapeDistance(depth_weights=-np.ones(101)), "depth_weights has numbers below 0"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(make, message):
    with pytest.raises(OptionError, match=message):
        make()


def test_terms_that_do_not_fit_are_refused(problem):
    with pytest.raises(OptionError, match="two-stage formulations have terms of their own"):
        solve_per_frame(problem, "two-stage", terms=[TipPosition(1.0)])
    with pytest.raises(OptionError, match=r"parameter tip_position_wanted twice"):
        solve_per_frame(problem, model="dominant", terms=[TipPosition(1.0), TipPosition(2.0)])
    with pytest.raises(OptionError, match="a term is"):
        solve_per_frame(problem, model="dominant", terms=["straight"])
    with pytest.raises(OptionError, match="tip_position has 3 rows and frame 4 is asked for"):
        solve_per_frame(problem, model="dominant", direction="forward", terms=[TipPosition(np.ones(3))])
