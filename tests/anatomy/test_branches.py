"""Which branch is followed and from where to where; the program that lists branches and its picture."""

import csv
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread

from ctr_nlp import curve_from_points, read_csv
from ctr_nlp.anatomy.branch import CENTRELINE_SPACE_TO_LPS, Branch, Branches, transform_points
from ctr_nlp.anatomy.branch_selection import find_extent, select_branch
from ctr_nlp.anatomy.files import READERS, read_branches
from ctr_nlp.anatomy.reading import GIVEN, STATED, FileFacts
from ctr_nlp.anatomy.suffixes import ANATOMY_SUFFIXES
from ctr_nlp.cli.commands.branches import main as list_branches
from ctr_nlp.exceptions import CurveError
from ctr_nlp.view.figures.branches import tree

T = np.linspace(0, 1, 31)[:, None]
TRUNK = np.array([0, 0, 100]) + T * [0, 0, -60]


def branch(name, towards, radius=4.0):
    """A trunk along -z of 60 mm, then 30 mm more in another direction."""
    tip = TRUNK[-1] + T[1:] * 30 * np.array(towards)
    points = np.vstack([TRUNK, tip])
    return Branch(name, points, None if radius is None else np.full(len(points), radius))


def airway(space="LPS", radius=4.0):
    to_left, to_right = branch("left", (0.8, 0, -0.6), radius), branch("right", (-0.8, 0, -0.6), radius)
    return Branches((to_left, to_right), space, CENTRELINE_SPACE_TO_LPS[space])


def write_csv(path, points, radius=None):
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["x_mm", "y_mm", "z_mm"] + ["radius_mm"] * (radius is not None))
        writer.writerows(points if radius is None else np.column_stack([points, radius]))
    return path


@pytest.mark.parametrize(("choice", "name"), [("1", "left"), ("2", "right"), ("left", "left"), ("right", "right")])
def test_a_branch_is_chosen_by_number_or_name(choice, name):
    assert select_branch(airway(), choice).name == name


def test_a_number_is_the_place_in_the_list_whatever_the_names():
    numbered = Branches((branch("2", (1, 0, 0)), branch("1", (-1, 0, 0))), "LPS", np.eye(4))
    assert select_branch(numbered, "1").name == "2"


def test_the_only_branch_needs_no_choice():
    alone = Branches((branch("left", (1, 0, 0)),), "LPS", np.eye(4))
    assert select_branch(alone).name == "left"


@pytest.mark.parametrize("choice", ["0", "3", "-1", "middle", ""])
def test_a_choice_that_does_not_exist_lists_those_that_do(choice):
    with pytest.raises(CurveError, match=r"none of that name or number: 1 'left' \(90\.0 mm\), 2 'right'"):
        select_branch(airway(), choice)


def test_several_branches_without_a_choice_are_listed():
    with pytest.raises(
        CurveError, match=r"there are 2 branches, 1 'left' .*, 2 'right' .*number or name .*, or by"
    ):
        select_branch(airway(), entry=(0, 0, 100))


@pytest.mark.parametrize("choice", [None, "77"])
def test_many_branches_are_not_listed_in_a_message(choice):
    many = Branches(tuple(branch(f"b{k}", (1, 0, 0)) for k in range(50)), "LPS", np.eye(4))
    with pytest.raises(CurveError, match=r"1 to 50, which `ctr-nlp branches` lists") as refused:
        select_branch(many, choice)
    assert "90.0 mm" not in str(refused.value)
    assert len(str(refused.value)) < 250


def test_signs_are_tried_on_every_branch():
    there = np.linspace((50, 150, 0), (50, 150, 90), 91)
    near_mistake = np.linspace((-20, -150, 0), (-20, -150, 90), 91)
    both = tuple(Branch(name, points, np.full(91, 4.0)) for name, points in (("a", there), ("b", near_mistake)))
    with pytest.raises(CurveError, match="With the signs of x and y exchanged it would"):
        select_branch(Branches(both, "LPS", np.eye(4)), target=(-50, -150, 60))


