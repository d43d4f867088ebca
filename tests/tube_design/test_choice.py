"""The choice among robots: the one that fits a path best, why others do not, and the robots of the package."""

from __future__ import annotations

import shlex
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, Robot, choose_robot, compare_robots, curve_from_points, growing, read_robot_files
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import RobotError
from ctr_nlp.ocp.shared.design import DesignedTubes
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.robot.shipped import SHIPPED_ROBOTS_FOLDER, read_robot
from ctr_nlp.tube_design import choice

PAIR = Robot(TWO.tubes)
FRAMES = 5


def _printed(capsys):
    """All that was printed since the last call."""
    found = capsys.readouterr()
    return found.out + found.err


def _bent(radius):
    """The pair with both curved parts bent to this radius, mm."""
    return replace(PAIR, tubes=tuple(replace(tube, curvature=1 / radius) for tube in PAIR.tubes))


def _points(radius):
    """Points of an arc of 60 mm."""
    u = np.linspace(0.0, 60.0, 31)
    return np.stack([radius * (1 - np.cos(u / radius)), 0 * u, radius * np.sin(u / radius)], axis=-1)


@pytest.fixture(scope="module")
def sharp():
    curve = curve_from_points(_points(50.0), np.full(31, 3.0))
    return Problem("sharp", PAIR, growing(curve, FRAMES), duration=4.0)


ROBOTS = {"straight": _bent(2000.0), "bent": _bent(50.0)}


@pytest.fixture
def dominant(monkeypatch):
    """Plans of the choice on the dominant model, which take a fraction of the time."""
    monkeypatch.setattr(choice, "solve_horizon", partial(choice.solve_horizon, model="dominant"))


def test_the_robot_that_fits_the_path_is_chosen(sharp, dominant):
    assert choose_robot(sharp, ROBOTS).name == "bent"


def test_an_unchecked_verdict_does_not_count_as_reached(sharp, dominant):
    """The dominant model cannot say whether a robot snaps."""
    (one,) = compare_robots(sharp, {"bent": ROBOTS["bent"]})
    assert one.plan.verdicts.solved.word == "yes"
    assert not one.reaches
    assert one.binding.word == "NOT CHECKED"


@pytest.mark.slow
def test_robots_are_listed_with_what_keeps_them_from_the_end(sharp):
    best, other = compare_robots(sharp, ROBOTS)
    assert (best.name, best.reaches, best.binding) == ("bent", True, None)
    assert (other.name, other.reaches) == ("straight", False)
    assert other.binding.word == "no"
    assert other.binding.matter in ("arrives", "within the wall")


def test_a_robot_that_is_too_short_is_listed_with_the_reason(sharp):
    outer, inner = PAIR.tubes
    short = replace(PAIR, tubes=(replace(outer, curved_length=20.0), replace(inner, curved_length=30.0)))
    (found,) = compare_robots(sharp, {"short": short})
    assert found.plan is None
    assert not found.reaches
    assert "reach" in found.reason
    assert choose_robot(sharp, {"short": short}) is None


def test_shipped_robots_can_be_made_and_are_slim():
    robots = read_robot_files()
    assert len(robots) >= 3
    for name, robot in robots.items():
        assert name.startswith("stock_")
        assert max(tube.outer_diameter for tube in robot.tubes) <= 2.8
        tubes = DesignedTubes(robot, Manufacture(outer=2.8))
        assert tubes.satisfies_rules(tubes.nominal_unknowns), name


def test_shipped_robot_files_say_how_they_were_designed():
    for path in SHIPPED_ROBOTS_FOLDER.glob("*.toml"):
        head = path.read_text(encoding="utf-8").partition("[[tubes]]")[0]
        assert "ctr-nlp design" in head, path.name
        assert "--walls" in head, path.name


def test_robots_are_counted_while_they_are_compared(sharp, dominant):
    told = []
    choose_robot(sharp, ROBOTS, progress=lambda *step: told.append(step))
    assert told == [(0, 2, "straight, bent"), (1, 2, "bent"), (2, 2, "")]


