"""Lines in VTK files, written by other means than those that read them: whole, in pieces, from tip to root."""

import sys
import xml.etree.ElementTree as ET
from itertools import pairwise

import meshio
import numpy as np
import pytest
import pyvista
import vtk
from hypothesis import given
from hypothesis import strategies as st
from vtkmodules.util.numpy_support import numpy_to_vtk

from ctr_nlp import curve_from_points, read_csv
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.formats.network import CentrelineNetwork
from ctr_nlp.exceptions import CurveError, OptionError

FLIP = np.array([-1.0, -1.0, 1.0])
RADIUS = "MaximumInscribedSphereRadius"


def write_xml(path, points, lines, radius=None, space=None, name=RADIUS, cells=None):
    """An ascii .vtp, as VTK's file format documentation describes it."""
    root = ET.Element("VTKFile", type="PolyData", version="0.1", byte_order="LittleEndian")
    poly = ET.SubElement(root, "PolyData")
    if space:
        field = ET.SubElement(poly, "FieldData")
        array = ET.SubElement(field, "DataArray", type="String", Name="SPACE", NumberOfTuples="1", format="ascii")
        array.text = " ".join(str(ord(letter)) for letter in space) + " 0"
    piece = ET.SubElement(poly, "Piece", NumberOfPoints=str(len(points)), NumberOfLines=str(len(lines)))

    def array(parent, kind, label, values, width=1):
        data = ET.SubElement(parent, "DataArray", type=kind, NumberOfComponents=str(width), format="ascii")
        data.set("Name", label)
        data.text = " ".join(repr(float(v)) if kind == "Float64" else str(int(v)) for v in np.ravel(values))

    if radius is not None:
        array(ET.SubElement(piece, "PointData"), "Float64", name, radius)
    if cells:
        data = ET.SubElement(piece, "CellData")
        for label, values in cells.items():
            array(data, "Int64", label, values)
    array(ET.SubElement(piece, "Points"), "Float64", "Points", points, 3)
    topology = ET.SubElement(piece, "Lines")
    array(topology, "Int64", "connectivity", np.concatenate([*lines, []]))
    array(topology, "Int64", "offsets", np.cumsum([len(line) for line in lines]))
    ET.ElementTree(root).write(path, xml_declaration=True)
    return path


def write_vtk(path, points, lines, radius=None, space=None, name=RADIUS):
    """Binary files by VTK itself, marked as 3D Slicer marks them."""
    poly, cells, places = vtk.vtkPolyData(), vtk.vtkCellArray(), vtk.vtkPoints()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points, dtype=np.float32), deep=True))
    for line in lines:
        cells.InsertNextCell(len(line), [int(i) for i in line])
    poly.SetPoints(places)
    poly.SetLines(cells)
    if radius is not None:
        array = numpy_to_vtk(np.asarray(radius, dtype=float), deep=True)
        array.SetName(name)
        poly.GetPointData().AddArray(array)
    if path.suffix == ".vtk":
        writer = vtk.vtkPolyDataWriter()
        writer.SetFileTypeToBinary()
        writer.SetHeader(f"3D Slicer output. SPACE={space}" if space else "vtk output")
    else:
        writer = vtk.vtkXMLPolyDataWriter()
        if space:
            mark = vtk.vtkStringArray()
            mark.SetName("SPACE")
            mark.InsertNextValue(space)
            poly.GetFieldData().AddArray(mark)
    writer.SetFileName(str(path))
    writer.SetInputData(poly)
    assert writer.Write()
    return path


def write_meshio(path, points, lines, radius=None, space=None, name=RADIUS):
    """Legacy .vtk and .vtu with two points a line; meshio has no place for SPACE."""
    assert space is None
    pairs = np.concatenate([np.column_stack([line[:-1], line[1:]]) for line in lines])
    data = None if radius is None else {name: np.asarray(radius)}
    meshio.Mesh(points, [("line", pairs)], point_data=data).write(path)
    return path


