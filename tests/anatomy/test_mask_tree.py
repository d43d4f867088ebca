"""Trees of known ends, drawn into masks, come back with all of their ends and no others."""

import nibabel
import numpy as np
import pytest
import pyvista
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ctr_nlp.anatomy.branch import transform_points
from ctr_nlp.anatomy.branch_measures import count_bifurcations
from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.cli.commands.branches import main as list_branches
from ctr_nlp.exceptions import CurveError

FINE = np.full(3, 0.7)
STRAIGHT = np.eye(3)
TRUNK = ([0, 0, 0], [0, 0, -28], 4.0)
TREE = (
    TRUNK,
    ([0, 0, -28], [16, 0, -48], 3.0),
    ([0, 0, -28], [-14, 4, -46], 2.6),
    ([16, 0, -48], [28, 6, -58], 1.8),
    ([16, 0, -48], [14, -8, -66], 1.8),
)
ENDS = np.array([[-14, 4, -46], [28, 6, -58], [14, -8, -66]])
OBLIQUE = Rotation.from_euler("zyx", [25, -15, 40], degrees=True).as_matrix()
MIRRORED = OBLIQUE @ np.diag([-1, 1, 1])


def points_of(tree):
    """Points every 0.3 mm along straight pieces, and their radii."""
    points, radii = [], []
    for start, end, radius in tree:
        start, end = np.array(start, float), np.array(end, float)
        part = np.linspace(0, 1, int(np.linalg.norm(end - start) / 0.3) + 1)[:, None]
        points.append(start + part * (end - start))
        radii.append(np.full(len(part), radius))
    return np.vstack(points), np.concatenate(radii)


def draw(tree, spacing=FINE, axes=STRAIGHT, margin=4.0, unevenness=0.0, seed=0):
    """The voxels in balls around pieces of a tree, and the transform from their indices to RAS."""
    points, radii = points_of(tree)
    local = points @ axes
    low, high = (f(local, axis=0) + sign * (radii.max() + margin) for f, sign in ((np.min, -1), (np.max, 1)))
    shape = np.ceil((high - low) / spacing).astype(int) + 1
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * spacing + low
    ratio = np.full(shape, np.inf)
    for radius in np.unique(radii):
        away, _ = cKDTree(local[radii == radius]).query(grid, distance_upper_bound=2 * radius)
        ratio = np.minimum(ratio, away / radius)
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.5 / spacing)
    lumen = ratio <= 1 + unevenness * noise / noise.std()
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes * spacing, axes @ low
    return lumen, affine


def save(path, lumen, affine):
    nibabel.save(nibabel.Nifti1Image(lumen.astype(np.uint8), affine), path)
    return path


def tips_of(found):
    """The last points of branches, in the coordinates of the file."""
    return transform_points(np.array([branch.points[-1] for branch in found.branches]), found.from_lps)


def assert_ends(found, ends, within=2.0):
    away = np.linalg.norm(tips_of(found)[:, None] - ends, axis=2)
    assert len(found.branches) == len(ends)
    assert away.min(axis=0).max() < within


@pytest.fixture(scope="module")
def mask(tmp_path_factory):
    return save(tmp_path_factory.mktemp("tree") / "lumen.nii", *draw(TREE))


@pytest.fixture(scope="module")
def tree(mask):
    return read_branches(mask)


@pytest.mark.parametrize(
    ("spacing", "axes", "unevenness"),
    [
        (FINE, MIRRORED, 0.0),
        ((0.8, 0.8, 0.8), OBLIQUE, 0.22),
        ((0.5, 0.6, 0.7), MIRRORED, 0.22),
        ((0.5, 0.5, 2.0), np.eye(3), 0.0),
    ],
)
def test_all_ends_are_found_and_no_others(tmp_path, spacing, axes, unevenness):
    lumen, affine = draw(TREE, np.array(spacing), axes, unevenness=unevenness)
    assert_ends(read_branches(save(tmp_path / "lumen.nii", lumen, affine)), ENDS, within=3.0)


