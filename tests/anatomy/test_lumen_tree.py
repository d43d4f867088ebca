"""Trees whose ends are planned one after another: carina, widths, and problems."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import Limits, Robot, Tube, problem_from_file
from ctr_nlp.anatomy.branch import Branch, Branches
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.lumen_tree import find_carina, read_lumen_tree
from ctr_nlp.anatomy.synthetic_tree import draw_mask, synthetic_tree, write_mask
from ctr_nlp.exceptions import CurveError, ProblemError

pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')

THIN = Robot(
    (
        Tube(90, 60, 1 / 130, outer_diameter=2.4, inner_diameter=2.0),
        Tube(400, 150, 1 / 60, outer_diameter=1.6, inner_diameter=1.2),
    )
)


def line(*corners, radius=4.0):
    """A branch with a point every millimetre through corners."""
    points = [np.array(corners[0], float)]
    for corner in np.array(corners[1:], float):
        start = points[-1]
        count = max(1, round(np.linalg.norm(corner - start)))
        points += [start + (corner - start) * k / count for k in range(1, count + 1)]
    return Branch("line", np.array(points), np.full(len(points), radius))


def test_carina_is_the_main_bifurcation_and_not_a_spur():
    main = (0, 0, 40)
    sides = [(40, 0, 80), (-40, 0, 80)]
    # A spur of the trachea before the carina, and as many ends beyond it that the spur is less than a sixth.
    spur = line((0, 0, 0), (0, 0, 20), (0, 15, 30))
    ends = [line((0, 0, 0), main, side, (side[0] + k, 10 * k, 110)) for side in sides for k in (-2, 0, 2, 4)]
    assert find_carina([spur, *ends]).tolist() == [0, 0, 40]


def test_tree_without_a_bifurcation_has_no_carina():
    with pytest.raises(CurveError, match="no main bifurcation"):
        find_carina([line((0, 0, 0), (0, 0, 50))])


@pytest.fixture(scope="module")
def tree_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("tree") / "tree.vtp"
    write_vtk(path, synthetic_tree(0, 6))
    return path


def test_ends_are_those_of_the_file_from_the_entry(tree_file):
    whole = read_lumen_tree(tree_file)
    grown = synthetic_tree(0, 6)
    assert [end.depth for end in whole.ends] == pytest.approx([each.length for each in grown.branches], rel=2e-3)
    inner = read_lumen_tree(tree_file, from_carina=True)
    assert inner.entry == pytest.approx([0, 0, -60], abs=1e-3)
    assert [a.depth - b.depth for a, b in zip(whole.ends, inner.ends, strict=True)] == pytest.approx(
        [60] * 6, abs=0.5
    )
    lower = read_lumen_tree(tree_file, entry=(0, 0, -30))
    assert whole.ends[0].depth - lower.ends[0].depth == pytest.approx(30, abs=0.1)


def test_file_is_read_again_only_when_it_changes(tmp_path):
    path = tmp_path / "tree.vtp"
    write_vtk(path, synthetic_tree(0, 3))
    first = read_lumen_tree(path)
    assert read_lumen_tree(path) is first
    write_vtk(path, synthetic_tree(0, 4))
    assert len(read_lumen_tree(path).ends) == 4


def test_branch_that_does_not_pass_the_carina_is_not_entered(tmp_path):
    main = [(20 * side, 0, -60) for side in (-1, 1)]
    sides = [
        line((0, 0, 0), (0, 0, -40), middle, (2 * middle[0], 3 * k, -90)) for middle in main for k in (-8, 0, 8)
    ]
    spur = line((0, 0, 0), (0, 0, -20), (0, 15, -30))
    write_vtk(tmp_path / "spur.vtp", Branches((spur, *sides), "LPS", np.eye(4)))
    tree = read_lumen_tree(tmp_path / "spur.vtp", from_carina=True)
    assert [end.start is None for end in tree.ends] == [True, *[False] * 6]


def test_narrowest_place_counts_the_thinnest_robot_there(tmp_path):
    points = np.column_stack([np.zeros(101), np.zeros(101), np.arange(101.0)])
    radius = np.where(np.arange(101) < 50, 3.0, 1.5)
    write_vtk(tmp_path / "line.vtp", Branches((Branch("a", points, radius),), "LPS", np.eye(4)))
    tree = read_lumen_tree(tmp_path / "line.vtp")
    found = tree.find_narrowest(tree.ends[0], THIN)
    assert found.margin == pytest.approx(1.5 - 0.8, abs=0.05)
    assert found.depth > 49
    # A tube that cannot be drawn back shorter than 70 mm is there.
    pushed = replace(THIN, limits=Limits(beta=((60, 60), (60, 150))))
    found = tree.find_narrowest(tree.ends[0], pushed)
    assert found.margin == pytest.approx(1.5 - 1.2, abs=0.05)
    assert found.point == pytest.approx([0, 0, found.depth], abs=1e-6)


def test_problem_is_that_of_the_file(tree_file):
    tree = read_lumen_tree(tree_file)
    ours = tree.problem(2, THIN, frames=4, trim=True)
    theirs = problem_from_file(tree_file, THIN, 4, branch=2, trim="start")
    assert ours.target_frames[-1].points == pytest.approx(theirs.target_frames[-1].points, abs=1e-9)
    assert ours.to_robot == pytest.approx(theirs.to_robot, abs=1e-9)
    assert ours.lumen.length == theirs.lumen.length


def test_path_that_is_too_long_is_refused_without_trimming(tree_file):
    short = replace(THIN, limits=Limits(beta=((0, 20), (0, 60))))
    with pytest.raises(ProblemError, match="robot reaches"):
        read_lumen_tree(tree_file).problem(1, short)


def test_wall_of_a_mask_is_that_of_single_paths(tmp_path):
    pytest.importorskip("nibabel", reason='needs nibabel: pip install -e ".[anatomy]"')
    write_mask(tmp_path / "tree.nii.gz", draw_mask(synthetic_tree(0, 2), spacing=1.5))
    ours = read_lumen_tree(tmp_path / "tree.nii.gz").problem(2, THIN, frames=2)
    theirs = problem_from_file(tmp_path / "tree.nii.gz", THIN, 2, branch=2)
    # Beside the path, and away from its ends, at which the rims of the openings differ by a triangle.
    points = theirs.target_frames[-1].points[10:-10] + np.array([1.0, 0.5, 0.0])
    assert ours.walls[0].room(points) == pytest.approx(theirs.walls[0].room(points), abs=1e-4)
    fields = [problem.walls[0].field.evaluate(points)[0] for problem in (ours, theirs)]
    assert fields[0] == pytest.approx(fields[1], abs=0.05)


def test_entry_outside_of_all_branches_is_refused(tree_file):
    with pytest.raises(CurveError):
        read_lumen_tree(tree_file, entry=(500, 0, 0))
