"""The command `ctr-nlp reach`."""

import csv
import json

import pytest

from ctr_nlp import Robot, Tube
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.lumen_tree import read_lumen_tree
from ctr_nlp.anatomy.synthetic_tree import synthetic_tree
from ctr_nlp.cli.studies.reach import _print, main
from ctr_nlp.studies.reach.outcomes import UNPLANNED, EndOutcome
from ctr_nlp.studies.reach.reach import Reach

pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')
pytest.importorskip("distributed", reason='needs dask: pip install -e ".[study]"')

WIDE = Robot((Tube(300, 200, 1 / 400, outer_diameter=17, inner_diameter=16.5),))


@pytest.fixture
def tree(tmp_path):
    write_vtk(tmp_path / "tree.vtp", synthetic_tree(0, 4))
    (tmp_path / "wide.toml").write_text(WIDE.to_toml(), encoding="utf-8")
    return tmp_path / "tree.vtp"


def test_tree_without_room_is_listed_and_drawn_and_nothing_is_planned(tree, capsys):
    out = tree.parent / "out"
    robot = str(tree.parent / "wide.toml")
    call = [str(tree), "--robot", robot, "--from-carina", "--workers", "1", "--out", str(out)]
    assert main(call) == 0  # no end is wide enough, and so none is missed
    printed = capsys.readouterr().out
    assert max(map(len, printed.partition("wrote")[0].splitlines())) <= 100
    assert "wide: 0 of 0 wide-enough ends reached" in printed
    with open(out / "reach.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["outcome"] for row in rows] == ["too narrow"] * 4
    assert all("at a depth of" in row["reason"] for row in rows)
    assert json.loads((out / "summary.json").read_text())["robots"]["any"]["too narrow"] == 4
    assert (out / "tree.png").stat().st_size > 10_000
    page = (out / "reach.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in page
    assert "http" not in page
    assert main(call) == 0


def test_no_robot_is_the_best_at_an_end_without_a_plan(tree, capsys):
    read = read_lumen_tree(tree)
    ends = tuple(
        EndOutcome(end.number, name, UNPLANNED, "", False, 0.0, 0.0, 0.0, 80.0, margin=1.0)
        for end in read.ends
        for name in ("thin", "other")
    )
    _print(Reach(read, ("thin", "other"), ends, robust=True))
    printed = capsys.readouterr().out
    assert "best of 2 robots so far" in printed
    assert printed.count("not planned") == 4 + 3  # rows, and sentences
    assert not [
        line for line in printed.splitlines() if "not planned" in line and line.startswith(" ") and "thin" in line
    ]


def test_robots_of_one_name_are_refused(tree, tmp_path, capsys):
    other = tmp_path / "other"
    other.mkdir()
    (other / "wide.toml").write_text(WIDE.to_toml(), encoding="utf-8")
    robots = ["--robot", str(tmp_path / "wide.toml"), "--robot", str(other / "wide.toml")]
    assert main([str(tree), *robots, "--out", str(tmp_path / "out")]) == 2
    assert "named wide" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_ends_out_of_reach_are_bounded_without_a_plan(tree, capsys):
    thin = Robot((Tube(300, 40, 1 / 400, outer_diameter=1.6, inner_diameter=1.2),))
    (tree.parent / "thin.toml").write_text(thin.to_toml(), encoding="utf-8")
    out = tree.parent / "far"
    call = [str(tree), "--robot", str(tree.parent / "thin.toml"), "--workers", "1", "--out", str(out)]
    assert main(call) == 1
    printed = capsys.readouterr()
    assert "--from-carina or --trim start" in printed.err
    assert "path too long" in printed.out
    with open(out / "reach.csv", encoding="utf-8") as file:
        assert all(float(row["bound"]) > 20 for row in csv.DictReader(file))
