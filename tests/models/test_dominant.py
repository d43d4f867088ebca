"""The dominant-stiffness model against closed forms and an independent integration."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from strategies import numbers, robots, robots_with_q

from ctr_nlp import Limits, Robot, Tube, shape_curve, shapes, table_i_robot
from ctr_nlp.models.dominant import shape as dominant
from ctr_nlp.plan.simulation import tangents

SIGMA = np.linspace(0, 1, 41)
DEPLOYS_ALL = Limits(beta=[(0, 80), (0, 150), (0, 300)])


def lone(curvature, curved=100.0, length=100.0, limits=None):
    return Robot((Tube(length, curved, curvature, 2.0, 1.0),), limits or Limits())


def heaviside(x):
    return np.heaviside(x, 0.5)


def precurvature(tube, x):
    """k in 1/mm at x mm from a tube's tip: linear in x over the curved part, 0 behind it."""
    if x > tube.curved_length:
        return 0.0
    return tube.tip_curvature + (tube.root_curvature - tube.tip_curvature) * x / (tube.curved_length or 1)


def integrated(robot, q, sigma):
    """Points (n, 3) and tangents (n, 3) by integrating t' = k (cos a d1 + sin a d2), d' = -(d . t') t."""
    alpha, beta, theta = robot.split(q)
    frame = (Rotation.from_rotvec([0, theta[1], 0]) * Rotation.from_rotvec([theta[0], 0, 0])).as_matrix()
    state = np.concatenate([np.zeros(3), frame[:, 2], frame[:, 0], frame[:, 1]])
    wanted = sigma * beta[-1]
    points, directions = np.zeros((len(sigma), 3)), np.tile(frame[:, 2], (len(sigma), 1))
    start = 0.0
    for tube, angle, end in zip(robot.tubes, alpha, beta, strict=True):
        for stop in sorted({float(np.clip(end - tube.curved_length, start, end)), float(end)}):
            if stop <= start:
                continue
            middle = (start + stop) / 2

            def rates(s, y, tube=tube, angle=angle, end=end, middle=middle):
                t, d1, d2 = y[3:6], y[6:9], y[9:12]
                k = (
                    0.0
                    if end - middle > tube.curved_length
                    else precurvature(tube, min(end - s, tube.curved_length))
                )
                return np.concatenate(
                    [t, k * (math.cos(angle) * d1 + math.sin(angle) * d2), -k * math.cos(angle) * t,
                     -k * math.sin(angle) * t]
                )  # fmt: skip

            accuracy = {"rtol": 1e-11, "atol": 1e-11, "max_step": 5.0}  # between its steps it is less accurate
            run = solve_ivp(rates, (start, stop), state, method="DOP853", dense_output=True, **accuracy)
            here = (wanted > start) & (wanted <= stop)
            if here.any():
                points[here], directions[here] = run.sol(wanted[here])[:3].T, run.sol(wanted[here])[3:6].T
            start, state = stop, run.y[:, -1]
    return points, directions


def test_lone_tube_lies_on_its_own_circle_towards_plus_x():
    k = 1 / 60
    points = shapes(lone(k), np.array([[0.0, 100, 0, 0]]))[0]
    np.testing.assert_allclose(np.linalg.norm(points - [1 / k, 0, 0], axis=1), 1 / k, atol=1e-12)
    np.testing.assert_allclose(points[-1], [(1 - math.cos(100 * k)) / k, 0, math.sin(100 * k) / k], atol=1e-12)


def test_a_quarter_turn_of_alpha_bends_towards_plus_y():
    tip = shapes(lone(0.01), np.array([[math.pi / 2, 100, 0, 0]]))[0, -1]
    np.testing.assert_allclose(tip, [0, 100 * (1 - math.cos(1)), 100 * math.sin(1)], atol=1e-12)


def test_perpendicular_tubes_are_two_arcs_in_perpendicular_planes():
    """Tube 1 turns z to x by a quarter circle; tube 2, on +y, then goes from +x towards +y on its own circle."""
    first, second = 30.0, 20.0
    robot = Robot((Tube(60, 60, 1 / first, 4, 3), Tube(120, 120, 1 / second, 2, 1)))
    s1, angle = first * math.pi / 2, 1.3
    tip = shapes(robot, np.array([[0, math.pi / 2, s1, s1 + second * angle, 0, 0]]), np.ones(1))[0, 0]
    np.testing.assert_allclose(
        tip, [first + second * math.sin(angle), second * (1 - math.cos(angle)), first], atol=1e-12
    )


def test_many_short_turned_tubes_approach_a_helix():
    """Tubes of one curvature whose angles advance with s form a curve of curvature k and torsion tau."""
    k, tau, n, step = 1 / 40, 1 / 60, 60, 1.0
    tubes = [Tube((i + 1) * step, (i + 1) * step, k, 6.3 - 0.1 * i, 6.25 - 0.1 * i) for i in range(n)]
    beta = np.arange(1, n + 1) * step
    q = np.concatenate([tau * (beta - step / 2), beta, [0, 0]])
    tip = shapes(Robot(tuple(tubes)), q[None], np.ones(1))[0, 0]
    w = math.hypot(k, tau)
    length = n * step
    along = tau**2 / w**2 * length + k**2 / w**3 * math.sin(w * length)
    normal = k / w**2 * (1 - math.cos(w * length))
    binormal = k * tau / w**2 * (length - math.sin(w * length) / w)
    np.testing.assert_allclose(tip, [normal, binormal, along], atol=2e-3)


