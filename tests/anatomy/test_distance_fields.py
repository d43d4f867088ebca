"""Walls made from masks, beside the formulas of the bodies that the masks were made from."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctr_nlp.anatomy.distance_fields import field_of_mask
from ctr_nlp.exceptions import CurveError

pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')

TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()


def cylinder(points, radius=3.0):
    return radius - np.linalg.norm((points @ TURN)[..., :2], axis=-1)


def bent_tube(points, radius=2.5):
    x, y, z = np.moveaxis(points @ TURN, -1, 0)
    return radius - np.hypot(np.hypot(x + 25.0, z) - 25.0, y)


def ball(points, radius=4.0):
    return radius - np.linalg.norm(points, axis=-1)


def ellipse_tube(points, wide=4.0, narrow=2.5):
    """Distance from a tube of elliptic section: Newton's method for the nearest point of the ellipse."""
    x, y = np.moveaxis(abs((points @ TURN)[..., :2]), -1, 0)
    angle = np.arctan2(wide * y, narrow * x)
    for _ in range(25):
        cosine, sine = np.cos(angle), np.sin(angle)
        ahead, aside = wide * cosine - x, narrow * sine - y
        slope = narrow * cosine * aside - wide * sine * ahead
        bend = (wide * sine) ** 2 + (narrow * cosine) ** 2 - wide * cosine * ahead - narrow * sine * aside
        angle = np.clip(angle - slope / np.maximum(abs(bend), 1e-9), 0, np.pi / 2)
    away = np.hypot(wide * np.cos(angle) - x, narrow * np.sin(angle) - y)
    return np.where((x / wide) ** 2 + (y / narrow) ** 2 < 1, away, -away)


HALF_SIDES = np.array([4.0, 3.0, 5.0])


def box(points):
    beyond = abs(points @ TURN) - HALF_SIDES
    return -np.linalg.norm(np.maximum(beyond, 0), axis=-1) - np.minimum(beyond.max(axis=-1), 0)


def two_that_meet(points):
    """A cylinder through a ball: the distance outside, and a lower bound of it inside."""
    return np.maximum(cylinder(points), ball(points + np.array([0.0, 0.0, 1.0]), 5.0))


def made(distance, spacing, seed):
    """The field of a body's mask, whose voxels lie anywhere and whose axes are turned."""
    rng = np.random.default_rng(seed)
    axes = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    count = np.ceil(22.0 / np.array(spacing)).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = axes * spacing
    affine[:3, 3] = affine[:3, :3] @ (rng.uniform(-0.5, 0.5, 3) - count / 2)
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    return field_of_mask(distance(index @ affine[:3, :3].T + affine[:3, 3]) > 0, affine), rng


@pytest.mark.parametrize("spacing", [(0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (0.4, 0.4, 1.6)], ids=str)
@pytest.mark.parametrize("body", [cylinder, bent_tube, ball, ellipse_tube])
def test_distances_are_within_a_third_of_a_voxel_and_unbiased(body, spacing):
    field, rng = made(body, spacing, 1)
    points = rng.uniform(-6, 6, (40000, 3))
    # Within a mm of the wall, and away from the axes, where the distance itself has an edge.
    points = points[abs(body(points)) < 1.0]
    error = (field.evaluate(points)[0] - body(points)) / max(spacing)
    middle, most = np.percentile(abs(error), [50, 99])
    assert middle < 0.1
    assert most < 0.3
    assert abs(error.mean()) < 0.05


@pytest.mark.parametrize("spacing", [(0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (0.4, 0.4, 1.6)], ids=str)
def test_faces_of_a_box_are_unbiased_and_its_edges_are_rounded_to_the_safe_side(spacing):
    field, rng = made(box, spacing, 1)
    points = rng.uniform(-6, 6, (40000, 3))
    points = points[abs(box(points)) < 1.0]
    error = (field.evaluate(points)[0] - box(points)) / max(spacing)
    # A mask cannot tell a sharp edge from a rounded one. So faces are compared two voxels away from edges, where
    # the second largest coordinate is well within the box; at the edges the lumen may only become narrower.
    second = np.sort(abs(points @ TURN) - HALF_SIDES, axis=1)[:, 1]
    faces = abs(error[second < -2 * max(spacing)])
    assert np.median(faces) < 0.1
    assert np.percentile(faces, 99.9) < 0.3
    assert error.max() < 0.3


def test_lumens_that_meet_open_into_each_other():
    field, rng = made(two_that_meet, (0.5, 0.5, 0.5), 3)
    points = rng.uniform(-6, 6, (20000, 3))
    truth = two_that_meet(points)
    found = field.evaluate(points)[0]
    # Half a millimetre, a voxel, from the surface nothing is on the wrong side of it.
    assert (found[truth > 0.5] > 0).all()
    assert (found[truth < -0.5] < 0).all()


def test_far_from_the_wall_the_field_is_still_the_distance():
    field, rng = made(ball, (0.6, 0.6, 0.6), 2)
    points = rng.normal(size=(2000, 3))
    points *= rng.uniform(6, 22, (2000, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(field.evaluate(points)[0], ball(points), atol=0.9)


def test_a_mask_without_a_wall_is_refused():
    with pytest.raises(CurveError, match="no voxel"):
        field_of_mask(np.zeros((5, 5, 5), bool), np.eye(4))
