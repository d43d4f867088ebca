"""Derivatives over the numbers of tubes, against robots whose numbers are changed a little."""

import numpy as np
import pytest

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.identify.calibration.sensitivities import sensitivities
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES

pytestmark = pytest.mark.interpreted

SIGMA = np.array([0.3, 0.7, 1.0])
TAPERED = Robot(
    (
        Tube(90, 50, (1 / 200, 1 / 100), 5.7, 4.3),
        Tube(202, 107, 1 / 60, 3.7, 2.9),
        Tube(390, 150, (1 / 120, 1 / 60), 2.1, 1.0),
    ),
    Limits(beta=[(0, 80), (0, 150), (0, 300)]),
)
ROBOTS = {"constant": table_i_robot(), "linear, pushed out": TAPERED}
Q = np.array([0.3, -0.6, 0.9, 20.0, 60.0, 110.0, 0.1, -0.2])
OPPOSED = np.array([0.0, 2.2, 4.0, 20.0, 60.0, 110.0, 0.1, -0.2])


class Changed:
    """A robot of which one number of one tube is another."""

    def __init__(self, robot, tube, number, value):
        self.__dict__.update(d=robot.d, axes=robot.axes, structure=robot.structure, lower=robot.lower)
        self.numbers = robot.numbers.copy()
        self.numbers[tube, number] = value

    @property
    def tube_numbers(self):
        from ctr_nlp.robot.structure import tubes_of

        return tubes_of(self.structure, self.numbers.tolist())


def differences(robot, of, arcs):
    """Central differences of of(changed robot) over every number, (.., d, 8); arcs have one curvature."""
    found = []
    for tube in range(robot.d):
        row = []
        for number, name in enumerate(TUBE_NUMBER_NAMES):
            value = robot.numbers[tube, number]
            step = 1e-5 * max(abs(value), 1e-3)
            ahead, behind = (of(Changed(robot, tube, number, value + sign * step)) for sign in (1, -1))
            away = (ahead - behind) / (2 * step)
            row.append(away * (0 if arcs[tube] and name == "root_curvature" else 1))
        found.append(np.stack(row, axis=-1))
    return np.stack(found, axis=-2)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())
@pytest.mark.parametrize("name", ["dominant", "elastic"])
def test_shapes_and_angles_change_as_they_do_for_a_robot_with_other_numbers(robot, name):
    model = KINEMATIC_MODELS[name]
    x = model.rest(robot, Q)[None]
    found = sensitivities(robot, x, name, SIGMA)
    arcs = [kind == "arc" for kind in robot.structure.kinds]
    points = differences(robot, lambda other: model.points(other, x, SIGMA)[0], arcs)
    scale = abs(points).max(axis=(0, 1), keepdims=True) + 1e-9
    np.testing.assert_allclose(found.points[0] / scale, points / scale, atol=0.01)
    alpha = differences(robot, lambda other: model.configuration(other, x)[0, : robot.d], arcs)
    np.testing.assert_allclose(found.alpha[0], alpha, atol=0.01 * abs(alpha).max() + 1e-9)


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())
def test_with_motors_held_the_elastic_robot_comes_to_rest_where_the_derivative_says(robot):
    model, number = KINEMATIC_MODELS["elastic"], TUBE_NUMBER_NAMES.index("tip_curvature")
    x = model.rest(robot, Q)[None]
    found = sensitivities(robot, x, "elastic", SIGMA)
    for tube in range(robot.d):
        if robot.structure.kinds[tube] == "linear":
            continue
        ends = []
        for sign in (1, -1):
            other = Changed(robot, tube, number, robot.numbers[tube, number] * (1 + sign * 1e-4))
            ends.append(model.points(other, model.rest(other, Q)[None], SIGMA)[0])
        moved = (ends[0] - ends[1]) / (2e-4 * robot.numbers[tube, number])
        np.testing.assert_allclose(
            found.points_at_fixed_q[0, :, :, tube, number], moved, atol=0.02 * abs(moved).max()
        )


@pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())
def test_the_margin_changes_as_the_eigenvalue_does(robot):
    model = KINEMATIC_MODELS["elastic"]
    x = model.rest(robot, OPPOSED)[None]
    assert 0 < model.margins(robot, x)[0] < 0.95
    found = sensitivities(robot, x, "elastic", SIGMA)
    arcs = [kind == "arc" for kind in robot.structure.kinds]
    margin = differences(robot, lambda other: model.margins(other, x)[0], arcs)
    np.testing.assert_allclose(found.margin[0], margin, atol=0.03 * abs(margin).max())
    assert np.isnan(sensitivities(robot, Q[None], "dominant", SIGMA).margin).all()