@pytest.mark.parametrize(
    ("known", "told"), [(GIVEN, "does not seem to be in cm, as --units says"), (STATED, "check --units")]
)
def test_lumen_too_wide_for_an_airway_makes_the_unit_doubtful(known, told):
    wide = Branch("trachea", np.linspace((0, 0, 0), (0, 0, 2000), 91), np.full(91, 67.4))
    facts = FileFacts(units="cm", units_known=known)
    with pytest.raises(CurveError, match="No airway has a radius of more than 15 mm") as refused:
        select_branch(Branches((wide,), "RAS", np.diag([-1.0, -1, 1, 1]), facts), target=(5.5, 15.5, -1800))
    assert told in str(refused.value)
    assert "Ten times" not in str(refused.value)


def test_names_that_several_branches_have_do_not_choose():
    twins = Branches((branch("b", (1, 0, 0)), branch("b", (-1, 0, 0))), "LPS", np.eye(4))
    with pytest.raises(CurveError, match="branch is 'b'; 2 branches have that name"):
        select_branch(twins, "b")


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_a_target_in_the_file_s_own_coordinates_chooses_what_it_lies_on(space):
    found = airway(space)
    for each in found.branches:
        assert select_branch(found, target=transform_points(each.points[-5], found.from_lps)) is each


def test_branches_that_share_a_trunk_agree_on_it():
    found, target = airway(), (1.0, 0.5, 65.0)
    ends = []
    for each in found.branches:
        curve = curve_from_points(each.points, each.radius)
        start, stop = find_extent(curve, found, target=target)
        ends.append(curve.part(start, stop).point(np.array([0.0, 20.0, stop])))
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)
    assert select_branch(found, target=target).name in ("left", "right")


@given(st.floats(0, 1), st.floats(0, 1))
def test_points_on_a_curve_cut_it_there(one, other):
    each = airway().branches[0]
    curve = curve_from_points(each.points)
    start, stop = np.sort([one, other]) * curve.length
    entry, target = curve.point(np.array([start, stop]))
    if stop - start < 0.01:
        return
    assert find_extent(curve, airway(), entry, target) == pytest.approx((start, stop), abs=1e-3)


