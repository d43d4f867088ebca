"""Errors of hand-made plans with known answers, and plan.npz."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from strategies import rigid_transforms, seeds

from ctr_nlp import Limits, Plan, Robot, table_i_robot
from ctr_nlp.exceptions import OutputError
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.metrics import by_frame, summary, tip_angle
from ctr_nlp.plan.plan import plan_from_configurations
from ctr_nlp.plan.simulation import shapes, tangents

LINE = np.outer(100 * SIGMA_GRID, [0, 0, 1.0])
ERRORS = ("e3", "e4", "e_max", "tip_max", "tip_angle_max_deg", "nearest_max")


def meta(robot):
    return {
        "problem": {"name": "made", "frames": 1, "duration": 1.0, "deviation": 0.0},
        "robot": robot.to_dict(),
        "formulation": "joint",
        "model": "dominant",
        "solver": "ipopt",
        "options": {},
        "snaps": [],
        "format": 1,
    }


def made(shape, target, q=None, dt=0.1, **changes):
    """A plan of the seed's robot with given shapes and targets (T, 101, 3) and q (T, 8)."""
    robot, count = table_i_robot(), len(shape)
    q = np.zeros((count, 8)) if q is None else np.asarray(q, dtype=float)
    up = np.tile([0, 0, 1.0], (count, 1))
    plan = Plan(
        time=dt * np.arange(1, count + 1),
        alpha=q[:, :3],
        beta=q[:, 3:6],
        theta=q[:, 6:],
        target=np.asarray(target),
        shape=np.asarray(shape),
        target_direction=up,
        tip_direction=up,
        solve_time=np.full(count, 0.02),
        success=np.isfinite(q).all(axis=1),
        objective=np.zeros(count),
        kkt=np.zeros(count),
        stability=np.full(count, np.nan),
        stability_between=np.full(count, np.nan),
        to_robot=np.eye(4),
        meta=meta(robot),
    )
    return replace(plan, **changes)


def aside(x=0.0, y=0.0, z=0.0):
    return LINE + np.array([x, y, z])


def shifted(*distances):
    """A plan whose frames' shapes stand aside of the target by these mm."""
    shape = [aside(distance) for distance in distances]
    return made(shape, [LINE] * len(distances))


def test_a_constant_offset_is_every_error_of_its_frame():
    columns = by_frame(shifted(3, 0.5))
    for name in ("e2", "max", "tip"):
        np.testing.assert_allclose(columns[name], [3, 0.5])


def test_e2_of_an_error_growing_from_base_to_tip_is_its_trapezoidal_mean():
    """The mean of sigma^2 by the trapezoidal rule on 100 cells is 1/3 + 1/60000."""
    plan = made([LINE + np.outer(SIGMA_GRID, [6, 0, 0])], [LINE])
    assert by_frame(plan)["e2"][0] == pytest.approx(6 * math.sqrt(1 / 3 + 1 / 60_000), rel=1e-12)


def test_an_error_at_one_end_counts_half_as_much_as_one_inside():
    """Trapezoidal weights: 1/200 at the tip, 1/100 inside."""
    inside, tip = LINE.copy(), LINE.copy()
    inside[50, 0], tip[100, 0] = 5, 5
    plan = made([inside, tip], [LINE] * 2)
    np.testing.assert_allclose(by_frame(plan)["e2"], [0.5, 0.5 / math.sqrt(2)])
    np.testing.assert_allclose(by_frame(plan)["max"], 5)
    np.testing.assert_allclose(by_frame(plan)["tip"], [0, 5])


def test_e3_is_the_root_mean_square_and_e4_the_median_over_frames():
    found = summary(shifted(1, 2, 3, 10))
    assert found["e3"] == pytest.approx(math.sqrt((1 + 4 + 9 + 100) / 4))
    assert found["e4"] == pytest.approx(2.5)
    assert found["e_max"] == found["tip_max"] == pytest.approx(10)


