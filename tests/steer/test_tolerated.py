"""Plans for all robots that tolerances allow: what is planned for, and who is lost."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import (
    Limits,
    Problem,
    Robot,
    Tolerances,
    Tube,
    curve_from_formula,
    growing,
    solve_horizon,
    table_i_robot,
)
from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot.draws import drawn
from ctr_nlp.robot.structure import NUMBERS
from ctr_nlp.simulation.drawn import lost_draws
from ctr_nlp.steer.robust import solve_robust
from ctr_nlp.steer.robust.tolerated import balanced, scenarios_of

TUBES = Tube(150, 90, 0.012, 3, 2), Tube(300, 140, 0.015, 1.8, 1.2)


def deviations(robot, scenarios):
    """By what part (S, d) curvature and bending stiffness of scenarios differ from a robot's, and offsets."""
    parts = scenarios.numbers / robot.numbers - 1
    names = NUMBERS.index("root_curvature"), NUMBERS.index("bending_stiffness")
    return np.concatenate([*(parts[..., name] for name in names), scenarios.offsets], axis=1)


@pytest.mark.parametrize("count", range(1, 25))
def test_balanced_deviations_have_no_mean_unit_variance_and_no_correlation(count):
    found = balanced(count)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose(found.T @ found / len(found), np.eye(count), atol=1e-15)


def test_scenarios_have_the_mean_and_the_covariance_of_the_tolerances():
    robot = replace(table_i_robot(), tolerances=Tolerances(curvature=[0.01, 0.02, 0.03], motor_zero=0.05))
    scenarios = scenarios_of(robot)
    found = deviations(robot, scenarios)
    assert abs(found[0]).max() == 0
    assert scenarios.weights[0] == 0
    np.testing.assert_allclose(found[1:].mean(axis=0), 0, atol=1e-15)
    bands = np.r_[0.01, 0.02, 0.03, [0.02] * 3, [0.05] * 3]
    np.testing.assert_allclose(np.cov(found[1:].T, bias=True), np.diag(bands**2 / 3), atol=1e-15)


def test_scenarios_are_as_correlated_as_a_covariance_says():
    generator = np.random.default_rng(3)
    factor = 0.01 * generator.standard_normal((15, 15))
    covariance = factor @ factor.T
    robot = replace(table_i_robot(), tolerances=Tolerances(distribution="normal", covariance=covariance))
    robot = robot.with_limits(beta=[(0, 20), (0, 40), (0, 60)])
    found = deviations(robot, scenarios_of(robot))
    places = [5 * tube + name for name in (0, 1, 4) for tube in range(3)]
    np.testing.assert_allclose(np.cov(found[1:].T, bias=True), covariance[np.ix_(places, places)], atol=1e-12)


@pytest.mark.parametrize(
    ("tolerances", "message"),
    [
        (Tolerances(0, 0, motor_zero=0), "all tolerances of the robot are 0"),
        (Tolerances(curved_length=1.0), "curved_length of tolerances"),
    ],
)
def test_what_cannot_be_planned_for_is_refused(tolerances, message):
    with pytest.raises(OptionError, match=message):
        scenarios_of(replace(table_i_robot(), tolerances=tolerances))


def test_a_robust_plan_keeps_robots_that_a_plain_one_loses():
    robot = Robot(TUBES, Limits(beta=[(0, 85), (0, 135)]), tolerances=Tolerances(0.05, 0.05, motor_zero=0.05))
    path = curve_from_formula(lambda u: (0, 0, u), 0.0, 120.0)
    problem = Problem("straight", robot, growing(path, 12))
    plain, robust = solve_horizon(problem, model="elastic"), solve_robust(problem)
    assert robust.complete
    draws = drawn(robot, 60, 5)
    lost = [int((lost_draws(robot, draws, plan.q, "elastic") > 0).sum()) for plan in (plain, robust)]
    assert lost[0] > 5
    assert lost[1] <= 1
