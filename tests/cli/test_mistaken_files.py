"""Files that were given for another one: swapped ones, and names with a slip."""

from pathlib import Path

import pytest
from bench import sweep

from ctr_nlp import Plan, Robot, table_i_robot
from ctr_nlp.exceptions import HardwareError, OutputError, RobotError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.support.mistaken_files import suggest_file

RIG = Path(__file__).parents[2] / "examples" / "hardware.toml"


@pytest.fixture
def files(tmp_path):
    """A robot file, a hardware file and a plan in a folder of results, by kind."""
    robot, rig, results = tmp_path / "robot.toml", tmp_path / "rig.toml", tmp_path / "first"
    robot.write_text(table_i_robot().to_toml())
    rig.write_text(RIG.read_text(encoding="utf-8"), encoding="utf-8")
    results.mkdir()
    sweep().save(results / "plan.npz")
    return {"robot file": robot, "hardware file": rig, "plan": results / "plan.npz"}


@pytest.mark.parametrize(
    ("wanted", "read", "error"),
    [
        ("robot file", Robot.from_toml, RobotError),
        ("hardware file", Hardware.from_toml, HardwareError),
        ("plan", Plan.load, OutputError),
    ],
)
def test_a_file_of_another_kind_is_named(files, wanted, read, error):
    read(files.pop(wanted))
    for kind, file in files.items():
        with pytest.raises(
            error, match=rf"{file.name}.*: it is a {kind}, not a {wanted}; were two files swapped\?"
        ):
            read(file)


def test_a_slip_in_a_path_is_offered_right(files):
    plan = files["plan"]
    root = plan.parents[1]
    for slip in (root / "frist" / "plan.npz", root / "first" / "pln.npz", root / "first"):
        with pytest.raises(OutputError, match=r"Did you mean '.*first/plan\.npz'\?"):
            Plan.load(slip)
    with pytest.raises(RobotError, match=r"Did you mean '.*robot\.toml'\?"):
        Robot.from_toml(root / "robto.toml")


def test_nothing_is_offered_where_no_name_is_near(tmp_path):
    assert suggest_file(tmp_path / "else" / "plan.npz") == ""
    assert suggest_file(tmp_path) == ""
    (tmp_path / "plan.npz").touch()
    assert suggest_file(tmp_path / "plan.npz") == ""
