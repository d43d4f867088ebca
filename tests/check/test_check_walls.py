"""Distances to walls of all kinds beside those of the library, and the way that files hold them."""

import json

import numpy as np
import pytest

from ctr_nlp.anatomy.distance_fields import field_of_mask
from ctr_nlp.check.walls import LumenWall, Triangles, measure_clearance, read_walls
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.surface import Surface
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
    (wall,) = read_walls(*arrays_of((body,)))
    found = wall.left(places())
    np.testing.assert_allclose(found, near.radius - near.distance, atol=CLOSE_MM)


def test_moved_bodies_are_read_where_they_are(field):
    turn = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 5], [0, 0, 0, 1]])
    body = Body("mask", field).apply_transform(turn)
    near = body.project(places())
    (wall,) = read_walls(*arrays_of((body,)))
    np.testing.assert_allclose(wall.left(places()), near.radius - near.distance, atol=CLOSE_MM)


def test_nearest_wall_counts_and_lumen_only_beside_bodies_to_avoid(field):
    z = np.linspace(0, 30, 61)
    table = np.stack([0.01 * z**2, 0 * z, z, 5 + 0.05 * z], axis=-1)
    inside, outside = Body("a", field), Body("b", field, keep_out=True)
    points = places(400)[:400]
    for bodies in ((inside,), (outside,), (inside, outside)):
        near = nearest_of(Lumen(table), bodies).project(points)
        arrays, meta = arrays_of(bodies)
        walls = read_walls(arrays | {"lumen": table}, meta)
        # The lumen, which comes last, is no body to keep out of.
        assert [wall.kept_out for wall in walls] == [body.keep_out for body in bodies] + [False] * (
            inside not in bodies
        )
        found = measure_clearance(walls, points[:, None], np.zeros((len(points), 1)), known=-np.inf)[:, 0]
        np.testing.assert_allclose(found, near.radius - near.distance, atol=5e-3)
    assert read_walls({}, {}) == []


def test_nearest_place_may_lie_between_points_far_apart():
    back = np.linspace(100, 0, 101)
    there = [[0.0, 0, -1, 4], [0, 0, 0, 4], [0, 0, 100, 4]]
    crossing = np.stack([0 * back + 20, 0 * back, back, 0 * back + 9], axis=-1)
    left = LumenWall(np.concatenate([there, crossing])).left(np.array([[6.0, 0, 50.0]]))
    assert left == pytest.approx([4.0 - 6.0])


def test_repeated_points_of_a_path_do_no_harm():
    table = np.array([[0.0, 0, 0, 4], [0, 0, 0, 4], [0, 0, 10, 5]])
    assert LumenWall(table).left(np.array([[1.0, 0, 5.0]])) == pytest.approx([3.5])


def test_distance_to_triangles_is_that_of_vtk(field):
    pyvista = pytest.importorskip("pyvista")
    mesh = pyvista.ParametricTorus(ringradius=9, crosssectionradius=4).triangulate().clean()
    mesh = mesh.compute_normals(auto_orient_normals=True, cell_normals=False, split_vertices=False)
    points = np.random.default_rng(1).uniform(-14, 14, (600, 3)) * [1, 1, 0.5]
    found = Triangles(mesh.points, mesh.regular_faces).signed_distance(points)
    vtk = pyvista.PolyData(points).compute_implicit_distance(mesh)["implicit_distance"]
    np.testing.assert_allclose(abs(found), abs(vtk), atol=1e-4)
    clear = abs(vtk) > 1e-3
    np.testing.assert_array_equal(
        np.sign(found[clear]), np.sign(4 - np.hypot(np.hypot(points[:, 0], points[:, 1]) - 9, points[:, 2])[clear])
    )


def test_small_and_large_triangles_together_are_measured_exactly():
    """A cube of twelve large triangles beside a fine patch upon it."""
    corner = np.array([[x, y, z] for x in (0, 8) for y in (0, 8) for z in (0, 8)], dtype=float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    large = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])
    fine = np.linspace(2, 4, 9)
    x, y = np.meshgrid(fine, fine, indexing="ij")
    patch = np.stack([x, y, np.full_like(x, 8.0)], axis=-1).reshape(-1, 3)
    k = 8 + np.arange(81).reshape(9, 9)
    one = np.stack([k[:-1, :-1], k[1:, :-1], k[1:, 1:]], -1).reshape(-1, 3)
    other = np.stack([k[:-1, :-1], k[1:, 1:], k[:-1, 1:]], -1).reshape(-1, 3)
    surface = Triangles(np.concatenate([corner, patch]), np.concatenate([large, one, other]))
    points = np.random.default_rng(2).uniform(-3, 11, (500, 3))
    beyond = np.maximum(np.maximum(-points, points - 8), 0)
    outside = np.linalg.norm(beyond, axis=1)
    inside = np.minimum(points, 8 - points).min(axis=1)
    np.testing.assert_allclose(surface.signed_distance(points), np.where(outside > 0, -outside, inside), atol=1e-9)


@pytest.mark.parametrize("keep_out", [False, True])
def test_bodies_are_measured_at_their_triangles_where_they_have_some(field, keep_out):
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0], [0, 0, 14]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    points = places(40)[:40]
    inside = Triangles(corners, triangles).signed_distance(points)
    smooth, sharp = (
        read_walls(*arrays_of((Body("mask", field, keep_out, margin=0.25, surface=surface),)))[0]
        for surface in (None, Surface(corners, triangles))
    )
    np.testing.assert_array_equal(smooth.left_exactly(points), smooth.left(points))
    np.testing.assert_array_equal(sharp.left(points), smooth.left(points))
    np.testing.assert_allclose(sharp.left_exactly(points), (-inside if keep_out else inside) - 0.25, atol=1e-5)
