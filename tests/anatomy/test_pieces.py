"""Pieces of a tree, as 3D Slicer writes one curve for each: joined where they meet, within and over files."""

import json

import numpy as np
import pytest

from ctr_nlp import problem_from_file
from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.cli.commands.plan import plan
from ctr_nlp.exceptions import CurveError, OptionError


def arc(start, heading, side, length, step=1.0, bend=60.0):
    """Points (n, 3) mm from `start` along `heading`, bending towards `side`, about `step` apart."""
    s = np.linspace(0, length, round(length / step) + 1)
    heading, side = np.array(heading, float), np.array(side, float)
    heading /= np.linalg.norm(heading)
    side -= (side @ heading) * heading
    side /= np.linalg.norm(side)
    return start + bend * (np.sin(s / bend)[:, None] * heading + (1 - np.cos(s / bend))[:, None] * side)


TRUNK = arc(np.zeros(3), (0, 0, -1), (0, 1, 0), 45)
HEADING = TRUNK[-1] - TRUNK[-2]
LEFT = arc(TRUNK[-1], HEADING, (1, 0, 0), 50)
RIGHT = arc(TRUNK[-1], HEADING, (-1, 0, 0), 40)
DEEP = arc(LEFT[-1], LEFT[-1] - LEFT[-2], (0, 0, 1), 30)
PIECES = {"tree (0)": TRUNK, "tree (1)": LEFT, "tree (2)": RIGHT, "tree (3)": DEEP}
WAYS = {"tree (2)": [TRUNK, RIGHT], "tree (3)": [TRUNK, LEFT, DEEP]}


def markup(name, points, wide=None, **more):
    controls = [{"id": str(k), "position": point} for k, point in enumerate(points.tolist(), start=1)]
    found = {
        "type": "Curve",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "name": name,
        "controlPoints": controls,
    }
    if wide is not None:
        radius = np.linspace(*wide, len(points)).tolist()
        found["measurements"] = [{"name": "Radius", "units": "mm", "controlPointValues": radius}]
    return found | more


@pytest.fixture
def write(tmp_path):
    """A function that writes markups into a file and returns its path."""

    def write(name, *markups):
        path = tmp_path / f"{name}.mrk.json"
        path.write_text(json.dumps({"markups": markups}), encoding="utf-8")
        return path

    return write


def assert_tree(found, tolerance=1e-9):
    assert [branch.name for branch in found.branches] == list(WAYS)
    for branch in found.branches:
        way = np.vstack([piece if k == 0 else piece[1:] for k, piece in enumerate(WAYS[branch.name])])
        assert branch.length == pytest.approx(np.linalg.norm(np.diff(way, axis=0), axis=1).sum(), abs=tolerance)
        assert branch.points[0] == pytest.approx(TRUNK[0])


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_pieces_in_one_file_are_joined_in_any_order(write, order):
    names = [list(PIECES)[k] for k in order]
    found = read_branches(write("tree", *(markup(name, PIECES[name]) for name in names)))
    assert {branch.name for branch in found.branches} == set(WAYS)
    assert any("pieces that meet were joined" in note for note in found.facts.notes)


def test_pieces_in_several_files_are_joined(write):
    paths = [write(name, markup(name, points)) for name, points in PIECES.items()]
    assert_tree(read_branches(paths[0], pieces=paths))
    problem = problem_from_file(paths[0], pieces=paths[1:], target=DEEP[-1], frames=3)
    assert problem.target.lengths[-1] == pytest.approx(125, abs=0.1)


def test_end_points_beside_the_pieces_are_left_out(write):
    ends = write("Endpoints", markup("Endpoints", TRUNK[[0, -1]], type="Fiducial"))
    paths = [write(name, markup(name, points)) for name, points in PIECES.items()]
    found = read_branches(ends, pieces=paths)
    assert_tree(found)
    assert "Endpoints.mrk.json: left out, it holds no open curve but Fiducial" in found.facts.notes
    with pytest.raises(CurveError, match="hold no open curve"):
        read_branches(ends, pieces=[write("more", markup("more", TRUNK[[0, -1]], type="Fiducial"))])


def test_pieces_that_begin_one_step_further_on_are_joined(write):
    pieces = [markup(name, points if name == "tree (0)" else points[1:]) for name, points in PIECES.items()]
    assert_tree(read_branches(write("tree", *pieces)), tolerance=0.1)


def test_a_radius_is_joined_with_its_points(write):
    wide = {"tree (0)": (8, 6), "tree (1)": (6, 5), "tree (2)": (6, 4), "tree (3)": (5, 4)}
    found = read_branches(write("tree", *(markup(name, points, wide[name]) for name, points in PIECES.items())))
    assert [(branch.radius[0], branch.radius[-1]) for branch in found.branches] == [(8, 4), (8, 4)]


