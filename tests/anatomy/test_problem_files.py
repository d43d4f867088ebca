"""From files of anatomy to problems, through the library and through the command line."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from common import UNJUDGED, named_problem

from ctr_nlp import problem_from_file, table_i_robot
from ctr_nlp.anatomy.branch import transform_points
from ctr_nlp.anatomy.suffixes import ANATOMY_SUFFIXES
from ctr_nlp.cli.commands.branches import main as list_branches
from ctr_nlp.cli.commands.plan import plan as solve_horizon
from ctr_nlp.cli.commands.plan import steer as solve_per_frame
from ctr_nlp.exceptions import CtrError, CurveError, OptionError
from ctr_nlp.paths.lumen_fit import problem_notes

FLIP = np.array([-1.0, -1.0, 1.0])
Z = np.linspace(0, 120, 121)
GENTLE = np.column_stack([230 - 200 * np.cos(Z / 200), 0 * Z - 50, 80 + 200 * np.sin(Z / 200)])
RADIUS = np.linspace(6, 4, len(Z))


def write_csv(path, points=GENTLE, radius=RADIUS):
    table = points if radius is None else np.column_stack([points, radius])
    header = "x_mm,y_mm,z_mm" + ",radius_mm" * (radius is not None)
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    return path


def markup(points=GENTLE, radius=RADIUS, name="airway", **more):
    found = {
        "type": "Curve",
        "name": name,
        "coordinateSystem": "LPS",
        "controlPoints": [{"position": [float(x) for x in point]} for point in points],
        **more,
    }
    if radius is not None:
        found["measurements"] = [{"name": "Radius", "units": "mm", "controlPointValues": list(map(float, radius))}]
    return {key: value for key, value in found.items() if value is not None}


def write_slicer(path, *markups):
    path.write_text(json.dumps({"markups": markups or [markup()]}), encoding="utf-8")
    return path


def write_vtp(path, points=GENTLE, radius=RADIUS):
    pyvista = pytest.importorskip("pyvista")
    line = pyvista.lines_from_points(points)
    line.point_data["MaximumInscribedSphereRadius"] = radius
    line.save(path)
    return path


def write_nrrd(path, lumen, **changes):
    """A mask by hand; spacing 1 mm, LPS, the first voxel's middle at the origin."""
    header = {
        "type": "unsigned char",
        "dimension": 3,
        "sizes": " ".join(map(str, lumen.shape)),
        "space": "left-posterior-superior",
        "space directions": "(1,0,0) (0,1,0) (0,0,1)",
        "space origin": "(0,0,0)",
        "encoding": "raw",
        **changes,
    }
    lines = [f"{key}: {value}" for key, value in header.items() if value is not None]
    text = "\n".join(["NRRD0004", *lines, "", ""])
    path.write_bytes(text.encode() + lumen.astype(np.uint8).tobytes(order="F"))
    return path


def tube(length=60, gap=()):
    """A lumen of radius 5 mm along the third axis, closed where gap says."""
    x, y = np.mgrid[:13, :13] - 6
    lumen = np.zeros((13, 13, length), bool)
    lumen[..., 1:-1] = (x**2 + y**2 <= 25)[..., None]
    lumen[..., list(gap)] = False
    return lumen


def followed(problem, count=50):
    """Points of the last frame's target, (count, 3) mm."""
    return problem.target.curves[-1].point(np.linspace(0, problem.target.lengths[-1], count))


def back(problem, points):
    """Points in the robot's frame in the file's own coordinates."""
    return transform_points(points, np.linalg.inv(problem.to_robot))


# What kinds of files say


