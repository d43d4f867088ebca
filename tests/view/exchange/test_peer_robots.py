"""Robots as other programs' files give them: units, order, directions, and what is refused."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import savemat

import ctr_nlp as ctr
from ctr_nlp.cli.commands import new
from ctr_nlp.exceptions import CtrError

INNER = {
    "length": 0.15,
    "length_curved": 0.1,
    "diameter_inner": 1.0e-3,
    "diameter_outer": 2.4e-3,
    "stiffness": 5e10,
    "torsional_stiffness": 2.3e10,
    "x_curvature": 15.82,
    "y_curvature": 0.0,
}
OUTER = INNER | {"length": 0.1, "length_curved": 0.04, "diameter_inner": 3e-3, "diameter_outer": 3.8e-3}
GYM = {"inner": INNER, "outer": OUTER}
MEXLIB = {
    "tube1": {"OD": 1.1e-3, "ID": 1e-3, "k": 25.0, "L": 0.15, "Lt": 0.1, "E": 50e9, "G": 50e9 / 2.6},
    "tube2": {"OD": 1.4e-3, "ID": 1.3e-3, "k": -20.0, "L": 0.1, "Lt": 0.07, "E": 50e9, "G": 50e9 / 2.8},
}


READ = r"Read are robot files of ctr_nlp \(\.toml\), and tubes as MexLib or gym-ctr have them \(\.json, \.mat\)"


@pytest.fixture
def written(tmp_path):
    """Writes what a file is to hold; gives its path."""

    def write(held, name="tubes.json"):
        path = tmp_path / name
        if path.suffix == ".mat":
            savemat(path, held)
        else:
            path.write_text(held if isinstance(held, str) else json.dumps(held))
        return path

    return write


def test_tubes_come_outermost_first_in_our_units(written):
    imported = ctr.read_robot(written(GYM))
    assert imported.names == ("outer", "inner")
    outer, inner = imported.robot.tubes
    assert (inner.length, inner.curved_length, inner.curvature) == (150.0, 100.0, 0.01582)
    assert (outer.inner_diameter, outer.outer_diameter) == (3.0, 3.8)
    assert inner.youngs_modulus == 50000.0
    assert inner.poisson_ratio == pytest.approx(5e10 / (2 * 2.3e10) - 1)


def test_a_struct_of_matlab_is_read(written):
    imported = ctr.read_robot(written({"tubes": MEXLIB}, "tubes.mat"))
    assert imported.names == ("tube2", "tube1")
    assert [tube.curved_length for tube in imported.robot.tubes] == [30.0, 50.0]
    assert [tube.poisson_ratio for tube in imported.robot.tubes] == pytest.approx([0.4, 0.3])
    assert ctr.read_robot(written(list(MEXLIB.values()))).names == ("2", "1")


def test_a_struct_array_of_matlab_is_read(written):
    rows = np.array([tuple(tube.values()) for tube in MEXLIB.values()], [(key, float) for key in MEXLIB["tube1"]])
    assert ctr.read_robot(written({"tubes": rows}, "tubes.mat")).robot == ctr.read_robot(written(MEXLIB)).robot


def test_a_lone_tube_turned_as_told_bends_as_it_does_there(written):
    """There R' = R [u]x with u = (x, y, 0) turned by the angle; it is integrated here in small steps."""
    for x, y, angle in [(12.0, 0.0, 0.0), (0.0, 9.0, 0.4), (-5.0, 7.0, -1.1)]:
        imported = ctr.read_robot(written({"one": INNER | {"x_curvature": x, "y_curvature": y}}))
        ux, uy = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ [x, y]
        turn = np.array([[0, 0, uy], [0, 0, -ux], [-uy, ux, 0]]) * 1e-3
        rotation, tip, step = np.eye(3), np.zeros(3), 0.01
        for _ in range(8000):
            middle = rotation @ (np.eye(3) + step / 2 * turn)
            tip, rotation = tip + step * middle[:, 2], rotation + step * middle @ turn
        q = np.array([[imported.alpha_offsets[0] + angle, 80.0, 0.0, 0.0]])
        assert ctr.shapes(imported.robot, q)[0, -1] == pytest.approx(tip, abs=1e-3)


def test_one_of_several_robots_is_taken_by_name(written):
    path = written({"ctr_0": GYM, "ctr_1": {"only": INNER}})
    assert ctr.read_robot(path, "ctr_1").names == ("only",)
    with pytest.raises(CtrError, match="holds several robots, ctr_0, ctr_1; give the name of one"):
        ctr.read_robot(path)
    with pytest.raises(CtrError, match=r"name of a robot is 'ctr_2'; it must be one of ctr_0, ctr_1"):
        ctr.read_robot(path, "ctr_2")


def test_a_poisson_ratio_may_take_the_place_of_a_shear_modulus_that_no_tube_has(written):
    path = written({"inner": INNER | {"stiffness": 68.6e10, "torsional_stiffness": 11.53e10}})
    with pytest.raises(CtrError, match=r"tube 'inner' .* Poisson ratio of 1\.97; .* give a Poisson ratio"):
        ctr.read_robot(path)
    assert ctr.read_robot(path, poisson_ratio=0.3).robot.tubes[0].poisson_ratio == 0.3


