"""What a robot may be, and how it is written down."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from strategies import robots, robots_with_q

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.exceptions import RobotError

SEED_TOML = """
name = "the seed's"

[[tubes]]
length = 90
curved_length = 50
curvature = 0.0076923076923076923
outer_diameter = 5.7
inner_diameter = 4.3

[[tubes]]
length = 202
curved_length = 107
curvature = [0.01, 0.02]
outer_diameter = 3.7
inner_diameter = 2.9

[limits]
alpha = [-inf, 3.5]
beta = [[0, 50], [5, 107]]
theta_speed = inf
"""


def tube(**changes):
    plain = {"length": 100, "curved_length": 50, "curvature": 0.01, "outer_diameter": 2, "inner_diameter": 1}
    return Tube(**(plain | changes))


def pair(outer=None, inner=None, **limits):
    """Two tubes that fit, but for the changes."""
    first = {"length": 80, "outer_diameter": 4, "inner_diameter": 3} | (outer or {})
    return Robot((tube(**first), tube(**(inner or {}))), Limits(**limits))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"length": 0}, "length is 0 mm.*positive"),
        ({"length": -5, "curved_length": -6}, "length is -5 mm.*positive"),
        ({"length": math.nan}, "length is nan.*finite"),
        ({"length": math.inf}, "length is inf.*finite"),
        ({"length": "long"}, "length is 'long'.*number"),
        ({"length": None}, "length is None.*number"),
        ({"length": True}, "length is True.*number"),
        ({"length": [1, 2]}, "length is .1, 2.*number"),
        ({"curved_length": 101}, r"curved_length is 101 mm.*\[0, length = 100\]"),
        ({"curved_length": -1}, r"curved_length is -1 mm"),
        ({"curvature": -0.01}, "curvature is -0.01.*unsigned"),
        ({"curvature": (0.01, -0.01)}, "curvature is .*unsigned"),
        ({"curvature": (-0.01, 0.0)}, "curvature is .*unsigned.*at the root alone it may be negative"),
        ({"curvature": (-0.6, 0.01)}, "curvature 0.6 per mm is a radius of 1.7 mm"),
        ({"curvature": (0.01, 0.02, 0.03)}, "curvature is .*2 of them"),
        ({"curvature": (0.01, math.nan)}, "curvature is .*finite"),
        ({"inner_diameter": 2}, r"inner_diameter is 2 mm.*\[0, outer_diameter = 2\)"),
        ({"inner_diameter": -0.1}, "inner_diameter is -0.1 mm"),
        ({"poisson_ratio": 0.6}, r"poisson_ratio is 0.6.*\(-1, 0.5\]"),
        ({"poisson_ratio": -1}, "poisson_ratio is -1"),
        ({"youngs_modulus": 0}, "youngs_modulus is 0.*positive"),
    ],
)
def test_a_tube_that_cannot_be_is_refused(changes, message):
    with pytest.raises(RobotError, match=message):
        tube(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outer": {"inner_diameter": 1.9}}, "do not nest: inner_diameter of tube 1 is 1.9 mm.*tube 2 is 2 mm"),
        ({"outer": {"outer_diameter": 0.9, "inner_diameter": 0.5}}, "wrong order"),
        ({"outer": {"length": 101}}, "length of tube 1 is 101 mm and of tube 2 100 mm"),
        ({"alpha": (1, -1)}, r"alpha_1 are \[1, -1\]"),
        ({"alpha": (math.nan, 1)}, "alpha_1 are"),
        ({"theta": [(-1, 1), (2, 1)]}, r"theta_y are \[2, 1\]"),
        ({"theta": "wide"}, "limits of theta are 'wide'"),
        ({"beta": [(0, 50)] * 3}, "limits of beta are .*2 of them"),
        ({"beta": [(-1, 50), (0, 50)]}, r"beta_1 are \[-1, 50\] mm.*\[0,.* 80\b"),
        ({"beta": [(0, 50), (0, 101)]}, r"beta_2 are \[0, 101\] mm.*\[0,.* 100\b"),
        ({"beta": [(40, 50), (0, 30)]}, "beta_2 leave no room: .*at least 40 mm .*at most 30 mm"),
        ({"beta": [(0, 10), (35, 50)], "carriage_gap": 0}, "beta_2 leave no room.*at least 35 mm.*at most 30 mm"),
        ({"alpha_speed": 0}, "speed of alpha_1 is 0.*positive"),
        ({"beta_speed": (9, -1)}, "speed of beta_2 is -1"),
        ({"theta_speed": math.nan}, "theta_speed is nan"),
        ({"theta_acceleration": (1, 2, 3)}, "theta_acceleration is .*2 of them"),
        ({"beta_acceleration": "fast"}, "beta_acceleration is 'fast'"),
        ({"carriage_gap": -1}, "carriage_gap is -1"),
        ({"carriage_gap": math.inf}, "carriage_gap is inf"),
        ({"carriage_gap": "wide"}, "carriage_gap is .*wide"),
    ],
)  # fmt: skip
@pytest.mark.hazard("wrong tube order")
def test_tubes_and_limits_that_do_not_go_together_are_refused(changes, message):
    with pytest.raises(RobotError, match=message):
        pair(**changes)


def test_limits_that_the_carriage_gap_just_allows_are_accepted():
    """beta_2 >= 45 mm and beta_2 - beta_1 <= 100 - 80 - 18 = 2 mm leave beta_1 in [43, 50]."""
    assert pair(beta=[(0, 50), (45, 50)], carriage_gap=18).d == 2


def test_a_carriage_gap_beyond_the_difference_of_lengths_is_refused():
    """(L2 - beta2) - (L1 - beta1) <= L2 - L1 = 20 mm wherever beta1 <= beta2."""
    with pytest.raises(RobotError, match="carriage"):
        pair(carriage_gap=25)


def test_a_robot_without_tubes_is_refused():
    with pytest.raises(RobotError, match="a robot has no tubes"):
        Robot(())


def test_equal_ends_of_curvature_are_one_number():
    assert tube(curvature=[0.02, 0.02]) == tube(curvature=0.02)


def test_bending_stiffness_is_that_of_a_ring():
    assert tube(youngs_modulus=2).bending_stiffness == pytest.approx(2 * math.pi / 64 * 15)


# q and its limits


def test_default_limits_of_the_seed_are_its_curved_parts_and_free_alpha(robot):
    np.testing.assert_array_equal(robot.lower, [-np.inf] * 3 + [0] * 3 + [-np.pi] * 2)
    np.testing.assert_array_equal(robot.upper, [np.inf] * 3 + [50, 107, 150] + [np.pi] * 2)
    assert robot.reach == 150


def test_both_readings_of_table_one():
    agreed, literal = table_i_robot(), table_i_robot(literal=True)
    assert [t.length for t in agreed.tubes] == [t.length for t in literal.tubes] == [90, 202, 390]
    assert [t.curved_length for t in agreed.tubes] == [50, 107, 150]
    assert [t.curved_length for t in literal.tubes] == [40, 95, 240]
    np.testing.assert_array_equal(literal.upper[3:6], [40, 95, 240])
    np.testing.assert_allclose([1 / t.root_curvature for t in agreed.tubes], [130, 60, 80])


def test_default_speeds_are_a_fifth_of_a_radian_nine_mm_and_0_08_rad_a_tenth_of_a_second(robot):
    np.testing.assert_allclose(robot.speed * 0.1, [0.2] * 3 + [9] * 3 + [0.08] * 2)


def test_locking_the_tilt_changes_only_theta(robot):
    locked = robot.with_locked_tilt()
    np.testing.assert_array_equal(locked.upper[6:], 0)
    np.testing.assert_array_equal(locked.lower[6:], 0)
    np.testing.assert_array_equal(locked.upper[:6], robot.upper[:6])


def test_limit_arrays_cannot_be_written(robot):
    for array in (robot.lower, robot.upper, robot.speed, robot.acceleration, robot.mm_per_unit):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@given(robots_with_q())
def test_split_gives_alpha_beta_and_theta_in_the_order_of_the_axes(case):
    robot, q = case
    by_axis = dict(zip(robot.axes, q, strict=True))
    alpha, beta, theta = robot.split(q)
    assert list(alpha) == [by_axis[f"alpha_{i + 1}"] for i in range(robot.d)]
    assert list(beta) == [by_axis[f"beta_{i + 1}"] for i in range(robot.d)]
    assert list(theta) == [by_axis["theta_x"], by_axis["theta_y"]]


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        (0, math.nan, "alpha_1 of q is nan"),
        (1, math.inf, "alpha_2 of q is inf"),
        (3, -0.1, r"beta_1 of q is -0.1.*\[0, 50\]"),
        (4, 29, "beta_1 of q is 30 mm and exceeds beta_2, 29 mm"),
        (5, 150.1, "beta_3 of q is 150.1"),
        (7, 3.2, "theta_y of q is 3.2"),
    ],
)
def test_a_q_outside_limits_or_order_is_named(robot, entry, value, message):
    q = np.array([0, 0, 0, 30, 60, 90, 0, 0], dtype=float)
    robot.check(q)
    q[entry] = value
    with pytest.raises(RobotError, match=message):
        robot.check(q)


def test_a_q_of_the_wrong_size_is_refused(robot):
    with pytest.raises(RobotError, match=r"start has shape \(7,\).*\(8,\).*alpha_1"):
        robot.check(np.zeros(7), "start")


def test_a_q_within_the_tolerance_is_accepted(robot):
    robot.check(np.array([0, 0, 0, 50 + 5e-7, 50, 90, 0, 0]))


def test_carriages_that_come_too_close_are_named(robot):
    """At beta (10, 120) the bases stand at -80 and -82 mm: 2 mm apart."""
    near = Robot(robot.tubes[:2], Limits(beta=[(0, 80), (0, 150)], carriage_gap=5.0))
    near.check(np.array([0, 0, 10, 117, 0, 0], dtype=float))
    with pytest.raises(RobotError, match="carriages 1 and 2 of q are 2 mm apart"):
        near.check(np.array([0, 0, 10, 120, 0, 0], dtype=float))


# Written down


@given(robots())
def test_a_robot_survives_strict_json(robot):
    text = json.dumps(robot.to_dict(), allow_nan=False)
    again = Robot.from_dict(json.loads(text))
    assert again.tubes == robot.tubes
    for name in ("lower", "upper", "speed", "acceleration"):
        np.testing.assert_array_equal(getattr(again, name), getattr(robot, name))
    assert json.dumps(again.to_dict(), allow_nan=False) == text


@pytest.mark.parametrize(
    "limits",
    [
        {"alpha": (-math.inf, 3.0), "carriage_gap": 2.0},
        {"alpha": [(-math.inf, 1), (-2, math.inf), (0, 0)], "theta_speed": math.inf},
        {"beta": np.array([[0.0, 40], [0, 90], [10, 150]]), "beta_speed": np.array([1.0, 2, math.inf])},
        {"beta": np.array([[0, 40], [0, 90], [10, 150]])},
        {"alpha_speed": np.int64(2)},
    ],
    ids=["one sided", "per tube", "arrays", "whole numbers", "a whole number"],
)
def test_limits_survive_strict_json(robot, limits):
    limited = replace(robot, limits=Limits(**limits))
    again = Robot.from_dict(json.loads(json.dumps(limited.to_dict(), allow_nan=False)))
    for name in ("lower", "upper", "speed", "acceleration"):
        np.testing.assert_array_equal(getattr(again, name), getattr(limited, name))
    assert again.limits.carriage_gap == limited.limits.carriage_gap


def test_a_robot_file_is_read(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(SEED_TOML, encoding="utf-8")
    robot = Robot.from_toml(path)
    assert [t.length for t in robot.tubes] == [90, 202]
    assert (robot.tubes[1].root_curvature, robot.tubes[1].tip_curvature) == (0.01, 0.02)
    np.testing.assert_array_equal(robot.lower, [-np.inf, -np.inf, 0, 5, -np.pi, -np.pi])
    np.testing.assert_array_equal(robot.speed[-2:], np.inf)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length = 90", "lenght = 90", "key 'lenght' is unknown in tube; allowed are length, curved_length"),
        ("theta_speed", "tilt_speed", "key 'tilt_speed' is unknown in limits; allowed are alpha, beta, theta"),
        (
            'name = "the seed\'s"',
            "colour = 1",
            "key 'colour' is unknown in a robot; allowed are name, tubes, limits",
        ),
        ("outer_diameter = 5.7", "", "tube: .*outer_diameter"),
        ("[[tubes]]", "[[pipes]]", "key 'pipes' is unknown"),
        ("length = 90", "length = ", "line 5"),
        ("length = 90", 'length = "ninety"', "length is 'ninety'"),
        ("[-inf, 3.5]", '"all"', "limits of alpha are 'all'"),
        ("theta_speed = inf", 'carriage_gap = "wide"', "carriage_gap"),
    ],
)
def test_a_wrong_robot_file_is_named_with_what_is_wrong(tmp_path, old, new, message):
    path = tmp_path / "robot.toml"
    path.write_text(SEED_TOML.replace(old, new), encoding="utf-8")
    with pytest.raises(RobotError, match=rf"(?s)robot file .*robot\.toml: .*{message}"):
        Robot.from_toml(path)


@pytest.mark.parametrize(
    "content", [b"", b"tubes = 3", b"limits = 3\ntubes = []", b"tubes = [1]", b"\xff\xfe\x00"]
)
def test_a_file_without_tubes_is_refused(tmp_path, content):
    path = tmp_path / "robot.toml"
    path.write_bytes(content)
    with pytest.raises(RobotError, match=r"robot\.toml"):
        Robot.from_toml(path)


def test_a_missing_robot_file_is_named(tmp_path):
    with pytest.raises(RobotError, match=r"nowhere\.toml"):
        Robot.from_toml(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    "limits", [{"beta": 5.0}, {"alpha": (1,)}, {"theta": [[0, 1], [0, 1], [0, 1]]}, {"beta": []}]
)
def test_limits_that_are_no_pairs_are_refused(limits):
    with pytest.raises(RobotError, match=r"give \(lower, upper\)"):
        Robot(table_i_robot().tubes, Limits(**limits))


@pytest.mark.parametrize("count", [1, 2, 3, 6, 12])
def test_the_summary_of_a_robot_is_short(count):
    diameters = 20 - 1.5 * np.arange(count)
    tubes = [Tube(100 + 10 * i, 50, 0.001 * (i % 3), d, d - 1.2) for i, d in enumerate(diameters)]
    text = repr(Robot(tuple(tubes)))
    assert len(text) <= 120
    assert "\n" not in text
    assert text.startswith(f"Robot({count} tube")


def test_the_summary_of_table_i_names_what_tells_robots_apart(robot):
    assert repr(robot) == "Robot(3 tubes: diameters 5.7, 3.7, 2.1 mm, bend radii 130, 60, 80 mm, reach 150 mm)"