FORMATS = {
    "xml.vtp": (write_xml, ".vtp", None),
    "xml RAS.vtp": (write_xml, ".vtp", "RAS"),
    "vtk LPS.vtp": (write_vtk, ".vtp", "LPS"),
    "vtk RAS.vtp": (write_vtk, ".vtp", "RAS"),
    "vtk RAS.vtk": (write_vtk, ".vtk", "RAS"),
    "vtk.vtk": (write_vtk, ".vtk", None),
    "meshio.vtk": (write_meshio, ".vtk", None),
    "meshio.vtu": (write_meshio, ".vtu", None),
}


@pytest.mark.parametrize(("write", "suffix", "space"), FORMATS.values(), ids=FORMATS)
def test_a_real_airway_comes_back(shared_data, tmp_path, write, suffix, space):
    file = shared_data / "airways" / "hra_vhm_left_main.csv"
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    points = table[:, :3] * (FLIP if space == "RAS" else 1)
    path = write(tmp_path / f"airway{suffix}", points, [np.arange(len(points))], table[:, 3], space)
    found = read_branches(path)
    (branch,) = found.branches
    same, expected = curve_from_points(branch.points, branch.radius), read_csv(file)
    s = np.linspace(0, expected.length, 400)
    assert found.space == (space or "LPS")
    assert same.length == pytest.approx(expected.length, abs=1e-2)
    assert np.abs(same.point(s) - expected.point(s)).max() < 0.01
    assert np.abs(same.radius(s) - expected.radius(s)).max() < 0.01


def test_real_airways_that_share_a_trachea_come_back_together(shared_data, tmp_path):
    """Their files start at different places of one trachea, and rounding keeps their points apart or not."""
    tables = [
        np.loadtxt(shared_data / "airways" / f"chaste_ts002_{n}.csv", delimiter=",", skiprows=1) for n in LOBES
    ]
    starts = np.cumsum([0, *(len(table) for table in tables)])
    lines = [np.arange(a, b) for a, b in pairwise(starts)]
    points = np.concatenate(tables)
    found = read_branches(write_xml(tmp_path / "lungs.vtp", points[:, :3], lines, points[:, 3]))
    tips = [branch.points[-1] for branch in found.branches]
    assert sorted(map(tuple, tips)) == sorted(tuple(table[-1, :3]) for table in tables)
    for branch in found.branches:
        assert branch.points[0, 2] > branch.points[-1, 2] + 80


LOBES = ("LLL", "RLL", "RML")


def fork(twigs=2, steps=12):
    """A trunk that parts into twigs, each of which parts in two: whole lines (k, n, 3), and radii (k, n) in mm."""
    t = np.linspace(0, 1, steps + 1)[1:, None]
    lines = []
    for i in range(twigs):
        for j in (-1, 1):
            out = np.array([np.cos(2 * np.pi * i / twigs), np.sin(2 * np.pi * i / twigs), -1.0])
            side = np.array([-out[1], out[0], 0.0]) * j
            trunk = np.vstack([[[0, 0, 100]], np.array([0, 0, 100]) + t * [0, 0, -60]])
            middle = trunk[-1] + t * 30 * out
            lines.append(np.vstack([trunk, middle, middle[-1] + t * 20 * (out + side)]))
    radius = np.repeat([8.0, 5.0, 3.0], [steps + 1, steps, steps])
    return np.array(lines), np.tile(radius, (len(lines), 1))


def pieces(lines):
    """The lines cut where branches part, each piece once: points (n, 3) that are not shared, and lines."""
    steps = (len(lines[0]) - 1) // 3
    cut = [line[k * steps : (k + 1) * steps + 1] for line in lines for k in range(3)]
    cut = [piece for k, piece in enumerate(cut) if not any(np.array_equal(piece, other) for other in cut[:k])]
    starts = np.cumsum([0, *(len(piece) for piece in cut)])
    return np.vstack(cut), [np.arange(a, b) for a, b in pairwise(starts)]


def width(points):
    """The lumen's radius in mm of fork() at points (n, 3): 8 on the trunk, 5 and 3 beyond it."""
    depth = 100 - points[:, 2]
    return np.where(depth <= 60, 8.0, np.where(depth <= 90, 5.0, 3.0))


