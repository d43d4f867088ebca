"""Distances from surfaces of triangles, beside a search over all of them and beside formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.surface import Surface


def rings(points):
    """Triangles between rings (m, n, 3) of points, their normals pointing away from the axis."""
    here = np.arange(points[..., 0].size).reshape(points.shape[:2])
    beside, ahead, across = np.roll(here, -1, axis=1)[:-1], here[1:], np.roll(here, -1, axis=1)[1:]
    triangles = np.stack([here[:-1], beside, ahead, beside, across, ahead], axis=-1).reshape(-1, 3)
    return Surface(points.reshape(-1, 3), triangles)


def tube(radius=3.0, length=20.0, count=96):
    """A tube along z that is open at both ends."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    z = np.linspace(0, length, 41)[:, None] + 0 * angle
    return rings(np.stack([radius * np.cos(angle) + 0 * z, radius * np.sin(angle) + 0 * z, z], axis=-1))


def box(size):
    """A closed box of twelve large triangles around the origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return Surface(corners, np.array([[[a, b, c], [a, c, d]] for a, b, c, d in sides]).reshape(-1, 3))


def box_distance(points, size):
    """Signed distance from a box, positive inside."""
    away = np.abs(points) - size
    return -np.linalg.norm(np.maximum(away, 0), axis=1) - np.minimum(away.max(axis=1), 0)


@given(st.integers(0, 10**6))
def test_distance_from_a_box_of_large_triangles_is_exact(seed):
    rng = np.random.default_rng(seed)
    size = rng.uniform(1, 12, 3)
    points = rng.uniform(-15, 15, (200, 3))
    np.testing.assert_allclose(box(size).signed_distances(points), box_distance(points, size), atol=1e-5)


@given(st.integers(0, 10**6))
def test_distance_from_one_triangle_is_that_of_its_nearest_point(seed):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-5, 5, (3, 3)).astype(np.float32)
    points = rng.uniform(-8, 8, (30, 3))
    v, w = (each.ravel() for each in np.meshgrid(np.linspace(0, 1, 150), np.linspace(0, 1, 150)))
    kept = v + w <= 1 + 1e-12
    weights = np.stack([1 - v - w, v, w], axis=1)[kept]
    sampled = np.linalg.norm(points[:, None] - weights @ corners, axis=2).min(axis=1)
    found = np.abs(Surface(corners, [[0, 1, 2]]).signed_distances(points))
    assert (found <= sampled + 1e-6).all()
    np.testing.assert_allclose(found, sampled, atol=0.1)


def test_beyond_an_opening_the_surface_goes_on():
    found = tube().signed_distances(np.array([[0, 0, 10.0], [0, 0, -4.0], [0, 5.0, 10.0], [4.0, 0, 24.0]]))
    np.testing.assert_allclose(found, [3, 5, -2, -np.hypot(1, 4)], atol=0.01)


def test_quick_search_is_exact_on_even_triangles():
    rng = np.random.default_rng(2)
    points = rng.uniform([-5, -5, 0], [5, 5, 20], (2000, 3))
    surface = tube()
    np.testing.assert_allclose(
        surface.signed_distances(points, exact=False), surface.signed_distances(points), atol=0.01
    )


def test_a_mirrored_surface_keeps_its_inside():
    mirrored = box(np.array([2.0, 3.0, 4.0])).apply_transform(np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert mirrored.signed_distances(np.zeros((1, 3)))[0] == pytest.approx(2)


def test_points_that_are_not_known_have_no_distance():
    found = tube().signed_distances(np.array([[0, 0, 10.0], [np.nan, 0, 0]]))
    assert np.isfinite(found).tolist() == [True, False]
    assert tube().signed_distances(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3)), "m > 0"),
        (np.zeros((3, 3)), [[0, 1, 3]], "none of the 3"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "finite"),
    ],
)
def test_what_is_no_surface_is_refused(vertices, triangles, message):
    with pytest.raises(CurveError, match=message):
        Surface(vertices, triangles)
