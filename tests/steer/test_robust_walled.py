"""Robust plans within a lumen: robots that were not planned for touch it less, at the errors that are allowed."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, Settings, growing
from ctr_nlp.formulations.settings import ROBUST_CLEARANCE_COST
from ctr_nlp.plan.metrics import summary
from ctr_nlp.steer.robust import solve_robust
from ctr_nlp.target.curve import curve_from_formula, curve_from_points

FRAMES, SEED, MARGINS = 12, 77, (0.3,)
"""The seed is of draws that judge, which no plan sees."""


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly, in a lumen that they hardly fit into."""
    bend = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    s = np.linspace(0, bend.length, 80)
    lumen = curve_from_points(bend.point(s), np.full(len(s), 3.0))
    return Problem("bend", TWO, growing(bend, FRAMES), lumen=lumen)


def _planned(problem, **settings):
    return solve_robust(problem, margins=MARGINS, motion_weight=1e-6, settings=Settings(**settings))


@pytest.fixture(scope="module")
def plans(problem):
    """Without the wall, and within it at a cost of a tenth."""
    return _planned(problem, contact_weight=0.0), _planned(problem, clearance_cost=0.1)


def _root(plan):
    return np.sqrt((plan.robustness(60, SEED).e3 ** 2).mean())


def test_robots_touch_the_wall_less_and_errors_grow_by_no_more_than_allowed(plans):
    free, within = plans
    assert free.success.all()
    assert within.success.all()
    before, after = (plan.robustness(60, SEED) for plan in plans)
    assert after.losses == before.losses == 0
    assert before.contact.mean() > 1.0
    assert after.contact.mean() < 0.9 * before.contact.mean()
    assert _root(within) <= 1.12 * _root(free)
    assert within.verdicts.solved.word == "yes"


def test_what_the_wall_costs_is_told(plans):
    free, within = plans
    np.testing.assert_allclose(within.free, free.q, atol=1e-9)
    assert within.meta["e3_free"] == pytest.approx(summary(free)["e3"])
    weight = within.meta["contact_weight"]
    assert 0 < weight <= Settings().contact_weight
    assert within.meta["rounds"][-1]["contact_weight"] == weight
    assert free.meta["contact_weight"] is None


def test_robust_plans_pay_more_for_clearance_than_others(problem, plans):
    """By default: as little contact as that is worth, where errors of draws grow by no more than that."""
    free, within = plans
    dear = _planned(problem)
    assert dear.options["clearance_cost"] == ROBUST_CLEARANCE_COST > within.options["clearance_cost"]
    assert Settings().options() == Settings(clearance_cost=0.1).options()
    assert dear.verdicts.solved.word == "yes"
    assert 1.2 * _root(free) < _root(dear) <= (1.02 + ROBUST_CLEARANCE_COST) * _root(free)
    assert dear.robustness(60, SEED).losses == 0
    assert dear.robustness(60, SEED).contact.mean() < 0.9 * within.robustness(60, SEED).contact.mean()


def test_more_is_kept_where_more_may_be_paid(problem, plans):
    dear = _planned(problem, clearance_cost=0.5)
    assert dear.meta["contact_weight"] > plans[1].meta["contact_weight"]
    contacts = [plan.robustness(60, SEED).contact.mean() for plan in (dear, plans[1])]
    assert contacts[0] < contacts[1]


def test_without_a_lumen_nothing_changes(problem, plans):
    open_air = _planned(replace(problem, lumen=None))
    np.testing.assert_array_equal(open_air.q, plans[0].q)
    assert open_air.free is None
    assert open_air.meta["contact_weight"] is None
    assert open_air.meta["rounds"] == plans[0].meta["rounds"]
