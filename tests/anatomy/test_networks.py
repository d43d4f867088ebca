"""VTK networks as people have them: loops, single points, units, spaces and radii of any name."""

from itertools import pairwise

import numpy as np
import pytest
from test_vtk import RADIUS, assert_same, fork, pieces, unshared, write_xml

from ctr_nlp import curve_from_points, problem_from_file
from ctr_nlp.anatomy.branch import Branch, transform_points
from ctr_nlp.anatomy.branch_measures import measure_branches
from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.reading import ASSUMED, GIVEN, STATED, ReadOptions
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.view.exchange.slicer import to_scan

FLIP = np.array([-1.0, -1.0, 1.0])


def tree_with(tmp_path, extra, radius=True, **more):
    """fork() in pieces, with lines (k, 3) beside them; its radius is that of fork()."""
    lines, _ = fork()
    points, cells = pieces(lines)
    for line in extra:
        cells.append(np.arange(len(points), len(points) + len(line)))
        points = np.vstack([points, line])
    depth = 100 - points[:, 2]
    width = np.where(depth <= 60, 8.0, np.where(depth <= 90, 5.0, 3.0))
    path = write_xml(tmp_path / "tree.vtp", points, cells, width if radius else None, **more)
    return path, lines


def between(lines, first=34, second=28):
    """A straight line from one half of a fork's twig to the other one's: a loop with the twig's end."""
    a, b = lines[0][first], lines[1][second]
    return a + np.linspace(0, 1, 9)[:, None] * (b - a)


def test_a_line_of_a_single_point_is_ignored_with_a_note(tmp_path):
    path, lines = tree_with(tmp_path, [np.array([[40.0, 40.0, 40.0]])])
    found = read_branches(path)
    assert_same(found, lines)
    assert any("a line of a single point" in note for note in found.facts.notes)


def test_a_loop_off_the_route_does_not_matter(tmp_path):
    _, lines = tree_with(tmp_path, [])
    path, _ = tree_with(tmp_path, [between(lines)])
    segment = read_branch_segment(path, target=lines[3][-1])
    assert segment.followed_path.point(np.array([segment.branch.length]))[0] == pytest.approx(
        lines[3][-1], abs=1e-6
    )
    expected = np.linalg.norm(np.diff(lines[3], axis=0), axis=1).sum()
    assert segment.followed_path.length == pytest.approx(expected, rel=0.02)
    assert any("form a loop between" in note for note in segment.facts.notes)


def test_a_loop_on_the_route_is_refused_until_a_branch_is_chosen(tmp_path):
    _, lines = tree_with(tmp_path, [])
    path, _ = tree_with(tmp_path, [between(lines)])
    with pytest.raises(CurveError, match=r"both lead to the target, by ways up to .* choose with --branch"):
        read_branch_segment(path, target=lines[0][-1])
    ways = [b for b in read_branches(path).branches if np.allclose(b.points[-1], lines[0][-1])]
    assert len(ways) == 2
    right = min(ways, key=lambda branch: branch.length)
    assert right.points == pytest.approx(lines[0], abs=1e-6)
    segment = read_branch_segment(path, branch=right.name, target=lines[0][-1])
    assert any("form a loop between" in note for note in segment.facts.notes)


def test_a_way_round_a_loop_that_runs_back_is_left_out(tmp_path):
    _, lines = tree_with(tmp_path, [])
    path, _ = tree_with(tmp_path, [between(lines, 30, 30)])
    found = read_branches(path)
    assert_same(found, lines)
    assert sum("left out one of the ways" in note for note in found.facts.notes) == 2
    assert read_branch_segment(path, target=lines[0][-1]).branch.length < 150


def test_a_loop_that_stays_in_the_lumen_is_no_choice(tmp_path):
    """Lines of one airway that part by less than half of its radius, and meet again."""
    lines, _ = fork()
    beside = lines[0][2:9].copy()
    beside[1:-1, 0] += 1.0
    path, _ = tree_with(tmp_path, [beside])
    found = read_branches(path)
    assert len(found.branches) == len(lines)
    assert any("narrow loop" in note for note in found.facts.notes)


def test_a_network_of_several_loops_leaves_out_only_the_tips_behind_them(tmp_path):
    lines, _ = fork()
    a, b = lines[0][30], lines[1][30]
    c = (lines[0][27] + lines[1][27]) / 2 + [0, 0, 5]
    web = [np.array([a, c]), np.array([b, c]), between(lines, 30, 30)]
    path, _ = tree_with(tmp_path, web)
    found = read_branches(path)
    assert {tuple(branch.points[-1]) for branch in found.branches} == {tuple(line[-1]) for line in lines[2:]}
    assert any("2 tips that have no clear path" in note for note in found.facts.notes)


