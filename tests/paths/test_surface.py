"""Distances from surfaces of triangles, beside a search over all of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctr_nlp.paths.surface import Surface, triangle_distances_squared


def ball(count=12, radius=3.0):
    """A ball of triangles: rings of latitude."""
    polar, turn = np.linspace(0, np.pi, count), np.linspace(0, 2 * np.pi, 2 * count, endpoint=False)
    points = radius * np.stack(
        [
            np.outer(np.sin(polar), np.cos(turn)),
            np.outer(np.sin(polar), np.sin(turn)),
            np.repeat(np.cos(polar)[:, None], 2 * count, axis=1),
        ],
        axis=-1,
    )
    here = np.arange(count * 2 * count).reshape(count, -1)
    beside, ahead, across = np.roll(here, -1, axis=1)[:-1], here[1:], np.roll(here, -1, axis=1)[1:]
    triangles = np.stack([here[:-1], beside, ahead, beside, across, ahead], axis=-1).reshape(-1, 3)
    return Surface(points.reshape(-1, 3).astype(np.float32), triangles.astype(np.int32))


def sampled(point, a, b, c, count=200):
    """Least distance of a point from a dense sample of a triangle."""
    v, w = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    inside = v + w <= 1 + 1e-12
    at = a + v[inside][:, None] * (b - a) + w[inside][:, None] * (c - a)
    return np.linalg.norm(at - point, axis=1).min()


@given(st.integers(0, 10**6))
def test_distance_from_one_triangle(seed):
    point, a, b, c = np.random.default_rng(seed).uniform(-2, 2, (4, 3))
    found = np.sqrt(triangle_distances_squared(point, a, b, c))
    assert found <= sampled(point, a, b, c) + 1e-9
    assert found == pytest.approx(sampled(point, a, b, c), abs=0.03)


@given(st.integers(0, 10**6))
def test_nearest_triangle_is_the_nearest_of_all(seed):
    surface = ball()
    points = np.random.default_rng(seed).uniform(-5, 5, (40, 3))
    corners = surface.vertices[surface.triangles].astype(float)
    every = triangle_distances_squared(points[:, None], *np.moveaxis(corners, 1, 0))
    found, least = surface.distances(points), np.sqrt(every.min(axis=1))
    assert (found >= least - 1e-6).all()
    # Beside the slivers at the poles the nearest triangle touches none of the nearest vertices.
    np.testing.assert_allclose(found, least, atol=0.02)


def test_points_that_are_not_known_have_no_distance():
    found = ball().distances(np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 5.0]]))
    assert found[0] == pytest.approx(3, abs=0.15)
    assert np.isnan(found[1])
    assert found[2] == pytest.approx(2, abs=1e-6)
    assert ball().distances(np.zeros((0, 3))).shape == (0,)