def test_nearest_sees_no_error_along_the_target():
    """A shape slid 8.4 mm along its target leaves it by that only beyond the end, the last 9 samples."""
    plan = made([aside(z=8.4)], [LINE])
    beyond, weights = np.arange(9) + 0.4, np.r_[np.full(8, 0.01), 0.005]
    assert by_frame(plan)["nearest"][0] == pytest.approx(math.sqrt(beyond**2 @ weights))
    assert by_frame(plan)["nearest_max"][0] == pytest.approx(8.4)
    assert by_frame(plan)["e2"][0] == pytest.approx(8.4)


def test_nearest_is_measured_to_the_line_between_targets_points():
    plan = made([aside(y=0.3, z=0.5)], [LINE])
    near = by_frame(plan)
    assert near["nearest_max"][0] == pytest.approx(math.hypot(0.3, 0.5))
    assert near["nearest"][0] == pytest.approx(math.sqrt(0.09 + 0.25 * 0.005), rel=1e-9)


def test_nearest_of_a_target_that_stands_still_is_the_distance_to_it():
    here, there = np.zeros((101, 3)), np.tile([3.0, 4, 0], (101, 1))
    assert by_frame(made([there], [here]))["nearest"][0] == pytest.approx(5)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, math.pi / 2, 3.0, math.pi])
def test_tip_angle_is_exact_from_tiny_to_opposite(angle):
    tip = np.array([[math.sin(angle), 0, math.cos(angle)]])
    plan = replace(shifted(0), tip_direction=tip)
    assert tip_angle(plan)[0] == pytest.approx(angle, rel=1e-9, abs=1e-15)


@given(rigid_transforms(), seeds)
def test_moving_shape_and_target_together_changes_no_error(transform, seed):
    rng = np.random.default_rng(seed)
    shape, target = LINE + rng.normal(0, 2, (2, 101, 3)), np.cumsum(rng.normal(0, 1, (2, 101, 3)), axis=1)
    tips = rng.normal(size=(2, 2, 3))
    rotation, shift = transform[:3, :3], transform[:3, 3]

    def errors(move, turn):
        plan = made(move(shape), move(target), target_direction=turn(tips[0]), tip_direction=turn(tips[1]))
        return {name: value for name, value in summary(plan).items() if name in ERRORS}

    still = errors(lambda x: x, lambda x: x)
    moved = errors(lambda x: x @ rotation.T + shift, lambda x: x @ rotation.T)
    assert moved == pytest.approx(still, rel=1e-8)


def test_frames_never_reached_are_left_out_but_counted():
    plan = shifted(1, 1, 3)
    shape, alpha = plan.shape.copy(), plan.alpha.copy()
    shape[2], alpha[2] = np.nan, np.nan
    success = np.array([True, True, False])
    found = summary(replace(plan, shape=shape, alpha=alpha, success=success))
    assert found["e3"] == found["e4"] == pytest.approx(1)
    assert found["e_max"] == pytest.approx(1)
    assert (found["frames"], found["failed"]) == (3, 1)
    assert found["roughness"] == 0


def test_a_plan_without_any_shape_has_no_errors_and_fits_strict_json():
    nothing = np.full((2, 101, 3), np.nan)
    found = summary(made(nothing, [LINE] * 2, q=np.full((2, 8), np.nan), solve_time=np.full(2, np.nan)))
    assert [found[name] for name in ERRORS] == [None] * len(ERRORS)
    assert found["failed"] == 2
    json.dumps(found, allow_nan=False)


def test_roughness_weighs_angles_by_ten_mm_per_radian_and_divides_by_dt():
    """Two steps: 0.1 rad and 2 mm, then 0.3 rad of tilt; dt = 0.1 s."""
    q = np.zeros((3, 8))
    q[1, [0, 5]] = 0.1, 2
    q[2, [0, 5, 7]] = 0.1, 2, 0.3
    found = summary(made([LINE] * 3, [LINE] * 3, q))
    assert found["roughness"] == pytest.approx((1 + 4 + 9) / 0.1)
    assert found["max_step"] == pytest.approx({"alpha": 0.1, "beta": 2, "theta": 0.3})


