"""Distances to walls of all kinds beside those of the library, and the way that files hold them."""

import json

import numpy as np
import pytest

from ctr_nlp.anatomy.distance_fields import field_of_mask
from ctr_nlp.check.walls import LumenWall, read_wall
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.walls import Body, nearest_of
from ctr_nlp.plan.plan_data import pack_walls

CLOSE_MM = 1e-4
SPACING_MM = 0.7


@pytest.fixture(scope="module")
def field():
    """The distance field of a bent tube in a mask: a fine grid in blocks near its wall, and a coarse one."""
    x, y, z = np.indices((26, 22, 40))
    lumen = np.hypot(x - 9 - 0.005 * z**2, y - 11) < 6
    affine = np.diag([SPACING_MM, SPACING_MM, SPACING_MM, 1.0])
    affine[:3, 3] = -6, -8, 0
    return field_of_mask(lumen, affine)


def arrays_of(bodies):
    """The arrays and meta of a file that holds these bodies."""
    meta, arrays = pack_walls(bodies)
    return arrays, json.loads(json.dumps(meta))


def places(count=4000):
    random = np.random.default_rng(0)
    near = random.uniform([-6, -8, 0], [12, 8, 28], (count, 3))
    return np.concatenate([near, random.uniform(-90, 120, (count // 8, 3))])


@pytest.mark.parametrize("keep_out", [False, True])
def test_distance_to_a_mask_is_that_of_its_field(keep_out, field):
    assert len(field.grids) == 2
    body = Body("mask", field, keep_out, margin=0.25)
    near = body.project(places())
    found = read_wall(*arrays_of((body,))).left(places())
    np.testing.assert_allclose(found, near.radius - near.distance, atol=CLOSE_MM)


def test_moved_bodies_are_read_where_they_are(field):
    turn = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 5], [0, 0, 0, 1]])
    body = Body("mask", field).apply_transform(turn)
    near = body.project(places())
    np.testing.assert_allclose(
        read_wall(*arrays_of((body,))).left(places()), near.radius - near.distance, atol=CLOSE_MM
    )


def test_nearest_wall_counts_and_lumen_only_beside_bodies_to_avoid(field):
    z = np.linspace(0, 30, 61)
    table = np.stack([0.01 * z**2, 0 * z, z, 5 + 0.05 * z], axis=-1)
    inside, outside = Body("a", field), Body("b", field, keep_out=True)
    points = places(400)[:400]
    for bodies in ((inside,), (outside,), (inside, outside)):
        near = nearest_of(Lumen(table), bodies).project(points)
        arrays, meta = arrays_of(bodies)
        found = read_wall(arrays | {"lumen": table}, meta).left(points)
        np.testing.assert_allclose(found, near.radius - near.distance, atol=5e-3)
    assert read_wall({}, {}) is None


def test_repeated_points_of_a_path_do_no_harm():
    table = np.array([[0.0, 0, 0, 4], [0, 0, 0, 4], [0, 0, 10, 5]])
    assert LumenWall(table).left(np.array([[1.0, 0, 5.0]])) == pytest.approx([3.5])