@pytest.mark.parametrize("name", ["chaste_ts002_LLL", "hra_vhm_left_main"])
def test_an_airway_is_the_same_problem_in_every_kind_of_file(shared_data, tmp_path, name):
    """RAS and LPS markups and VTK lines beside the CSV file that they were made from, which is in LPS."""
    file = shared_data / "airways" / f"{name}.csv"
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    points, radius = table[:, :3], table[:, 3]
    ras = markup(points * FLIP, radius, coordinateSystem="RAS")
    files = {
        write_slicer(tmp_path / "ras.mrk.json", ras): FLIP,
        write_slicer(tmp_path / "lps.mrk.json", markup(points, radius)): 1,
        write_vtp(tmp_path / "airway.vtp", points, radius): 1,
    }
    expected = problem_from_file(file, frames=2, trim="start")
    for path, flip in files.items():
        found = problem_from_file(path, frames=2, trim="start")
        assert followed(found) == pytest.approx(followed(expected), abs=0.01)
        assert found.target_frames[-1].radius == pytest.approx(expected.target_frames[-1].radius, abs=0.01)
        own = transform_points(points * flip, found.to_robot)
        assert own == pytest.approx(transform_points(points, expected.to_robot), abs=0.01)
        assert own[-1] == pytest.approx(found.target_frames[-1].points[-1], abs=0.01)


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_a_problem_of_a_slicer_file_starts_at_the_origin_and_maps_its_own_points(tmp_path, space):
    points = GENTLE * (FLIP if space == "RAS" else 1)
    path = write_slicer(tmp_path / "left.mrk.json", markup(points, coordinateSystem=space))
    found = problem_from_file(path, frames=2)
    assert found.name == "left"
    assert transform_points(points, found.to_robot)[0] == pytest.approx(np.zeros(3), abs=1e-9)
    assert back(found, followed(found, len(Z))) == pytest.approx(points, abs=0.01)


def test_a_mask_is_followed_between_two_points(tmp_path):
    pytest.importorskip("nrrd")
    path = write_nrrd(tmp_path / "lumen.nrrd", tube())
    found = problem_from_file(path, frames=2, entry=(6, 6, 5), target=(6, 6, 54))
    assert found.name == "lumen"
    assert found.target.lengths[-1] == pytest.approx(49, abs=0.5)
    assert back(found, followed(found))[[0, -1]] == pytest.approx(np.array([[6, 6, 5], [6, 6, 54]]), abs=0.5)
    assert found.lumen.radius(np.array([20.0]))[0] == pytest.approx(5, abs=0.6)