def test_two_whole_lines_to_one_tip_are_refused_until_one_is_chosen(tmp_path):
    lines, _ = fork()
    wrong = np.vstack([lines[1][:29], between(lines)[::-1][1:], lines[0][35:]])
    every = [*lines, wrong]
    starts = np.cumsum([0, *(len(line) for line in every)])
    cells = [np.arange(a, b) for a, b in pairwise(starts)]
    path = write_xml(tmp_path / "tree.vtp", np.vstack(every), cells)
    with pytest.raises(CurveError, match="both lead to the target"):
        read_branch_segment(path, target=lines[0][-1])
    assert read_branch_segment(path, target=lines[3][-1]).branch.length > 100


def test_a_line_drawn_from_branch_to_branch_is_noted(shared_data):
    path = shared_data / "cases" / "N6_shortcut.vtp"
    found = read_branches(path)
    assert [round(branch.length, 1) for branch in found.branches] == [113.4, 116.0]
    assert any("branch 2 turns by 45 degrees" in note for note in found.facts.notes)


def test_lines_that_share_a_trunk_are_a_tree(shared_data):
    found = read_branches(shared_data / "cases" / "N3_whole_lines.vtp")
    assert [branch.length for branch in found.branches] == pytest.approx([113.43, 113.43], abs=0.01)
    assert found.space == "LPS"
    assert found.facts.space_known == ASSUMED
    assert any("LPS is assumed" in note for note in found.facts.notes)


def test_a_single_point_beside_a_line(shared_data):
    found = read_branches(shared_data / "cases" / "N2_single_point_line.vtp")
    assert [branch.length for branch in found.branches] == pytest.approx([40.0], abs=1e-6)


def test_centimetres_are_asked_for_and_read(shared_data):
    path = shared_data / "cases" / "N7_cm_no_radius.vtp"
    with pytest.raises(CurveError, match="State the unit with --units cm"):
        read_branches(path)
    found = read_branches(path, options=ReadOptions(units="cm"))
    assert [branch.length for branch in found.branches] == pytest.approx([113.43, 113.43], abs=0.01)
    assert (found.facts.units, found.facts.units_known) == ("cm", GIVEN)


def test_a_real_tree_with_a_tiny_loop_is_read(shared_data):
    found = read_branches(shared_data / "anatomy" / "chaste_ts002_tree.vtp")
    assert len(found.branches) >= 82
    assert any("narrow loop" in note for note in found.facts.notes)


@pytest.mark.parametrize("factor", [0.1, 0.001])
def test_radii_are_scaled_with_the_points(tmp_path, factor):
    lines, radius = fork()
    points, cells = unshared(lines)
    path = write_xml(tmp_path / "tree.vtp", points * factor, cells, radius.ravel() * factor)
    unit = {0.1: "cm", 0.001: "m"}[factor]
    with pytest.raises(CurveError, match=f"--units {unit}"):
        read_branches(path)
    found = read_branches(path, options=ReadOptions(units=unit))
    assert_same(found, lines)
    assert found.branches[0].radius == pytest.approx(radius[0])


@pytest.mark.parametrize(
    ("name", "factor"),
    [("Maximum Inscribed Sphere Radius", 1), ("radius_mm", 1), ("Diameter", 2), ("diameter_mm", 2), ("RADIUS", 1)],
)
def test_radii_of_usual_names_are_read(tmp_path, name, factor):
    lines, radius = fork()
    path = write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], radius[0] * factor, name=name)
    assert read_branches(path).branches[0].radius == pytest.approx(radius[0])


def test_an_array_that_may_be_the_radius_is_named(tmp_path):
    lines, radius = fork()
    path = write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], radius[0], name="MeanWidth")
    found = read_branches(path)
    assert found.branches[0].radius is None
    assert any("not read: MeanWidth" in note for note in found.facts.notes)


def test_a_radius_of_zeros_is_unknown(tmp_path):
    lines, _ = fork()
    path = write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], np.zeros(37))
    found = read_branches(path)
    assert found.branches[0].radius is None
    assert any("taken as unknown" in note for note in found.facts.notes)


def test_a_radius_of_zero_at_an_end_is_its_neighbours(tmp_path):
    lines, radius = fork()
    radius[0, -1] = 0
    found = read_branches(write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], radius[0]))
    assert found.branches[0].radius[-1] == 3
    assert any("missing at an end" in note for note in found.facts.notes)


def test_a_stated_space_is_kept_apart_from_an_assumed_one(tmp_path):
    lines, _ = fork()
    stated = write_xml(tmp_path / "stated.vtp", lines[0], [np.arange(37)], space="RAS")
    assert read_branches(stated).facts.space_known == STATED
    with pytest.raises(CurveError, match="space is LPS, but the file states RAS"):
        read_branches(stated, options=ReadOptions(space="LPS"))
    silent = write_xml(tmp_path / "silent.vtp", lines[0], [np.arange(37)])
    found = read_branches(silent, options=ReadOptions(space="RAS"))
    assert (found.space, found.facts.space_known) == ("RAS", GIVEN)
    assert found.branches[0].points == pytest.approx(lines[0] * FLIP)
    assert not any("assumed" in note for note in found.facts.notes)


