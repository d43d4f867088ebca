"""Robust plans on draws of their robots, beside robots that are shot from the differential equations."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import shooting
from common import named_problem
from truth import TWO

from ctr_nlp import Problem, growing, problem_from_file, solve_horizon
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.plan.sample_motions import simulate_samples
from ctr_nlp.robot.samples import sample_robots
from ctr_nlp.robust import solve_robust

NAMED = "cos", "arc", "line", "line_arc", "synthesis", "bronchus"
AIRWAYS = "chaste_ts002_RLL", "chaste_ts002_LLL", "chaste_ts002_RML", "hra_vhm_left_main"
DRAWS, SEED = 10, 20260101
EVERY = 5
"""Which of the 101 samples of a shape are compared."""
AGREE = 0.05
"""mm"""


def beside(plan, count):
    """The frames in which draws are lost, by the library and shot, and how far shapes are apart (n, T), mm."""
    draws = sample_robots(plan.robot, count, SEED)
    found = simulate_samples(plan.robot, draws, plan.q, "elastic")
    parts = np.concatenate([draws.deviations, np.zeros_like(draws.deviations[:1])])
    shot = shooting.followed(shooting.tubes(plan.robot, parts), plan.q, np.linspace(0, 1, 100 // EVERY + 1))
    assert shot.snapped[-1] == 0
    away = np.linalg.norm(shot.shapes[:-1] - found.shape[:, :, ::EVERY], axis=-1)
    return found.lost, shot.lost(shot.tips[-1])[:-1], away.max(axis=2)


def agreed(plan, count):
    """Where draws are lost, by the library and shot, after both agree on which, and on shapes until then."""
    lost, shot, away = beside(plan, count)
    np.testing.assert_array_equal(lost > 0, shot > 0)
    before = np.arange(1, len(plan.q) + 1) < np.where(lost > 0, lost, np.inf)[:, None]
    assert np.isfinite(away[before]).all()
    assert away[before].max() < AGREE
    return lost, shot


def test_draws_of_a_robust_plan_of_two_tubes_are_where_equations_say():
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    plan = solve_robust(Problem("bend", TWO, growing(curve, 10)), margins=(0.3,))
    assert plan.success.all()
    agreed(plan, 3)


@pytest.mark.slow
def test_draws_of_a_plain_plan_snap_where_equations_say():
    """Also that a snap is seen at all: of these some snap and some do not."""
    lost, shot = agreed(solve_horizon(named_problem("cos"), model="elastic"), 4)
    assert 0 < (shot > 0).sum() < len(shot)
    assert abs(lost - shot).max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NAMED, *AIRWAYS])
def test_ten_draws_of_robust_plans_are_where_equations_say(name, request):
    if name in AIRWAYS:
        folder = request.getfixturevalue("shared_data")
        file = folder / "airways" / f"{name}.csv"
        problem = replace(problem_from_file(file, frames=100, trim="end"), lumen=None)
    else:
        problem = replace(named_problem(name), lumen=None)
    plan = solve_robust(problem)
    assert plan.success.all()
    agreed(plan, DRAWS)