def test_what_only_some_need_is_not_imported_for_a_table(tmp_path):
    path = write_csv(tmp_path / "path.csv")
    program = (
        "import sys\n"
        "for module in ('nibabel', 'nrrd', 'networkx', 'pyvista', 'vtkmodules', 'vtk'):\n"
        "    sys.modules[module] = None\n"
        f"import ctr_nlp; ctr_nlp.problem_from_file({str(path)!r}, branch=1, entry=(30, -50, 80))\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


# From where to where


def test_entry_and_target_cut_the_path_and_not_the_lumen(tmp_path):
    path = write_csv(tmp_path / "path.csv")
    found = problem_from_file(path, frames=2, entry=GENTLE[20] + [0, 3, 0], target=GENTLE[100])
    assert back(found, followed(found))[[0, -1]] == pytest.approx(GENTLE[[20, 100]], abs=0.01)
    assert found.lumen.length == pytest.approx(120, abs=0.01)
    ends = found.lumen.point(np.array([0.0, found.lumen.length]))
    assert back(found, ends) == pytest.approx(GENTLE[[0, -1]], abs=0.01)
    assert found.target_frames[-1].radius[0] == pytest.approx(RADIUS[20], abs=0.01)


def test_reversed_files_are_entered_at_their_other_end(tmp_path):
    path = write_csv(tmp_path / "path.csv", GENTLE[::-1], RADIUS[::-1])
    there = {"entry": GENTLE[20], "target": GENTLE[100]}
    found = problem_from_file(path, frames=2, reverse=True, **there)
    straight = problem_from_file(write_csv(tmp_path / "other.csv"), frames=2, **there)
    assert followed(found) == pytest.approx(followed(straight), abs=0.01)
    assert found.lumen.radius(np.zeros(1)) == pytest.approx(RADIUS[:1])
    with pytest.raises(CurveError, match="must enter first"):
        problem_from_file(path, frames=2, **there)


def test_the_lumen_keeps_what_is_trimmed_away(tmp_path):
    points = np.column_stack([0 * Z, 0 * Z, 2 * Z])
    found = problem_from_file(write_csv(tmp_path / "path.csv", points), frames=2, trim="start")
    assert found.target.lengths[-1] == pytest.approx(150)
    assert found.lumen.length == pytest.approx(240)
    assert found.lumen.point(np.zeros(1))[0] == pytest.approx([0, 0, -90], abs=1e-6)
    assert found.retraction().lumen is found.lumen


def test_without_radii_there_is_no_lumen(tmp_path):
    assert problem_from_file(write_csv(tmp_path / "path.csv", radius=None)).lumen is None


def test_a_target_chooses_the_branch_of_a_tree(tmp_path):
    """Two lines of one .vtp that leave their root to the same side; the target lies 2 mm off the second's tip."""
    pyvista = pytest.importorskip("pyvista")
    other = GENTLE + np.column_stack([0 * Z, Z / 4, 0 * Z])
    count = len(Z)
    lines = [count, *range(count), count, 0, *range(count, 2 * count - 1)]
    tree = pyvista.PolyData(np.vstack([GENTLE, other[1:]]), lines=lines)
    tree.point_data["Radius"] = np.full(2 * count - 1, 5.0)
    tree.save(tmp_path / "tree.vtp")
    found = problem_from_file(tmp_path / "tree.vtp", frames=2, target=other[100] + [0, 0, 2])
    assert back(found, followed(found))[-1] == pytest.approx(other[100] + [0, 0, 2], abs=2)
    assert found.lumen.length > found.target.lengths[-1] + 15
    with pytest.raises(CurveError, match="there are 2 branches, 1 'branch 1'"):
        problem_from_file(tmp_path / "tree.vtp", frames=2)


@pytest.mark.parametrize("choice", ["2", 2, "right"])
def test_a_branch_is_chosen_by_name_or_number(tmp_path, choice):
    right = markup(GENTLE * [-1, 1, 1], name="right")
    path = write_slicer(tmp_path / "tree.mrk.json", markup(name="left"), right)
    found = problem_from_file(path, frames=2, branch=choice)
    assert back(found, followed(found))[-1] == pytest.approx(GENTLE[-1] * [-1, 1, 1], abs=0.01)


def test_smoothing_moves_the_target_and_not_the_lumen(tmp_path):
    noise = np.random.default_rng(0).normal(0, 0.1, GENTLE.shape)
    path = write_csv(tmp_path / "path.csv", GENTLE + noise)
    exact, smooth = (problem_from_file(path, frames=2, smoothing=mm) for mm in (0.0, 0.6))
    assert (exact.deviation, exact.deviation_share) == (0, 0)
    assert 0.1 < smooth.deviation <= 0.6
    assert smooth.deviation_share == pytest.approx(smooth.deviation / 5, rel=0.3)
    assert any("smoothing moved" in note for note in problem_notes(smooth))
    at = np.linspace(0, exact.lumen.length, 50)
    assert back(smooth, smooth.lumen.point(at)) == pytest.approx(back(exact, exact.lumen.point(at)), abs=1e-6)


# Placed


@pytest.mark.parametrize(("space", "flip"), [("LPS", 1), ("RAS", FLIP)])
def test_the_insertion_direction_is_in_the_files_own_coordinates(tmp_path, space, flip):
    path = write_slicer(tmp_path / "path.mrk.json", markup(GENTLE * flip, coordinateSystem=space))
    direction = np.array([0.3, -0.2, 2.0])
    found = problem_from_file(path, frames=2, insertion=direction * flip)
    turned = found.to_robot[:3, :3] @ (direction * flip)
    assert turned / np.linalg.norm(turned) == pytest.approx([0, 0, 1], abs=1e-9)


@pytest.mark.parametrize(
    ("theta", "tilt", "expected"),
    [
        ((-math.pi, math.pi), 0.2, [-0.2, -0.2, 0.2, 0.2]),
        (((-0.1, 0.3), (-1, 0.05)), 0.2, [-0.1, -0.2, 0.2, 0.05]),
        ((-0.1, 0.1), None, [-0.1, -0.1, 0.1, 0.1]),
    ],
)
def test_tilt_tightens_and_never_widens(tmp_path, theta, tilt, expected):
    path = write_csv(tmp_path / "path.csv")
    robot = problem_from_file(path, table_i_robot().with_limits(theta=theta), tilt=tilt).robot
    assert [*robot.lower[-2:], *robot.upper[-2:]] == pytest.approx(expected)


@pytest.mark.parametrize("tilt", [-0.1, 4.0, math.nan])
def test_a_tilt_out_of_range_is_refused(tmp_path, tilt):
    with pytest.raises(OptionError, match=r"tilt is .* rad, .* degrees; it must lie in \[0, pi\] rad"):
        problem_from_file(write_csv(tmp_path / "path.csv"), tilt=tilt)


@pytest.mark.parametrize("insertion", [(0, 0, 0), (0, 0, math.nan), (1, 2), (-0.1, 0, -1)])
def test_an_insertion_that_is_none_or_leads_away_is_refused(tmp_path, insertion):
    with pytest.raises(CtrError, match="insertion direction"):
        problem_from_file(write_csv(tmp_path / "path.csv"), insertion=insertion)


@pytest.mark.parametrize("point", [(1, 2), (1, 2, math.nan), "here", (1, None, 2)])
@pytest.mark.parametrize("role", ["entry", "target"])
def test_points_are_three_finite_numbers(tmp_path, role, point):
    with pytest.raises(CurveError, match=rf"{role} is .*; it must be three finite numbers in mm"):
        problem_from_file(write_vtp(tmp_path / "path.vtp"), **{role: point})


# On the command line


CASES = {
    "no coordinate system": ("lost.mrk.json", [], "coordinateSystem of 'airway' is missing; it must be one of"),
    "no coordinate system of a mask": ("lost.nrrd", ["--entry", 6, 6, 5, "--target", 6, 6, 54], "lost.nrrd: "),
    "no spacing": ("flat.nrrd", ["--entry", 6, 6, 5, "--target", 6, 6, 54], "flat.nrrd: "),
    "several curves": ("tree.mrk.json", [], "there are 2 branches, 1 'left' (120.0 mm), 2 'right' (120.0 mm)"),
    "no such branch": ("tree.mrk.json", ["--branch", "middle"], "branch is 'middle'; there is none of that name"),
    "a mask in two parts": (
        "parted.nrrd",
        ["--entry", 6, 6, 5, "--target", 6, 6, 54],
        "entry and target lie in separate parts of the mask",
    ),
    "no such branch of a mask": ("lumen.nrrd", ["--branch", 7], "there is none of that name or number: 1 'branch"),
    "a mask reversed": ("lumen.nrrd", ["--reverse"], "reverse does not go with a mask"),
    "entry outside a mask": ("lumen.nrrd", ["--entry", 0, 0, 5, "--target", 6, 6, 54], "outside the mask"),
    "entry outside": ("path.csv", ["--entry", 30, -40, 80], "entry (30, -40, 80) is 10.0 mm away from branch"),
    "target before entry": ("path.csv", ["--target", *GENTLE[0]], "it must enter first"),
    "too short": ("path.csv", ["--target", *(GENTLE[0] + [0, 0, 0.4])], "path is 0.4 mm long; it must be at"),
    "metres": ("metres.csv", [], "in m that would be"),
    "too long": ("long.csv", [], "240.00 mm long and the robot reaches 150.00"),
    "unknown kind": ("path.stl", [], f"its name must end in {', '.join(ANATOMY_SUFFIXES)}"),
    "no file": ("nowhere.vtp", [], "an existing centreline file (.csv, .tsv"),
    "no insertion": ("path.csv", ["--insertion", 0, 0, 0], "insertion direction is [0.0, 0.0, 0.0];"),
    "insertion backwards": ("path.csv", ["--insertion", 0, 0, -1], "is 179 degrees away from where the path"),
    "tilt": ("path.csv", ["--tilt", -5], "tilt is -0.0872665 rad, -5 degrees"),
    "smoothing": ("path.csv", ["--smoothing", "-1"], "smoothing is -1.0 mm"),
}  # fmt: skip


@pytest.fixture
def files(tmp_path):
    """A folder of files, good and bad."""
    folder = tmp_path / "files"
    folder.mkdir()
    write_csv(folder / "path.csv")
    write_csv(folder / "path.stl")
    write_csv(folder / "metres.csv", GENTLE / 1000)
    write_csv(folder / "long.csv", np.column_stack([0 * Z, 0 * Z, 2 * Z]))
    write_slicer(folder / "lost.mrk.json", markup(coordinateSystem=None))
    write_slicer(folder / "tree.mrk.json", markup(name="left"), markup(GENTLE * [-1, 1, 1], name="right"))
    write_nrrd(folder / "lumen.nrrd", tube())
    write_nrrd(folder / "parted.nrrd", tube(gap=(30, 31)))
    write_nrrd(folder / "lost.nrrd", tube(), space=None)
    write_nrrd(folder / "flat.nrrd", tube(), **{"space directions": None})
    return folder


@pytest.mark.parametrize("program", [solve_per_frame, solve_horizon])
@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_one_line_and_nothing_written(files, tmp_path, capsys, case, program):
    name, arguments, message = CASES[case]
    if name.endswith("nrrd"):
        pytest.importorskip("nrrd")
    before = sorted(files.iterdir())
    status = program([str(files / name), *map(str, arguments), "--out", str(tmp_path / "out")])
    seen = capsys.readouterr()
    assert (status, seen.out, seen.err.count("\n")) == (2, "", 1), seen.err
    assert seen.err.startswith("error: ")
    assert message in seen.err
    assert [path.name for path in tmp_path.iterdir()] == ["files"]
    assert sorted(files.iterdir()) == before


OPTIONS = {
    "branch": ["left"],
    "entry": [0, 0, 0],
    "target": [0, 0, 0],
    "insertion": [0, 0, 1],
    "tilt": [0],
    "reverse": [],
    "smoothing": [0],
    "trim": ["end"],
}


@pytest.mark.parametrize("option", OPTIONS)
def test_named_problems_refuse_what_goes_with_a_file(tmp_path, capsys, option):
    arguments = ["arc", f"--{option}", *map(str, OPTIONS[option]), "--out", str(tmp_path / "out")]
    assert solve_per_frame(arguments) == 2
    assert capsys.readouterr().err == (
        f"error: --{option} goes with a centreline file or a mask; arc is a named problem\n"
    )
    assert not list(tmp_path.iterdir())


def test_the_branches_of_a_mask_are_listed(files, capsys):
    assert list_branches([str(files / "lumen.nrrd")]) == 0
    seen = capsys.readouterr()
    assert "the entry is guessed" in seen.err
    (row,) = [line.split() for line in seen.out.splitlines() if line.startswith(" 1 ")]
    assert row[:2] == ["1", "0"]  # a mask has no names for its branches


def test_a_file_is_solved_with_all_its_options(tmp_path, capsys):
    """And what a centred tube cannot do is said before."""
    radius = np.where((Z > 95) & (Z < 98), 0.9, 6.0)
    right = markup(GENTLE * FLIP, radius, name="right", coordinateSystem="RAS")
    path = write_slicer(tmp_path / "tree.mrk.json", markup(coordinateSystem="RAS"), right)
    arguments = ["--branch", "right", "--entry", *GENTLE[5] * FLIP, "--target", *GENTLE[110] * FLIP]
    arguments += [
        "--insertion",
        0,
        0,
        1,
        "--tilt",
        20,
        "--smoothing",
        0.05,
        "--trim",
        "end",
        "--frames",
        2,
        "--model",
        "dominant",
    ]
    assert solve_per_frame([*UNJUDGED, str(path), *map(str, arguments), "--out", str(tmp_path / "out")]) == 0
    seen = capsys.readouterr()
    assert "note: smoothing moved the path by at most 0.0" in seen.err
    assert "note: tube 3 (2.1 mm) does not fit even centred from 9" in seen.err
    with np.load(tmp_path / "out" / "plan.npz") as plan:
        assert np.abs(plan["theta"]).max() <= math.radians(20) + 1e-9
        start = transform_points(plan["target"][0, 0], np.linalg.inv(plan["to_robot"]))
    assert start == pytest.approx(GENTLE[5] * FLIP, abs=0.1)


def test_a_named_problem_can_know_its_whole_lumen():
    found = named_problem("bronchus", 3)
    assert found.lumen.length > found.target.lengths[-1]
    path = found.target.curves[-1]
    s = np.linspace(0, 150, 20)
    before = found.lumen.length - 150
    assert found.lumen.point(s + before) == pytest.approx(path.point(s), abs=1e-9)
    assert found.lumen.radius(s + before) == pytest.approx(path.radius(s), abs=1e-9)