def assert_same(found, lines):
    """The branches are these lines, in any order."""

    def ordered(paths):
        return sorted((np.round(path, 3).tolist() for path in paths), key=lambda path: path[-1])

    assert len(found.branches) == len(lines)
    for one, other in zip(ordered([b.points for b in found.branches]), ordered(lines), strict=True):
        assert np.array(one) == pytest.approx(np.array(other), abs=2e-3)


def unshared(lines):
    count = len(lines[0])
    return lines.reshape(-1, 3), [np.arange(k * count, (k + 1) * count) for k in range(len(lines))]


@pytest.mark.parametrize("turned", [False, True])
def test_whole_lines_over_a_shared_trunk(tmp_path, turned):
    lines, radius = fork()
    points, cells = unshared(lines)
    cells = [cell[::-1] for cell in cells] if turned else cells
    found = read_branches(write_xml(tmp_path / "tree.vtp", points, cells, radius.ravel()))
    assert_same(found, lines)
    assert all(branch.radius[0] == 8 and branch.radius[-1] == 3 for branch in found.branches)
    assert [branch.name for branch in found.branches] == ["branch 1", "branch 2", "branch 3", "branch 4"]


def test_whole_lines_need_not_meet_on_the_trunk(tmp_path):
    """VMTK's lines to different targets part at once, and may meet again by chance."""
    lines, radius = fork()
    lines[1:, 1:9, 0] += np.array([0.4, -0.3, 0.2])[:, None]
    points, cells = unshared(lines)
    assert_same(read_branches(write_xml(tmp_path / "tree.vtp", points, cells, radius.ravel())), lines)


@pytest.mark.parametrize("order", ["as they are", "shuffled"])
def test_tracts_of_the_branch_extractor(tmp_path, order):
    """Each centreline is cut into tracts; GroupIds and Blanking tell of bifurcations and do not matter."""
    lines, _ = fork()
    cut = [line[a : b + 1] for line in lines for a, b in ((0, 9), (9, 15), (15, 36))]
    ids = {"CenterlineIds": np.repeat(range(4), 3), "TractIds": np.tile(range(3), 4), "Blanking": [0, 1, 0] * 4}
    shuffle = np.random.default_rng(0).permutation(12) if order == "shuffled" else np.arange(12)
    cut = [cut[k] for k in shuffle]
    starts = np.cumsum([0, *(len(piece) for piece in cut)])
    cells = [np.arange(a, b) for a, b in pairwise(starts)]
    arrays = {name: np.array(values)[shuffle] for name, values in ids.items()}
    found = read_branches(write_xml(tmp_path / "tracts.vtp", np.vstack(cut), cells, cells=arrays))
    assert_same(found, lines)


@given(st.randoms(use_true_random=False), st.integers(2, 4), st.booleans())
def test_pieces_of_any_order_and_direction_make_the_tree(random, twigs, pairs):
    """Cut where branches part, or down to two points a piece."""
    lines, _ = fork(twigs, steps=4)
    points, cells = pieces(lines)
    if pairs:
        cells = [np.array(pair) for cell in cells for pair in pairwise(cell)]
    random.shuffle(cells)
    cells = [cell[:: random.choice([-1, 1])] for cell in cells]
    paths = CentrelineNetwork(points, width(points), tuple(cells)).paths()
    assert sorted(tuple(points[path[-1]]) for path in paths) == sorted(tuple(line[-1]) for line in lines)
    for path in paths:
        line = next(line for line in lines if (line[-1] == points[path[-1]]).all())
        assert points[path] == pytest.approx(line)


@pytest.mark.parametrize("turned", [False, True])
def test_pieces_without_a_radius_start_where_they_all_lead_away(tmp_path, turned):
    lines, _ = fork()
    points, cells = pieces(lines)
    cells = [cell[::-1] for cell in cells] if turned else cells
    assert_same(read_branches(write_xml(tmp_path / "tree.vtp", points, cells)), lines)


def test_a_start_that_is_not_clear_is_asked_for(tmp_path):
    lines, _ = fork()
    points, cells = pieces(lines)
    path = write_xml(tmp_path / "tree.vtp", points, [cells[0][::-1], *cells[1:]], space="RAS")
    with pytest.raises(CurveError, match=r"tree\.vtp: where its lines start is not clear: none of their 5 ends"):
        read_branches(path)
    assert_same(read_branches(path, entry=(1, 1, 98)), lines * FLIP)