def test_roughness_of_a_linear_motion_does_not_depend_on_frames():
    """int |W q'|^2 dt over one second, between the first frame and the last."""
    found = [
        summary(made([LINE] * n, [LINE] * n, np.linspace(0, 1, n)[:, None] * np.ones(8), dt=1 / (n - 1)))
        for n in (11, 101)
    ]
    assert found[0]["roughness"] == pytest.approx(found[1]["roughness"])
    assert found[0]["roughness"] == pytest.approx(5 * 100 + 3)


def test_acceleration_used_is_a_part_of_the_limits():
    """beta_3 at 0, 0, 3 mm, 0.1 s apart, is 300 mm/s^2; of 600 that is a half."""
    q = np.zeros((3, 8))
    q[2, 5] = 3.0
    plan = made([LINE] * 3, [LINE] * 3, q)
    assert summary(plan)["acceleration_used"] == 0.0
    limited = Robot(plan.robot.tubes, Limits(beta_acceleration=600.0))
    plan = replace(plan, meta=plan.meta | {"robot": limited.to_dict()})
    assert summary(plan)["acceleration_used"] == pytest.approx(0.5)


def test_a_single_frame_has_no_roughness():
    assert summary(shifted(2))["roughness"] == 0


def test_solve_times_are_milliseconds_over_the_frames_that_have_them():
    plan = replace(shifted(0, 0, 0, 0), solve_time=np.array([0.01, 0.03, 0.02, np.nan]))
    assert summary(plan)["solve_ms"] == pytest.approx({"median": 20, "p99": 29.8, "total": 60})


# Plans of real configurations


@pytest.fixture
def plan(arc_problem):
    count = arc_problem.frames
    q = np.tile([0.1, 0.2, 0.3, 10, 20, 30, 0.05, -0.1], (count, 1)) * np.arange(1, count + 1)[:, None]
    given = {"success": np.array([True, True, False, True]), "solve_time": np.array([0.01, 0.02, np.nan, 0.04])}
    described = {"formulation": "joint", "model": "dominant", "solver": "ipopt", "options": {"seed": 3}}
    return plan_from_configurations(
        arc_problem, q, described, objective=np.ones(count), kkt=np.zeros(count), **given
    )


def test_a_plan_holds_the_shapes_and_targets_of_its_configurations(plan, arc_problem):
    robot = arc_problem.robot
    np.testing.assert_array_equal(plan.shape, shapes(robot, plan.q))
    np.testing.assert_array_equal(plan.tip_direction, tangents(robot, plan.q, np.ones(1))[:, 0])
    np.testing.assert_array_equal(plan.target[2], arc_problem.target_frames[2].points)
    np.testing.assert_allclose(plan.time, [2.5, 5, 7.5, 10])
    assert plan.dt == arc_problem.dt
    assert not plan.complete


