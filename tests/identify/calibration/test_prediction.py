"""Predicted measurements, and their derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sensed import TWO, observations, parts_within, shapes_of

from ctr_nlp import Load
from ctr_nlp.identify.calibration.parameters import MODULUS_KIND, OFFSET, PARAMETER_KINDS, parameters_of
from ctr_nlp.identify.calibration.prediction import Prediction, flat_measured, register_points
from ctr_nlp.models import KINEMATIC_MODELS, model_with_load
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.robot.tolerances import DEVIATION_NAMES

RANDOM = np.random.default_rng(5)
COUNT = 6
SIGMA = (0.4, 0.9)


def motion():
    q = np.zeros((COUNT, 6))
    q[:, :2] = np.cumsum(RANDOM.uniform(-0.3, 0.3, (COUNT, 2)), axis=0)
    q[:, 2], q[:, 3] = np.linspace(30, 50, COUNT), np.linspace(125, 140, COUNT)
    return q


def measured(q):
    seen = [RANDOM.standard_normal((COUNT, 3)) for _ in range(2)]
    points = RANDOM.standard_normal((COUNT, 2, 3))
    return observations(q, points, SIGMA, *seen, 0.1 * np.arange(COUNT), np.arange(COUNT) // 3)


def values_of(parameters):
    low, _ = parameters.bounds
    found = 0.2 * parameters.sigma * RANDOM.standard_normal(len(parameters))
    return np.where(np.isfinite(low) & (low == 0), abs(found) + 0.3 * parameters.sigma, found)


@pytest.mark.parametrize("model", ["dominant", "elastic"])
def test_derivatives_are_those_of_differences(model):
    robot = TWO.with_limits(beta=[(0, 60), (0, 150)])
    seen = measured(motion())
    parameters = parameters_of(robot, seen, [kind for kind in PARAMETER_KINDS if kind != MODULUS_KIND])
    assert len(parameters) == 2 * 8 + 2 + 2 * 6
    compare(parameters, seen, KINEMATIC_MODELS[model])


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize(
    "load",
    [Load(), pytest.param(Load(densities=6.45, down=(0, 1, 0)), marks=pytest.mark.slow)],
    ids=["forces", "weight too"],
)
def test_derivatives_under_forces_are_those_of_differences(load, timed):
    robot = with_modulus(TWO.with_limits(beta=[(0, 60), (0, 150)]), 60_000)
    seen = replace(measured(motion()), force=0.1 * RANDOM.standard_normal((COUNT, 3)))
    if not timed:
        seen = replace(seen, time=np.full(COUNT, np.nan))
    kinds = PARAMETER_KINDS if timed else (*DEVIATION_NAMES, MODULUS_KIND, OFFSET)
    compare(parameters_of(robot, seen, kinds, loaded=True), seen, model_with_load("elastic", load))


def compare(parameters, seen, model):
    """Derivatives with differences of predictions."""
    prediction, values = Prediction(parameters, seen, model), values_of(parameters)
    found, changes = prediction.predict_with_derivatives(values)
    np.testing.assert_array_equal(found.flat(), prediction.predict_values(values).flat())
    for k, name in enumerate(parameters.names):
        step = np.zeros(len(parameters))
        step[k] = 1e-5 * min(1.0, parameters.sigma[k])
        ends = [prediction.predict_values(values + sign * step).flat() for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * step[k])
        np.testing.assert_allclose(
            changes[..., k], difference, atol=3e-3 * (1 + abs(difference).max()), err_msg=name
        )


def test_predictions_are_shapes_of_the_robot_with_these_parts_in_the_sensor_s_axes():
    parts = parts_within(TWO, 3)
    q = motion()
    seen = observations(q, np.zeros((COUNT, 2, 3)), SIGMA, np.zeros((COUNT, 3)), np.zeros((COUNT, 3)))
    parameters = parameters_of(TWO, seen)
    values = np.zeros(len(parameters))
    for k, one in enumerate(parameters.each):
        if one.kind in DEVIATION_NAMES:
            values[k] = parts[one.number - 1, DEVIATION_NAMES.index(one.kind)]
    turn, place = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([100.0, -50, 20])
    found = Prediction(parameters, seen, KINEMATIC_MODELS["elastic"], [(turn, place)]).predict_values(values)
    shapes = shapes_of(TWO, parts, q, np.array([*SIGMA, 1.0, 1 - 1e-6]))
    np.testing.assert_allclose(found.points, shapes[:, :2] @ turn.T + place, atol=1e-9)
    np.testing.assert_allclose(found.tip, shapes[:, 2] @ turn.T + place, atol=1e-9)
    along = shapes[:, 2] - shapes[:, 3]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    np.testing.assert_allclose(found.direction, along @ turn.T, atol=1e-5)


def test_a_registration_is_found_from_points_of_which_some_are_missing():
    turn, place = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix(), np.array([3.0, 2.0, 1.0])
    points = RANDOM.standard_normal((9, 3))
    seen = points @ turn.T + place
    seen[2, 1] = np.nan
    found = register_points(points, seen)
    np.testing.assert_allclose(found[0], turn, atol=1e-12)
    np.testing.assert_allclose(found[1], place, atol=1e-12)
    np.testing.assert_array_equal(register_points(points, np.full((9, 3), np.nan))[0], np.eye(3))


def test_all_that_was_measured_stands_side_by_side():
    seen = measured(motion())
    assert flat_measured(seen).shape == (COUNT, 12)
