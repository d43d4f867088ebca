"""Walls that are distance fields: C beside numpy, and formulas beside both."""

import casadi as ca
import numpy as np
import pytest
from distance_walls import BALL, TUBE, bent_tube
from hypothesis import given
from hypothesis import strategies as st

from ctr_nlp import table_i_robot
from ctr_nlp.codegen import cache
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.ocp.terms.lumen import room_beside_path
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.distance_field import BLOCK_NODES
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.walls import Walls

needs_compiler = pytest.mark.skipif(bool(cache.unavailable_reason()), reason="needs a C compiler")
WITHIN = {"dominant": 1e-9, "elastic": 2e-4}
"""mm by which the two may differ: the elastic model's equilibria are found to a tolerance."""
NEAR = st.integers(0, 10**6)


def points_near(seed, count=60):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 1.1, count)
    off = rng.uniform(-7, 7, (count, 2))
    return np.column_stack([(100 + off[:, 0]) * np.cos(angle) - 100, off[:, 1], (100 + off[:, 0]) * np.sin(angle)])


@given(NEAR)
def test_field_is_the_formula(seed):
    points = points_near(seed)
    near_wall = abs(bent_tube(points)) < 1.5
    found, slope, _ = TUBE.field.evaluate(points[near_wall])
    np.testing.assert_allclose(found, bent_tube(points[near_wall]), atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1.0, atol=0.05)


@given(NEAR)
def test_slopes_are_those_of_the_values(seed):
    points, h = points_near(seed, 20), 1e-5
    blocks = TUBE.field.grids[0].locate(points + h)[1]
    points = points[(blocks >= 0) & (blocks == TUBE.field.grids[0].locate(points - h)[1])]
    _, slope, bend = TUBE.field.evaluate(points)
    for k, step in enumerate(h * np.eye(3)):
        ahead, behind = TUBE.field.evaluate(points + step), TUBE.field.evaluate(points - step)
        np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * h), slope[:, k], atol=1e-6)
        np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * h), bend[:, k], atol=1e-4)


def test_second_derivatives_do_not_jump_between_cells_and_blocks():
    grid = TUBE.field.grids[0]
    rng = np.random.default_rng(0)
    places = rng.uniform(0, np.array(grid.index.shape) * BLOCK_NODES, (4000, 3))
    places[:, 0] = np.round(places[:, 0])
    back = np.linalg.inv(grid.to_grid)
    sides = [(places + np.array([step, 0, 0])) @ back[:3, :3].T + back[:3, 3] for step in (-1e-9, 1e-9)]
    both = (grid.locate(sides[0])[1] >= 0) & (grid.locate(sides[1])[1] >= 0)
    assert both.sum() > 500
    one, other = (TUBE.field.evaluate(side[both])[2] for side in sides)
    np.testing.assert_allclose(one, other, atol=1e-6)


def rooms_of_the_program(points, near):
    """Room at points (n, 3) as programs write it, and its slopes (n, 3), with the wall described near them."""
    columns = near.centre, near.tangent, near.bend
    numbers = near.room_on_path, near.taper, near.length_before, near.length_after, near.slope
    wall = np.column_stack([*columns, *numbers])
    p, about = ca.SX.sym("p", 3), ca.SX.sym("about", wall.shape[1])
    path = [ca.vertsplit(about[3 * k : 3 * k + 3]) for k in range(3)]
    written = room_beside_path(ca.vertsplit(p), path, ca.vertsplit(about[9:]))
    found = ca.Function("room", [p, about], [written, ca.jacobian(written, p)])
    rows = [found(*each) for each in zip(points, wall, strict=True)]
    return np.array([float(value) for value, _ in rows]), np.array([slope.full().ravel() for _, slope in rows])


@given(NEAR)
def test_programs_have_the_slopes_of_the_field(seed):
    """In the middle of a lumen, too, where a smoothed field is flat: taken for 1, its slope is far off there."""
    points = points_near(seed, 30)
    value, slope, _ = TUBE.field.evaluate(points)
    steep = np.linalg.norm(slope, axis=1)
    found, slopes = rooms_of_the_program(points, Walls(None, (TUBE,)).project(points))
    np.testing.assert_allclose(found, value, atol=0.01)
    np.testing.assert_allclose(slopes[steep > 0.01], slope[steep > 0.01], atol=1e-3)


def test_fields_are_flat_in_the_middle_of_a_lumen():
    middle = np.array([[100 * np.cos(0.5) - 100, 0.0, 100 * np.sin(0.5)]])
    assert np.linalg.norm(TUBE.field.evaluate(middle)[1]) < 0.9


@given(NEAR)
def test_path_near_a_point_has_the_wall_of_the_field(seed):
    """Value and slope of the lumen that stands for the wall are those of the field, at the point and beside it."""
    points = points_near(seed, 30)
    near = Walls(None, (TUBE, BALL)).project(points)
    distance = near.radius - near.distance
    np.testing.assert_allclose(
        distance, np.minimum(TUBE.field.evaluate(points)[0], -BALL.field.evaluate(points)[0] - 0.3), atol=1e-9
    )


@needs_compiler
@given(NEAR)
def test_c_evaluates_the_same_distance(seed):
    points = np.concatenate([points_near(seed), [[np.nan, 0, 0], [300.0, -200.0, 500.0]]])
    for walls in (
        Walls(None, (TUBE,)),
        Walls(None, (TUBE, BALL)),
        Walls(Lumen(np.column_stack([np.zeros((141, 2)), np.arange(141.0), np.full(141, 6.0)])), (BALL,)),
    ):
        near = walls.project(points)
        np.testing.assert_allclose(WallDistance(walls)(points), near.radius - near.distance, atol=1e-9)
        for name, found, expected in zip(near._fields, WallDistance(walls).project(points), near, strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=name)


@needs_compiler
@pytest.mark.parametrize("model", ["dominant", "elastic"])
def test_c_describes_the_same_wall_around_a_robot(model):
    robot, rng = table_i_robot(), np.random.default_rng(3)
    wall = Wall(robot, Walls(None, (TUBE, BALL)), KINEMATIC_MODELS[model], 30.0, 0.1)
    assert wall.compiled_wall.ready(wait=True)
    q = rng.uniform(np.maximum(robot.lower, -3), np.minimum(robot.upper, 100), (12, len(robot.axes)))
    q[:, robot.d : 2 * robot.d] = np.sort(q[:, robot.d : 2 * robot.d], axis=1)
    x = KINEMATIC_MODELS[model].guess(robot, q)
    (found, slack), (expected, needed) = wall.compiled_wall(x), wall.compute_local_wall(x)
    np.testing.assert_allclose(slack, needed, atol=WITHIN[model])
    # Where the wall is equally curved in all directions any tangent serves: only products with the bend count.
    tangents = slice(3, 6)
    curved = np.linalg.norm(expected[..., 6:9], axis=-1) > 1e-3
    np.testing.assert_allclose(
        np.delete(found, tangents, axis=-1), np.delete(expected, tangents, axis=-1), atol=5 * WITHIN[model]
    )
    one, other = found[curved][:, tangents], expected[curved][:, tangents]
    assert len(one) > 10
    np.testing.assert_allclose(abs((one * other).sum(axis=1)), 1.0, atol=1e-3)