def test_a_plan_survives_its_file(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    for field in fields(Plan):
        one, other = getattr(plan, field.name), getattr(again, field.name)
        np.testing.assert_equal(other, one, err_msg=field.name)
    assert again.robot.tubes == plan.robot.tubes


def test_a_plan_is_read_without_pickle_under_the_names_of_its_format(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz", allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    assert json.loads(str(arrays["meta"]))["format"] == 1
    sizes = {"time": (4,), "alpha": (4, 3), "beta": (4, 3), "theta": (4, 2), "target": (4, 101, 3)}
    sizes |= {"shape": (4, 101, 3), "success": (4,), "kkt": (4,), "stability": (4,), "to_robot": (4, 4)}
    assert {name: arrays[name].shape for name in sizes} == sizes
    assert arrays["success"].dtype == bool


def test_optional_arrays_survive_too(plan, tmp_path):
    full = replace(plan, lumen_radius=np.full((4, 101), 5.0), truth=plan.q)
    full.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    np.testing.assert_array_equal(again.lumen_radius, 5)
    np.testing.assert_array_equal(again.truth, plan.q)


def test_arrays_of_a_later_program_are_ignored(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz") as data:
        np.savez(tmp_path / "more.npz", colour=np.ones(3), **data)
    np.testing.assert_array_equal(Plan.load(tmp_path / "more.npz").q, plan.q)


WRONG = ["empty", "text", "torn zip", "binary"]


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 torn", bytes(range(256))], ids=WRONG)
def test_a_file_that_is_no_plan_is_refused_by_name(tmp_path, content):
    path = tmp_path / "wrong.npz"
    path.write_bytes(content)
    with pytest.raises(OutputError, match=r"wrong\.npz is not a plan"):
        Plan.load(path)


@pytest.mark.parametrize("kept", [0.2, 0.9, 0.999])
def test_a_plan_cut_short_is_refused(plan, tmp_path, kept):
    path = tmp_path / "plan.npz"
    plan.save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(OutputError, match="not a plan"):
        Plan.load(path)


def test_a_plan_with_damaged_bytes_is_refused(plan, tmp_path):
    path = tmp_path / "plan.npz"
    plan.save(path)
    content = bytearray(path.read_bytes())
    for start in range(200, len(content) - 2000, 997):
        content[start : start + 40] = bytes(40)
    path.write_bytes(content)
    with pytest.raises(OutputError, match="not a plan"):
        Plan.load(path)


def rewritten(plan, path, drop=(), **changes):
    plan.save(path)
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files if name not in drop}
    np.savez(path, **(arrays | changes))


@pytest.mark.parametrize(
    ("drop", "changes", "message"),
    [
        (("meta",), {}, "meta"),
        (("beta",), {}, "beta"),
        ((), {"meta": np.array("no json")}, "not a plan"),
        ((), {"meta": np.array("[1, 2]")}, "not a plan"),
        ((), {"meta": np.array("{}")}, "format"),
        ((), {"meta": np.array('{"format": 99}')}, "format 99"),
        ((), {"meta": np.array('{"format": 1}')}, "robot"),
        ((), {"alpha": np.zeros((3, 3))}, "alpha"),
    ],
)
def test_an_npz_that_is_no_plan_is_refused(plan, tmp_path, drop, changes, message):
    path = tmp_path / "other.npz"
    rewritten(plan, path, drop, **changes)
    with pytest.raises(OutputError, match=rf"other\.npz.*{message}"):
        Plan.load(path)


def test_an_npz_with_pickled_objects_is_refused(plan, tmp_path):
    path = tmp_path / "other.npz"
    plan.save(path)
    with np.load(path) as data:
        np.savez(path, **(dict(data) | {"time": np.array([object()], dtype=object)}))
    with pytest.raises(OutputError, match="not a plan"):
        Plan.load(path)


def test_a_missing_plan_is_refused(tmp_path):
    with pytest.raises(OutputError, match=r"nowhere\.npz"):
        Plan.load(tmp_path / "nowhere.npz")


def test_a_plan_that_cannot_be_written_leaves_nothing_behind(plan, tmp_path):
    (tmp_path / "plan.npz").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        plan.save(tmp_path / "plan.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]


def test_a_plan_in_a_folder_that_is_not_there_is_refused(plan, tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        plan.save(tmp_path / "nowhere" / "plan.npz")


def test_saving_replaces_an_older_plan(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    replace(plan, objective=np.full(4, 9.0)).save(tmp_path / "plan.npz")
    np.testing.assert_array_equal(Plan.load(tmp_path / "plan.npz").objective, 9)
    assert len(list(tmp_path.iterdir())) == 1
