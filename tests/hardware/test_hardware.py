"""What a robot is played on: which axis moves which joint, in what unit, how far, how fast; the hardware file."""

from __future__ import annotations

import math
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import numbers, robots, robots_with_q

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.axis import Axis
from ctr_nlp.hardware.description import Connection, Hardware, simulated_hardware
from ctr_nlp.hardware.sensing.description import Sensing

EXAMPLE = Path(__file__).parents[2] / "examples" / "hardware.toml"
LETTERS = "XYZABCUVW"


def axis(**changes):
    plain = {"joint": "beta_1", "letter": "X", "unit": "mm", "range": (0, 50), "speed": 50, "acceleration": 200}
    return Axis(**(plain | changes))


@st.composite
def rigs(draw, robot):
    """Hardware for a robot of up to four tubes: any order, units, signs, zeros, and ranges that move it."""
    axes = []
    for joint, letter in zip(draw(st.permutations(robot.axes[:-2])), LETTERS, strict=False):
        unit = "mm" if joint.startswith("beta") else draw(st.sampled_from(["deg", "rad"]))
        made = Axis(joint, letter, unit, (0, 1), draw(numbers(0.1, 1e3)), draw(numbers(0.1, 1e4)),
                    draw(st.sampled_from([-1, 1])), draw(numbers(-1e3, 1e3)))  # fmt: skip
        ends = (0.0, robot.reach + 1) if unit == "mm" else (-draw(numbers(0.1, 20)), draw(numbers(0.1, 20)))
        axes.append(replace(made, range=tuple(sorted(made.zero + made.scale * end for end in ends))))
    return Hardware(tuple(axes), draw(st.sampled_from([None, simulated_hardware(table_i_robot()).arm])))


# Axes and connections that cannot be


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint": "beta"}, "joint of an axis is 'beta'; it must be alpha_i or beta_i, with i from 1"),
        ({"joint": "beta_0"}, "joint of an axis is 'beta_0'"),
        ({"joint": "beta_-1"}, "joint of an axis is 'beta_-1'"),
        ({"joint": "beta_²"}, "joint of an axis is 'beta_²'"),
        ({"joint": "theta_1"}, "joint of an axis is 'theta_1'"),
        ({"joint": 3}, "joint of an axis is 3"),
        ({"unit": "deg"}, "unit of beta_1 is 'deg'; it must be mm"),
        ({"unit": "m"}, "unit of beta_1 is 'm'; it must be mm"),
        ({"joint": "alpha_1"}, "unit of alpha_1 is 'mm'; it must be deg or rad"),
        ({"letter": "x"}, "letter of beta_1 is 'x'; it must be one of X Y Z A B C U V W"),
        ({"letter": "XY"}, "letter of beta_1 is 'XY'"),
        ({"letter": ""}, "letter of beta_1 is ''"),
        ({"letter": 1}, "letter of beta_1 is 1"),
        ({"sign": 0}, "sign of beta_1 is 0; it must be 1 or -1"),
        ({"sign": True}, "sign of beta_1 is True"),
        ({"sign": "-"}, "sign of beta_1 is '-'"),
        ({"speed": 0}, "speed of beta_1 is 0; it must be positive$"),
        ({"speed": -3}, "speed of beta_1 is -3; it must be positive$"),
        ({"speed": math.inf}, "speed of beta_1 is inf; it must be a finite number"),
        ({"speed": "fast"}, "speed of beta_1 is 'fast'; it must be a number"),
        ({"speed": True}, "speed of beta_1 is True"),
        ({"speed": [1, 2]}, r"speed of beta_1 is \[1, 2\]"),
        ({"acceleration": 0}, "acceleration of beta_1 is 0; it must be positive$"),
        ({"acceleration": math.nan}, "acceleration of beta_1 is nan"),
        ({"zero": math.nan}, "zero of beta_1 is nan"),
        ({"backlash": -0.1}, "backlash of beta_1 is -0.1; it must be positive or 0"),
        ({"tolerance": 0}, "tolerance of beta_1 is 0; it must be positive$"),
        ({"range": (5, 5)}, r"range of beta_1 is \[5, 5\]; the lower must be less"),
        ({"range": (50, 0)}, r"range of beta_1 is \[50, 0\]; the lower must be less"),
        ({"range": (0, math.inf)}, r"range of beta_1 is \(0, inf\)"),
        ({"range": (0, 1, 2)}, r"range of beta_1 is \(0, 1, 2\); it must be 2 numbers"),
        ({"range": 50}, "range of beta_1 is 50; it must be 2 numbers"),
        ({"range": "all"}, "range of beta_1 is 'all'; it must be 2 numbers"),
        ({"range": ("low", "high")}, r"range of beta_1 is \('low', 'high'\)"),
    ],
)
def test_an_axis_that_cannot_be_is_refused(changes, message):
    with pytest.raises(HardwareError, match=message):
        axis(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": "lpt"}, "device of the connection is 'lpt'; it must be one of simulated, grbl, ros2"),
        ({"device": ["grbl"]}, "device of the connection"),
        ({"homing": "never"}, "homing of the connection is 'never'; it must be one of manual, cycle"),
        ({"flow": "fast"}, "flow of the connection is 'fast'; it must be one of count, wait"),
        ({"device": "grbl"}, "url of the connection is ''; a grbl device needs one"),
        ({"device": "ros2", "url": 5}, "url of the connection is 5; a ros2 device needs one"),
        ({"baud": 0}, "baud of the connection is 0; it must be a positive whole number"),
        ({"baud": 9600.5}, "baud of the connection is 9600.5"),
        ({"baud": True}, "baud of the connection is True"),
    ],
)
def test_a_connection_that_cannot_be_is_refused(changes, message):
    with pytest.raises(HardwareError, match=message):
        Connection(**changes)


