"""Tables of points as programs of the trade write them: what is read, and what is refused."""

import numpy as np
import pytest

from ctr_nlp import problem_from_file, read_csv
from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.reading import ASSUMED, GIVEN, STATED, ReadOptions
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.robot import table_i_robot

ANGLE = np.linspace(0, 1.2, 51)
POINTS = 80 * np.column_stack([1 - np.cos(ANGLE), 0.3 * ANGLE**2, np.sin(ANGLE)])
RADIUS = np.linspace(8, 4, 51)
FLIP = np.array([-1.0, -1.0, 1.0])
FIDUCIAL_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"


@pytest.fixture
def write(tmp_path):
    """A function that writes a header and columns, and returns the file's path."""

    def write(header, table=POINTS, name="path.csv", separator=",", encoding="utf-8", decimal=".", end="\n"):
        rows = [separator.join(f"{x:.4f}".replace(".", decimal) for x in row) for row in table]
        path = tmp_path / name
        path.write_bytes((end.join([*([header] if header else []), *rows]) + end).encode(encoding))
        return path

    return write


def only(path, **stated):
    found = read_branches(path, options=ReadOptions(**stated))
    (branch,) = found.branches
    return branch, found


@pytest.mark.parametrize(
    "header",
    [
        "x_mm,y_mm,z_mm",
        "x,y,z",
        "X,Y,Z",
        "x (mm), y (mm), z (mm)",
        "x [mm],y [mm],z [mm]",
        '"Points:0","Points:1","Points:2"',
        "Points_0,Points_1,Points_2",
        "pos_x,pos_y,pos_z",
        "PositionX,PositionY,PositionZ",
        "# c\n\nx,y,z",
        "# x y z",
        "#x,y,z",
    ],
)
def test_headers_of_coordinates(write, header):
    branch, found = only(write(header))
    assert branch.points == pytest.approx(POINTS, abs=1e-4)
    assert branch.radius is None
    assert found.facts.units_known == (STATED if "mm" in header else ASSUMED)


@pytest.mark.parametrize(
    ("title", "factor"),
    [
        ("radius", 1),
        ("radius_mm", 1),
        ("Radius (mm)", 1),
        ("MaximumInscribedSphereRadius", 1),
        ("r", 1),
        ("diameter_mm", 2),
        ("Diameter", 2),
        ("radius_cm", 0.1),
        ("lumen radius [mm]", 1),
        ("radius_m", 1e-3),
    ],
)
def test_names_of_the_radius(write, title, factor):
    digits = np.column_stack([POINTS, RADIUS * factor])
    branch, _ = only(write(f"x_mm,y_mm,z_mm,{title}", digits))
    assert branch.radius == pytest.approx(RADIUS, abs=0.06)
    turned, _ = only(write(f"{title},z_mm,y_mm,x_mm", digits[:, ::-1]))
    assert turned.points == pytest.approx(POINTS, abs=1e-4)
    assert turned.radius == pytest.approx(RADIUS, abs=0.06)


@pytest.mark.parametrize(
    "title", ["min_radius", "width", "Rmax", "Dmean", "d", "mean diameter", "calibre", "thickness"]
)
def test_a_column_that_may_be_the_radius_is_refused_by_name(write, title):
    with pytest.raises(CurveError, match=rf"not certain what column '{title}' means"):
        read_branches(write(f"x,y,z,{title}", np.column_stack([POINTS, RADIUS])))


def test_columns_that_are_something_else_are_named_in_a_note(write):
    table = np.column_stack([POINTS, RADIUS, RADIUS, RADIUS])
    branch, found = only(write("x_mm,y_mm,z_mm,Curvature,radius,Torsion", table))
    assert branch.radius == pytest.approx(RADIUS, abs=1e-4)
    assert "columns not used: Curvature, Torsion" in found.facts.notes


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("x,y,z,Points:0", "columns 'x' and 'Points:0' may both be x"),
        ("x,y,z,x", "columns 'x' and 'x' may both be x"),
        ("radius,x,y,z,diameter", "columns 'radius' and 'diameter' may both be the lumen's size"),
        ("x_mm,y_cm,z_mm", "units of columns 'x_mm', 'y_cm', 'z_mm' differ"),
        ("x,y", "expected a header"),
        ("a,b,c", "first line is 'a,b,c'; expected a header"),
        ("", r"first line is '0\.0000,0\.0000,0\.0000'; expected a header"),
    ],
)
def test_columns_in_doubt_are_refused(write, header, message):
    width = max(len(header.split(",")), 3) if header else 3
    with pytest.raises(CurveError, match=message):
        read_branches(write(header, np.tile(POINTS, 2)[:, :width]))


