"""The filter: its slopes, whether what it claims to know is true, and what it does not believe."""

import numpy as np
import pytest
from loops_of import OFF, ROBOT, SENSORS, made_plan, robots

from ctr_nlp import Tolerances
from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.feed import Feed
from ctr_nlp.identify.closed_loop.observer import Observer
from ctr_nlp.identify.closed_loop.parameter_differences import ParameterDifferences
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.prediction import Predictor
from ctr_nlp.identify.closed_loop.sensors import Reading
from ctr_nlp.models import KINEMATIC_MODELS

ELASTIC = KINEMATIC_MODELS["elastic"]


@pytest.fixture(scope="module")
def plan():
    return made_plan()


def observer(tolerances=OFF):
    of = ParameterDifferences.of(ROBOT, tolerances)
    return Observer(ELASTIC, of, SENSORS, Predictor(ELASTIC, ROBOT.structure, SENSORS.sigma, of.tube_parts))


def true(draws, k):
    """The differences of a draw, in the order of Differences."""
    parts = draws.deviations[k]
    return np.concatenate([parts[:, 0], parts[:, 1], parts[:, 4], draws.backlash[k][draws.backlash[k] > 0]])


def watched(plan, draws, k, tolerances=OFF, **feed):
    plant, found = Plant(ROBOT, draws[k : k + 1]), observer(tolerances)
    source = Feed(plant, SENSORS, k, **feed)
    for q, time in zip(plan.q, plan.time.tolist(), strict=True):
        plant.move_to(q, time)
        found.move_motors(q, time)
        for reading in source.take_readings(time):
            found.update_estimate(reading)
    return found


def test_slopes_of_what_is_measured_match_finite_differences(plan):
    found, step = observer(), 1e-5
    found.move_motors(plan.q[0], 0.0)
    found.move_motors(plan.q[30], 1.0)
    _, slopes = found.expected_reading(1.0)
    of = found.differences
    for k in range(len(of)):
        ends = []
        for side in (1, -1):
            draw = of.perturbed_robots((side * step * np.eye(len(of))[k])[None])
            plant = Plant(ROBOT, draw)
            plant.move_to(plan.q[0], 0.0)
            plant.move_to(plan.q[30], 1.0)
            ends.append(SENSORS.values(plant.sample_shape(SENSORS.sigma)))
        assert slopes[:, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.01, abs=0.05)


def test_what_is_known_beforehand_is_what_the_tolerances_say():
    of = ParameterDifferences.of(ROBOT, Tolerances(0.1, 0.0, motor_zero=(0.0, 0.03), rotation_lag=0.06))
    places = [(0, "curvature"), (1, "curvature"), (1, "motor_zero"), (0, "rotation_lag"), (1, "rotation_lag")]
    assert list(of.entries) == places
    assert np.sqrt(of.covariance.diagonal()) == pytest.approx(np.array([0.1, 0.1, 0.03, 0.03, 0.03]) / np.sqrt(3))
    assert of.mean == pytest.approx([0, 0, 0, 0.03, 0.03])
    values = np.array([0.05, -0.02, 0.01, 0.04, 0.02])
    draw = of.perturbed_robots(values[None])
    assert of.numbers(values) == pytest.approx(draw.numbers[0])
    assert of.offsets(values) == pytest.approx(draw.offsets[0])
    assert of.lags(values) == pytest.approx(draw.backlash[0])


def test_a_robot_without_tolerances_has_nothing_to_learn():
    with pytest.raises(OptionError, match="all 0"):
        ParameterDifferences.of(ROBOT, Tolerances(0.0, 0.0, motor_zero=0.0))


@pytest.mark.parametrize("feed", [{}, {"latency": 0.6}, {"dropped": 0.3}], ids=["prompt", "late", "dropped"])
def test_errors_are_as_large_as_the_filter_says(plan, feed):
    """Their mean square, in deviations, is 1; of 8 robots with 6 differences each its deviation is about 0.2."""
    draws = robots(8)
    sizes = []
    for k in range(8):
        found = watched(plan, draws, k, **feed)
        away = found.mean - true(draws, k)
        sizes.append(away @ np.linalg.solve(found.covariance, away) / len(away))
        assert (found.covariance.diagonal() < found.differences.covariance.diagonal()).all()
    assert 0.4 < np.mean(sizes) < 1.7


def test_lags_are_among_what_is_estimated(plan):
    tolerances = Tolerances(0.02, 0.02, motor_zero=0.01, rotation_lag=0.2)
    draws = robots(4, tolerances=tolerances)
    away = []
    for k in range(4):
        found = watched(plan, draws, k, tolerances)
        away.append((found.mean - true(draws, k)) / np.sqrt(found.covariance.diagonal()))
    assert abs(np.array(away)).max() < 4


def test_values_that_cannot_be_are_not_taken(plan):
    found = observer()
    for k, time in ((0, 0.0), (10, 1.0)):
        found.move_motors(plan.q[k], time)
    values, _ = found.expected_reading(1.0)
    values = values.copy()
    values[3:6] += 30.0
    values[6] = np.nan
    seen = found.update_estimate(Reading(1.0, values))
    assert seen.accepted.tolist() == [True] * 3 + [False] * 6
    assert found.mean == pytest.approx(found.differences.mean, abs=1e-9)


def test_judging_a_reading_takes_nothing_of_it(plan):
    found = observer()
    for k, time in ((0, 0.0), (10, 1.0)):
        found.move_motors(plan.q[k], time)
    mean, covariance = found.mean, found.covariance
    seen = found.compute_innovation(Reading(1.0, found.expected_reading(1.0)[0] + 0.3))
    assert seen.accepted.all()
    assert found.mean is mean
    assert found.covariance is covariance