@given(robots_with_q())
def test_shape_matches_an_integration_of_the_bishop_frame(case):
    robot, q = case
    points, directions = integrated(robot, q, SIGMA)
    np.testing.assert_allclose(shapes(robot, q[None], SIGMA)[0], points, atol=1e-7)
    np.testing.assert_allclose(tangents(robot, q[None], SIGMA)[0], directions, atol=1e-8)


def test_a_long_tube_that_bends_to_both_sides_is_within_a_hundredth_of_a_micrometre():
    robot = Robot((Tube(180.0, 180.0, (-0.04, 0.04), 1.0, 0.8),))
    q = np.array([0.3, 180.0, 0.0, 0.0])
    assert abs(shapes(robot, q[None], SIGMA)[0] - integrated(robot, q, SIGMA)[0]).max() < 1e-5


@pytest.mark.parametrize("beta", [(80, 150, 300), (80, 80, 250), (20, 140, 140), (0, 0, 200)])
def test_deployed_transmissions_are_straight(beta):
    robot = Robot(table_i_robot().tubes, DEPLOYS_ALL)
    q = np.array([0.3, -2, 1.2, *beta, 0.2, -0.4], dtype=float)
    np.testing.assert_allclose(shapes(robot, q[None], SIGMA)[0], integrated(robot, q, SIGMA)[0], atol=1e-8)


def test_lone_transmission_lies_on_the_insertion_direction():
    robot = lone(1 / 50, curved=40, length=100, limits=Limits(beta=(0, 100)))
    points = shapes(robot, np.array([[0.7, 100, 0, 0]]), np.array([0.25, 0.6]))[0]
    np.testing.assert_allclose(points, [[0, 0, 25], [0, 0, 60]], atol=1e-12)


@pytest.mark.parametrize("k", [0.0, 1e-300, 1e-12, 1e-9])
def test_vanishing_curvature_is_the_straight_tube(k):
    points = shapes(lone(k), np.array([[0.4, 100, 0, 0]]))[0]
    np.testing.assert_allclose(points, np.outer(np.linspace(0, 100, 101), [0, 0, 1]), atol=1e-5)


@pytest.mark.parametrize("k", [0.0, 1e-12, (0.0, 0.01)])
def test_gradient_stays_finite_where_tubes_are_straight_or_hidden(k):
    robot = Robot((Tube(50, 50, k, 4, 3), Tube(100, 100, k, 2, 1)))
    q = ca.SX.sym("q", 6)
    points = dominant.backbone(robot.tube_numbers, ca.vertsplit(q), ca.DM(SIGMA), ca).points
    jacobian = ca.Function("j", [q], [ca.jacobian(ca.vertcat(*points), q)])
    for beta in ([0, 0], [0, 50], [50, 50]):
        assert np.isfinite(jacobian([0, 0, *beta, 0, 0]).full()).all()


@given(robots_with_q())
def test_tangents_are_unit_vectors_along_the_points_differences(case):
    robot, q = case
    beta = robot.split(q)[1]
    corners = [*beta, *(b - tube.curved_length for b, tube in zip(beta, robot.tubes, strict=True))]
    h = 1e-5 * beta[-1]
    s = SIGMA[1:-1] * beta[-1]
    s = s[np.abs(s[:, None] - corners).min(axis=1) > 2 * h]
    t = tangents(robot, q[None], s / beta[-1])[0]
    ahead, behind = shapes(robot, q[None], (s + h) / beta[-1])[0], shapes(robot, q[None], (s - h) / beta[-1])[0]
    np.testing.assert_allclose(t, (ahead - behind) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1, atol=1e-12)


@given(numbers(-3, 3), numbers(-3, 3))
def test_tilt_is_a_rotation_about_x_and_then_about_the_fixed_y(theta_x, theta_y):
    robot = lone(0.0)
    tip = shapes(robot, np.array([[0, 100, theta_x, theta_y]]), np.ones(1))[0, 0]
    about_x = np.array([0, -math.sin(theta_x), math.cos(theta_x)])
    c, s = math.cos(theta_y), math.sin(theta_y)
    np.testing.assert_allclose(tip, 100 * np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ about_x, atol=1e-12)


def test_tilt_turns_the_bending_plane_with_the_base():
    robot = lone(0.01)
    q = np.array([0.5, 100, 0.7, -1.1])
    rotation = Rotation.from_euler("xy", q[2:]).as_matrix()
    upright = shapes(robot, np.array([[0.5, 100, 0, 0]]))[0]
    np.testing.assert_allclose(shapes(robot, q[None])[0], upright @ rotation.T, atol=1e-11)