@pytest.mark.parametrize(
    ("separator", "decimal"), [(";", ","), (";", "."), ("\t", "."), ("\t", ","), ("  ", "."), (" ", ",")]
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_separators_and_encodings(write, separator, decimal, encoding, end):
    header = separator.join(["x_mm", "y_mm", "z_mm", "radius_mm"])
    branch, _ = only(write(header, np.column_stack([POINTS, RADIUS]), "p.csv", separator, encoding, decimal, end))
    assert branch.points == pytest.approx(POINTS, abs=1e-4)
    assert branch.radius == pytest.approx(RADIUS, abs=1e-4)


def test_decimal_commas_between_commas_are_refused(write):
    with pytest.raises(CurveError, match=r"row 2 has 6 cells.*decimal commas.*semicolons"):
        read_branches(write("x,y,z", decimal=","))


def test_the_sign_of_a_micrometre_in_latin_1(write):
    branch, found = only(write("x (µm),y (µm),z (µm)", POINTS * 1000, encoding="latin-1"))
    assert branch.points == pytest.approx(POINTS, abs=1e-4)
    assert (found.facts.units, found.facts.units_known) == ("um", STATED)


@pytest.mark.parametrize(("unit", "factor"), [("cm", 0.1), ("m", 0.001)])
def test_units_are_stated_given_or_asked_for(write, unit, factor):
    table = np.column_stack([POINTS, RADIUS]) * factor
    stated, found = only(write(f"x_{unit},y_{unit},z_{unit},radius_{unit}", table))
    assert stated.points == pytest.approx(POINTS, abs=0.06)
    assert stated.radius == pytest.approx(RADIUS, abs=0.06)
    assert found.facts.units_known == STATED
    commented, _ = only(write(f"# units: {unit}\nx,y,z,radius", table))
    assert commented.radius == pytest.approx(RADIUS, abs=0.06)
    for header in ("x,y,z,radius", "x_mm,y_mm,z_mm,radius_mm"):
        path = write(header, table)
        with pytest.raises(CurveError, match=rf"State the unit with --units {unit}, or --units mm"):
            read_branches(path)
        given, found = only(path, units=unit)
        assert given.points == pytest.approx(POINTS, abs=0.06)
        assert given.radius == pytest.approx(RADIUS, abs=0.06)
        assert found.facts.units_known == GIVEN
        assert read_csv(path, units=unit).length == pytest.approx(read_csv(write("x,y,z")).length, abs=0.2)


def test_points_of_a_person_stay_in_mm(write):
    path = write("x_cm,y_cm,z_cm", POINTS / 10)
    segment = read_branch_segment(path, entry=POINTS[5], target=POINTS[40])
    assert segment.stop - segment.start == pytest.approx(35 / 50 * segment.branch.length, rel=0.05)


@pytest.mark.parametrize(
    ("comment", "space"),
    [
        ("# CoordinateSystem = LPS\n", "LPS"),
        ("# CoordinateSystem = RAS\n", "RAS"),
        ("# CoordinateSystem = 0\n", "RAS"),
        ("# CoordinateSystem = 1\n", "LPS"),
        ("", "RAS"),
    ],
)
def test_fiducial_lists_of_every_version(tmp_path, comment, space):
    rows = [f'C_{k},{x:.4f},{y:.4f},{z:.4f},0,0,0,1,1,1,0,"a, b",,,2,0' for k, (x, y, z) in enumerate(POINTS)]
    rows[7] = rows[7].replace(",2,0", ",0,0")  # a point that was not placed
    header = f"# Markups fiducial file version = 5.10\n{comment}# columns = {FIDUCIAL_COLUMNS}\n"
    path = tmp_path / "F.fcsv"
    path.write_text(header + "\n".join(rows) + "\n")
    branch, found = only(path)
    assert found.space == space
    assert found.facts.space_known == (STATED if comment else ASSUMED)
    lps = POINTS if space == "LPS" else POINTS * FLIP
    assert branch.points == pytest.approx(np.delete(lps, 7, axis=0), abs=1e-4)
    assert any("in their order" in note for note in found.facts.notes)


def test_patient_axes_may_be_named_or_given(write):
    branch, found = only(write("R,A,S"))
    assert (found.space, found.facts.space_known) == ("RAS", STATED)
    assert branch.points == pytest.approx(POINTS * FLIP, abs=1e-4)
    assert only(write("L,P,S"))[1].space == "LPS"
    branch, found = only(write("x,y,z"), space="RAS")
    assert (found.space, found.facts.space_known) == ("RAS", GIVEN)
    assert branch.points == pytest.approx(POINTS * FLIP, abs=1e-4)
    with pytest.raises(CurveError, match="space is LPS, but the file states RAS"):
        only(write("R,A,S"), space="LPS")
    assert only(write("x_mm,y_mm,z_mm"))[1].facts.space_known == ASSUMED


def test_lines_of_vmtk_are_split_by_edge_and_by_their_start(write):
    side = POINTS * [1, -1, 1]
    trunk, one, other = POINTS[:21], POINTS[20:], np.vstack([POINTS[20:21], POINTS[20] + (side[21:] - side[20])])
    edges = np.repeat([[0, 1], [1, 2], [1, 3]], [len(trunk), len(one), len(other)], axis=0)
    table = np.column_stack([np.vstack([trunk, one, other]), edges])
    found = read_branches(write("X Y Z EdgeArray0 EdgeArray1", table, "n.dat", " "))
    assert [branch.name for branch in found.branches] == ["edge 1.0000-2.0000", "edge 1.0000-3.0000"]
    assert found.branches[0].points == pytest.approx(POINTS, abs=1e-4)
    whole = read_branches(write("X Y Z", np.vstack([POINTS, side]), "l.dat", " "))
    assert [len(branch.points) for branch in whole.branches] == [51, 51]
    assert whole.branches[1].points == pytest.approx(side, abs=1e-4)


def test_a_file_cut_short_is_noted_or_refused(write):
    path = write("x_mm,y_mm,z_mm,radius_mm", np.column_stack([POINTS, RADIUS]))
    whole = path.read_bytes()
    cut = path.with_name("cut.csv")
    lines = whole.splitlines(keepends=True)
    last = len(lines[-1])
    for dropped in range(2, last):
        cut.write_bytes(whole[:-dropped])
        try:
            branch, found = only(cut)
        except CurveError:
            continue
        assert found.facts.notes or np.abs(branch.points[-1] - POINTS[len(branch.points) - 1]).max() < 0.5
    cut.write_bytes(whole[: -(last - 8)])
    with pytest.raises(CurveError, match="seems to be cut short"):
        read_branches(cut)


@pytest.mark.parametrize(
    "content", [b"\x00\x01\x02\x03" * 50, b"", b"\xff\xfe\x00", b'x,y,z\n"1,2,3\n', b"x,y,z\n1_0,2,3\n"]
)
def test_what_is_no_table_is_refused(tmp_path, content):
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    with pytest.raises(CurveError, match=r"bad\.csv"):
        read_branches(path)


def test_a_path_is_held_against_the_robot(write, tmp_path):
    with pytest.raises(CurveError, match="robot reaches"):
        problem_from_file(write("x_mm,y_mm,z_mm", POINTS * 0.22), _long_robot())
    assert problem_from_file(write("x_mm,y_mm,z_mm", POINTS * 0.22), _long_robot(), units="mm", frames=3)


def _long_robot():
    """A robot that reaches 300 mm."""
    return table_i_robot().with_limits(beta=((0, 50), (0, 107), (0, 300)))


def test_units_that_nobody_knows_are_refused():
    with pytest.raises(OptionError, match="units is 'inch'"):
        ReadOptions(units="inch")


@pytest.mark.parametrize(
    "header", ["Xmm,Ymm,Zmm", "x,y,z\nmm,mm,mm", "sep=,\nx_mm,y_mm,z_mm", "% MATLAB\nx (mm),y (mm),z (mm)"]
)
def test_other_ways_to_state_mm(write, header):
    branch, found = only(write(header))
    assert branch.points == pytest.approx(POINTS, abs=1e-4)
    assert (found.facts.units_known, found.facts.notes) == (STATED, ())


def test_columns_without_a_name_are_noted_unless_they_are_empty(write):
    numbered = np.column_stack([np.arange(51), POINTS])
    assert only(write(",x_mm,y_mm,z_mm", numbered))[1].facts.notes == ("column not used: number 1",)
    path = write("x_mm,y_mm,z_mm")
    path.write_text(path.read_text().replace("\n", ",\n"))
    assert only(path)[1].facts.notes == ()
