"""The eight named problems against their definitions."""

import json

import numpy as np
import pytest
from common import NAMES, named_problem

from ctr_nlp import Plan, curve_from_points
from ctr_nlp.paths.target import SIGMA_GRID


def test_the_problems_of_the_pages_are_there():
    assert {"arc", "bronchus", "cos", "euler", "euler_mixed", "line", "line_arc", "synthesis"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_targets_start_at_the_insertion_point_and_fit_the_robot(name):
    problem = named_problem(name, 7)
    assert problem.frames == 7
    for frame in problem.target_frames:
        assert np.abs(frame.points[0]).max() < 1e-6
        assert frame.length <= problem.robot.reach * 1.005


def test_cos_grows_by_its_parameter():
    points = named_problem("cos", 10).target_frames[4].points
    u = 45.45 * np.pi * 0.5
    assert points[-1] == pytest.approx([10 * np.cos(0.044 * u) - 10, 0, u], abs=1e-6)


def test_arc_has_its_radius_and_length():
    problem = named_problem("arc", 10)
    last = problem.target_frames[-1]
    assert last.length == pytest.approx(150, abs=1e-6)
    assert np.hypot(last.points[:, 0] + 100, last.points[:, 2]) == pytest.approx(np.full(101, 100), abs=1e-6)


def test_line_arc_is_tangent_continuous_and_bends_towards_minus_x():
    last = named_problem("line_arc", 2).target_frames[-1]
    angle = np.arctan2(last.tangents[:, 0], last.tangents[:, 2])
    assert angle[0] == pytest.approx(np.arctan(0.02))
    assert np.abs(np.diff(angle)).max() < 1.51 / 100
    assert angle[-1] == pytest.approx(np.arctan(0.02) - 0.75, abs=1e-6)


def test_euler_turns_as_its_curvature_says():
    last = named_problem("euler", 2).target_frames[-1]
    s = SIGMA_GRID * 150
    turned = s / 180 + (1 / 60 - 1 / 180) * s**2 / 300
    assert np.arctan2(last.tangents[:, 0], last.tangents[:, 2]) == pytest.approx(turned, abs=1e-6)


def test_synthesis_ends_where_the_seed_says():
    problem = named_problem("synthesis", 4)
    assert problem.truth is not None
    assert problem.truth[-1] == pytest.approx([np.pi] * 3 + [50, 107, 150] + [np.pi] * 2)
    assert problem.truth[1, 3:6] == pytest.approx([44, 88.5, 112.5])


def test_euler_mixed_has_a_straight_tube_an_arc_and_an_euler_tube():
    curvatures = [tube.curvature for tube in named_problem("euler_mixed", 2).robot.tubes]
    assert curvatures == [0.0, 1 / 80, (1 / 120, 1 / 60)]


def test_plan_keeps_the_transform_of_a_placed_path(tmp_path):
    """Target points carried back by the transform lie on the curve that was given."""
    from ctr_nlp import problem_from_file, solve_per_frame

    t = np.linspace(0, 1, 40)
    given = np.column_stack([50 + 80 * t, -20 + 20 * t**2, 300 - 60 * t])
    path = tmp_path / "path.csv"
    np.savetxt(path, given, delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    plan = solve_per_frame(problem_from_file(path, frames=2), model="dominant", direction="forward")
    plan.save(tmp_path / "plan.npz")
    loaded = Plan.load(tmp_path / "plan.npz")
    back = (loaded.target[-1] - loaded.to_robot[:3, 3]) @ loaded.to_robot[:3, :3]
    curve = curve_from_points(given)
    assert back == pytest.approx(curve.point(SIGMA_GRID * curve.length), abs=1e-6)
    assert json.dumps(loaded.meta)