class Exported:
    """As much of a plan as its export to Slicer asks for its coordinates."""

    def __init__(self, problem):
        self.to_robot = problem.to_robot
        self.meta = {"problem": {"space": problem.space, "space_assumed": problem.space_assumed}}


def test_an_assumed_space_may_be_stated_later(tmp_path):
    lines, radius = fork()
    path = write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], radius[0])
    problem = problem_from_file(path, frames=2)
    assert (problem.space, problem.space_assumed) == ("LPS", True)
    followed = problem.target.curves[-1].point(np.array([0.0, problem.target.lengths[-1]]))
    for space, flip in ((None, 1), ("LPS", 1), ("RAS", FLIP)):
        scanned = transform_points(followed, to_scan(Exported(problem), space))
        assert scanned == pytest.approx(lines[0][[0, -1]] * flip, abs=1e-6)
    older = Exported(problem)
    del older.meta["problem"]["space_assumed"]
    to_scan(older)
    with pytest.raises(OptionError, match="states LPS"):
        to_scan(older, "RAS")


def test_a_lumen_that_is_wide_beyond_a_narrow_part_is_noted(tmp_path):
    lines, radius = fork()
    radius[0, -4:] = 9
    path = write_xml(tmp_path / "line.vtp", lines[0], [np.arange(37)], radius[0])
    notes = read_branch_segment(path).facts.notes
    assert any("radius grows from 3.0 mm at" in note and "leak" in note for note in notes)


def bifurcating(depth, per_piece, seed=0):
    """A tree of 2**depth tips: whole lines (n, 3) and their radii, and pieces of both."""
    random = np.random.default_rng(seed)
    whole, cut = [], []

    def grow(start, heading, length, level, points, radii):
        part = np.linspace(0, 1, per_piece + 1)[1:, None]
        side = np.cross(heading, random.normal(size=3))
        side /= np.linalg.norm(side)
        stretch = start + part * length * heading + 0.1 * length * part**2 * side
        width = 9 * 0.8 ** (level + part[:, 0])
        cut.append((np.vstack([start, stretch]), np.append(9 * 0.8**level, width)))
        points, radii = np.vstack([points, stretch]), np.append(radii, width)
        if level == depth:
            whole.append((points, radii))
            return
        ahead = (stretch[-1] - stretch[-2]) / np.linalg.norm(stretch[-1] - stretch[-2])
        across = np.cross(ahead, random.normal(size=3))
        across /= np.linalg.norm(across)
        for sign in (-1, 1):
            turned = np.cos(0.5) * ahead + sign * np.sin(0.5) * across
            grow(stretch[-1], turned, 0.8 * length, level + 1, points, radii)

    grow(np.zeros(3), np.array([0.0, 0.0, -1.0]), 80.0, 0, np.zeros((1, 3)), np.array([9.0]))
    return whole, cut


@pytest.mark.parametrize("form", ["whole", "pieces"])
def test_a_tree_of_many_tips_is_listed_the_same_in_both_forms(tmp_path, form):
    """256 tips; before, pairs of all points of the shared trunk took gigabytes."""
    whole, cut = bifurcating(8, 12)
    parts = whole if form == "whole" else cut
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    cells = [np.arange(a, b) for a, b in pairwise(starts)]
    points, radius = (np.concatenate(each) for each in zip(*parts, strict=True))
    found = read_branches(write_xml(tmp_path / "tree.vtp", points.astype(np.float32), cells, radius, name=RADIUS))
    assert len(found.branches) == 256
    tips = {tuple(np.round(branch.points[-1], 2)) for branch in found.branches}
    assert tips == {tuple(np.round(line[-1].astype(np.float32).astype(float), 2)) for line, _ in whole}
    lengths = sorted(branch.length for branch in found.branches)
    assert lengths == pytest.approx(
        sorted(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line, _ in whole), abs=1e-3
    )


def test_branches_that_share_points_are_measured_as_they_are_alone():
    whole, _ = bifurcating(4, 30)
    branches = [Branch(f"branch {k}", points, radius) for k, (points, radius) in enumerate(whole)]
    for branch, measures in zip(branches, measure_branches(branches), strict=True):
        (alone,) = measure_branches([branch])
        assert measures.length == pytest.approx(alone.length, abs=1e-3)
        assert measures.length == pytest.approx(curve_from_points(branch.points).length, abs=0.05)
        assert measures.curvature == pytest.approx(alone.curvature, rel=0.2)
        assert measures.sharpest == pytest.approx(alone.sharpest, rel=0.02)


def test_the_bend_of_a_noisy_circle_is_that_of_the_circle():
    angle = np.linspace(0, 2, 120)
    circle = 40 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    noise = np.random.default_rng(0).normal(scale=0.01, size=circle.shape)
    (measures,) = measure_branches([Branch("circle", circle + noise)])
    # The largest curvature is one of noise; that of the spline through all points is many times as large.
    assert measures.curvature == pytest.approx(1 / 40, rel=0.5)
    assert measures.sharpest > 2 * measures.curvature