def test_paths_are_centred_and_share_their_trunk(tree):
    points, radii = points_of(TREE)
    for branch in tree.branches:
        own = transform_points(branch.points, tree.from_lps)
        away, nearest = cKDTree(points).query(own)
        assert np.median(away) < 0.35
        # Corners are rounded where branches part.
        assert (away < 0.6 * radii[nearest]).all()
        assert np.median(np.abs(branch.radius - radii[nearest])) < 0.35
    one, other = (branch.points for branch in tree.branches[:2])
    shared = (one[:20] == other[:20]).all(axis=1)
    assert shared.all()
    assert sorted(count_bifurcations(tree.branches)) == [1, 2, 2]


def test_the_entry_is_the_widest_end_and_said(tree):
    start = transform_points(tree.branches[0].points[0], tree.from_lps)
    assert np.linalg.norm(start[:2]) < 1.5
    assert start[2] > -1
    assert any("the entry is guessed" in note and "--entry X Y Z" in note for note in tree.facts.notes)


def test_a_given_entry_is_where_paths_begin(mask):
    found = read_branches(mask, entry=[14, -8, -65])
    assert_ends(found, np.array([[-14, 4, -46], [28, 6, -58], [0, 0, 2]]), within=3.0)
    assert np.linalg.norm(transform_points(found.branches[0].points[0], found.from_lps) - [14, -8, -66]) < 2


def test_of_two_wide_ends_the_upper_one_is_the_entry(tmp_path):
    lumen, affine = draw([([0, 0, 0], [30, 0, 25], 3.0)])
    found = read_branches(save(tmp_path / "tube.nii", lumen, affine))
    assert_ends(found, np.array([[0, 0, 0]]), within=3.0)


def test_the_entry_is_where_the_image_cuts_the_lumen(tmp_path):
    # The trunk is cut so near to where it parts that it is no end of its own.
    lumen, affine = draw(TREE)
    height = affine[2, 3] + 0.7 * np.arange(lumen.shape[2])
    found = read_branches(save(tmp_path / "cut.nii", lumen[:, :, height < -25], affine))
    assert_ends(found, ENDS)
    assert np.linalg.norm(transform_points(found.branches[0].points[0], found.from_lps) - [0, 0, -25]) < 1.5
    assert any("where the image cuts the lumen" in note for note in found.facts.notes)


def test_noise_is_not_listed(tmp_path):
    lumen, affine = draw(TREE)
    noisy = lumen ^ (np.random.default_rng(3).random(lumen.shape) < 0.01)
    found = read_branches(save(tmp_path / "noisy.nii", noisy, affine))
    assert_ends(found, ENDS, within=3.0)
    assert any("parts are not connected with the entry" in note for note in found.facts.notes)
    assert any("within the lumen are not of it" in note for note in found.facts.notes)


def test_a_loop_is_cut_and_said(tmp_path, tree):
    # A thin bridge between two branches, as partial volume leaves it where they pass near each other.
    lumen, affine = draw((*TREE, ([9, 0, -39], [-8, 2, -39], 0.8)))
    found = read_branches(save(tmp_path / "loop.nii", lumen, affine))
    assert_ends(found, ENDS)
    assert any("the lumen forms a loop" in note and "it is cut there" in note for note in found.facts.notes)
    assert not any("loop" in note for note in tree.facts.notes)


def test_a_wide_loop_has_no_end(tmp_path):
    ring = (
        TRUNK,
        ([0, 0, -28], [18, 0, -46], 2.5),
        ([0, 0, -28], [-18, 0, -46], 2.5),
        ([18, 0, -46], [0, 0, -64], 2.5),
        ([-18, 0, -46], [0, 0, -64], 2.5),
        ([0, 0, -64], [0, 0, -84], 2.5),
    )
    found = read_branches(save(tmp_path / "ring.nii", *draw(ring)))
    assert_ends(found, np.array([[0, 0, -84]]), within=3.0)
    assert any("the lumen forms a loop" in note for note in found.facts.notes)