@pytest.mark.parametrize("approach", [0, -0.1, 1.01, math.nan, "slow", True, None])
def test_an_approach_outside_of_0_to_1_is_refused(approach):
    with pytest.raises(HardwareError, match=rf"approach is {re.escape(repr(approach))}; it must lie in \(0, 1\]"):
        Hardware((axis(),), approach=approach)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({"joint": "beta_2"}, "letter X is given to 2 axes; give it to one"),
        ({"letter": "Y"}, "joint beta_1 is given to 2 axes; give it to one"),
    ],
)
def test_two_axes_with_one_letter_or_joint_are_refused(second, message):
    with pytest.raises(HardwareError, match=message):
        Hardware((axis(), axis(**second)))


# Positions


def test_a_joint_of_each_kind_in_each_unit(robot):
    """Positions by hand: zero + sign * joint, in mm, degrees or radians."""
    rig = Hardware((
        axis(sign=-1, zero=-1.0, range=(-51, -1)),
        axis(joint="beta_2", letter="Y"),
        axis(joint="beta_3", letter="Z", zero=12.5, range=(0, 200)),
        axis(joint="alpha_1", letter="A", unit="deg", sign=-1, zero=90.0),
        axis(joint="alpha_2", letter="B", unit="rad", zero=1.0),
        axis(joint="alpha_3", letter="C", unit="deg"),
    ))  # fmt: skip
    q = np.array([math.pi / 2, 0.5, -math.pi, 10, 20, 30, 0.3, -0.2])
    np.testing.assert_allclose(rig.positions(robot, q), [-11, 20, 42.5, 0, 1.5, -180])
    assert rig.letters == ("X", "Y", "Z", "A", "B", "C")


@given(st.data())
def test_joints_and_back(data):
    robot, q = data.draw(robots_with_q())
    rig = data.draw(rigs(robot))
    both = np.stack([q, 0.5 * q])
    positions = rig.positions(robot, both)
    assert positions.shape == (2, 2 * robot.d)
    np.testing.assert_allclose(rig.joints(robot, positions, both[:, -2:]), both, rtol=1e-10, atol=1e-10)
    for row, lone in zip(positions, both, strict=True):
        np.testing.assert_array_equal(rig.positions(robot, lone), row)