def test_the_nearest_place_is_found_beyond_the_samples():
    """A circle's nearest place to a point lies on the ray from its centre."""
    angle = np.linspace(0, np.pi, 60)
    circle = curve_from_points(50 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    target = 53 * np.array([np.cos(1.2345), np.sin(1.2345), 0])
    assert find_extent(circle, airway(), target=target)[1] == pytest.approx(50 * 1.2345, abs=1e-3)


def test_without_points_the_whole_curve_is_meant():
    curve = curve_from_points(airway().branches[0].points)
    assert find_extent(curve, airway()) == (0.0, curve.length)


def test_an_entry_after_the_target_is_refused():
    curve = curve_from_points(airway().branches[0].points)
    with pytest.raises(CurveError, match=r"target at 20\.0 mm and its entry at 50\.0 mm; it must enter first"):
        find_extent(curve, airway(), entry=(0, 0, 50), target=(0, 0, 80))


@pytest.mark.parametrize(
    ("radius", "away", "allowed"), [(4.0, 3.9, True), (4.0, 4.1, False), (None, 4.9, True), (None, 5.1, False)]
)
@pytest.mark.parametrize("role", ["entry", "target"])
def test_a_point_outside_of_the_lumen_is_refused(radius, away, allowed, role):
    points = {role: (0, away, 90)}
    if allowed:
        assert select_branch(airway(radius=radius), "left", **points).name == "left"
    else:
        with pytest.raises(CurveError, match=rf"{role} \(0, {away}, 90\) is {away} mm away from branch 'left'"):
            select_branch(airway(radius=radius), "left", **points)


@pytest.mark.parametrize("point", [(1, 2), (1, 2, np.nan), (1, 2, 3, 4)])
def test_a_point_is_three_finite_numbers(point):
    with pytest.raises(CurveError, match=r"target is \(1, 2.*three finite numbers"):
        select_branch(airway(), target=point)


def test_a_table_is_a_single_branch_in_its_own_coordinates(shared_data):
    file = shared_data / "airways" / "chaste_ts002_LLL.csv"
    found = read_branches(file)
    (only,) = found.branches
    same, expected = curve_from_points(only.points, only.radius), read_csv(file)
    s = np.linspace(0, expected.length, 50)
    assert (found.space, only.name) == ("xyz", "chaste_ts002_LLL")
    assert same.point(s) == pytest.approx(expected.point(s))
    assert same.radius(s) == pytest.approx(expected.radius(s))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line is ''; expected a header"),
        ("a,b\n1,2\n", "first line is 'a,b'; expected a header"),
        ("x_mm,y_mm,z_mm\n1,2,three\n", "row 2 is '1,2,three'"),
        ("x_mm,y_mm,z_mm\n1,2\n", "row 2 has 2 cells, but the header has 3"),
        ("x_mm,y_mm,z_mm\n0,0,0\n0,0,9\n0,0,20\n", "points of a centreline is 3; it must be at least 4"),
        ("x_mm,y_mm,z_mm\n0,0,0\n0,0,.1\n0,0,.2\n0,0,.3\n", "span 0.3 mm .*--units"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CurveError, match=rf"bad\.csv.*{message}"):
        read_branches(path)


@pytest.mark.parametrize("name", ["airway.stl", "airway", "airway.mha"])
def test_unknown_kinds_of_files_are_refused_with_the_known_ones(name):
    assert {".csv", ".mrk.json", ".vtu", ".nii", ".nhdr"} <= set(ANATOMY_SUFFIXES)
    assert sorted(suffix for reader in READERS for suffix in reader.suffixes) == sorted(ANATOMY_SUFFIXES)
    known = re.escape(", ".join(ANATOMY_SUFFIXES))
    with pytest.raises(CurveError, match=rf"{name} is not a known kind of file; its name must end in {known}$"):
        read_branches(name)


@pytest.fixture
def narrowing(tmp_path):
    """A file of an arc of radius 100 mm and length 90 mm, from 9 to 3 mm wide."""
    angle = np.linspace(0, 0.9, 91)
    points = 100 * np.column_stack([1 - np.cos(angle), 0 * angle, np.sin(angle)])
    return write_csv(tmp_path / "left.csv", points, np.linspace(9, 3, len(points)))


def test_the_list_tells_what_there_is_to_choose_from(narrowing, capsys):
    assert list_branches([str(narrowing)]) == 0
    (row,) = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(" 1 ")]
    assert row[:3] == ["1", "left", "0"]
    assert [float(cell) for cell in row[3:]] == pytest.approx([90, 100, 9, 3, 3, 37.8, 0, 78.3], rel=2e-3)


def test_a_lumen_that_widens_is_remarked_on(narrowing, capsys):
    assert list_branches([str(narrowing), "--reverse"]) == 0
    out = capsys.readouterr().out
    assert "widens, as if from tip to root" in " ".join(out.split())  # the table breaks lines between words
    assert "0.0 0.0 0.0" in out
    list_branches([str(narrowing)])
    assert "as if" not in capsys.readouterr().out


def test_a_corner_is_remarked_on(tmp_path, capsys):
    assert list_branches([str(write_csv(tmp_path / "kink.csv", airway().branches[0].points))]) == 0
    printed = " ".join(capsys.readouterr().out.split())  # the table breaks lines between words
    assert "jagged: --smoothing helps, radius unknown" in printed


