"""The end of a motion: what the tip's distance from the target's end costs, and what plans do about it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, Settings, growing, solve_horizon
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.terms import ArrivalTerm, TipPosition
from ctr_nlp.ocp.terms.arrival import (
    ARRIVAL_FUNNEL_MM,
    ARRIVAL_MOTION_FRACTION,
    PENALTY_ROUNDING_MM,
    smooth_excess,
    with_arrival,
)
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.plan.measures import arrival
from ctr_nlp.plan.metrics import e3

FRAMES = 20


@pytest.fixture(scope="module")
def bend():
    """A path in space that two tubes can follow nowhere exactly, and whose end they can reach."""
    path = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    return Problem("bend", TWO, growing(path, FRAMES))


# The penalty


def test_nothing_is_paid_up_to_zero():
    assert [float(ca.DM(smooth_excess(value))) for value in (-5.0, -1e-9, 0.0)] == [0.0, 0.0, 0.0]


def test_beyond_its_rounded_corner_a_millimetre_costs_one():
    assert float(ca.DM(smooth_excess(2.0) - smooth_excess(1.0))) == pytest.approx(1.0)
    assert float(ca.DM(smooth_excess(1.0))) == pytest.approx(1.0 - PENALTY_ROUNDING_MM / 2)


def test_its_slope_is_continuous():
    x = ca.SX.sym("x")
    slope = ca.Function("slope", [x], [ca.gradient(smooth_excess(x), x)])
    values = [
        float(slope(value)) for value in (-1e-6, 1e-6, PENALTY_ROUNDING_MM - 1e-6, PENALTY_ROUNDING_MM + 1e-6)
    ]
    np.testing.assert_allclose(values, [0, 0, 1, 1], atol=1e-4)


# The term


def test_it_counts_in_the_last_tenth_alone_and_tightens_towards_the_end(bend):
    filled = [ArrivalTerm(weight=50.0, radius=0.3, required=1.7).fill(frame) for frame in bend.target_frames]
    parts = np.array([frame.motion_fraction for frame in bend.target_frames])
    weights = np.array([values["arrival_weight"] for values in filled])
    np.testing.assert_array_equal(weights, np.where(parts > 1 - ARRIVAL_MOTION_FRACTION, 50.0, 0.0))
    radii = [values["arrival_radius"] for values in filled]
    assert radii[-1] == pytest.approx(0.3)
    assert radii[0] == pytest.approx(0.3 + ARRIVAL_FUNNEL_MM / ARRIVAL_MOTION_FRACTION)
    np.testing.assert_array_equal(filled[-1]["arrival_end"], bend.target_frames[-1].points[-1:])


def test_settings_ask_for_it_once():
    asked = TipPosition(1.0)
    terms = with_arrival((asked,), Settings(arrival_tolerance=1.0), KINEMATIC_MODELS["elastic"])
    assert [type(term) for term in terms] == [TipPosition, ArrivalTerm]
    assert terms[1].required < 1.0
    assert with_arrival(terms, Settings(), KINEMATIC_MODELS["elastic"]) == terms
    assert with_arrival((asked,), Settings(arrival_weight=0.0), KINEMATIC_MODELS["elastic"]) == (asked,)


def test_on_a_model_that_cannot_snap_it_counts_where_it_is_asked_for():
    """The paper's experiments on the dominant model stay as they are."""
    assert with_arrival((), Settings(), KINEMATIC_MODELS["dominant"]) == ()
    assert len(with_arrival((), Settings(arrival_weight=5.0), KINEMATIC_MODELS["dominant"])) == 1


@pytest.mark.parametrize("weight", [-1.0, float("nan"), float("inf")])
def test_a_weight_out_of_range_is_refused(weight):
    with pytest.raises(OptionError, match="arrival_weight is"):
        Settings(arrival_weight=weight)


# Plans


def test_plans_end_nearer_to_the_target_at_little_cost(bend):
    without = solve_horizon(bend, model="dominant", settings=Settings(arrival_weight=0.0))
    plan = solve_horizon(bend, model="dominant", settings=Settings(arrival_weight=50.0))
    assert arrival(without).distance > 1.0
    assert arrival(plan).distance < 0.5
    assert e3(plan) < 1.25 * e3(without)


def test_a_plan_that_arrives_anyway_stays_the_same(bend):
    wide = {"arrival_tolerance": 40.0}
    plans = [
        solve_horizon(bend, model="dominant", settings=Settings(arrival_weight=weight, **wide))
        for weight in (0.0, 50.0)
    ]
    np.testing.assert_allclose(plans[1].q, plans[0].q, atol=1e-4)


def test_plans_list_what_was_asked_for(bend):
    plan = solve_horizon(bend, model="dominant", terms=[TipPosition(0.1)], settings=Settings(arrival_weight=5.0))
    assert plan.options["terms"] == ["TipPosition(weight=0.1, wanted=None)"]
    assert plan.options["arrival_weight"] == 5.0