@given(st.data())
def test_changes_are_differences_of_joints(data):
    """in_joints knows no zero: a change of positions is a change of q in which the tilt rests."""
    robot, q = data.draw(robots_with_q())
    rig = data.draw(rigs(robot))
    a, b = rig.positions(robot, np.stack([q, 2 * q]))
    change = rig.in_joints(robot, b - a)
    np.testing.assert_allclose(change[:-2], q[:-2], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(change[-2:], 0)


# Limits


@given(st.data())
def test_limits_are_never_widened_and_are_kept_by_both(data):
    robot = data.draw(robots())
    robot = robot.with_limits(alpha_speed=data.draw(numbers(0.01, 10)), beta_acceleration=data.draw(numbers(1, 9)))
    rig = data.draw(rigs(robot))
    tight = rig.apply_limits(robot)
    assert tight.tubes == robot.tubes
    assert tight.carriage_gap == robot.carriage_gap
    assert (tight.lower >= robot.lower).all()
    assert (tight.upper <= robot.upper).all()
    assert (tight.speed <= robot.speed).all()
    assert (tight.acceleration <= robot.acceleration).all()
    for end in (tight.lower, tight.upper):
        for axis, position in zip(rig.axes, rig.positions(robot, end), strict=True):
            assert axis.range[0] - 1e-9 <= position <= axis.range[1] + 1e-9
    for rate, allowed in ((tight.speed, "speed"), (tight.acceleration, "acceleration")):
        for axis in rig.axes:
            in_units = rate[robot.axes.index(axis.joint)] * abs(axis.scale)
            assert in_units <= getattr(axis, allowed) * (1 + 1e-12)


def test_what_binds_by_hand(robot):
    """The first slide stops at 30 mm counted from the other end, the first turn at 90 deg and 90 deg/s."""
    slide, *others = simulated_hardware(robot).axes
    turn = next(axis for axis in others if axis.joint == "alpha_1")
    others = [axis for axis in others if axis is not turn]
    rig = Hardware((
        replace(slide, sign=-1, zero=100.0, range=(70.0, 98.0)),
        replace(turn, range=(-90.0, 90.0), speed=90.0, acceleration=180.0),
        *others,
    ))  # fmt: skip
    tight = rig.apply_limits(robot)
    assert tight.lower[3] == pytest.approx(2.0)
    assert tight.upper[3] == pytest.approx(30.0)
    assert tight.upper[0] == -tight.lower[0] == pytest.approx(math.pi / 2)
    assert tight.speed[0] == pytest.approx(math.pi / 2)
    assert tight.acceleration[0] == pytest.approx(math.pi)
    np.testing.assert_allclose(tight.speed[3:6], 50.0)
    np.testing.assert_array_equal(tight.upper[4:6], robot.upper[4:6])


def test_without_an_arm_the_tilt_is_locked_and_with_one_it_is_as_fast_as_the_arm_says(robot):
    rig = simulated_hardware(robot)
    locked = replace(rig, arm=None).apply_limits(robot)
    np.testing.assert_array_equal(np.concatenate([locked.lower[-2:], locked.upper[-2:]]), 0)
    slow = replace(rig, arm=replace(rig.arm, tilt_speed_deg=(10, 20), tilt_acceleration_deg=60)).apply_limits(
        robot
    )
    np.testing.assert_allclose(slow.speed[-2:], np.radians([10, 20]))
    np.testing.assert_allclose(slow.acceleration[-2:], math.pi / 3)
    np.testing.assert_array_equal(slow.upper[-2:], robot.upper[-2:])


def test_a_robot_that_must_be_tilted_needs_an_arm(robot):
    """Locking at 0 what must be between 0.1 and 0.2 rad would widen its limits."""
    with pytest.raises(HardwareError, match=r"cannot move the robot: limits of theta_x are \[0.1, 0\]"):
        replace(simulated_hardware(robot), arm=None).apply_limits(robot.with_limits(theta=(0.1, 0.2)))


def test_a_range_that_the_robot_cannot_use_is_named(robot):
    rig = simulated_hardware(robot)
    out = replace(rig, axes=(replace(rig.axes[0], range=(60.0, 80.0)), *rig.axes[1:]))
    with pytest.raises(
        HardwareError, match=r"this hardware cannot move the robot: limits of beta_1 are \[60, 50\]"
    ):
        out.apply_limits(robot)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda axes: axes[:-1],
            r"no axis moves alpha_3 of the robot; `joint` of the axes must be alpha_1, .* beta_3",
        ),
        (
            lambda axes: (*axes, axis(joint="beta_4", letter="U")),
            "an axis moves beta_4, which the robot does not have; `joint` of the axes must be alpha_1",
        ),
        (lambda axes: (), "no axis moves alpha_1 of the robot"),
    ],
)
def test_axes_must_move_every_joint_and_no_other(robot, change, message):
    rig = simulated_hardware(robot)
    with pytest.raises(HardwareError, match=message):
        replace(rig, axes=change(rig.axes)).apply_limits(robot)


