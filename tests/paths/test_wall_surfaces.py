"""Walls as triangles for pictures."""

import numpy as np
import pytest

from ctr_nlp.paths.distance_field import DistanceField, make_grid
from ctr_nlp.paths.surface import Surface
from ctr_nlp.paths.wall_surfaces import merge_vertices, section_lines, wall_sections, walls_to_draw
from ctr_nlp.paths.walls import Body

RADIUS, LENGTH = 5.0, 60.0
AXIS = np.stack([np.zeros(61), np.zeros(61), np.linspace(0.0, LENGTH, 61)], axis=1)


def tube(places=121, sides=64):
    """An open cylinder around the z-axis."""
    z, angle = np.meshgrid(np.linspace(0.0, LENGTH, places), np.arange(sides) * 2 * np.pi / sides, indexing="ij")
    vertices = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z], axis=-1).reshape(-1, 3)
    here = np.arange(places * sides).reshape(places, sides)
    beside, ahead = np.roll(here, -1, axis=1), np.roll(here, -1, axis=0)
    across = np.roll(beside, -1, axis=0)
    one, other = np.stack([here, beside, ahead], -1)[:-1], np.stack([beside, across, ahead], -1)[:-1]
    return Surface(vertices, np.concatenate([one.reshape(-1, 3), other.reshape(-1, 3)]))


def body(name="airways", keep_out=False, surface=None):
    """A body of that surface; its field is that of a plane, which pictures do not use."""
    grid = make_grid(np.zeros((13, 13, 13)) + np.arange(13.0), np.eye(4))
    return Body(name, DistanceField((grid, grid)), keep_out, surface=tube() if surface is None else surface)


def test_a_surface_of_merged_vertices_lies_on_the_surface_and_faces_outwards():
    vertices, triangles = merge_vertices(tube().vertices, tube().triangles, 0.8)
    assert len(triangles) < 0.6 * len(tube().triangles)
    assert np.abs(np.linalg.norm(vertices[:, :2], axis=1) - RADIUS).max() < 0.05
    (wall,) = walls_to_draw((body(),), AXIS)
    normals, vertices = wall.normals, wall.vertices
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert ((normals[:, :2] * vertices[:, :2]).sum(axis=1) > 0.9 * RADIUS).all()
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    open_edges = vertices[np.unique(edges, axis=0)[count == 1]]
    assert count.max() == 2
    assert (np.minimum(open_edges[..., 2], LENGTH - open_edges[..., 2]) < 0.8).all()  # holes at the two ends alone


def test_sections_are_circles_at_right_angles_to_the_path():
    (wall,) = walls_to_draw((body(),), AXIS)
    pieces = wall_sections(wall, AXIS, 7.0)
    assert np.unique(pieces[..., 2].round(6)).tolist() == [7.0 * k for k in range(1, 9)]
    assert np.abs(np.linalg.norm(pieces[..., :2], axis=-1) - RADIUS).max() < 0.06
    one = section_lines(wall, AXIS[30:31], np.array([[0.0, 0.0, 1.0]]), 12.0)
    around = np.linalg.norm(one[:, 1] - one[:, 0], axis=1).sum()
    assert around == pytest.approx(2 * np.pi * RADIUS, rel=0.02)


def test_only_what_is_near_is_drawn():
    far = Surface(tube().vertices + np.array([80.0, 0.0, 0.0]), tube().triangles)
    near, again = walls_to_draw((body(), body("far", surface=far), body("vessel", True)), AXIS)
    assert (near.name, near.keep_out) == ("airways", False)
    assert (again.name, again.keep_out) == ("vessel", True)
    (half,) = walls_to_draw((body(),), AXIS[:1])
    assert half.vertices[:, 2].max() < 16.0


def test_a_body_that_is_known_as_a_field_alone_is_left_out():
    grid = make_grid(np.zeros((13, 13, 13)) + np.arange(13.0), np.eye(4))
    assert walls_to_draw((Body("field", DistanceField((grid, grid))),), AXIS) == []