@given(robots_with_q())
def test_symbols_and_numbers_agree(case):
    robot, q = case
    symbol = ca.SX.sym("q", len(q))
    shape = dominant.backbone(robot.tube_numbers, ca.vertsplit(symbol), ca.DM(SIGMA), ca)
    function = ca.Function("f", [symbol], [ca.horzcat(*shape.points), ca.horzcat(*shape.tangents)])
    points, directions = (value.full() for value in function(q))
    np.testing.assert_allclose(points, shapes(robot, q[None], SIGMA)[0], atol=1e-10)
    np.testing.assert_allclose(directions, tangents(robot, q[None], SIGMA)[0], atol=1e-12)


@given(robots_with_q(), numbers(-7, 7))
def test_turning_every_tube_turns_the_shape(case, angle):
    robot, q = case
    q[-2:] = 0
    turned = q.copy()
    turned[: robot.d] += angle
    rotation = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    np.testing.assert_allclose(
        shapes(robot, turned[None], SIGMA)[0], shapes(robot, q[None], SIGMA)[0] @ rotation.T, atol=1e-9
    )


@given(robots_with_q(), st.data())
def test_a_full_turn_of_one_axis_changes_nothing(case, data):
    robot, q = case
    angles = [*range(robot.d), 2 * robot.d, 2 * robot.d + 1]
    turned = q.copy()
    turned[data.draw(st.sampled_from(angles))] += 2 * math.pi
    np.testing.assert_allclose(shapes(robot, turned[None]), shapes(robot, q[None]), atol=1e-9)


QUADRATURE = 1e-9
"""mm by which a step of some 0.03 mm may be off: where curvature is linear, travel is found by six Gauss nodes.
On a tube of 69 mm that turns by 1.6 rad steps are off by 3e-11 mm beside the exact integral, its tip by 5e-9."""


@given(robots_with_q())
def test_the_polyline_through_the_shape_is_as_long_as_beta_d(case):
    robot, q = case
    points = shapes(robot, q[None], np.linspace(0, 1, 2001))[0]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    beta_d = robot.split(q)[1][-1]
    largest = max(max(abs(tube.root_curvature), tube.tip_curvature) for tube in robot.tubes)
    shortfall = beta_d / 2000 - steps
    assert shortfall.min() > -QUADRATURE
    assert shortfall.max() <= (beta_d / 2000) ** 3 * largest**2 / 24 * 1.01 + QUADRATURE


@given(robots(least=2, most=3), st.data())
def test_points_are_c1_in_beta_where_a_sample_crosses_a_joint(robot, data):
    """One-sided differences with respect to every beta agree at a sample that lies on the first joint."""
    d = robot.d
    q = np.zeros(2 * d + 2)
    q[:d] = [data.draw(numbers(-3, 3)) for _ in range(d)]
    q[d : 2 * d] = np.linspace(0.4, 0.9, d) * [tube.curved_length for tube in robot.tubes]
    assume((np.diff(q[d : 2 * d]) > 1).all())
    sigma, h = np.array([q[d] / q[2 * d - 1]]), 1e-4
    at = shapes(robot, q[None], sigma)[0]
    for i in range(d, 2 * d):
        step = np.zeros_like(q)
        step[i] = h
        right = (shapes(robot, (q + step)[None], sigma)[0] - at) / h
        left = (at - shapes(robot, (q - step)[None], sigma)[0]) / h
        np.testing.assert_allclose(right, left, atol=2e-4)


def profile(robot, beta, s):
    """k(s) by walking the segments: the first tube that reaches beyond s sets the curvature."""
    for tube, end in zip(robot.tubes, beta, strict=True):
        if s < end:
            return precurvature(tube, end - s)
    raise AssertionError("s is beyond the tip")


@given(robots_with_q())
def test_stepped_curvature_is_that_of_the_outermost_tube_present(case):
    robot, q = case
    beta = robot.split(q)[1]
    corners = [*beta, *(b - tube.curved_length for b, tube in zip(beta, robot.tubes, strict=True))]
    s = np.linspace(0, beta[-1], 97)[1:-1]
    s = s[np.abs(s[:, None] - corners).min(axis=1) > 1e-6]
    found = dominant.curvature(robot.tube_numbers, beta, s, heaviside, np)
    np.testing.assert_allclose(found, [profile(robot, beta, x) for x in s], atol=1e-14)


@pytest.mark.parametrize(
    ("beta", "expected"),
    [
        ((50, 107, 150), [1 / 130, 1 / 60, 1 / 80]),
        ((50, 50, 150), [1 / 130, 1 / 80, 1 / 80]),
        ((0, 100, 150), [1 / 60, 1 / 60, 1 / 80]),
        ((0, 0, 150), [1 / 80] * 3),
    ],
)
def test_hidden_tubes_show_no_curvature(robot, beta, expected):
    found = dominant.curvature(robot.tube_numbers, beta, np.array([25.0, 75, 125]), heaviside, np)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


@given(robots_with_q(varying=False))
def test_shape_curve_has_the_shapes_points_and_length(case):
    robot, q = case
    curve = shape_curve(robot, q)
    assert curve.length == robot.split(q)[1][-1]
    np.testing.assert_allclose(curve.point(SIGMA * curve.length), shapes(robot, q[None], SIGMA)[0], atol=1e-9)