def test_a_single_line_runs_as_it_is_given(tmp_path):
    lines, radius = fork()
    path = write_xml(tmp_path / "line.vtp", lines[0][::-1], [np.arange(37)], radius[0][::-1])
    (branch,) = read_branches(path).branches
    assert branch.points == pytest.approx(lines[0][::-1])


def test_a_chain_of_pieces_runs_as_they_do_whatever_its_width(tmp_path):
    lines, radius = fork()
    cells = [np.arange(20, 37), np.arange(21)]
    (branch,) = read_branches(write_xml(tmp_path / "line.vtp", lines[0], cells, radius[0][::-1])).branches
    assert branch.points == pytest.approx(lines[0])


def test_lines_apart_are_branches_of_their_own(tmp_path):
    lines, _ = fork()
    both = np.stack([lines[0], lines[1] + [0, 200, 0]])
    points, cells = unshared(both)
    assert_same(read_branches(write_xml(tmp_path / "two.vtp", points, cells)), both)


def test_repeated_points_are_left_out(tmp_path):
    lines, radius = fork()
    twice = np.repeat(lines[0], 2, axis=0)
    (branch,) = read_branches(
        write_xml(tmp_path / "line.vtp", twice, [np.arange(74)], np.repeat(radius[0], 2))
    ).branches
    assert branch.points == pytest.approx(lines[0])
    assert len(branch.radius) == 37


@pytest.mark.parametrize("name", [RADIUS, "Radius", "radius"])
def test_names_of_the_radius(tmp_path, name):
    lines, radius = fork()
    path = write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], radius[0], name=name)
    assert read_branches(path).branches[0].radius == pytest.approx(radius[0])


def test_the_radius_is_found_among_other_arrays_of_a_legacy_file(tmp_path):
    lines, radius = fork()
    path = tmp_path / "line.vtk"
    ones = " ".join(["1"] * 37)
    text = [
        "# vtk DataFile Version 3.0\n3D Slicer output. SPACE=RAS\nASCII\nDATASET POLYDATA\nPOINTS 37 double",
        *(" ".join(map(str, point)) for point in lines[0]),
        "LINES 1 38\n37 " + " ".join(map(str, range(37))),
        f"POINT_DATA 37\nSCALARS Curvature double\nLOOKUP_TABLE default\n{ones}",
        "SCALARS Radius double\nLOOKUP_TABLE default\n" + " ".join(map(str, radius[0])),
    ]
    path.write_text("\n".join(text), encoding="ascii")
    found = read_branches(path)
    assert found.space == "RAS"
    assert found.branches[0].radius == pytest.approx(radius[0])


LINE = fork()[0][0]
WHOLE = [np.arange(37)]
LOOP = np.append(np.arange(37), 0)
BAD = {
    "metres": ((LINE / 1000, WHOLE), {}, r"span 0\.\d+ .* State the unit with --units m"),
    "kilometres": ((LINE * 1e6, WHOLE), {}, r"at most 100000 mm"),
    "not finite": ((LINE * [1, np.nan, 1], WHOLE), {}, r"point 1 is .*must be finite"),
    "no lines": ((LINE, []), {}, r"holds no lines"),
    "a line of one point": ((LINE, [np.arange(1)]), {}, r"no line of two or more points"),
    "three points": ((LINE[:3], [np.arange(3)]), {}, r"points of a centreline is 3; it must be at least 4"),
    "a loop": ((LINE, [LOOP]), {}, r"lines form a loop"),
    "a loop on a line": ((LINE, [np.arange(37), np.array([5, 20])]), {}, r"lines start is not clear"),
    "a line beyond": ((LINE, [np.arange(38)]), {}, r"passes point 38 of 37"),
    "a radius of zero": ((LINE, WHOLE), {"radius": 1.0 * (np.arange(37) % 5 > 0)}, r"radius at point 6 is 0"),
    "an unknown space": ((LINE, WHOLE), {"space": "scanner"}, r"SPACE is 'scanner'; it must be one of LPS, RAS"),
}