def test_number_and_target_choose_the_same_path(mask, tree):
    by_number = read_branch_segment(mask, branch=2)
    by_target = read_branch_segment(mask, target=tips_of(tree)[1])
    assert by_number.whole.points == pytest.approx(by_target.whole.points)
    assert (by_number.start, by_number.stop) == pytest.approx((by_target.start, by_target.stop), abs=0.1)
    part = read_branch_segment(mask, target=[0, 0, -20])
    assert part.stop == pytest.approx(20, abs=4)
    with pytest.raises(CurveError, match=r"there are 3 branches, .*--branch.*--target"):
        read_branch_segment(mask)


def test_a_saved_tree_is_read_back(tmp_path, tree):
    path = tmp_path / "tree.vtp"
    write_vtk(path, tree)
    again = read_branches(path)
    assert again.space == "LPS"
    assert [branch.name for branch in again.branches] == [branch.name for branch in tree.branches]
    for one, other in zip(again.branches, tree.branches, strict=True):
        assert one.points == pytest.approx(other.points)
        assert one.radius == pytest.approx(other.radius)
    mesh = pyvista.read(path)
    assert mesh.point_data.keys() == ["MaximumInscribedSphereRadius"]
    assert mesh.n_lines == len(tree.branches)


def test_a_leak_is_refused_unless_accepted(tmp_path):
    leaking = (TRUNK, ([0, 0, -28], [0, 12, -48], 1.5), ([0, 12, -48], [0, 14, -58], 5.0))
    path = save(tmp_path / "leak.nii", *draw(leaking))
    with pytest.raises(CurveError, match=r"radius grows from .*leak.* --accept leak"):
        read_branch_segment(path, branch=1)
    found = read_branch_segment(path, branch=1, options=ReadOptions(accept=("leak", "ends")))
    assert any("leak" in note for note in found.facts.notes)


def test_a_ball_has_no_branches(tmp_path):
    path = save(tmp_path / "ball.nii", *draw([([0, 0, 0], [0, 0, 0.1], 6.0)]))
    with pytest.raises(CurveError, match=r"longer than it is wide"):
        read_branches(path)


def test_the_command_lists_draws_and_saves(mask, tmp_path, capsys):
    picture, saved = tmp_path / "tree.png", tmp_path / "tree.vtp"
    assert list_branches([str(mask), "--out", str(picture), "--save", str(saved)]) == 0
    seen = capsys.readouterr()
    assert "the entry is guessed" in seen.err
    assert "generation" in seen.out
    assert f"wrote {picture}" in seen.out.replace("\n", "")
    assert len(read_branches(saved).branches) == 3
    assert list_branches([str(mask), "--save", str(tmp_path / "tree.vtk")]) == 2
    assert "must end in .vtp" in capsys.readouterr().err


def assert_real_ends(found, truth):
    """Every end of the true tree that is wide all along is found, and every end found lies on the tree."""
    tips = np.array([branch.points[-1] for branch in found.branches])
    wide = np.array([branch.points[-1] for branch in truth.branches if branch.radius.min() > 0.9])
    assert len(wide) == 5
    assert np.linalg.norm(wide[:, None] - tips, axis=2).min(axis=1).max() < 3
    axis, nearest = cKDTree(np.vstack([branch.points for branch in truth.branches])).query(tips)
    assert axis.max() < 3
    # The mask ends where the radius falls below about 0.9 mm.
    ends = np.array([branch.points[-1] for branch in truth.branches])
    radius = np.concatenate([branch.radius for branch in truth.branches])[nearest]
    at_end = np.linalg.norm(tips[:, None] - ends, axis=2).min(axis=1) < 3
    assert (at_end | (radius < 1.5)).all()


@pytest.mark.parametrize("name", ["airways", pytest.param("airways_uneven", marks=pytest.mark.slow)])
def test_a_whole_human_tree(shared_data, name):
    folder = shared_data / "anatomy"
    found = read_branches(folder / f"chaste_ts002_{name}.nii.gz")
    assert_real_ends(found, read_branches(folder / "chaste_ts002_tree.vtp"))
    assert 38 <= len(found.branches) <= 48