# Rigs that are there without a file


@given(robots(most=3))
def test_the_bench_moves_every_robot_of_up_to_three_tubes_as_far_as_it_goes(robot):
    tight = simulated_hardware(robot).apply_limits(robot)
    np.testing.assert_array_equal(tight.lower[robot.d :], robot.lower[robot.d :])
    np.testing.assert_array_equal(tight.upper[robot.d :], robot.upper[robot.d :])


def test_the_bench_moves_a_straight_outer_tube_that_may_move_farther_than_the_inner_ones_reach():
    robot = Robot((Tube(21, 10, 0.0, 2, 1.8), Tube(21, 20, 1 / 32, 1.6, 1.4)))
    assert robot.upper[robot.d] > robot.reach
    tight = simulated_hardware(robot).apply_limits(robot)
    np.testing.assert_array_equal(tight.upper[robot.d :], robot.upper[robot.d :])


def test_the_bench_is_for_up_to_three_tubes(robot):
    tube = replace(robot.tubes[-1], outer_diameter=0.9, inner_diameter=0.5)
    with pytest.raises(HardwareError, match="a robot of 4 tubes needs a hardware file"):
        simulated_hardware(Robot((*robot.tubes, tube), Limits()))


# The hardware file


def test_the_example_is_the_bench_of_the_seed_within_its_limits(robot):
    rig, default = Hardware.from_toml(EXAMPLE), simulated_hardware(robot)
    assert rig.connection == default.connection
    assert rig.approach == default.approach
    assert {axis.joint: (axis.letter, axis.unit, axis.speed, axis.acceleration) for axis in rig.axes} == {
        axis.joint: (axis.letter, axis.unit, axis.speed, axis.acceleration) for axis in default.axes
    }
    one, other = rig.apply_limits(robot), replace(default, arm=rig.arm).apply_limits(robot)
    for name in ("lower", "upper", "speed", "acceleration"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("described", [Axis, Connection, Sensing], ids=lambda c: c.__name__)
def test_every_key_stands_in_the_example_with_a_comment_and_its_default(described):
    text = EXAMPLE.read_text(encoding="utf-8")
    for field in fields(described):
        line = re.search(rf"^(?:# )?{field.name} = (.*?)\s*# (.+)$", text, re.MULTILINE)
        assert line, f"{field.name} is not explained"
        if described is Axis and isinstance(field.default, int | float):
            assert f"({field.default:g})" in line[2], f"default of {field.name}"
            assert float(line[1]) == field.default


def test_the_commented_lines_of_the_example_are_a_controller(tmp_path):
    text = EXAMPLE.read_text(encoding="utf-8").replace('device = "simulated"', "")
    path = tmp_path / "rig.toml"
    path.write_text(
        re.sub(r"^# (device|url|baud|homing|flow) =", r"\1 =", text, flags=re.MULTILINE), encoding="utf-8"
    )
    assert Hardware.from_toml(path).connection == Connection("grbl", "/dev/ttyUSB0", 115200, "cycle", "count")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("approach = 0.2", "aproach = 0.2", "key 'aproach' is unknown in hardware; allowed are name, robot, "),
        ("approach = 0.2", "approach = 2", r"approach is 2; it must lie in \(0, 1\]"),
        ('letter = "Y"', 'leter = "Y"', "key 'leter' is unknown in axis; allowed are joint, letter, unit, range"),
        ('letter = "Y"', "", "axis: .*letter"),
        ('letter = "Y"', 'letter = "X"', "letter X is given to 2 axes"),
        ('joint = "alpha_1"\nletter = "A"\nunit = "deg"', 'joint = "alpha_1"\nletter = "A"\nunit = "mm"',
         "unit of alpha_1 is 'mm'; it must be deg or rad"),
        ("range = [0, 150]  ", "range = [150]  ", r"range of beta_1 is \[150\]; it must be 2 numbers"),
        ("speed = 600 ", "speed = inf ", "speed of alpha_1 is inf"),
        ('device = "simulated"  ', 'device = "grbl"', "url of the connection is ''"),
        ('device = "simulated"  ', 'devise = "grbl"', "key 'devise' is unknown in connection"),
        ("[connection]", "connection = 3\n[bad]", "key 'bad' is unknown"),
        ('model = "ur3e"', 'model = "ur1"', "model of the arm is 'ur1'; it must be one of"),
        ("[arm]", "[arm]\ncolour = 1", "key 'colour' is unknown in arm"),
        ("[arm]", "[lag]\nplay = -0.1\n[arm]", "play of a lag is -0.1; it must be at least 0"),
        ("[arm]", "[lag]\nplay = [0, 0]\ndarg = 1\n[arm]", "key 'darg' is unknown in lag; allowed are play"),
        ("range = [0, 150]  ", "range = # ", "line \\d+"),
    ],
)  # fmt: skip
def test_a_wrong_hardware_file_is_named_with_what_is_wrong(tmp_path, old, new, message):
    text, path = EXAMPLE.read_text(encoding="utf-8"), tmp_path / "rig.toml"
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(HardwareError, match=rf"(?s)hardware file .*rig\.toml: .*{message}"):
        Hardware.from_toml(path)


