"""What can be had where a robot cannot both arrive and keep off the wall, and what stands in its way."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import Settings, solve_horizon, table_i_robot
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.ocp.settings import ARRIVAL_WEIGHT
from ctr_nlp.plan.measures import Contact
from ctr_nlp.planning import compromise as module
from ctr_nlp.planning.compromise import (
    Compromise,
    compromise_sentences,
    compromises,
    find_arrival_weight,
    find_path_demands,
    pareto_front,
)
from ctr_nlp.planning.horizon import horizon_planner
from ctr_nlp.problems import named_problem
from ctr_nlp.view.figures.compromise import compromise


@pytest.fixture(scope="module")
def problem():
    """An airway whose bends the paper's tubes cannot take."""
    return named_problem("bronchus", frames=12)


@pytest.fixture(scope="module")
def plan(problem):
    return solve_horizon(problem)


def test_what_can_be_had_lies_between_contact_first_and_arrival_first(problem, plan):
    found = compromises(problem, plan, weights=(0.0, 5000.0))
    assert len(found) == 3
    assert [one.contact for one in found] == sorted(one.contact for one in found)
    by_weight = {one.arrival_weight: one for one in found}
    assert by_weight[5000.0].tip <= by_weight[None].tip + 1e-3
    assert by_weight[0.0].tip > by_weight[5000.0].tip
    first, last = (0.0 if one.where is None else one.where.depth for one in (by_weight[0.0], by_weight[5000.0]))
    assert first <= last + 0.05, "in frames; so few of them let the robot touch on the way between two"
    own = by_weight[None]
    assert own.tip == pytest.approx(np.linalg.norm(plan.shape[-1, -1] - plan.target[-1, -1]))
    assert own.contact >= -plan.clearance.min() - 1e-12
    figure = compromise(plan, found)
    assert "Arrival against contact" in figure.get_suptitle()
    assert [find_arrival_weight(plan, one) for one in (by_weight[0.0], own)] == [0.0, ARRIVAL_WEIGHT]


def test_a_motion_beaten_by_another_one_is_named(plan):
    places = {None: (1.0, 1.0), 5.0: (3.0, 0.5), 10.0: (2.0, 2.0)}  # tip and contact, mm
    found = [Compromise(weight, *place, 1.0, True, None) for weight, place in places.items()]
    labels = [text.get_text() for text in compromise(plan, found).axes[0].get_legend().get_texts()]
    other = "other motions, for the robot as described"
    assert {other, f"{other}, another is better in both"} <= set(labels)


def test_motions_begin_where_the_plan_was_asked_to(problem, plan, monkeypatch):
    asked = []

    def planner(*given):
        asked.append(given)
        return horizon_planner(*given)

    monkeypatch.setattr(module, "horizon_planner", planner)
    here = replace(plan, meta=plan.meta | {"options": plan.options | {"start": plan.q[0].tolist()}})
    assert len(compromises(problem, here, weights=(0.0,))) >= 1
    ((_, _, _, start, end, *_),) = asked
    np.testing.assert_array_equal(start, plan.q[0])
    assert end is None


def test_a_plan_without_a_wall_has_nothing_to_weigh(problem):
    open_air = replace(problem, lumen=None)
    plan = solve_horizon(open_air, settings=Settings(arrival_weight=0.0))
    with pytest.raises(ProblemError, match="the lumen's radii are not known"):
        compromises(open_air, plan)


def test_what_a_path_asks_for_is_told_where_it_bends_most(plan):
    at, tubes = find_path_demands(plan), table_i_robot().tubes
    present = [tube for tube, end in zip(tubes, plan.beta[-1], strict=True) if end >= at.bend]
    stiff = [tube.bending_stiffness for tube in present]
    most = sum(e * tube.largest_curvature for e, tube in zip(stiff, present, strict=True)) / sum(stiff)
    assert at.least == pytest.approx(1 / most)
    s = np.linspace(0, plan.beta[-1, -1], 101)
    tangents = np.gradient(plan.target[-1], s, axis=0)
    bends = np.linalg.norm(np.gradient(tangents, s, axis=0), axis=1)
    assert 1 / at.radius == pytest.approx(bends[abs(s - at.bend) <= 5].mean(), rel=0.1)
    assert at.least > at.radius, "these tubes cannot take that bend"
    nearest = int(np.argmin(abs(s - at.narrow)))
    assert at.tube == 1 + int((plan.beta[-1] < s[nearest]).sum())
    assert 0 < at.room < 9


def test_what_another_motion_beats_in_both_is_left_out():
    near, clear, worse = (Compromise(k, tip, contact, 1.0, True, None) for k, tip, contact in POINTS)
    assert pareto_front([near, worse, clear]) == [clear, near]
    assert pareto_front([near, near]) == [near, near]


POINTS = (5000.0, 0.3, 6.0), (5.0, 7.0, 2.5), (0.0, 12.0, 10.0)
TOUCHED = Contact(10, 12, 1.5, 12, 2, 61.0, 62.0)


def test_sentences_tell_what_excludes_what(plan):
    clear = Compromise(0.0, 4.0, -0.2, 1.0, True, None)
    pressed = Compromise(5000.0, 0.5, 1.5, 1.2, True, TOUCHED)
    told = " ".join(compromise_sentences(plan, [clear, pressed]))
    assert "the best that arrives presses 1.50 mm into the wall; its tip ends 0.50 mm off." in told
    assert "with at most 0.5 mm of contact, the best ends 4.00 mm off the target." in told
    assert "The wall is in the way of tube 2, 61 mm along the robot (62 mm along the path)." in told
    assert "The path is hardest to follow" in told
    both = " ".join(compromise_sentences(plan, [clear, replace(pressed, contact=0.1)]))
    assert "The path is hardest" not in both, "nothing stands in the way"
    none = " ".join(compromise_sentences(plan, [replace(pressed, tip=3.0)]))
    assert "None of the motions tried arrives within 2 mm." in none
    assert "None of them keeps contact to 0.5 mm." in none
