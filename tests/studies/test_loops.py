"""The study of closed loops: what it counts, on two robots."""

import numpy as np
import pytest
from closed_loop_study import CLOSED_LOOP_CASES, REPLANNED, REPLANNING_MODES, run_closed_loops
from identification import identify_robot
from loops_of import OFF, ROBOT, made_plan, robots

from ctr_nlp.identify.closed_loop.parameter_differences import ParameterDifferences
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.robot.tolerances import DEVIATION_NAMES


def test_feedback_is_told_beside_open_loop():
    plan = made_plan()
    first, again = (run_closed_loops("made", plan, "tip and 5 points", 2, seed=1) for _ in range(2))
    assert (first.opened, first.closed, first.lost) == (again.opened, again.closed, again.lost)
    assert first.draws == 2
    assert first.kept == pytest.approx(first.closed)
    assert 0 < first.cycle <= first.slowest


def test_cases_measure_what_their_names_say():
    assert {name: len(case.sensors) for name, case in CLOSED_LOOP_CASES.items()} == {
        "tip and 5 points": 18,
        "tip alone": 3,
        "with play": 18,
        "with bending": 18,
    }


def test_a_robot_that_was_measured_in_free_space_is_known_as_well_as_is_said():
    tolerances, places = OFF, np.array([1 / 3, 2 / 3, 1.0])
    differences = ParameterDifferences.of(ROBOT, tolerances)
    for k in range(4):
        draw = robots(4)[k : k + 1]
        mean, covariance = identify_robot(ROBOT, tolerances, draw, KINEMATIC_MODELS["elastic"], places, 0.5, k)
        truth = np.array(
            [draw.deviations[0, tube, DEVIATION_NAMES.index(name)] for tube, name in differences.entries]
        )
        deviations = (mean - truth) / np.sqrt(covariance.diagonal())
        assert abs(deviations).max() < 4.0
        learnt = np.sqrt(covariance.diagonal() / differences.covariance.diagonal())
        assert learnt[differences.zero_indices[0]].max() < 0.5
        assert learnt[:2].max() < 0.5  # curvatures


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=pytest.mark.slow) if how == REPLANNED else how for how in REPLANNING_MODES]
)
def test_every_way_of_leading_a_plan_is_told_beside_open_loop(how):
    found = run_closed_loops("made", made_plan(), "tip and 5 points", 2, seed=1, replanning_mode=how)
    assert found.draws == 2
    assert found.kept < found.opened
    assert not found.lost
    assert (found.replanning > 0) == (how == REPLANNED)