def test_the_picture_is_written_and_replaced_whole(narrowing, tmp_path, capsys):
    picture = tmp_path / "new" / "left.png"
    for _ in range(2):
        assert list_branches([str(narrowing), "--out", str(picture)]) == 0
        assert f"wrote {picture}" in capsys.readouterr().out.replace("\n", "")
    assert imread(picture).std() > 0.01
    assert [file.name for file in picture.parent.iterdir()] == ["left.png"]


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("left.pdf", "must end in .png"),
        ("notes.png", "exists and is not a picture; choose another with --out"),
        ("folder.png", "is a folder or a link"),
    ],
)
def test_other_files_are_not_replaced(narrowing, tmp_path, capsys, out, message):
    (tmp_path / "notes.png").write_text("notes", encoding="utf-8")
    (tmp_path / "folder.png").mkdir()
    assert list_branches([str(narrowing), "--out", str(tmp_path / out)]) == 2
    seen = capsys.readouterr()
    assert (seen.out, seen.err.count("\n")) == ("", 1)
    assert message in seen.err
    assert (tmp_path / "notes.png").read_text(encoding="utf-8") == "notes"


def test_bad_input_is_one_line_and_exit_code_2(tmp_path, capsys):
    picture = tmp_path / "none.png"
    assert list_branches([str(tmp_path / "none.vtp"), "--out", str(picture)]) == 2
    seen = capsys.readouterr()
    assert (seen.out, seen.err.count("\n")) == ("", 1)
    assert seen.err.startswith("error: ")
    assert not picture.exists()


def drawn(space, count=2):
    found = airway(space)
    paths = [transform_points(each.points, found.from_lps) for each in found.branches]
    return tree(paths[:count], ["left", "right"][:count], "airway", space)


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_the_patient_s_left_is_on_the_right_of_the_picture(space):
    """Seen from the front, whatever the file's coordinates; the back is right from the left, down from below."""
    front, side, below = drawn(space).axes
    for axes, keep in ((front, (0, 2)), (side, (1, 2)), (below, (0, 1))):
        flip = [1 if axis == 2 or space == "LPS" else -1 for axis in keep]
        middle = axes.transData.transform((0, 0))
        right_up = axes.transData.transform(flip) - middle
        assert right_up[0] > 0
        assert (right_up[1] > 0) == (axes is not below)
        assert abs(right_up[0]) == pytest.approx(abs(right_up[1]))
    assert [axes.get_xlabel() for axes in (front, side)] == [f"{space[0]} (mm)", f"{space[1]} (mm)"]
    assert front.get_ylabel() == "S (mm)"


def test_every_tip_bears_its_number_and_no_two_lie_on_one_another():
    for axes in drawn("LPS").axes:
        assert [text.get_text() for text in axes.texts] == ["1", "2"]
        one, other = (np.array(text.xy) for text in axes.texts)
        assert np.linalg.norm(one - other) > 7


def test_without_directions_the_axes_are_x_y_z():
    found = airway()
    front, side, below = tree([found.branches[0].points], ["left"], "airway").axes
    assert [axes.get_title() for axes in (front, side, below)] == ["", "", ""]
    assert (front.get_xlabel(), below.get_ylabel()) == ("x (mm)", "y (mm)")


@pytest.mark.parametrize("count", [1, 40])
def test_any_number_of_branches_is_drawn(count):
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    paths = [branch("b", (np.cos(a), np.sin(a), -0.5)).points for a in angle]
    figure = tree(paths, [f"$b_{k}" for k in range(count)], "a tree")
    figure.draw_without_rendering()
    numbers = [text for text in figure.axes[0].texts if text.get_text()]
    assert [text.get_text() for text in numbers] == [f"{k + 1}" for k in range(count)]
    boxes = [text.get_window_extent() for text in numbers]
    assert not [k for k, box in enumerate(boxes) if box.count_overlaps(boxes[:k])]
    assert len(figure.legends[0].get_texts()) == count + 1
