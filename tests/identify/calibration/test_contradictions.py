"""Measurements that contradict the robot are refused with the cause, and good ones never are."""

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from contradictory import MISTAKES, ROBOTS, moved_sensor, simulate

from ctr_nlp import Robot, calibrate
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import MeasurementError, OptionError
from ctr_nlp.identify.calibration.reading import read_measurements
from ctr_nlp.identify.calibration.residuals import errors

LAYOUTS = list(itertools.product((True, False), (0, 4)))
"""Whether measurements are registered, and the number of points beside the tip."""
QUICK = (
    ("points in m", "two", False, 0),
    ("points in cm", "wide", True, 0),
    ("beta and points in m", "two", False, 0),
    ("beta and points in cm", "two", True, 4),
    ("degrees", "two", True, 0),
    ("sign of alpha_1", "wide", True, 0),
    ("mirrored y", "two", False, 4),
    ("y and z exchanged, turned", "two", True, 0),
    ("alpha columns exchanged", "wide", True, 0),
    ("tubes exchanged", "two", True, 0),
    ("rows shifted by one", "wide", True, 0),
    ("rows permuted", "two", False, 4),
    ("two rows exchanged", "two", True, 0),
    ("points permuted in a third", "two", True, 4),
    ("sensor 3 degrees, 5 mm off", "two", True, 0),
)


def refusal(name, robot, registered, points, seed=1):
    """Message about a mistake in measurements of a robot that is within its tolerances."""
    good = simulate(robot, seed, points=points, registered=registered)
    with pytest.raises(MeasurementError) as raised:
        calibrate(robot, MISTAKES[name].apply(good, robot), registered=registered, held_out=0)
    return str(raised.value)


@pytest.mark.parametrize(("name", "robot", "registered", "points"), QUICK)
def test_a_mistake_is_refused_and_named(name, robot, registered, points):
    assert re.search(MISTAKES[name].words, refusal(name, ROBOTS[robot], registered, points))


@pytest.mark.slow
@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_mistake_is_refused_and_named(name, robot):
    mistake = MISTAKES[name]
    if ROBOTS[robot].d < mistake.least_tubes:
        pytest.skip("needs more tubes")
    for registered, points in LAYOUTS:
        if points >= mistake.least_points and (registered or not mistake.needs_registered):
            assert re.search(mistake.words, refusal(name, ROBOTS[robot], registered, points))


@pytest.mark.parametrize(("registered", "points", "noise", "off"), [(True, 0, 1.0, 0.02), (False, 4, 0.05, 0.1)])
def test_good_measurements_are_accepted(registered, points, noise, off):
    robot = ROBOTS["two"]
    good = simulate(robot, 10, noise=noise, off=off, points=points, registered=registered)
    found = calibrate(robot, good, registered=registered, held_out=0)
    assert found.fit.noise.position == pytest.approx(noise, rel=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("seed", range(5))
def test_all_good_measurements_are_accepted(robot, seed):
    for (registered, points), noise, off in itertools.product(LAYOUTS, (0.05, 0.2, 0.5, 1.0), (0.02, 0.1)):
        good = simulate(ROBOTS[robot], seed + 10, noise=noise, off=off, points=points, registered=registered)
        calibrate(ROBOTS[robot], good, registered=registered, held_out=0)


@pytest.mark.parametrize("registered", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("meas_tip_m", "tip_x, tip_y and tip_z are in m"),
        ("meas_beta_m", r"are extensions in m\?"),
        ("meas_deg", "would be possible if angles were in degrees"),
    ],
)
def test_units_of_the_given_files_are_named(shared_data, name, message, registered):
    robot = Robot.from_toml(shared_data / "cases/robots/gym2_wide.toml")
    path = shared_data / f"cases/{name}.csv"
    with pytest.raises(MeasurementError, match=message):
        calibrate(robot, read_measurements(path, robot), registered=registered, held_out=0)


def test_the_right_file_is_accepted(shared_data):
    robot = Robot.from_toml(shared_data / "cases/robots/gym2_wide.toml")
    found = calibrate(robot, read_measurements(shared_data / "cases/meas_right.csv", robot), held_out=0)
    assert errors(found.fit.residuals).mean() == pytest.approx(0.27, abs=0.02)
    assert not found.notes