def test_pieces_in_different_directions_are_joined_from_the_widest_end(write):
    wide = {"tree (0)": (6, 8), "tree (1)": (5, 6), "tree (2)": (6, 4), "tree (3)": (5, 4)}
    turned = {
        name: points[::-1] if name in ("tree (0)", "tree (1)") else points for name, points in PIECES.items()
    }
    found = read_branches(write("tree", *(markup(name, points, wide[name]) for name, points in turned.items())))
    assert len(found.branches) == 2
    assert all(branch.points[0] == pytest.approx(TRUNK[0]) for branch in found.branches)
    assert any("different directions" in note for note in found.facts.notes)


def test_paths_from_one_entry_stay_apart(write):
    whole = np.vstack([TRUNK, LEFT[1:]]), np.vstack([TRUNK, RIGHT[1:]])
    found = read_branches(write("whole", markup("left", whole[0]), markup("right", whole[1])))
    assert [branch.points.shape for branch in found.branches] == [each.shape for each in whole]
    from_carina = read_branches(write("two", markup("left", LEFT), markup("right", RIGHT)))
    assert [branch.name for branch in from_carina.branches] == ["left", "right"]
    assert from_carina.branches[0].points == pytest.approx(LEFT)


def test_a_curve_that_begins_on_the_side_of_another_is_joined(write):
    whole = np.vstack([TRUNK, LEFT[1:]])
    found = read_branches(write("side", markup("left", whole), markup("right", RIGHT[1:])))
    assert [branch.name for branch in found.branches] == ["left", "right"]
    assert found.branches[1].points[0] == pytest.approx(TRUNK[0])
    assert found.branches[1].length == pytest.approx(85, abs=0.1)


def test_a_piece_that_does_not_quite_meet_is_noted(write):
    found = read_branches(write("gap", markup("a", TRUNK), markup("b", LEFT[6:])))
    assert len(found.branches) == 2
    assert any("'b' begins 6.0 mm from the end of 'a'" in note for note in found.facts.notes)


def test_curves_that_go_round_are_refused(write):
    back = np.linspace(LEFT[-1], TRUNK[0], 60)
    with pytest.raises(CurveError, match="loop"):
        read_branches(write("loop", markup("a", TRUNK), markup("b", LEFT), markup("c", back)))


@pytest.mark.parametrize("name", ["tree (1)", "tree (3)"])
def test_a_piece_beside_its_siblings_is_not_planned_from_its_first_point(write, name):
    for each, points in PIECES.items():
        path = write(f"scene {each}", markup(each, points))
        if each == name:
            alone = path
    with pytest.raises(
        CurveError, match=r"is a piece of a tree: it begins at \(.*scene tree \(.*--pieces.*--entry"
    ):
        read_branch_segment(alone)
    assert any("as a piece of a tree" in note for note in read_branches(alone).facts.notes)
    assert read_branch_segment(alone, entry=PIECES[name][0]).start == pytest.approx(0, abs=1e-6)


def test_a_trunk_names_the_files_where_the_tree_goes_on(write):
    for name, points in PIECES.items():
        write(name, markup(name, points))
    alone = write("tree (0)", markup("tree (0)", TRUNK))
    segment = read_branch_segment(alone)
    assert any("goes on in tree (1).mrk.json, tree (2).mrk.json" in note for note in segment.facts.notes)
    with pytest.raises(CurveError, match=r"away from branch .* goes on in tree \(1\)"):
        read_branch_segment(alone, target=LEFT[-1])


def test_a_piece_on_its_own_is_noted_by_its_name(write):
    notes = read_branches(write("b", markup("tree (1)", LEFT))).facts.notes
    assert any("'tree (1)', is that of a piece of a tree" in note for note in notes)
    assert not read_branches(write("b", markup("tree (0)", TRUNK))).facts.notes


def test_pieces_in_different_axes_or_units(write):
    trunk = write("t", markup("t", TRUNK))
    other = write("o", markup("o", LEFT * [-1, -1, 1], coordinateSystem="RAS"))
    with pytest.raises(CurveError, match=r"o\.mrk\.json is in RAS, but .*t\.mrk\.json in LPS"):
        read_branches(trunk, pieces=[other])
    in_cm = write("c", markup("c", LEFT / 10, coordinateUnits="cm"))
    (branch,) = read_branches(trunk, pieces=[in_cm]).branches
    assert branch.length == pytest.approx(95, abs=0.1)
    with pytest.raises(OptionError, match="is a mask; pieces"):
        read_branches(trunk, pieces=["airway.nii.gz"])
    with pytest.raises(CurveError, match="space is RAS"):
        read_branches(trunk, options=ReadOptions(space="RAS"))


def test_plan_takes_several_files(write, tmp_path, capsys):
    paths = [str(write(name, markup(name, points))) for name, points in PIECES.items()]
    assert plan([*paths, "--frames", "3", "--out", str(tmp_path / "out")]) == 2
    assert "there are 2 branches, 1 'tree (2)' (85.0 mm), 2 'tree (3)' (125.0 mm)" in capsys.readouterr().err
    assert plan(["arc", paths[0], "--out", str(tmp_path / "out")]) == 2
    assert "only a centreline file goes with further files" in capsys.readouterr().err
