"""Malformed robots, rigs, starts and plans in files: each is one clear error or rightly accepted."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from malformed import (
    RIG,
    ROBOT,
    Case,
    Said,
    changed,
    judge,
    of_file,
    plan_entries,
    plan_file,
    program,
    rig,
    spoilt,
    written,
)

from ctr_nlp import Plan, Robot, table_i_robot
from ctr_nlp.cli.arguments import read_start
from ctr_nlp.cli.commands import robust
from ctr_nlp.exceptions import MAX_MESSAGE_LENGTH, HardwareError, LoadError, OptionError, OutputError, RobotError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.models.loads import Load

ROBOT_FILES = [
    ("length = 90 ", "length = 0.09 ",
     r"tubes, number 1: tube length is 0\.09 mm.*did you mean 90 mm \(0\.09 m\)"),
    ("length = 90 ", "length = 90000 ", r"length is 90000 mm.*did you mean 90 mm \(90000 µm\)"),
    ("length = 90 ", "length = -90 ", "length is -90 mm; it must be positive"),
    ("length = 90 ", "length = 'long' ", "length is 'long'; it must be a number"),
    ("length = 90 ", "length = true ", "length is True; it must be a number"),
    ("length = 90 ", "length = inf ", "length is inf; it must be a finite number"),
    ("length = 90 ", "length = [90, 91] ", r"length is \[90, 91\]; it must be a number"),
    ("length = 90 ", "length = {} ", "length is {}; it must be a number"),
    ("length = 90 ", "length = 1979-05-27 ", "length is .*; it must be a number"),
    ("length = 90 ", "length = 300 ", "length of tube 1 is 300 mm and of tube 2 202 mm"),
    ("length = 90 ", "", "tubes, number 1: tube: .*length"),
    ("curved_length = 50 ", "curved_length = 95 ", r"curved_length is 95 mm; it must lie in \[0, length = 90\]"),
    ("curved_length = 50 ", "curved_length = 0.05 ", r"curved_length is 0\.05 mm.*did you mean 50 mm"),
    ("curvature = 0.016666666666667", "curvature = 66.7",
     r"number 2: tube curvature 66\.7 per mm is a radius of 0\.015 mm; .*did you mean 1/66\.7"),
    ("curvature = 0.016666666666667", "curvature = 16.7",
     r"curvature 16\.7 per mm is a radius of 0\.06 mm.*did you mean 0\.0167 \(16\.7 per metre\)\?"),
    ("curvature = 0.0125", "curvature = 12.5",
     r"1/12\.5 .*or 0\.0125 \(12\.5 per metre\)|0\.0125 \(12\.5 per metre\)"),
    ("curvature = 0.0076923076923", "curvature = 0.2",
     r"curvature is 0\.2 per mm.*strained by 57 %.*nitinol allows 8 %"),
    ("curvature = 0.0125", "curvature = [130, 60]", r"curvature 130 per mm.*did you mean 1/130"),
    ("curvature = 0.0125", "curvature = -0.0125", "curvature is -0.0125; it is unsigned"),
    ("curvature = 0.0125", "curvature = nan", "curvature is nan; it must be a finite number"),
    ("curvature = 0.0125", "curvature = [0.01, 0.02, 0.03]", "curvature is .*; it must be a number or 2 of them"),
    ("curvature = 0.0125", "curvature = '1/80'", "curvature is '1/80'; it must be a number"),
    ("outer_diameter = 5.7", "outer_diameter = 0.0057",
     r"inner_diameter is 4\.3 mm; .*exchanged, or in different"),
    ("outer_diameter = 5.7\ninner_diameter = 4.3", "outer_diameter = 0.0057\ninner_diameter = 0.0043",
     r"outer_diameter is 0\.0057 mm.*did you mean 5\.7 mm \(0\.0057 m\)"),
    ("outer_diameter = 5.7\ninner_diameter = 4.3", "outer_diameter = 4.3\ninner_diameter = 5.7",
     "inner_diameter is 5.7 mm.*are the two diameters exchanged"),
    ("outer_diameter = 5.7\ninner_diameter = 4.3", "outer_diameter = 5700\ninner_diameter = 4300",
     r"outer_diameter is 5700 mm.*did you mean 5\.7 mm \(5700 µm\)"),
    ("inner_diameter = 4.3", "inner_diameter = 3.6",
     "tubes 1 and 2 do not nest: inner_diameter of tube 1 is 3.6 mm"),
    ("outer_diameter = 5.7\ninner_diameter = 4.3", "outer_diameter = 2.5\ninner_diameter = 2.2",
     "tubes 1 and 2 are in the wrong order"),
    ("poisson_ratio = 0.3", "poisson_ratio = 3", r"poisson_ratio is 3; it must lie in \(-1, 0\.5\]"),
    ("youngs_modulus = 1.0", "youngs_modulus = 0", "youngs_modulus is 0; it must be positive"),
    ("youngs_modulus = 1.0", "youngs_modulus = 1000",
     r"youngs_modulus of tubes 1 and 2 are 1000 and 1.*in the same unit: is one in GPa and the other in MPa"),
    ("youngs_modulus = 1.0", "youngs_modulus = 1e-6", "youngs_modulus of tubes 1 and 2 are 1e-06 and 1"),
    ("[[tubes]]", "[[tube]]", "key 'tube' is unknown in a robot; allowed are name, tubes, limits"),
    ("poisson_ratio", "poison_ratio", "key 'poison_ratio' is unknown in tube; .*Did you mean 'poisson_ratio'"),
    ("alpha = [-inf, inf]", "alpha = [-180, 180]",
     r"limits of alpha_1.*did you mean -3\.142 rad \(-180 degrees\)"),
    ("alpha = [-inf, inf]", "alpha = [1, -1]", "limits of alpha_1 are .1, -1.; the lower must not exceed"),
    ("alpha = [-inf, inf]", "alpha = 3", "limits of alpha are 3; give .lower, upper., or 3 of them"),
    ("alpha = [-inf, inf]", "alpha = [nan, 1]", "limits of alpha_1 are"),
    ("beta = [[0, 50], [0, 107], [0, 150]]", "beta = [[0, 0.05], [0, 0.107], [0, 0.15]]",
     r"upper limit of beta_1 is 0\.05 mm.*did you mean 50 mm"),
    ("beta = [[0, 50], [0, 107], [0, 150]]", "beta = [[0, 95], [0, 107], [0, 150]]",
     r"beta_1 are \[0, 95\] mm.*\[0, 90\]"),
    ("beta = [[0, 50], [0, 107], [0, 150]]", "beta = [[-5, 50], [0, 107], [0, 150]]", r"beta_1 are \[-5, 50\] mm"),
    ("beta = [[0, 50], [0, 107], [0, 150]]", "beta = [[40, 50], [0, 30], [0, 150]]", "beta_2 leave no room"),
    ("beta = [[0, 50], [0, 107], [0, 150]]", "beta = [[0, 50], [0, 107]]", "limits of beta are .*3 of them"),
    ("theta = [-3.141592653589793, 3.141592653589793]", "theta = [-30, 30]", "limits of theta_x.*-30 degrees"),
    ("alpha_speed = 2.0", "alpha_speed = 0", "speed of alpha_1 is 0; it must be positive"),
    ("beta_speed = 90.0", "beta_speed = -90", "speed of beta_1 is -90; it must be positive"),
    ("beta_speed = 90.0", "beta_speed = [1, 2]", "beta_speed is .*; it must be a number or 3 of them"),
    ("theta_speed = 0.8", "theta_speed = 'fast'", "theta_speed is 'fast'"),
    ("# carriage_gap = 5.0", "carriage_gap = 500", "carriage_gap is 500 mm; it must be at most 112 mm, by which"),
    ("# carriage_gap = 5.0", "carriage_gap = -5", "carriage_gap is -5 mm"),
    ("[limits]", "[limit]", "key 'limit' is unknown in a robot"),
    ("[limits]", "limits = 3\n[bad]", "key 'bad' is unknown in a robot"),
    ("length = 90 ", "length = 90 length ", "robot.toml: .*line"),
]  # fmt: skip
WHOLE_ROBOTS = [
    (b"", "a robot needs a list of tubes"),
    (b"\xff\xfe\x00\x01", "codec can't decode"),
    (b"tubes = []", "a robot has no tubes"),
    (b"tubes = [1, 2]", "a robot needs a list of tubes"),
    (b"tubes = 'three'", "a robot needs a list of tubes"),
    (b"limits = 3\n[[tubes]]\nlength = 1", "tubes, number 1: tube: "),
    (b"[" * 5000, "robot.toml"),
]

RANGE_OF_Y, RANGE_OF_Z = (f'letter = "{letter}"\nunit = "mm"\nrange = [0, 150]' for letter in "YZ")
RIG_FILES = [
    ("range = [0, 150]  ", "range = [60, 80]  ", r"axis X has the range \[60, 80\] mm.*robot allows \[0, 50\]"),
    (RANGE_OF_Z, RANGE_OF_Z.replace("150", "0.15"), r"upper limit of beta_3 is 0\.15 mm.*did you mean 150 mm"),
    (
        RANGE_OF_Y,
        f"{RANGE_OF_Y}\nzero = 151",
        r"limits of beta_2 are .*axis Y has the range .*zero 151",
    ),
    (RANGE_OF_Y, f"{RANGE_OF_Y}\nsign = -1", r"limits of beta_2 are \[0, .*axis Y .*sign -1"),
    ("range = [0, 150]  ", "range = [45, 50]  ", None),
    ('letter = "X"', 'letter = "x"', "letter of beta_1 is 'x'; it must be one of X Y Z"),
    ('letter = "X"', 'letter = "Y"', "letter Y is given to 2 axes"),
    ('joint = "beta_1"', 'joint = "beta_7"', "no axis moves beta_1 of the robot|an axis moves beta_7"),
    ('joint = "beta_1"', 'joint = "theta_x"', "joint of an axis is 'theta_x'; it must be alpha_i or beta_i"),
    ('joint = "beta_1"', "joint = 1", "joint of an axis is 1"),
    ("approach = 0.2", "approach = 20", r"approach is 20; it must lie in \(0, 1\]"),
    ("approach = 0.2", "aproach = 0.2", "key 'aproach' is unknown"),
    ('robot = "robot.toml"', 'robot = "nowhere.toml"', "robot file .*nowhere.toml"),
    ('robot = "robot.toml"', "robot = 5", "robot is 5; it must be the name of a robot file"),
    ('robot = "robot.toml"', 'robot = "."', "robot file"),
    ("[connection]", "connection = 3\n[bad]", "key 'bad' is unknown"),
    (
        'device = "simulated"  ',
        'device = "lpt1"',
        "device of the connection is 'lpt1'; it must be one of simulated, grbl, ros2",
    ),
    ('device = "simulated"  ', 'device = "grbl"', "url of the connection is ''; a grbl device needs one"),
    ("[arm]", "[arm]\nspeed = 3", "key 'speed' is unknown in arm"),
    ('model = "ur3e"', 'model = "kuka"', "model of the arm is 'kuka'; it must be one of"),
    ('model = "ur3e"', "model = [1]", r"model of the arm is \[1\]"),
    ("speed = 600 ", "speed = nan ", "speed of alpha_1 is nan"),
    ("speed = 600 ", "speed = '600' ", None),
]
WHOLE_RIGS = [
    (b"", "hardware needs a list of axes"),
    (b"axes = 3", "hardware needs a list of axes"),
    (b"axes = [1, 2]", "key 1 is unknown in axis|axis"),
    (b"axes = []\narm = 'ur3'", "arm"),
    (b"\x00\x01\x02", "rig.toml"),
]

STARTS = [
    ("", "cannot be read"),
    ("{}", "cannot be read .'alpha'.*it must be JSON"),
    ("3", "cannot be read"),
    ("null", "cannot be read"),
    ('"abcdefgh"', "cannot be read"),
    ('["a"]', "cannot be read"),
    ('{"alpha": 1, "beta": 2, "theta": 3}', "cannot be read"),
    ('{"alpha": [0], "beta": [0]}', "cannot be read .'theta'"),
    ("[[1, 2], [3, 4]]", "cannot be read"),
    ("[1, 2", "cannot be read"),
    ("[true, false]", "cannot be read|True"),
    ("[" * 100_000, "cannot be read"),
]

GOOD = plan_entries()
PLANS = [
    ({"alpha": ...}, "it has no alpha"),
    ({"time": ...}, "it has no time"),
    ({"meta": ...}, "it has no .*meta"),
    ({"shape": ...}, "it has no shape"),
    ({"alpha": GOOD["alpha"][:, :2]}, r"alpha has shape \(4, 2\), not \(4, 3\)"),
    ({"alpha": GOOD["alpha"][:2]}, r"alpha has shape \(2, 3\)"),
    ({"shape": GOOD["shape"][:, :50]}, r"shape has shape \(4, 50, 3\), not \(4, 101, 3\)"),
    ({"success": GOOD["success"][:2]}, r"success has shape \(2,\), not \(4,\)"),
    ({"to_robot": np.eye(3)}, r"to_robot has shape \(3, 3\), not \(4, 4\)"),
    ({"lumen": np.zeros((5, 3))}, r"lumen has shape \(5, 3\), not \(5, 4\)"),
    ({"truth": np.zeros((4, 7))}, r"truth has shape \(4, 7\), not \(4, 8\)"),
    ({"clearance": np.zeros(4)}, r"clearance has shape \(4,\)"),
    ({"success": np.ones(4)}, "success holds float64; it must be bool"),
    ({"beta": GOOD["beta"].astype(str)}, "beta holds <U.*; it must be numbers"),
    ({"beta": GOOD["beta"].astype(complex)}, "beta holds complex128; it must be numbers"),
    ({"time": GOOD["time"][::-1]}, "it must be finite and grow"),
    ({"time": np.array([1, 2, math.nan, 4])}, "it must be finite and grow"),
    ({"time": np.zeros(0)}, "it has no frames|shape"),
    ({"time": np.zeros((2, 2))}, r"time has shape \(2, 2\)"),
    ({"alpha": np.array([{}], dtype=object)}, "damaged, or another file: .*allow_pickle"),
    ({"meta": "no JSON"}, "Expecting value"),
    ({"meta": "[]"}, r"meta is \[\]; it must be a JSON object"),
    ({"meta": "[" * 100_000}, "is not a plan"),
    ({"meta": changed(GOOD["meta"], "format", 99)}, "it has format 99; this version reads 1"),
    ({"meta": changed(GOOD["meta"], "format", ...)}, "it has format None"),
    ({"meta": changed(GOOD["meta"], "robot", ...)}, "robot of meta is None; it must be a dict"),
    ({"meta": changed(GOOD["meta"], "robot", 3)}, "robot of meta is 3"),
    ({"meta": changed(GOOD["meta"], "robot.tubes", [])}, "a robot has no tubes"),
    ({"meta": changed(GOOD["meta"], "robot.tubes.0.curvature", 66.7)}, "curvature 66.7 per mm is a radius of"),
    ({"meta": changed(GOOD["meta"], "robot.tubes.0", 5)}, "a robot needs a list of tubes"),
    (
        {"meta": changed(GOOD["meta"], "model", "foo")},
        "model of meta is 'foo'; it must be one of dominant, elastic",
    ),
    ({"meta": changed(GOOD["meta"], "evaluated", ["elastic"])}, "evaluated of meta is .'elastic'."),
    ({"meta": changed(GOOD["meta"], "problem", "cos")}, "problem of meta is 'cos'; it must be a dict"),
    ({"meta": changed(GOOD["meta"], "problem.name", ...)}, "name of meta's problem is None"),
    ({"meta": changed(GOOD["meta"], "options", [])}, r"options of meta is \[\]"),
    ({"meta": changed(GOOD["meta"], "solver", 3)}, "solver of meta is 3"),
    ({"meta": changed(GOOD["meta"], "build_s", math.nan)}, "meta holds NaN; its numbers must be finite"),
    ({"meta": changed(GOOD["meta"], "build_s", "x")}, "build_s of meta is 'x'; it must be a number or null"),
    ({"meta": changed(GOOD["meta"], "failures", True)}, "failures of meta is True; it must be a dict"),
    (
        {"meta": changed(GOOD["meta"], "failures", {"a": "b"})},
        "failures of meta tell 'a': 'b'; it must be a frame",
    ),
    ({"meta": changed(GOOD["meta"], "snaps", None)}, "snaps of meta is None; it must be a list"),
    ({"meta": changed(GOOD["meta"], "snaps", [{"a": 1}])}, "snaps of meta hold .*must have frame, tubes and jump"),
    ({"meta": changed(GOOD["meta"], "interrupted", 3)}, "interrupted of meta is 3; it must be a bool"),
    ({"time": np.array([1e12, 2e12, 3e12, 4e12])}, r"time runs from .*; it must be finite and grow.* to 1e\+06 s"),
    ({"target": np.full_like(GOOD["target"], 1e300)}, r"target is 1e\+300 at \[1, 1, 1\]; it must be finite"),
    ({"target": np.full_like(GOOD["target"], math.nan)}, r"target is nan at \[1, 1, 1\]"),
    ({"beta": np.full_like(GOOD["beta"], math.nan)}, "beta is nan at .*, as the robot has a shape there"),
    ({"shape": np.full_like(GOOD["shape"], math.inf)}, "shape is inf at"),
    ({"extra": np.zeros(3)}, None),
    ({"lumen": ..., "clearance": ..., "lumen_radius": ...}, None),
]
WHOLE_PLANS = [b"", b"PK\x03\x04", b"\x93NUMPY", b"hello", b"\x00" * 1000]


def cases():
    """All of the table."""
    for old, new, message in ROBOT_FILES:
        yield of_file(
            Robot.from_toml, "robot.toml", spoilt(ROBOT, old, new), RobotError, message, new or f"no {old}"
        )
    for content, message in WHOLE_ROBOTS:
        yield of_file(Robot.from_toml, "robot.toml", content, RobotError, message, repr(content[:20]))
    for old, new, message in RIG_FILES:
        run = functools.partial(rig, text=spoilt(RIG, old, new))
        yield Case(f"rig.toml: {new}", run, message and HardwareError, message or "it can be moved so")
    crossed = spoilt(
        spoilt(RIG, "range = [0, 150]  ", "range = [45, 50]  "), RANGE_OF_Y, RANGE_OF_Y.replace("150", "30")
    )
    message = "axis Y takes beta_2 to at most 30 mm, and axis X beta_1 to at least 45 mm"
    yield Case("rig.toml: ranges that cross", functools.partial(rig, text=crossed), HardwareError, message)
    for content, message in WHOLE_RIGS:
        yield of_file(Hardware.from_toml, "rig.toml", content, HardwareError, message, repr(content))
    for content, message in STARTS:
        read = functools.partial(read_start, robot=table_i_robot())
        yield of_file(read, "q.json", content, OptionError, message, content[:30])
    for changes, message in PLANS:
        label = ", ".join(f"{name} = {value!r:.40}" for name, value in changes.items()).replace("\n", "")
        run = functools.partial(lambda folder, changes: Plan.load(plan_file(folder, **changes)), changes=changes)
        yield Case(f"plan.npz: {label}", run, message and OutputError, message or "further arrays are allowed")
    for content in WHOLE_PLANS:
        yield of_file(Plan.load, "plan.npz", content, OutputError, "plan.npz is not a plan", repr(content[:10]))


CASES = list(cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_malformed_file_is_one_clear_error_or_rightly_accepted(case, tmp_path):
    judge(case, tmp_path)


def test_the_good_files_that_the_table_spoils_are_good(tmp_path):
    assert Robot.from_toml(written(tmp_path, "robot.toml", ROBOT)).d == 3
    assert rig(tmp_path, RIG).robot.d == 3
    assert Plan.load(plan_file(tmp_path)).complete


@pytest.mark.parametrize(
    ("interrupted", "said"), [(False, "has no frame that was reached"), (True, "was interrupted")]
)
def test_a_plan_of_which_nothing_can_be_simulated_is_refused_by_robust(interrupted, said, tmp_path):
    none = {name: np.full_like(GOOD[name], math.nan) for name in ("shape", "alpha", "beta", "theta")}
    path = plan_file(tmp_path, **none, meta=changed(GOOD["meta"], "interrupted", interrupted))
    with pytest.raises(Said, match=f"plan .*plan.npz {said}"):
        program(robust.main, path, "--draws", "1", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_force_beyond_what_floats_square_is_refused_without_a_warning():
    with pytest.raises(LoadError, match=r"force of a load is 1e\+300 N; it must be at most 100 N"):
        Load((1e300, 0, 0))


def test_an_error_that_quotes_thousands_of_letters_is_cut_in_the_middle(tmp_path):
    path = written(tmp_path, "robot.toml", f"{'k' * 5000} = 1\n{ROBOT}")
    with pytest.raises(RobotError) as raised:
        Robot.from_toml(path)
    assert len(str(raised.value)) <= MAX_MESSAGE_LENGTH
    assert "allowed are name, tubes" in str(raised.value)