@pytest.mark.parametrize(
    ("held", "told"),
    [
        ("{", "tubes.json: it is damaged, or of another kind"),
        ("[" * 4000 + "]" * 4000, "tubes.json: it is damaged, or of another kind|deep"),
        ([[[[[[[[[[[[[[[[[[[[[[[INNER]]]]]]]]]]]]]]]]]]]]]]], "more than 20 deep"),
        ({}, "it holds no tubes; a tube is a table with OD, .* \\(MexLib\\); or diameter_outer"),
        (3, "it holds no tubes"),
        ({"inner": {k: v for k, v in INNER.items() if k != "length"}}, "length of tube 'inner' is missing"),
        ({"inner": INNER | {"stiffness": "5e10"}}, "of tube 'inner' is '5e10'; it must be a finite number"),
        ('{"inner": ' + json.dumps(INNER | {"length": math.nan}) + "}", "length of tube 'inner' is nan"),
        ({"inner": INNER | {"diameter_outer": 2.4}}, "tube 'inner', in gym-ctr's m, 1/m and Pa: .*2.4 mm"),
        ({"inner": INNER | {"torsional_stiffness": 0.0}}, "Poisson ratio of inf"),
        ({"inner": INNER, "outer": OUTER | {"diameter_inner": 2e-3}}, "tubes.json: .*diameter"),
    ],
)  # fmt: skip
def test_what_holds_no_robot_is_refused_by_name(written, held, told):
    with pytest.raises(CtrError, match=f"(?s)robot file .*{told}"):
        ctr.read_robot(written(held))


def test_other_kinds_of_files_are_refused(tmp_path):
    with pytest.raises(CtrError, match=rf"its name must end in \.toml, \.json or \.mat\. {READ}"):
        ctr.read_robot(tmp_path / "tubes.yaml")
    for name in ("none.json", "none.mat", "none.toml"):
        with pytest.raises(CtrError, match=rf"cannot be read: .*No such file.*{READ}"):
            ctr.read_robot(tmp_path / name)
    (tmp_path / "tubes.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(CtrError, match="damaged"):
        ctr.read_robot(tmp_path / "tubes.mat")
    for name, text in (
        ("bad.toml", "[[tubes"),
        ("load.toml", "force = [0, 0, 1]"),
        ("bad.json", "{"),
        ("no.json", "3"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(CtrError, match=rf"robot file .*{name}: .*{READ}"):
            ctr.read_robot(tmp_path / name)


def test_robot_files_of_this_library_are_read(tmp_path):
    robot = ctr.table_i_robot().with_limits(alpha=(-3.0, 3.0))
    robot = replace(robot, tolerances=ctr.Tolerances(0.05, motor_zero=0.1))
    (tmp_path / "robot.toml").write_text(robot.to_toml("A robot."))
    imported = ctr.read_robot(tmp_path / "robot.toml")
    assert imported.robot == robot
    assert (imported.names, imported.alpha_offsets) == (("tube 1", "tube 2", "tube 3"), (0.0, 0.0, 0.0))
    (tmp_path / "again.toml").write_text(imported.to_toml("robot.toml"))
    assert ctr.Robot.from_toml(tmp_path / "again.toml") == robot
    assert "there" not in (tmp_path / "again.toml").read_text().split("[[tubes]]")[0]
    softer = ctr.read_robot(tmp_path / "robot.toml", poisson_ratio=0.2).robot
    assert {tube.poisson_ratio for tube in softer.tubes} == {0.2}
    with pytest.raises(CtrError, match="holds one robot, without a name"):
        ctr.read_robot(tmp_path / "robot.toml", "mine")


def test_a_robot_file_from_the_template_is_read(tmp_path):
    assert called("robot", tmp_path / "robot.toml") == 0
    assert ctr.read_robot(tmp_path / "robot.toml").robot == ctr.Robot.from_toml(tmp_path / "robot.toml")


def called(*arguments):
    return new.main([str(argument) for argument in arguments])


def test_the_command_writes_a_robot_file_that_says_how_angles_are_turned(written, tmp_path, capsys):
    source, file = written({"tubes": MEXLIB}, "tubes.mat"), tmp_path / "robot.toml"
    assert called("robot", file, "--from", source) == 0
    assert ctr.Robot.from_toml(file) == ctr.read_robot(source).robot
    head = file.read_text().split("[[tubes]]")[0]
    assert (
        "# Tube 1 is called tube2 there. Its angle there +1.5708 rad is alpha_1, and the position of its base"
        in head
    )
    assert "# Tube 2 is called tube1 there. Its angle there -1.5708 rad is alpha_2" in head
    assert "next: ctr-nlp plan bronchus --robot" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("load", "a.toml", "--from", "tubes.json"), "--from is given for a load file"),
        (("robot", "a.toml", "--name", "x"), "--name says what to take from another program's file"),
        (("robot", "a.toml", "--poisson-ratio", "0.3"), "--poisson-ratio says what"),
        (("robot", "a.toml", "--from", "none.json"), "robot file none.json cannot be read"),
    ],
)
def test_calls_that_make_no_sense_write_nothing(arguments, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert called(*arguments) == 2
    assert told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
