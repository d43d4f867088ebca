"""Robots that do not arrive or press into the wall join the scenarios of a robust plan."""

from __future__ import annotations

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, Settings, growing
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.paths.curve import curve_from_formula, curve_from_points
from ctr_nlp.plan.sample_outcomes import sample_outcomes
from ctr_nlp.robot import Tolerances
from ctr_nlp.robust import arrival_rounds, solve_robust
from ctr_nlp.robust.arrival_rounds import ArrivalJudge
from ctr_nlp.robust.trials import CERTIFICATION_SAMPLES, MAX_JOINING_SAMPLES

FRAMES, SEED = 12, 77
"""The seed is of samples that judge, which no plan sees."""


def _problem(radius=3.4):
    """A bend that two tubes follow so well that most samples hold, and some do not."""
    robot = replace(TWO, tolerances=Tolerances(curvature=0.01, bending_stiffness=0.01, motor_zero=0.01))
    bend = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    s = np.linspace(0, bend.length, 80)
    return Problem(
        "bend", robot, growing(bend, FRAMES), lumen=curve_from_points(bend.point(s), np.full(80, radius))
    )


def _planned(problem):
    return solve_robust(problem, margins=(0.3,), motion_weight=1e-6)


@pytest.fixture(scope="module")
def plans():
    """Without robots that join, and with them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrival_rounds, "MAX_ARRIVAL_ROUNDS", 0)
        before = _planned(_problem())
    return before, _planned(_problem())


def test_more_samples_hold_once_failing_ones_have_joined(plans):
    before, after = (sample_outcomes(plan.with_samples(300, SEED)).share for plan in plans)
    assert before < 0.9
    assert after > before + 0.04
    assert all(plan.meta["certificate"]["held"] for plan in plans)


def test_rounds_tell_what_holds_and_the_best_is_kept(plans):
    told = [one for one in plans[1].meta["rounds"] if one["held"] is not None]
    assert len(told) > 1
    assert all(
        later["scenarios"] <= earlier["scenarios"] + MAX_JOINING_SAMPLES
        for earlier, later in itertools.pairwise(told)
    )
    best = max(told, key=lambda one: one["held"])
    assert plans[1].meta["iterations"] == best["iterations"]


def test_a_motion_is_judged_as_the_plan_of_it_is(plans):
    plan = plans[1]
    failing = ArrivalJudge(_problem(), KINEMATIC_MODELS["elastic"], Settings())(plan.q, 5)
    judged = sample_outcomes(
        plan.with_samples(CERTIFICATION_SAMPLES, arrival_rounds.ARRIVAL_FIRST_SAMPLE_SEED + 5)
    )
    assert failing.holding_share == judged.share
    assert len(failing.offsets) == (~judged.passed_all_checks & ~judged.lost).sum()
    worst = np.nanargmax(np.fmax(judged.tip_error - 2.0, judged.contact - 1.0))
    drawn = plan.with_samples(CERTIFICATION_SAMPLES, arrival_rounds.ARRIVAL_FIRST_SAMPLE_SEED + 5).drawn
    expected = _problem().robot.numbers[:, 3] * (1 + drawn.parts[worst, :, 0])
    np.testing.assert_allclose(failing.numbers[0, :, 3], expected, rtol=1e-9)


def test_no_robot_joins_where_most_fail(monkeypatch):
    monkeypatch.setattr(arrival_rounds, "MIN_HOLDING_SHARE", 0.99)
    assert len([one for one in _planned(_problem()).meta["rounds"] if one["held"] is not None]) == 1