@pytest.mark.parametrize(("given", "more", "message"), BAD.values(), ids=BAD)
def test_bad_lines_are_refused(tmp_path, capfd, given, more, message):
    path = write_xml(tmp_path / "bad.vtp", *given, **more)
    with pytest.raises(CurveError, match=rf"bad\.vtp: .*{message}"):
        read_branches(path)
    assert capfd.readouterr() == ("", "")


def test_a_bad_branch_among_several_is_named(tmp_path):
    lines, radius = fork()
    radius[2, -1] = -1
    points, cells = unshared(lines)
    with pytest.raises(CurveError, match=r"bad\.vtp, branch 3: the lumen radius at point 37 is -1"):
        read_branches(write_xml(tmp_path / "bad.vtp", points, cells, radius.ravel()))


def test_a_surface_is_refused(tmp_path):
    path = tmp_path / "surface.vtk"
    meshio.Mesh(LINE[20:26], [("triangle", np.array([[0, 1, 2], [3, 4, 5]]))]).write(path)
    with pytest.raises(CurveError, match=r"surface\.vtk: it holds no lines; .*not as a surface"):
        read_branches(path)


@pytest.mark.parametrize(
    "content",
    [
        None,
        "",
        "x,y,z\n1,2,3\n",
        "<VTKFile>",
        "# vtk DataFile Version 3.0\nhalf\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n0 0 0 1 1 1\nLINES 1",
        "# vtk DataFile Version 3.0\nother\nASCII\nDATASET NONE\n",
    ],
)
@pytest.mark.parametrize("suffix", [".vtp", ".vtk", ".vtu"])
def test_unreadable_files_are_refused_without_noise(tmp_path, capfd, content, suffix):
    path = tmp_path / f"bad{suffix}"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(CurveError, match=r"bad\.vt. cannot be read: |bad\.vtk: it holds no lines"):
        read_branches(path)
    assert capfd.readouterr() == ("", "")


def test_without_pyvista_the_extra_is_named(tmp_path, monkeypatch):
    path = write_xml(tmp_path / "line.vtp", LINE, WHOLE)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(OptionError, match=r'pyvista is not installed; .*-m pip install "ctr_nlp\[anatomy\]"'):
        read_branches(path)


SIGNALLING = np.array([0x7F800001], dtype=">u4").tobytes()
"""A byte pattern that is no number, and of which numpy warns when it is made a number of another width."""


@pytest.mark.parametrize("place", ["a point", "a radius"])
def test_bytes_that_are_no_number_are_refused_without_a_warning_of_another_library(tmp_path, place):
    mark = np.array([123.0], dtype=">f4").tobytes()
    points = np.column_stack([np.zeros(12), np.zeros(12), np.arange(12.0) * 4])
    radius = np.full(12, 5.0, dtype=np.float32)
    if place == "a point":
        points[4, 0] = 123.0
    else:
        radius[4] = 123.0
    mesh = pyvista.PolyData(points.astype(np.float32), lines=[12, *range(12)])
    mesh.point_data[RADIUS] = radius
    path = tmp_path / "lines.vtk"
    mesh.save(path, binary=True)
    content = path.read_bytes()
    assert content.count(mark) == 1
    path.write_bytes(content.replace(mark, SIGNALLING))
    with pytest.raises(CurveError, match=r"lines\.vtk"):
        read_branches(path)


def test_lines_through_points_before_the_first_are_refused(tmp_path):
    """As in a file of which bytes were changed."""
    text = "# vtk DataFile Version 3.0\nlines\nASCII\nDATASET POLYDATA\nPOINTS 20 float\n"
    text += "".join(f"{k} 0 {3 * k}\n" for k in range(20))
    numbers = [*range(10), -7, *range(11, 20)]
    text += f"LINES 1 21\n20 {' '.join(map(str, numbers))}\n"
    (tmp_path / "line.vtk").write_text(text)
    with pytest.raises(CurveError, match=r"line\.vtk: it is damaged: a line passes point -6 of 20"):
        read_branches(tmp_path / "line.vtk")
