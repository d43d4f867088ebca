"""Plans beside bodies that are distance fields: within one, around another, saved and read again."""

from dataclasses import replace

import numpy as np
import pytest
from lumens import away_from_tube_ends

from ctr_nlp import Plan, Problem, curve_from_points, growing, solve_horizon, table_i_robot
from ctr_nlp.exceptions import OutputError, ProblemError
from ctr_nlp.paths.distance_field import BLOCK_NODES, DistanceField, make_grid
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.walls import Body

CELL = 0.8
LOW = np.array([-14.0, -14.0, -10.0])
COUNT = BLOCK_NODES * np.array([4, 4, 12]) + 5
BALL_CENTRE, BALL_RADIUS = np.array([5.0, 0.5, 30.0]), 4.0


def field(distance):
    to_grid = np.diag([1 / CELL, 1 / CELL, 1 / CELL, 1.0])
    to_grid[:3, 3] = 2 - LOW / CELL
    nodes = np.stack(np.meshgrid(*map(np.arange, COUNT), indexing="ij"), axis=-1)
    return DistanceField((make_grid(distance((nodes - 2) * CELL + LOW), to_grid),))


def ball(points):
    return BALL_RADIUS - np.linalg.norm(points - BALL_CENTRE, axis=-1)


def tube(points):
    return 6.0 - np.linalg.norm(points[..., :2], axis=-1)


@pytest.fixture(scope="module")
def problem():
    robot = table_i_robot()
    z = np.linspace(0, 60, 20)
    path = curve_from_points(np.column_stack([0.002 * z**2, 0 * z, z]))
    return Problem("beside", robot, growing(path, 12), lumen=None)


def solved(problem, *walls):
    return solve_horizon(replace(problem, walls=walls), model="dominant", starts=1)


def clearances(plan, distance):
    return distance(plan.shape) - outermost_tube_radii(plan.robot, plan.beta, SIGMA_GRID)


def test_the_robot_keeps_out_of_a_body(problem):
    free = solved(problem)
    assert free.wall is None
    assert clearances(free, lambda points: -ball(points)).min() < -0.5
    kept = solved(problem, Body("tumour", field(ball), keep_out=True, margin=0.5))
    least = clearances(kept, lambda points: -ball(points)).min()
    assert least > 0.5 - 0.15
    # Reported by the plan as well, less the margin.
    assert kept.clearance.min() == pytest.approx(least - 0.5, abs=0.05)
    assert kept.verdicts.within_wall.word != "not asked"


def test_the_nearest_of_two_bodies_counts(problem):
    walls = Body("lumen", field(tube)), Body("vessel", field(ball), keep_out=True)
    plan = solved(problem, *walls)
    expected = np.minimum(clearances(plan, tube), clearances(plan, lambda points: -ball(points)))
    # On the axis of the tube the distance has an edge, which a smooth field rounds off.
    off_axis = np.linalg.norm(plan.shape[..., :2], axis=-1) > 2 * CELL
    # Where an outer tube ends between two points, the first of them has the clearance of that end.
    off_axis &= away_from_tube_ends(plan)
    assert off_axis.sum() > 50
    np.testing.assert_allclose(plan.clearance[off_axis], expected[off_axis], atol=0.06)
    assert (plan.clearance <= expected + 0.06).all()


def test_every_wall_is_judged_and_a_body_admits_no_contact(problem):
    plan = solved(problem, Body("lung", field(tube)), Body("vessel", field(ball), keep_out=True, margin=0.5))
    assert plan.wall_clearance.shape == (12, 2, 101)
    np.testing.assert_array_equal(plan.clearance, plan.wall_clearance.min(axis=1))
    least = np.fmin(plan.wall_clearance, plan.wall_clearance_between).min(axis=(0, 2))

    def judged(*depths):
        """The verdict where the robot is so deep in the two walls, mm."""
        moved = {
            name: getattr(plan, name) - (least + np.array(depths))[:, None]
            for name in ("wall_clearance", "wall_clearance_between")
        }
        return replace(plan, **moved).verdicts.within_wall

    # Tissue gives a little, a margin does not.
    assert judged(0.4, -0.1).word != "no"
    assert judged(0.6, -0.1).word == "no"
    touched = judged(-1.0, 0.2)
    assert touched.word == "no"
    assert touched.why.startswith("vessel: the deepest contact within the margin of 0.5 mm is 0.20 mm")
    assert "lung: the least clearance is 1.00 mm" in touched.why
    back = plan.reversed()
    np.testing.assert_array_equal(back.wall_clearance, plan.wall_clearance[::-1])
    np.testing.assert_array_equal(back.wall_clearance_between[1:], plan.wall_clearance_between[::-1][:-1])


def test_walls_are_saved_with_a_plan(problem, tmp_path):
    plan = solved(problem, Body("tumour", field(ball), keep_out=True))
    plan.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again == plan
    assert [body.name for body in again.walls] == ["tumour"]
    content = dict(np.load(tmp_path / "plan.npz"))
    del content["walls_array_1"]
    np.savez(tmp_path / "damaged.npz", **content)
    with pytest.raises(OutputError, match="walls are damaged"):
        Plan.load(tmp_path / "damaged.npz")


def test_problems_with_walls_are_saved_and_described(problem, tmp_path):
    walled = replace(problem, walls=(Body("left lung", field(tube)), Body("aorta", field(ball), True, 2.0)))
    walled.save(tmp_path / "problem.npz")
    assert Problem.load(tmp_path / "problem.npz") == walled
    assert "inside left lung, outside of aorta" in repr(walled)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda problem: replace(problem, walls=("aorta",)), "a wall of a problem is 'aorta'"),
        (lambda problem: Body("aorta", field(ball), True, -1.0), "margin of the wall 'aorta' is -1"),
        (lambda problem: Body("aorta", None), "field of the wall 'aorta'"),
    ],
)
def test_what_is_no_wall_is_refused(problem, make, message):
    with pytest.raises(ProblemError, match=message):
        make(problem)