@pytest.mark.parametrize(
    "content",
    [b"", b"axes = 3", b"[axes]\njoint = 1", b"axes = [1]", b"connection = 3\naxes = []", b"\xff\xfe\x00"],
)
def test_a_file_without_axes_is_refused(tmp_path, content):
    path = tmp_path / "rig.toml"
    path.write_bytes(content)
    with pytest.raises(HardwareError, match=r"hardware file .*rig\.toml"):
        Hardware.from_toml(path)


def test_a_missing_hardware_file_is_named(tmp_path):
    with pytest.raises(HardwareError, match=r"nowhere\.toml"):
        Hardware.from_toml(tmp_path / "nowhere.toml")


def test_a_plan_for_other_tubes_than_those_mounted_is_refused(tmp_path: Path) -> None:
    robot = table_i_robot()
    mounted = replace(simulated_hardware(robot), robot=robot)
    assert mounted.apply_limits(robot).tubes == robot.tubes
    tubes = (replace(robot.tubes[0], curvature=1 / 131), *robot.tubes[1:])
    with pytest.raises(HardwareError, match=r"tube 1 .* has curvature 0\.0076.*, the one that is mounted 0\.0076"):
        mounted.apply_limits(replace(robot, tubes=tubes))
    fewer = replace(robot, tubes=robot.tubes[1:])
    with pytest.raises(HardwareError, match="has 2 tubes, 3 are mounted"):
        replace(simulated_hardware(fewer), robot=robot).apply_limits(fewer)


def test_the_robot_file_is_beside_the_hardware_file(tmp_path: Path) -> None:
    examples = Path(__file__).resolve().parents[2] / "examples"
    text = (examples / "hardware.toml").read_text(encoding="utf-8").replace("# robot =", "robot =")
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    with pytest.raises(HardwareError, match=r"robot file .*robot\.toml"):
        Hardware.from_toml(tmp_path / "rig.toml")
    (tmp_path / "robot.toml").write_text((examples / "robot.toml").read_text(encoding="utf-8"), encoding="utf-8")
    assert Hardware.from_toml(tmp_path / "rig.toml").apply_limits(table_i_robot()).d == 3
