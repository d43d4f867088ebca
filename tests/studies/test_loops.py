"""The study of closed loops: what it counts, on two robots."""

import numpy as np
import pytest
from loops_of import OFF, ROBOT, made_plan, robots

from ctr_nlp.loops.differences import Differences
from ctr_nlp.models import MODELS
from ctr_nlp.robot.tolerances import NAMES
from ctr_nlp.studies.identified import identified
from ctr_nlp.studies.loops import CASES, HOWS, REPLANNED, looped


def test_feedback_is_told_beside_open_loop():
    plan = made_plan()
    first, again = (looped("made", plan, "tip and 5 points", 2, seed=1) for _ in range(2))
    assert (first.opened, first.closed, first.lost) == (again.opened, again.closed, again.lost)
    assert first.draws == 2
    assert first.kept == pytest.approx(first.closed)
    assert 0 < first.cycle <= first.slowest


def test_cases_measure_what_their_names_say():
    assert {name: len(case.sensors) for name, case in CASES.items()} == {
        "tip and 5 points": 18,
        "tip alone": 3,
        "with play": 18,
        "with bending": 18,
    }


def test_a_robot_that_was_measured_in_free_space_is_known_as_well_as_is_said():
    tolerances, places = OFF, np.array([1 / 3, 2 / 3, 1.0])
    differences = Differences.of(ROBOT, tolerances)
    for k in range(4):
        draw = robots(4)[k : k + 1]
        mean, covariance = identified(ROBOT, tolerances, draw, MODELS["elastic"], places, 0.5, k)
        truth = np.array([draw.parts[0, tube, NAMES.index(name)] for tube, name in differences.places])
        deviations = (mean - truth) / np.sqrt(covariance.diagonal())
        assert abs(deviations).max() < 4.0
        learnt = np.sqrt(covariance.diagonal() / differences.covariance.diagonal())
        assert learnt[differences.zeros[0]].max() < 0.5
        assert learnt[:2].max() < 0.5  # curvatures


@pytest.mark.parametrize("how", HOWS)
def test_every_way_of_leading_a_plan_is_told_beside_open_loop(how):
    found = looped("made", made_plan(), "tip and 5 points", 2, seed=1, how=how)
    assert found.draws == 2
    assert found.kept < found.opened
    assert not found.lost
    assert (found.replanning > 0) == (how == REPLANNED)
