"""The wall near to points: closed forms, brute force, finite differences, and what clearance is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lumens import brute, wandering
from strategies import numbers, rigid_transforms, robots, seeds

from ctr_nlp import table_i_robot
from ctr_nlp.paths.lumen import Lumen, outermost_tube_index, tube_outer_radii
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.simulation import shapes

LENGTH, R = 80.0, 40.0


def straight():
    """Along z from the origin, its radius falling from 9 mm by 0.05 mm a mm."""
    s = np.linspace(0, LENGTH, 161)
    return Lumen(np.column_stack([0 * s, 0 * s, s, 9 - 0.05 * s]))


def bent(transform=None):
    """A circle of radius R about (R, 0, 0) in the zx-plane, from the origin; as wide as the straight one."""
    transform, s = np.eye(4) if transform is None else transform, np.linspace(0, LENGTH, 161)
    return Lumen(np.column_stack([moved(transform, on_circle(s, 0.0)), 9 - 0.05 * s]))


def moved(transform, points):
    return points @ transform[:3, :3].T + transform[:3, 3]


def on_circle(s, inwards, aside=0.0):
    """Points beside the bent lumen's path."""
    turn, r = np.asarray(s) / R, R - np.asarray(inwards)
    return np.stack([R - r * np.cos(turn), aside + 0 * turn, r * np.sin(turn)], axis=-1)


# The nearest place


@given(numbers(0, LENGTH), numbers(0, 8), numbers(-4, 4))
def test_beside_a_straight_path(z, away, turn):
    near = straight().project(np.array([away * np.cos(turn), away * np.sin(turn), z]))
    assert near.distance == pytest.approx(away, abs=1e-9)
    assert near.centre == pytest.approx([0, 0, z], abs=1e-9)
    assert near.radius == pytest.approx(9 - 0.05 * z, abs=1e-9)
    assert (near.length_before, near.length_after) == pytest.approx((z, LENGTH - z), abs=1e-9)
    assert near.tangent == pytest.approx([0, 0, 1])
    assert near.curvature_vector == pytest.approx(np.zeros(3), abs=1e-9)
    assert near.taper == pytest.approx(-0.05)


@given(rigid_transforms(), numbers(2, LENGTH - 2), numbers(-20, 20), numbers(-8, 8))
def test_beside_a_circle(transform, s, inwards, aside):
    """Its path bends towards the middle by 1/R; a mm along the tangent is more along the path inside of it."""
    near = bent(transform).project(moved(transform, on_circle(s, inwards, aside)))
    turn, centre = transform[:3, :3], on_circle(s, 0.0)
    tangent = np.array([np.sin(s / R), 0, np.cos(s / R)])
    assert near.distance == pytest.approx(np.hypot(inwards, aside), abs=1e-5)
    assert near.length_before == pytest.approx(s, abs=1e-2)
    assert near.radius == pytest.approx(9 - 0.05 * s, abs=1e-3)
    np.testing.assert_allclose(near.centre, moved(transform, centre), atol=1e-4)
    np.testing.assert_allclose(near.tangent, turn @ tangent, atol=1e-4)
    np.testing.assert_allclose(near.curvature_vector, turn @ ([R, 0, 0] - centre) / R**2, atol=1e-4)
    assert near.taper == pytest.approx(-0.05 / (1 - inwards / R), rel=1e-3)


@given(numbers(0.1, 30), numbers(-8, 8), st.booleans())
def test_beyond_an_end_the_end_is_nearest(beyond, aside, at_tip):
    z = LENGTH + beyond if at_tip else -beyond
    near = straight().project(np.array([aside, 0, z]))
    assert near.distance == pytest.approx(np.hypot(beyond, aside))
    assert near.centre == pytest.approx([0, 0, LENGTH * at_tip])
    assert near.radius == pytest.approx(5 if at_tip else 9)
    assert (near.length_before, near.length_after) == ((LENGTH, 0) if at_tip else (0, LENGTH))


def test_the_ends_themselves():
    for lumen in (straight(), bent()):
        near = lumen.project(lumen.table[[0, -1], :3])
        np.testing.assert_allclose(near.distance, 0, atol=1e-9)
        np.testing.assert_allclose(near.radius, [9, 5])
        np.testing.assert_allclose(near.length_before, [0, LENGTH], atol=1e-3)
        np.testing.assert_allclose(near.length_after, [LENGTH, 0], atol=1e-3)


def test_points_that_are_not_known_are_near_to_nothing():
    """Others keep their places; two axes of points stay two."""
    points = np.array([[[1.0, 0, 10], [np.nan, 0, 10]], [[0, np.inf, 10], [0, 2, 20]]])
    near = straight().project(points)
    np.testing.assert_allclose(near.distance, [[1, np.nan], [np.nan, 2]], atol=1e-9)
    assert near.centre.shape == (2, 2, 3)
    for name in ("distance", "centre", "tangent", "curvature_vector"):
        assert np.isnan(getattr(near, name)[0, 1]).all()


