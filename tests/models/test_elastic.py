"""The elastic model against shared reference shapes, shooting from the base, and what must hold of any robot."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import truth
from frames import configuration
from frames import elastic_shapes as shapes
from frames import elastic_tangents as tangents
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from strategies import numbers, robots, robots_with_q

from ctr_nlp import Limits, Robot, Tube
from ctr_nlp.models.elastic import shape as elastic
from ctr_nlp.models.elastic import stability, torsion
from ctr_nlp.plan import simulation as dominant_shapes

SIGMA = np.linspace(0, 1, 31)
pytestmark = pytest.mark.interpreted


def motors(robot, x, steps):
    """Alpha (d,) at x (2d + 2,)."""
    x = list(map(float, x))
    parts = torsion.sections(robot.tube_numbers, x[robot.d : 2 * robot.d], np)
    return np.array(torsion.motors(robot.tube_numbers, x, torsion.twist(robot.tube_numbers, x, parts, np, steps)))


def tips(robot, x):
    """q (2d + 2,) whose motors have the angles of x's tips."""
    q = np.array(x)
    q[: robot.d - 1] += q[robot.d - 1]
    return q


@pytest.mark.parametrize("number", range(truth.CASES))
def test_reference_shapes(shared_data, number, monkeypatch):
    monkeypatch.setenv("CTR_NLP_COMPILE", "now")
    case = truth.case(shared_data, number)
    assert np.abs(shapes(case.robot, case.x[None], SIGMA)[0] - case.points).max() < 0.002
    np.testing.assert_allclose(configuration(case.robot, case.x[None])[0], case.q, atol=1e-9)


@pytest.mark.parametrize("name", truth.CONFIGURATIONS)
def test_shapes_match_shooting_from_the_base(name):
    """Newton's method is left out: at the tips' angles that shooting finds, motors and shape must be the same."""
    shot = truth.shot(name)
    x = shot.x
    np.testing.assert_allclose(configuration(shot.robot, x[None])[0], shot.q, atol=2e-4)
    np.testing.assert_allclose(shapes(shot.robot, x[None], SIGMA)[0], shot.points(SIGMA), atol=0.01)


def test_errors_fall_with_a_power_of_the_steps():
    """The fifth for motors' angles, the fourth for tangents."""
    shot = truth.shot("two tubes, both within their curved parts")
    x, finest = shot.x, motors(shot.robot, shot.x, 24)
    of_motors = [abs(motors(shot.robot, x, steps) - finest).max() for steps in (2, 4, 8)]
    tip = shot.at(shot.q[3])[-3:]
    found = [elastic.backbone(shot.robot.tube_numbers, list(x), 1.0, np, steps).tangents for steps in (1, 2, 4)]
    of_tangents = np.abs(np.array(found) - tip).max(axis=1)
    for errors, order in ((np.array(of_motors), 5), (of_tangents, 4)):
        orders = np.log2(errors[:-1] / errors[1:])
        assert (orders > order - 0.3).all(), (errors, orders)


@given(robots_with_q())
def test_symbols_and_numbers_agree(case):
    robot, x = case
    symbol = ca.SX.sym("x", len(x))
    entries, d = ca.vertsplit(symbol), robot.d
    shape = elastic.backbone(robot.tube_numbers, entries, ca.DM(SIGMA), ca)
    parts = torsion.sections(robot.tube_numbers, entries[d : 2 * d], ca)
    alpha = torsion.motors(robot.tube_numbers, entries, torsion.twist(robot.tube_numbers, entries, parts, ca))
    values = ca.horzcat(*shape.points), ca.horzcat(*shape.tangents), ca.vertcat(*alpha)
    points, directions, angles = (value.full() for value in ca.Function("f", [symbol], values)(x))
    np.testing.assert_allclose(points, shapes(robot, x[None], SIGMA)[0], atol=1e-8)
    np.testing.assert_allclose(directions, tangents(robot, x[None], SIGMA)[0], atol=1e-9)
    np.testing.assert_allclose(angles.ravel(), configuration(robot, x[None])[0, :d], atol=1e-9)