def test_a_folder_without_robot_files_is_refused(tmp_path):
    with pytest.raises(RobotError, match="has no robot file"):
        read_robot_files(tmp_path)
    with pytest.raises(RobotError, match="is no folder"):
        read_robot_files(tmp_path / "none")


@pytest.fixture
def lumen_file(tmp_path):
    path = tmp_path / "sharp.csv"
    rows = np.column_stack([_points(50.0), np.full(31, 3.0)])
    np.savetxt(path, rows, delimiter=",", header="x_mm,y_mm,z_mm,radius_mm", comments="")
    return path


def test_choose_command_lists_the_robots_of_a_folder(lumen_file, tmp_path, capsys, dominant):
    folder = tmp_path / "robots"
    folder.mkdir()
    for name, robot in ROBOTS.items():
        (folder / f"{name}.toml").write_text(robot.to_toml(), encoding="utf-8")
    target = _points(50.0)[20].tolist()
    path = [str(lumen_file), "--target", *map(str, target)]
    asked = ["choose", *path, "--robots", str(folder), "--frames", str(FRAMES), "--jobs", "1"]
    assert main(asked) == 1
    printed = capsys.readouterr().out
    assert "None of the robots reaches the end; bent comes nearest" in printed
    next_command = next(line for line in printed.splitlines() if line.startswith("next, tubes for this path: "))
    assert next_command.partition(": ")[2] == shlex.join(["ctr-nlp", "design", *path, "--walls", "--nominal"])


@pytest.mark.slow
def test_choose_command_says_which_robots_reach_the_end(lumen_file, tmp_path, capsys):
    folder = tmp_path / "robots"
    folder.mkdir()
    for name, robot in ROBOTS.items():
        (folder / f"{name}.toml").write_text(robot.to_toml(), encoding="utf-8")
    asked = ["choose", str(lumen_file), "--robots", str(folder), "--frames", str(FRAMES), "--jobs", "1"]
    assert main(asked) == 0
    printed = capsys.readouterr().out
    assert "bent reaches the end as described" in printed
    (folder / "bent.toml").unlink()
    assert main(asked) == 1
    assert "None of the robots reaches the end; straight comes nearest" in capsys.readouterr().out


def test_choose_command_needs_a_wall(tmp_path, capsys):
    path = tmp_path / "bare.csv"
    np.savetxt(path, _points(50.0), delimiter=",", header="x_mm,y_mm,z_mm", comments="")
    assert main(["choose", str(path)]) == 2
    assert "no wall is known around bare" in capsys.readouterr().err


@pytest.mark.slow
def test_a_path_within_a_lumen_is_planned_for_a_shipped_robot(lumen_file, tmp_path, capsys):
    asked = ["plan", str(lumen_file), "--nominal", "--frames", "4", "--no-figures", "--no-evaluate"]
    main([*asked, "--out", str(tmp_path / "out")])
    assert "robot: stock_" in _printed(capsys)
    (tmp_path / "mine.toml").write_text(ROBOTS["bent"].to_toml(), encoding="utf-8")
    main([*asked, "--out", str(tmp_path / "mine"), "--robot", str(tmp_path / "mine.toml")])
    assert "robot: " not in _printed(capsys)


def test_a_robot_of_the_package_is_known_by_its_name(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert read_robot("stock_2").to_dict() == read_robot_files()["stock_2"].to_dict()
    with pytest.raises(RobotError, match=r"'stock_22'.*stock_1.*stock_4.*Did you mean 'stock_2'"):
        read_robot("stock_22")
    with pytest.raises(RobotError, match=r"none\.toml"):
        read_robot(tmp_path / "none.toml")
    # A file of that name counts first.
    (tmp_path / "stock_2").write_text(PAIR.to_toml())
    assert read_robot("stock_2").d == 2
    assert main(["plan", "arc", "--robot", "stock_9", "--frames", "3"]) == 2
    assert "which come with the package" in _printed(capsys)
