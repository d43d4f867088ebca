"""`ctr-nlp calibrate`: from a file of measurements to a robot file that plans can be made for."""

import csv
import json

import numpy as np
import pytest
from sensed import TWO, measured_shapes, parts_within, weighed

from ctr_nlp import Robot
from ctr_nlp.cli.main import main
from ctr_nlp.models.loads import with_modulus


def run(*arguments):
    return main([str(argument) for argument in arguments])


@pytest.fixture
def files(tmp_path, monkeypatch):
    """measured.csv, with a copy of its first line, and robot.toml."""
    monkeypatch.chdir(tmp_path)
    seen = measured_shapes(TWO, parts_within(TWO, 1), 1, count=12, places=3)
    names = [f"p{k}_{axis}" for k in (1, 2, 3) for axis in ("x", "y", "z", "sigma")]
    rows = np.hstack([seen.q, np.concatenate([seen.points, seen.sigma[..., None]], axis=2).reshape(12, -1)])
    with open("measured.csv", "w", newline="") as file:
        csv.writer(file).writerows([[*TWO.axes, *names], *rows.tolist(), rows[0].tolist()])
    (tmp_path / "robot.toml").write_text(TWO.to_toml())
    return "measured.csv", "--robot", "robot.toml"


def test_a_robot_is_written_with_what_is_left_to_doubt(files, tmp_path, capsys):
    assert run("calibrate", *files, "--out", "out", "--registered", "--folds", 2, "--next", 2) == 0
    said = capsys.readouterr().out
    assert "curvature_2" in said
    assert "determine it" in said
    assert "of the observations 1 is a copy of another, and was left out" in said
    out = tmp_path / "out"
    names = ["calibration.json", "correlations.png", "measured.png", "next.csv", "parameters.png"]
    assert sorted(path.name for path in out.iterdir() if path.name[0] != ".") == [
        *names,
        *("residuals.csv", "residuals.png", "robot.toml"),
    ]
    told = json.loads((out / "calibration.json").read_text())
    robot = Robot.from_toml(out / "robot.toml")
    values = {row["name"]: row["value"] for row in told["parameters"]}
    assert robot.tubes[0].tip_curvature == pytest.approx(TWO.tubes[0].tip_curvature * (1 + values["curvature_1"]))
    assert len(robot.tolerances.covariance) == 10
    assert told["observations"] == 12
    assert told["repeated"] == 1
    assert told["errors_mm"]["fitted"]["mean"] < told["errors_mm"]["described"]["mean"]
    assert "alpha_1 is" in (out / "robot.toml").read_text().splitlines()[2]
    with open(out / "residuals.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12
    assert {row["fold"] for row in rows} == {"1", "2"}
    with open(out / "next.csv", newline="") as file:
        assert [float(row["left"]) < 1 for row in csv.DictReader(file)] == [True, True]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["m [left] [red] 'a\"b $x$", "m\x1b[2J\n\u202e {0} %s"])
def test_files_of_any_name_are_read_and_named_as_text(name, files, tmp_path, capsys):
    (tmp_path / "measured.csv").rename(tmp_path / f"{name}.csv")
    (tmp_path / "robot.toml").rename(tmp_path / f"{name}.toml")
    asked = f"{name}.csv", "--robot", f"{name}.toml", "--registered", "--folds", 0
    assert run("calibrate", *asked, "--out", "out") == 0
    told = capsys.readouterr()
    assert all(line.isprintable() for line in (told.out + told.err).splitlines())
    assert Robot.from_toml(tmp_path / "out" / "robot.toml").d == TWO.d
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.csv", f"{name}.toml", "out"}


def test_weights_at_the_tip_tell_of_the_modulus(tmp_path, monkeypatch, capsys):
    """The robot file tells only ratios of moduli, so that a first value is asked for."""
    monkeypatch.chdir(tmp_path)
    seen = weighed(with_modulus(TWO, 70_000), with_modulus(TWO, 60_000), 12)
    names = [f"p{k}_{axis}" for k in range(1, 5) for axis in ("x", "y", "z", "sigma")]
    points = np.concatenate([seen.points, seen.sigma[..., None]], axis=2).reshape(12, -1)
    with open("measured.csv", "w", newline="") as file:
        rows = np.hstack([seen.q, seen.force, points]).tolist()
        csv.writer(file).writerows([[*TWO.axes, "force_x", "force_y", "force_z", *names], *rows])
    (tmp_path / "robot.toml").write_text(TWO.to_toml())
    asked = "calibrate", "measured.csv", "--robot", "robot.toml", "--registered", "--folds", 0, "--no-figures"
    assert run(*asked, "--out", "none") == 2
    assert "--youngs-modulus" in capsys.readouterr().err
    assert run(*asked, "--youngs-modulus", 60_000, "--out", "out") == 0
    assert "youngs_modulus" in capsys.readouterr().out
    moduli = [tube.youngs_modulus for tube in Robot.from_toml(tmp_path / "out" / "robot.toml").tubes]
    np.testing.assert_allclose(moduli, 70_000, rtol=0.05)
    with open(tmp_path / "out" / "residuals.csv", newline="") as file:
        assert [float(row["force_z"]) for row in csv.DictReader(file)][:3] == [0, 0, 1]


def test_without_pictures_and_folds_nothing_is_drawn_or_held_out(files, tmp_path):
    assert run("calibrate", *files, "--out", "out", "--registered", "--folds", 0, "--no-figures") == 0
    assert not list((tmp_path / "out").glob("*.png"))
    assert json.loads((tmp_path / "out" / "calibration.json").read_text())["errors_mm"]["held_out"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--estimate", "length"], "'length' cannot be estimated"),
        (["--folds", "50"], "12 different poses"),
        (["--folds", "-1"], "number of folds is -1; it must be"),
        (["--next", "-2"], "number of next poses is -2"),
    ],
)
def test_bad_input_is_told_in_one_line_and_nothing_is_written(files, arguments, message, tmp_path, capsys):
    assert run("calibrate", *files, "--out", "out", *arguments) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert message in line
    assert not (tmp_path / "out").exists()


def test_what_is_not_ours_stays(files, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "robot.toml").write_text("mine")
    assert run("calibrate", *files, "--out", "out") == 2
    assert "not empty and was not written by ctr-nlp" in capsys.readouterr().err
    assert (tmp_path / "out" / "robot.toml").read_text() == "mine"