def test_a_base_pose_may_be_confirmed():
    robot = ROBOTS["two"]
    moved = moved_sensor(3, 5)(simulate(robot, 2), robot)
    with pytest.raises(MeasurementError, match=r"a base pose explains it.* 3\.\d degrees .* drop --registered"):
        calibrate(robot, moved, registered=True, held_out=0)
    found = calibrate(robot, moved, registered=True, held_out=0, accept=["base", "residual"])
    assert any("this was accepted" in note for note in found.notes)
    with pytest.raises(OptionError, match="accept is 'bases'"):
        calibrate(robot, moved, registered=True, accept=["bases"])


@pytest.mark.parametrize("noise", [0, -1, float("nan"), float("inf")])
def test_the_noise_of_a_sensor_is_positive(noise):
    with pytest.raises(OptionError, match="noise is"):
        calibrate(ROBOTS["two"], simulate(ROBOTS["two"], 2), noise=noise)


def test_what_no_mistake_explains_is_refused_without_a_cause():
    robot = ROBOTS["two"]
    good = simulate(robot, 3, points=4)
    random = np.random.default_rng(1)
    wrong = replace(good, tip=good.tip + 8 * random.standard_normal(good.tip.shape), points=good.points * np.nan)
    with pytest.raises(MeasurementError, match=r"noise of 1 mm in each coordinate \(assumed.*--noise"):
        calibrate(robot, wrong, registered=True, held_out=0)
    calibrate(robot, wrong, registered=True, held_out=0, noise=8.0)


def test_an_outlier_is_named_and_changes_next_to_nothing():
    robot = ROBOTS["wide"]
    good = simulate(robot, 20)
    tip = np.array(good.tip)
    tip[5, 0] += 30
    line = np.arange(len(tip)) + 2
    clean = calibrate(robot, good, registered=True, held_out=0)
    found = calibrate(robot, replace(good, tip=tip, line=line), registered=True, held_out=0)
    (note,) = found.notes
    assert re.match(r"line 7: the tip is 30\.\d mm off; it is an outlier, with the weight 0", note)
    assert np.argwhere(found.outliers).tolist() == [[5, 0]]
    assert found.weights[5, 0] == 0
    assert (abs(found.fit.values - clean.fit.values) < clean.fit.sigma).all()
    np.testing.assert_allclose(found.fit.sigma, clean.fit.sigma, rtol=0.15)


def write(path, robot, measured):
    """Write tips to a file, of which line 2 is the first row."""
    rows = np.hstack([measured.q[:, : 2 * robot.d], measured.tip])
    names = ",".join((*robot.axes[: 2 * robot.d], "tip_x", "tip_y", "tip_z"))
    np.savetxt(path, rows, delimiter=",", header=names, comments="")


def run(*arguments):
    return main(["calibrate", *map(str, arguments), "--no-figures", "--folds", "0"])


def test_outliers_are_in_all_files_and_contradictions_in_none(tmp_path, capsys):
    robot = ROBOTS["two"]
    good = simulate(robot, 4)
    tip = np.array(good.tip)
    tip[5, 2] -= 30
    (tmp_path / "robot.toml").write_text(robot.to_toml())
    write(tmp_path / "outlier.csv", robot, replace(good, tip=tip))
    write(tmp_path / "metres.csv", robot, replace(good, tip=good.tip / 1000))
    options = "--robot", tmp_path / "robot.toml", "--registered", "--out", tmp_path / "out"
    assert run(tmp_path / "metres.csv", *options) == 2
    assert "are in m" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert run(tmp_path / "outlier.csv", *options) == 0
    assert "line 7: the tip is" in capsys.readouterr().out
    assert "# Line 7: the tip is" in (tmp_path / "out" / "robot.toml").read_text()
    assert '"line": 7' in (tmp_path / "out" / "calibration.json").read_text()
    header, *rows = (tmp_path / "out" / "residuals.csv").read_text().splitlines()
    weight = header.split(",").index("weight_tip")
    assert [float(row.split(",")[weight]) == 0 for row in rows].count(True) == 1
