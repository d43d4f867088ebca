"""What can be had where a robot cannot both arrive and keep off the wall, and what stands in its way."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, Settings, growing, solve_horizon
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.figures.compromise import compromise
from ctr_nlp.plan.measures import Contact
from ctr_nlp.steer.compromise import Compromise, compromises, needed, sentences
from ctr_nlp.target.curve import curve_from_formula, curve_from_points

FRAMES = 12


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly, in a lumen that they hardly fit into."""
    bend = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    s = np.linspace(0, bend.length, 80)
    lumen = curve_from_points(bend.point(s), np.full(len(s), 2.6))
    return Problem("bend", TWO, growing(bend, FRAMES), lumen=lumen)


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
    assert by_weight[0.0].contact <= by_weight[5000.0].contact + 0.05
    own = by_weight[None]
    assert own.tip == pytest.approx(np.linalg.norm(plan.shape[-1, -1] - plan.target[-1, -1]))
    assert own.contact >= -plan.clearance.min() - 1e-12
    figure = compromise(plan, found)
    assert "Arrival against contact" in figure.get_suptitle()


def test_a_plan_without_a_wall_has_nothing_to_weigh(problem):
    open_air = replace(problem, lumen=None)
    plan = solve_horizon(open_air, settings=Settings(arrival_weight=0.0))
    with pytest.raises(ProblemError, match="the lumen's radii are not known"):
        compromises(open_air, plan)


def test_what_a_path_asks_for_is_told_by_its_sharpest_bend(plan):
    """The path bends with 8 / 25^2 and 6 / 30^2 at most in its two planes."""
    at = needed(plan)
    assert 1 / at.radius < 1.1 * np.hypot(8 / 25**2, 6 / 30**2)
    present = [tube for tube, end in zip(TWO.tubes, plan.beta[-1], strict=True) if end >= at.bend]
    stiff = [tube.bending_stiffness for tube in present]
    most = sum(e * tube.largest_curvature for e, tube in zip(stiff, present, strict=True)) / sum(stiff)
    assert 1 / at.least <= most * (1 + 1e-9)
    assert at.room < 2.6
    assert at.tube in (1, 2)


TOUCHED = Contact(10, 12, 1.5, 12, 2, 61.0, 62.0)


def test_sentences_tell_what_excludes_what(plan):
    clear = Compromise(0.0, 4.0, -0.2, 1.0, True, None)
    pressed = Compromise(5000.0, 0.5, 1.5, 1.2, True, TOUCHED)
    told = " ".join(sentences(plan, [clear, pressed]))
    assert "the best that arrives presses 1.50 mm into the wall; its tip ends 0.50 mm off." in told
    assert "with at most 0.5 mm of contact, the best ends 4.00 mm off the target." in told
    assert "The wall is in the way of tube 2, 61 mm along the robot (62 mm along the path)." in told
    assert "The path asks most of the tubes" in told
    both = " ".join(sentences(plan, [clear, replace(pressed, contact=0.1)]))
    assert "The path asks" not in both, "nothing stands in the way"
    none = " ".join(sentences(plan, [replace(pressed, tip=3.0)]))
    assert "None of the motions tried arrives within 2 mm." in none
    assert "None of them keeps contact to 0.5 mm." in none
