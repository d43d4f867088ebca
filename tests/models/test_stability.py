"""Margins against shared ones, finite elements, and the determinants that say the same in a nonlinear program."""

from __future__ import annotations

import numpy as np
import pytest
import truth
from frames import configuration, settled, untwisted
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from strategies import numbers, robots_with_q

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.models.elastic import stability, torsion

pytestmark = pytest.mark.interpreted


def determinants(robot, x, margin):
    """Of all responses, the motors' last."""
    x = list(map(float, x))
    parts = torsion.sections(robot.tube_numbers, x[robot.d : 2 * robot.d], np)
    twisted = torsion.twist(robot.tube_numbers, x, parts, np)
    found = stability.responses(robot.tube_numbers, x[robot.d :], parts, twisted.nodes, margin, np)
    return [float(stability.determinant(response)) for response in found]


@pytest.mark.parametrize("number", range(truth.CASES))
def test_reference_margins(shared_data, number):
    case = truth.case(shared_data, number)
    (margin,) = stability.margins(case.robot.tube_numbers, case.x[None])
    assert margin == pytest.approx(case.margin, abs=0.01)
    assert (margin > 0) == (case.margin > 0)
    assert determinants(case.robot, case.x, 0.0)[-1] == pytest.approx(case.determinant, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("name", truth.CONFIGURATIONS)
def test_margins_match_finite_elements(name):
    shot = truth.shot(name)
    (margin,) = stability.margins(shot.robot.tube_numbers, settled(shot.robot, shot.q)[None])
    assert margin == pytest.approx(shot.margin(), abs=0.001)


def test_an_unstable_equilibrium_matches_finite_elements():
    """Opposed tubes, untwisted, are at rest for symmetry."""
    q = np.array([np.pi, 0, 40, 70, 0, 0])
    shot = truth.Shot(truth.TWO, q, (0.0, 0.0))
    (margin,) = stability.margins(truth.TWO.tube_numbers, untwisted(truth.TWO, q)[None])
    assert margin < -0.1
    assert margin == pytest.approx(shot.margin(), abs=0.005)


@given(robots_with_q())
def test_margins_are_at_most_one_and_do_not_depend_on_the_rest_of_a_batch(case):
    robot, x = case
    other = x.copy()
    other[: robot.d] = 0
    found = stability.margins(robot.tube_numbers, np.stack([x, np.full_like(x, np.nan), other]))
    assert found[0] <= 1
    assert np.isnan(found[1])
    if all(tube.root_curvature >= 0 for tube in robot.tubes):  # tubes shaped like an S act on each other aligned
        assert found[2] == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(stability.margins(robot.tube_numbers, x[None]), found[:1], atol=1e-12)


@pytest.mark.parametrize(
    "tubes",
    [
        (Tube(60, 40, 0.02, 4, 3),),
        (Tube(60, 40, 0.0, 4, 3), Tube(120, 100, 0.03, 2, 1)),
        (Tube(60, 0, 0.0, 6, 5), Tube(60, 40, 0.0, 4, 3), Tube(120, 0, 0.03, 2, 1)),
    ],
)
@pytest.mark.parametrize("transmissions", [False, True])
def test_tubes_that_do_not_act_on_each_other_are_stable(tubes, transmissions):
    d = len(tubes)
    robot = Robot(tubes, Limits(beta=[(0, tube.length) for tube in tubes]) if transmissions else Limits())
    x = np.concatenate([np.arange(d) + 1.0, robot.upper[d : 2 * d], [0.1, 0.2]])
    np.testing.assert_allclose(stability.margins(robot.tube_numbers, x[None]), 1, atol=1e-12)
    np.testing.assert_allclose(configuration(robot, x[None])[0, : d - 1], x[: d - 1] + x[d - 1], atol=1e-12)


@given(robots_with_q(least=2, transmissions=False))
def test_margins_do_not_depend_on_sections_without_length(case):
    robot, x = case
    out = Robot(robot.tubes, Limits(beta=[(0, tube.length) for tube in robot.tubes]))
    np.testing.assert_allclose(
        stability.margins(out.tube_numbers, x[None]), stability.margins(robot.tube_numbers, x[None]), atol=1e-9
    )


def test_a_tube_without_transmission_is_held_at_the_base():
    tubes = (Tube(40, 40, 0.03, 4, 3), Tube(70, 70, 0.03, 2, 1))
    x = np.array([[2.5, 0.0, 40.0, 70.0, 0.0, 0.0]])
    longer = Robot((Tube(41, 40, 0.03, 4, 3), Tube(71, 70, 0.03, 2, 1)))
    held, turning = (stability.margins(robot.tube_numbers, x)[0] for robot in (Robot(tubes), longer))
    assert turning < held < 1


@st.composite
def coupled(draw):
    """Robots whose tubes act strongly on each other, and equilibria at any angles."""
    robot = draw(st.sampled_from([truth.TWO, truth.FOUR, table_i_robot(), table_i_robot(literal=True)]))
    parts = np.sort([draw(numbers(0.4, 1)) for _ in range(robot.d)])
    angles = [draw(numbers(1, 4)) * draw(st.sampled_from([-1, 1])) for _ in range(robot.d - 1)]
    return robot, np.array([*angles, 0, *np.maximum.accumulate(parts * robot.upper[robot.d : 2 * robot.d]), 0, 0])


NEARLY_DOUBLE = truth.FOUR, np.array([-1.0, -3.96875, -1.65625, 0.0, 52.5, 97.5, 112.5, 168.75, 0.0, 0.0])
"""Two eigenvalues come to 0 within 0.013 of each other."""


@given(coupled())
@example(NEARLY_DOUBLE)
@settings(suppress_health_check=[HealthCheck.filter_too_much])
def test_the_last_determinant_changes_its_sign_at_the_margin(case):
    robot, x = case
    (margin,) = stability.margins(robot.tube_numbers, x[None])
    assume(-1.5 < margin < 0.95)
    assert min(determinants(robot, x, margin - 0.03)) > 0
    places = np.linspace(margin - 0.03, min(margin + 0.03, 0.99), 61)
    last = [determinants(robot, x, place)[-1] for place in places]
    changed = int(np.argmax(np.array(last) < 0))  # the first time: a second eigenvalue near by changes it back
    assert changed > 0
    root = brentq(lambda m: determinants(robot, x, m)[-1], places[changed - 1], places[changed])
    assert root == pytest.approx(margin, abs=0.01)


@given(robots_with_q(least=2))
def test_the_response_without_margin_is_the_derivative_of_the_motors_angles(case):
    """To the accuracy of both, which are integrated side by side, in twice as many steps as otherwise."""
    robot, x = case
    d, h, fine = robot.d, 1e-5, 2 * torsion.ELASTIC_STEPS_PER_SECTION

    def twisted(at):
        entries = list(map(float, at))
        parts = torsion.sections(robot.tube_numbers, entries[d : 2 * d], np)
        return entries, parts, torsion.twist(robot.tube_numbers, entries, parts, np, fine)

    def motors(at):
        entries, _, twist = twisted(at)
        return np.array(torsion.motors(robot.tube_numbers, entries, twist), dtype=float)

    entries, parts, twist = twisted(x)
    response = stability.responses(robot.tube_numbers, entries[d:], parts, twist.nodes, 0.0, np)[-1]
    slopes = np.array([(motors(x + step) - motors(x - step)) / (2 * h) for step in h * np.eye(len(x))[: d - 1]])
    expected = slopes[:, :-1] - slopes[:, -1:]
    np.testing.assert_allclose(np.array(response, dtype=float), expected.T, atol=1e-3 * abs(expected).max())


@pytest.mark.parametrize("size", [0, 1, 2, 3, 5])
def test_determinants_are_those_of_numpy(size):
    matrix = np.random.default_rng(size).normal(size=(size, size))
    assert stability.determinant(matrix.tolist()) == pytest.approx(np.linalg.det(matrix))
