"""Robust plans within a lumen: robots that were not planned for touch it less, and arrive."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, Settings, growing
from ctr_nlp.paths.curve import curve_from_formula, curve_from_points
from ctr_nlp.plan.sample_outcomes import sample_outcomes
from ctr_nlp.robust import solve_robust

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
    """Without the wall, and within it."""
    return _planned(problem, contact_weight=0.0), _planned(problem)


def test_robots_touch_the_wall_less(plans):
    free, within = plans
    assert free.success.all()
    assert within.success.all()
    before, after = (plan.robustness(60, SEED) for plan in plans)
    assert after.lost_count == before.lost_count == 0
    assert before.contact.mean() > 1.0
    assert after.contact.mean() < 0.7 * before.contact.mean()
    assert within.verdicts.solved.word == "yes"


def test_the_weight_of_contact_is_told(plans):
    free, within = plans
    assert within.meta["contact_weight"] == Settings().contact_weight
    assert within.meta["rounds"][-1]["contact_weight"] == Settings().contact_weight
    assert free.meta["contact_weight"] is None
    assert within.free is None


def test_a_plan_holds_the_robots_that_it_was_certified_on(plans):
    certificate, samples = plans[1].meta["certificate"], plans[1].drawn
    assert len(samples) == certificate["samples"]
    assert sample_outcomes(plans[1]).passed_all_checks.sum() == certificate["holds"]


def test_without_a_lumen_nothing_changes(problem, plans):
    open_air = _planned(replace(problem, lumen=None))
    np.testing.assert_array_equal(open_air.q, plans[0].q)
    assert open_air.free is None
    assert open_air.meta["contact_weight"] is None
    assert open_air.meta["rounds"] == plans[0].meta["rounds"]