@pytest.mark.parametrize("transmissions", [False, True])
@pytest.mark.parametrize("beta", [(0, 0, 0), (0, 0, 60), (30, 30, 30), (0, 40, 40), (50, 50, 90), (50, 90, 120)])
def test_derivatives_stay_finite_where_tubes_end_together_or_are_hidden(beta, transmissions):
    tubes = (Tube(60, 50, 0.02, 6, 5), Tube(90, 90, (0, 0.03), 4, 3), Tube(120, 120, 0.0, 2, 1))
    robot = Robot(tubes, Limits(beta=[(0, tube.length) for tube in tubes]) if transmissions else Limits())
    symbol = ca.SX.sym("x", 8)
    entries = ca.vertsplit(symbol)
    parts = torsion.sections(robot.tube_numbers, entries[3:6], ca)
    twisted = torsion.twist(robot.tube_numbers, entries, parts, ca)
    shape = elastic.backbone(robot.tube_numbers, entries, ca.DM(SIGMA), ca)
    responses = stability.responses(robot.tube_numbers, entries[3:6], parts, twisted.nodes, 0.1, ca)
    minors = [stability.determinant(response) for response in responses]
    alpha = torsion.motors(robot.tube_numbers, entries, twisted)
    values = ca.vertcat(*shape.points, *shape.tangents, *alpha, *minors)
    jacobian = ca.Function("j", [symbol], [values, ca.jacobian(values, symbol)])
    for value in jacobian([2.0, -1.0, 0.3, *beta, 0.1, 0.2]):
        assert np.isfinite(value.full()).all()


@given(robots_with_q(transmissions=False))
def test_sections_without_length_change_nothing(case):
    """A robot that could show its transmissions has sections for these, empty as long as it does not."""
    robot, x = case
    out = Robot(robot.tubes, Limits(beta=[(0, tube.length) for tube in robot.tubes]))
    np.testing.assert_allclose(shapes(out, x[None], SIGMA), shapes(robot, x[None], SIGMA), atol=1e-3)
    np.testing.assert_allclose(configuration(out, x[None]), configuration(robot, x[None]), atol=1e-9)


@given(robots_with_q(least=2), st.data())
def test_tubes_that_end_together_are_the_limit_of_those_that_almost_do(case, data):
    robot, x = case
    d = robot.d
    i = data.draw(st.integers(0, d - 2))
    x[d + i + 1 : 2 * d] = np.maximum(x[d + i + 1 : 2 * d], x[d + i])
    x[d + i + 1] = x[d + i]
    nearly = x.copy()
    nearly[d + i] += data.draw(st.sampled_from([-1e-9, 1e-9]))
    np.testing.assert_allclose(shapes(robot, nearly[None], SIGMA), shapes(robot, x[None], SIGMA), atol=1e-5)
    np.testing.assert_allclose(configuration(robot, nearly[None]), configuration(robot, x[None]), atol=1e-6)


@given(robots_with_q(), numbers(-7, 7))
def test_turning_every_tube_turns_the_shape(case, angle):
    robot, x = case
    x[-2:] = 0
    turned = x.copy()
    turned[robot.d - 1] += angle
    rotation = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    expected = shapes(robot, x[None], SIGMA)[0] @ rotation.T
    np.testing.assert_allclose(shapes(robot, turned[None], SIGMA)[0], expected, atol=1e-9)
    change = (configuration(robot, turned[None]) - configuration(robot, x[None]))[0]
    np.testing.assert_allclose(change, [angle] * robot.d + [0] * (robot.d + 2), atol=1e-12)


@given(robots_with_q(most=1))
def test_one_tube_is_that_of_the_dominant_model(case):
    robot, x = case
    np.testing.assert_allclose(shapes(robot, x[None]), dominant_shapes.shapes(robot, x[None]), atol=1e-10)
    np.testing.assert_allclose(tangents(robot, x[None]), dominant_shapes.tangents(robot, x[None]), atol=1e-12)
    np.testing.assert_array_equal(configuration(robot, x[None])[0], x)


@given(robots_with_q(transmissions=False))
def test_a_much_stiffer_outer_tube_dominates(case):
    """Where a tube is the outermost one it is as if alone: untwisted, at the angle of its tip."""
    robot, x = case
    tubes = tuple(replace(tube, youngs_modulus=1e-7**i) for i, tube in enumerate(robot.tubes))
    expected = dominant_shapes.shapes(robot, tips(robot, x)[None], SIGMA)
    np.testing.assert_allclose(shapes(Robot(tubes), x[None], SIGMA), expected, atol=0.02)


@given(robots_with_q())
def test_tubes_that_cannot_twist_have_their_motors_angles_all_along(case):
    robot, x = case
    stiff = Robot(tuple(replace(tube, poisson_ratio=-1 + 1e-9) for tube in robot.tubes), robot.limits)
    np.testing.assert_allclose(configuration(stiff, x[None])[0], tips(robot, x), atol=1e-4)
    assert stability.margins(stiff.tube_numbers, x[None])[0] > 1 - 1e-4


@given(robots(), st.data())
def test_the_polyline_through_the_shape_is_as_long_as_beta_d(robot, data):
    d = robot.d
    x = np.array([data.draw(numbers(-3, 3)) for _ in range(2 * d + 2)])
    x[d : 2 * d] = np.sort(np.abs(x[d : 2 * d])) / 3 * robot.upper[d]
    points = shapes(robot, x[None], np.linspace(0, 1, 1001))[0]
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert length == pytest.approx(x[2 * d - 1], abs=0.01)
