"""Small tables and markups that imitate what people reported: each gives what the table of the data says."""

import numpy as np
import pytest

from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.cli.commands.inspect import main as inspect
from ctr_nlp.exceptions import CurveError


@pytest.fixture
def cases(shared_data):
    return shared_data / "cases"


def read_one(path, **stated):
    found = read_branches(path, options=ReadOptions(**stated))
    (branch,) = found.branches
    return branch, found.facts.notes


@pytest.mark.parametrize(
    ("name", "length", "note"),
    [
        ("ok_curve.mrk.json", 110.0, None),
        ("A_repeated_point.mrk.json", 110.0, "left out a point that repeats the one before it (24)"),
        ("T9_repeat.csv", 100.0, "left out a point that repeats the one before it (21)"),
        ("C_radius_all_zero.mrk.json", 110.0, "the lumen's radius is zero at all points: it is taken as unknown"),
    ],
)
def test_what_is_repaired_has_a_note(cases, name, length, note):
    branch, notes = read_one(cases / name)
    assert branch.length == pytest.approx(length, abs=0.01)
    assert note is None or note in notes
    assert (branch.radius is None) == (name[0] in "CT")


@pytest.mark.parametrize("name", ["B_first_point_last", "B_first_point_last_no_radius"])
def test_the_first_point_last_is_refused_unless_accepted(cases, name):
    path = cases / f"{name}.mrk.json"
    message = r"points 110 \(.*\) and 111 \(0, 0, 0\) are 106\.3 mm apart.* 1 mm: .*SlicerVMTK before 2024"
    with pytest.raises(CurveError, match=message):
        read_branches(path)
    assert any("accepted" in note for note in read_one(path, accept=("steps",))[1])


@pytest.mark.parametrize("several", [False, True])
def test_pieces_of_a_tree_are_joined(cases, several):
    trunk, pieces = cases / "D_trunk_(0).mrk.json", sorted(cases.glob("D_branch_*"))
    found = (
        read_branches(trunk, pieces=pieces) if several else read_branches(cases / "D_tree_in_one_file.mrk.json")
    )
    assert [branch.name for branch in found.branches] == ["tree (1)", "tree (2)"]
    assert [branch.length for branch in found.branches] == pytest.approx([110, 110], abs=0.05)
    assert all(branch.points[0] == pytest.approx([0, 0, 0]) for branch in found.branches)
    assert all(branch.radius[[0, -1]] == pytest.approx([8, 4]) for branch in found.branches)


@pytest.mark.parametrize("name", ["D_branch_(1)", "D_branch_(2)"])
def test_a_piece_is_not_planned_from_where_another_ends(cases, name):
    with pytest.raises(CurveError, match=r"a piece of a tree: it begins at .* D_trunk_\(0\)"):
        read_branch_segment(cases / f"{name}.mrk.json")


@pytest.mark.parametrize(("name", "kind"), [("E_closed", "ClosedCurve"), ("E_fiducials", "Fiducial")])
def test_other_markups_are_refused(cases, name, kind):
    with pytest.raises(CurveError, match=rf"is of type '{kind}'; it must be an open curve, .*; .* open curve"):
        read_branches(cases / f"{name}.mrk.json")


@pytest.mark.parametrize(
    ("name", "unit", "length"),
    [("F_cm.mrk.json", "cm", 110.0), ("F_m.mrk.json", "m", 110.0), ("T11_cm.csv", "cm", 100.0)],
)
def test_a_unit_is_asked_for_by_name(cases, name, unit, length):
    with pytest.raises(CurveError, match=rf"State the unit with --units {unit}, or --units mm"):
        read_branches(cases / name)
    branch, notes = read_one(cases / name, units=unit)
    assert branch.length == pytest.approx(length, abs=0.01)
    assert f"units are {unit}, as given; the file says mm" in notes


@pytest.mark.parametrize(
    ("name", "radius"),
    [
        *((f"{name}.csv", True) for name in ("T10_radius_name", "T12_radius", "T12b_radius_mm", "T8_diameter")),
        *((name, True) for name in ("T2_paraview.csv", "T6_vmtk.dat", "T5_semicolon_comma.csv")),
        *((name, False) for name in ("T1_slicer510.fcsv", "T3_xyz.csv", "T7_hash_comment.csv")),
    ],
)
def test_tables_of_the_trade_are_read(cases, name, radius):
    branch, _ = read_one(cases / name)
    assert branch.length == pytest.approx(100, abs=0.01)
    assert branch.points[[0, -1]] == pytest.approx(np.array([[0, 0, 0], [19.2701, 0, 95.6533]]))
    assert (branch.radius is not None) == radius
    if radius:
        assert branch.radius[[0, -1]] == pytest.approx([8, 4])


def test_a_table_without_a_header_is_refused_with_what_is_expected(cases):
    with pytest.raises(CurveError, match=r"first line is '0\.0000,0\.0000,0\.0000'; expected a header x_mm,y_mm"):
        read_branches(cases / "T4_no_header.csv")


def test_columns_that_are_left_out_are_named(cases):
    notes = read_one(cases / "T6_vmtk.dat")[1]
    assert "columns not used: EdgeArray0, EdgeArray1, EdgePCoordArray" in notes


def test_every_path_that_is_read_can_be_inspected(cases, capsys):
    for name in ("A_repeated_point.mrk.json", "T1_slicer510.fcsv", "T6_vmtk.dat"):
        assert inspect([str(cases / name)]) == 0
    shown = capsys.readouterr().out
    for text in (
        "markups of 3D Slicer",
        "fiducial list of 3D Slicer",
        "point table of VMTK",
        "note: left out a point",
    ):
        assert text in shown