@given(seeds)
def test_no_point_of_any_path_is_nearer(seed):
    """Of points well within the tightest bend's radius, 20 mm."""
    curve, rng = wandering(seed), np.random.default_rng(seed)
    s = rng.uniform(0, curve.length, 40)
    points = curve.point(s) + rng.normal(0, 3, (40, 3))
    near = Lumen.from_curve(curve).project(points)
    distance, place = brute(curve, points)
    np.testing.assert_allclose(near.distance, distance, atol=1e-5)
    np.testing.assert_allclose(near.radius, curve.radius(place), atol=5e-4)


@given(seeds)
def test_a_step_along_the_tangent_changes_the_radius_by_the_taper(seed):
    curve, rng = wandering(seed), np.random.default_rng(seed)
    lumen, s, h = Lumen.from_curve(curve), rng.uniform(8, curve.length - 8, 20), 1e-3
    points = curve.point(s) + rng.normal(0, 2, (20, 3))
    near = lumen.project(points)
    inside = (near.length_before > 1) & (near.length_after > 1)
    ahead, behind = (lumen.project(points + step * near.tangent).radius for step in (h, -h))
    np.testing.assert_allclose(near.taper[inside], ((ahead - behind) / (2 * h))[inside], atol=1e-4)


def test_a_curves_lumen_has_its_points_and_radii():
    curve = wandering(1)
    table = Lumen.from_curve(curve).table
    np.testing.assert_allclose(table[[0, -1], :3], curve.point(np.array([0, curve.length])), atol=1e-9)
    assert np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1).max() <= 0.5
    np.testing.assert_allclose(table[:, 3], curve.radius(np.linspace(0, curve.length, len(table))))


# What is left to the wall


def present(beta, s):
    """The outermost tube at an arc length, from 0: the first that reaches it."""
    return next(i for i, end in enumerate(beta) if s <= end + 1e-9)


@given(robots(), seeds)
def test_the_outermost_tube_is_the_first_that_reaches_there(robot, seed):
    rng = np.random.default_rng(seed)
    beta = np.sort(rng.uniform(0, robot.upper[robot.d : 2 * robot.d]).clip(max=robot.upper[robot.d]))
    expected = [present(beta, s) for s in SIGMA_GRID * beta[-1]]
    np.testing.assert_array_equal(outermost_tube_index(beta[None], SIGMA_GRID)[0], expected)


@pytest.mark.parametrize(
    ("beta", "tubes"),
    [
        ((50, 75, 100), [0, 0, 0, 1, 2]),
        ((0, 75, 100), [0, 1, 1, 1, 2]),
        ((50, 50, 100), [0, 0, 0, 2, 2]),
        ((100, 100, 100), [0, 0, 0, 0, 0]),
        ((0, 0, 100), [0, 2, 2, 2, 2]),
        ((0, 0, 0), [0, 0, 0, 0, 0]),
    ],
)
def test_a_tube_is_there_up_to_its_very_end(beta, tubes):
    assert outermost_tube_index(np.array([beta], dtype=float), np.linspace(0, 1, 5))[0].tolist() == tubes


def test_ends_at_samples_are_found_whatever_the_rounding():
    """sigma beta_3 = beta_1 in exact numbers, for lengths that floats miss."""
    length = np.linspace(0.1, 150, 997)
    beta = np.column_stack([length * 0.07, length * 0.58, length])
    tubes = outermost_tube_index(beta, SIGMA_GRID)
    assert (tubes[:, [7, 8, 58, 59]] == [0, 1, 1, 2]).all()


@given(seeds)
def test_clearance_is_lumen_radius_less_distance_less_tube_at_every_sample(seed):
    robot, rng, curve = table_i_robot(), np.random.default_rng(seed), wandering(seed)
    q = np.concatenate([rng.uniform(-3, 3, (2, 3)), np.sort(rng.uniform(0, 50, (2, 3))), np.zeros((2, 2))], axis=1)
    shape = shapes(robot, q)
    found = Lumen.from_curve(curve).clearance(robot, q[:, 3:6], SIGMA_GRID, shape)
    for j in range(2):
        distance, place = brute(curve, shape[j])
        radii = [robot.tubes[present(q[j, 3:6], s)].outer_diameter / 2 for s in SIGMA_GRID * q[j, 5]]
        np.testing.assert_allclose(found[j], curve.radius(place) - distance - radii, atol=5e-3)


def test_clearance_of_frames_that_are_not_known_is_not():
    robot = table_i_robot()
    shape = np.stack([np.outer(60 * SIGMA_GRID, [0, 0, 1]), np.full((101, 3), np.nan)])
    beta = np.array([[10.0, 30, 60], [np.nan, np.nan, np.nan]])
    found = straight().clearance(robot, beta, SIGMA_GRID, shape)
    assert np.isnan(found[1]).all()
    assert found[0, 0] == pytest.approx(9 - tube_outer_radii(robot)[0])
    assert found[0, -1] == pytest.approx(9 - 0.05 * 60 - tube_outer_radii(robot)[2])
