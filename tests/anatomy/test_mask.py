"""Lumens of known middle and radius, written as images by other libraries and read back, and what is refused."""

import contextlib

import nibabel
import nrrd
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ctr_nlp import curve_from_points, read_csv
from ctr_nlp.anatomy.airway import synthetic_airway
from ctr_nlp.anatomy.segmentation.mask import read_mask
from ctr_nlp.exceptions import CurveError

SPACING = np.array([0.5, 0.5, 1.0])
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
OBLIQUE = Rotation.from_euler("zyx", [25, -15, 40], degrees=True).as_matrix()
SPACES = {"left-posterior-superior": np.eye(4), "RAS": LPS, "left-anterior-superior": np.diag([1.0, -1, 1, 1])}


def straight(u):
    return np.stack([0 * u, 0 * u, 45 * u], axis=1)


def arc(u):
    return np.stack([30 * np.cos(1.8 * u), 30 * np.sin(1.8 * u), 8 * u], axis=1)


def helix(u):
    return np.stack([14 * np.cos(7 * u), 14 * np.sin(7 * u), 45 * u], axis=1)


def curve(shape, radius=4.0):
    points = shape(np.linspace(0, 1, 400))
    return curve_from_points(
        points, np.full(400, radius) if np.isscalar(radius) else radius(np.linspace(0, 1, 400))
    )


class Tube:
    """A voxelised lumen (l, m, n): every voxel whose middle lies in a ball around the curve, or between its ends.

    axes (3, 3) are the directions of the image's axes in LPS. points (n, 3) every 0.2 mm and radius are the truth.
    """

    def __init__(self, path, spacing=SPACING, axes=OBLIQUE, flat=False, margin=2.0):
        s = np.linspace(0, path.length, int(path.length / 0.2) + 1)
        self.points, self.radius, tangent = path.point(s), path.radius(s), path.tangent(s)
        local = self.points @ axes
        first = (local - self.radius[:, None]).min(axis=0) - margin
        shape = np.ceil(((local + self.radius[:, None]).max(axis=0) + margin - first) / spacing).astype(int) + 1
        self.affine = np.eye(4)
        self.affine[:3, :3], self.affine[:3, 3] = axes * spacing, axes @ first
        self.spacing, self.voxels = spacing, np.zeros(shape, np.uint8)
        for middle, radius in zip(local, self.radius, strict=True):
            low = np.maximum(0, np.floor((middle - radius - first) / spacing).astype(int))
            high = np.ceil((middle + radius - first) / spacing).astype(int) + 1
            box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
            grid = np.ogrid[tuple(slice(0, each) for each in self.voxels[box].shape)]
            away = [
                g * d + (a * d + f - m) for g, d, a, f, m in zip(grid, spacing, low, first, middle, strict=True)
            ]
            self.voxels[box] |= sum(each**2 for each in away) <= radius**2
        if flat:
            for end, outwards in ((self.points[0], -tangent[0]), (self.points[-1], tangent[-1])):
                at = np.argwhere(self.voxels)
                off = at @ self.affine[:3, :3].T + self.affine[:3, 3] - end
                cut = (off @ outwards > 1e-9) & (np.linalg.norm(off, axis=1) < 2 * self.radius.max())
                self.voxels[tuple(at[cut].T)] = 0

    def nifti(self, path):
        nibabel.save(nibabel.Nifti1Image(self.voxels, LPS @ self.affine), path)
        return path

    def nrrd(self, path, space="left-posterior-superior", order=(0, 1, 2), **more):
        affine = (SPACES[space] @ self.affine)[:, [*order, 3]]
        header = {"space": space, "space directions": affine[:3, :3].T, "space origin": affine[:3, 3], **more}
        nrrd.write(str(path), np.transpose(self.voxels, order), header)
        return path

    def read(self, path, to_file=LPS, start=0, stop=-1):
        ends = [point @ to_file[:3, :3].T for point in self.points[[start, stop]]]
        return read_mask(path, *ends).branches[0]


def errors(branch, tube):
    """Mean and largest distance in mm from path to truth and back; largest error of the radius."""
    found = curve_from_points(branch.points, branch.radius)
    s = np.linspace(0, found.length, int(found.length / 0.1))
    points, radius = found.point(s), found.radius(s)
    there, nearest = cKDTree(tube.points).query(points)
    back, nearest_back = cKDTree(points).query(tube.points)
    off = np.concatenate([radius - tube.radius[nearest], radius[nearest_back] - tube.radius])
    return max(there.mean(), back.mean()), max(there.max(), back.max()), np.abs(off).max()


def assert_accurate(branch, tube):
    mean, largest, radius = errors(branch, tube)
    assert mean < 0.2
    assert largest < 0.8
    assert radius < 0.5


# Accuracy


@pytest.mark.parametrize("flat", [False, True], ids=["round ends", "flat ends"])
@pytest.mark.parametrize("radius", [2.0, 4.0, 7.0])
@pytest.mark.parametrize("shape", [straight, arc, helix], ids=lambda shape: shape.__name__)
def test_a_tube_comes_back(tmp_path, shape, radius, flat):
    tube = Tube(curve(shape, radius), flat=flat)
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii")), tube)


@pytest.mark.parametrize("radius", [lambda u: 7 - 4 * u, lambda u: 4 + np.sin(9 * u)], ids=["tapered", "wavy"])
def test_a_varying_radius_comes_back(tmp_path, radius):
    tube = Tube(curve(arc, radius))
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii.gz")), tube)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_synthetic_airway_comes_back(tmp_path, seed):
    tube = Tube(synthetic_airway(seed))
    assert_accurate(tube.read(tube.nifti(tmp_path / "airway.nii")), tube)


@pytest.mark.parametrize("name", ["chaste_ts002_RLL", "hra_vhm_left_main"])
def test_a_real_airway_comes_back(tmp_path, shared_data, name):
    tube = Tube(read_csv(shared_data / "airways" / f"{name}.csv"))
    assert_accurate(tube.read(tube.nifti(tmp_path / "airway.nii")), tube)


@pytest.mark.parametrize("spacing", [(0.4, 0.4, 0.4), (0.5, 1.0, 0.5), (1.0, 1.0, 1.0), (0.6, 0.6, 1.8)])
def test_voxels_of_other_shapes(tmp_path, spacing):
    tube = Tube(curve(arc, 4.0), np.array(spacing))
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii")), tube)


def test_a_rough_wall_is_evened_out(tmp_path):
    tube, random = Tube(curve(arc, 4.0)), np.random.default_rng(0)
    inside = tube.voxels.astype(bool)
    near = np.zeros_like(inside)
    for axis in range(3):
        for step in (-1, 1):
            near |= inside != np.roll(inside, step, axis)
    tube.voxels[near & (random.random(near.shape) < 0.15)] ^= 1
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii")), tube)


def test_the_border_of_the_image_is_no_wall(tmp_path):
    """A lumen cut open obliquely has its full radius there, and its middle does not turn towards the border."""
    tube = Tube(curve(straight, 5.0))
    at = np.rint(np.linalg.solve(tube.affine[:3, :3], tube.points[60] - tube.affine[:3, 3])).astype(int)
    axis = int(np.abs(np.linalg.solve(tube.affine[:3, :3], [0.0, 0.0, 1.0]) * tube.spacing).argmax())
    forwards = np.linalg.solve(tube.affine[:3, :3], [0.0, 0.0, 1.0])[axis] > 0
    kept = [slice(None)] * 3
    kept[axis] = slice(at[axis], None) if forwards else slice(None, at[axis] + 1)
    if forwards:
        tube.affine[:3, 3] += tube.affine[:3, axis] * at[axis]
    tube.voxels = tube.voxels[tuple(kept)]
    tube.points, tube.radius = tube.points[60:], tube.radius[60:]
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii")), tube)


@pytest.mark.parametrize("flat", [False, True], ids=["round ends", "flat ends"])
def test_an_entry_off_the_middle_starts_the_path_beside_it_in_the_middle(tmp_path, flat):
    tube = Tube(curve(straight, 6.0), flat=flat)
    entry = (tube.points[2] + [4.0, -2.0, 0.0]) @ LPS[:3, :3]
    branch = read_mask(tube.nifti(tmp_path / "tube.nii"), entry, tube.points[-1] @ LPS[:3, :3]).branches[0]
    np.testing.assert_allclose(branch.points[0], tube.points[2], atol=0.6)
    assert_accurate(branch, tube)


@pytest.mark.parametrize("degrees", [35, 90])
def test_a_side_branch_does_not_draw_the_path_far(tmp_path, degrees):
    angle = np.radians(degrees)
    tube = Tube(curve(straight, 5.0), margin=12.0)
    s = np.arange(0, 20, 0.2)[:, None]
    side = np.array([0.0, 0.0, 22.0]) + s * [np.sin(angle), 0.0, np.cos(angle)]
    places = np.argwhere(np.ones_like(tube.voxels)) @ tube.affine[:3, :3].T + tube.affine[:3, 3]
    tube.voxels |= (cKDTree(side).query(places)[0] < 3.0).reshape(tube.voxels.shape)
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii")), tube)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [2.0, 18.0])
def test_a_large_image(tmp_path, radius):
    def winding(u):
        return np.stack([48 * np.cos(7.5 * u), 48 * np.sin(7.5 * u), 100 * u], axis=1)

    tube = Tube(curve(winding, radius), np.full(3, 0.5), np.eye(3), margin=1.0)
    tube.voxels = np.pad(tube.voxels, [(0, max(0, 300 - size)) for size in tube.voxels.shape])
    assert_accurate(tube.read(tube.nifti(tmp_path / "tube.nii.gz")), tube)


def test_points_are_a_millimetre_apart_and_smooth(tmp_path):
    tube = Tube(curve(arc, 4.0))
    branch = tube.read(tube.nifti(tmp_path / "tube.nii"))
    found = curve_from_points(branch.points, branch.radius)
    np.testing.assert_allclose(np.linalg.norm(np.diff(branch.points, axis=0), axis=1), 1.0, atol=0.05)
    curvature = found.curvature(np.linspace(8, found.length - 8, 100))
    np.testing.assert_allclose(curvature, 30 / (30**2 + (8 / 1.8) ** 2), rtol=0.35)


# Coordinates


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
@pytest.mark.parametrize("space", SPACES)
def test_formats_and_spaces_give_the_same_points(tmp_path, space, order):
    tube = Tube(curve(arc, 3.0))
    expected = tube.read(tube.nifti(tmp_path / "tube.nii.gz")).points
    path = tube.nrrd(tmp_path / "tube.nrrd", space, order)
    found = tube.read(path, np.linalg.inv(SPACES[space])).points
    np.testing.assert_allclose(found, expected, atol=0.01)


@pytest.mark.parametrize("code", ["qform", "sform"])
def test_one_of_the_two_nifti_transforms_is_enough(tmp_path, code):
    tube = Tube(curve(arc, 3.0))
    expected = tube.read(tube.nifti(tmp_path / "tube.nii")).points
    image = nibabel.Nifti1Image(tube.voxels, LPS @ tube.affine)
    image.set_qform(LPS @ tube.affine, code=int(code == "qform"))
    image.set_sform(LPS @ tube.affine, code=int(code == "sform"))
    nibabel.save(image, tmp_path / "one.nii")
    np.testing.assert_allclose(tube.read(tmp_path / "one.nii").points, expected, atol=0.01)


def test_branches_tell_their_space(tmp_path):
    tube = Tube(curve(arc, 3.0))
    ends = tube.points[[0, -1]]
    ras = read_mask(tube.nifti(tmp_path / "tube.nii"), *(ends @ LPS[:3, :3]))
    lps = read_mask(tube.nrrd(tmp_path / "tube.nhdr"), *ends)
    assert (ras.space, lps.space) == ("RAS", "LPS")
    np.testing.assert_array_equal(ras.to_lps, LPS)
    np.testing.assert_array_equal(lps.to_lps, np.eye(4))
    assert ras.branches[0].name == "tube"


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.uint16])
def test_a_label_image_with_one_label_is_a_mask(tmp_path, dtype):
    tube = Tube(curve(arc, 3.0))
    expected = tube.read(tube.nifti(tmp_path / "tube.nii")).points
    tube.voxels = tube.voxels.astype(dtype) * 7
    np.testing.assert_array_equal(tube.read(tube.nifti(tmp_path / "seven.nii")).points, expected)


# What is refused

TUBE = Tube(curve(straight, 3.0), axes=np.eye(3))
RAS_ENDS = TUBE.points[[0, -1]] @ LPS[:3, :3]


@contextlib.contextmanager
def refused(path, message):
    """The one error names the file and says message."""
    with pytest.raises(CurveError, match=message) as caught:
        yield
    assert str(path) in str(caught.value)


def changed_nifti(tmp_path, voxels=TUBE.voxels, affine=TUBE.affine):
    """A NIfTI file of changed voxels or affine."""
    path = tmp_path / "bad.nii"
    nibabel.save(nibabel.Nifti1Image(voxels, LPS @ affine), path)
    return path


def poked(tmp_path, offset, value, dtype):
    """A NIfTI file with a number of its header replaced."""
    path = changed_nifti(tmp_path)
    raw = bytearray(path.read_bytes())
    part = np.asarray(value, dtype).tobytes()
    raw[offset : offset + len(part)] = part
    path.write_bytes(raw)
    return path


@pytest.mark.parametrize("name", ["mask.nii", "mask.nii.gz", "mask.nrrd", "mask.nhdr"])
@pytest.mark.parametrize("content", [None, b"", b"no image at all\n" * 40], ids=["missing", "empty", "text"])
def test_what_is_no_image(tmp_path, name, content):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with refused(path, r"cannot be read|does not begin|header has 348"):
        read_mask(path, *RAS_ENDS)


def test_a_file_of_another_kind(tmp_path):
    with refused(tmp_path / "mask.stl", r"must end in \.nii, \.nii\.gz, \.nrrd, \.nhdr"):
        read_mask(tmp_path / "mask.stl", *RAS_ENDS)


@pytest.mark.parametrize("name", ["cut.nii", "cut.nii.gz", "cut.nrrd"])
def test_a_file_that_was_cut_short(tmp_path, name):
    path = tmp_path / name
    (TUBE.nrrd if name.endswith("nrrd") else TUBE.nifti)(path)
    path.write_bytes(path.read_bytes()[:-60])
    with refused(path, "cannot be read|cut short"):
        read_mask(path, *RAS_ENDS)


@pytest.mark.parametrize("shape", [(1, *TUBE.voxels.shape[:2]), (*TUBE.voxels.shape, 2)], ids=["2D", "4D"])
def test_images_without_three_axes(tmp_path, shape):
    with refused(tmp_path, "must have 3 axes"):
        read_mask(changed_nifti(tmp_path, np.resize(TUBE.voxels, shape).squeeze()), *RAS_ENDS)


VALUES = {
    "several": (
        TUBE.voxels * (1 + (np.arange(TUBE.voxels.shape[2]) > 20)),
        r"labels 1 \(\d+ voxels\), 2 \(\d+ voxels\); choose .* --label N",
    ),
    "grey": (
        np.arange(TUBE.voxels.size).reshape(TUBE.voxels.shape).astype(np.int32),
        r"values from 0 to \d+, as in a scan",
    ),
    "empty": (0 * TUBE.voxels, "all 0"),
    "full": (0 * TUBE.voxels + 3, "all 3; those outside the lumen must be 0"),
}


@pytest.mark.parametrize("values", VALUES)
def test_images_that_are_no_mask(tmp_path, values):
    voxels, message = VALUES[values]
    path = changed_nifti(tmp_path, voxels.astype(np.int32))
    with refused(path, message):
        read_mask(path, *RAS_ENDS)


HEADERS = {
    "zero spacing": (80, 0, "<f4", r"spacing \(pixdim\) is \[0\.0, 0\.5, 1\.0\] mm; it must be positive"),
    "negative spacing": (84, -0.5, "<f4", "it must be positive"),
    "no spacing": (88, np.nan, "<f4", "it must be positive"),
    "other spacing": (80, 0.75, "<f4", "by pixdim and .* by sform; they must agree"),
    "no codes": (252, (0, 0), "<i2", "no coordinate system: qform_code and sform_code are 0"),
    "codes that differ": (252, (1, 1), "<i2", "qform and sform place voxels up to .* apart"),
    "direction": (280, np.nan, "<f4", "must agree|must be finite"),
    "skew": (284, 0.2, "<f4", "from perpendicular|must agree"),
    "metres": (123, 1, "u1", "lengths are in m; .* --units mm"),
    "format": (344, (0, 0), "u1", "does not begin with a NIfTI-1 header"),
}


@pytest.mark.parametrize("header", HEADERS)
def test_nifti_headers_that_say_nothing_clear(tmp_path, header):
    offset, value, dtype, message = HEADERS[header]
    path = poked(tmp_path, offset, value, dtype)
    if header == "codes that differ":
        path.write_bytes(path.read_bytes()[:268] + np.float32(99).tobytes() + path.read_bytes()[272:])
    with refused(path, message):
        read_mask(path, *RAS_ENDS)


@pytest.mark.parametrize(
    ("scale", "message"),
    [((1e-3,) * 3, "0.0005 x 0.0005 x 0.001 mm; .* metres"), ((1e3,) * 3, "500 x 500"), ((1, 1, 6), "10 times")],
)
def test_absurd_spacings(tmp_path, scale, message):
    affine = TUBE.affine @ np.diag([*scale, 1])
    for path in (changed_nifti(tmp_path, affine=affine), tmp_path / "bad.nrrd"):
        header = {"space": "RAS", "space directions": affine[:3, :3].T, "space origin": affine[:3, 3]}
        nrrd.write(str(tmp_path / "bad.nrrd"), TUBE.voxels, header)
        with refused(path, message):
            read_mask(path, *RAS_ENDS)


NRRD = {
    "no space": ({"space": None}, "space is None; it must be left-posterior-superior, .* no coordinate system"),
    "scanner": ({"space": "scanner-xyz"}, "space is 'scanner-xyz'"),
    "no origin": ({"space origin": None}, "space origin is missing"),
    "no directions": ({"space directions": None}, "space directions is missing"),
    "direction": ({"space directions": np.diag([np.inf, 0.5, 1.0])}, "must be finite"),
    "spacing": ({"space directions": np.diag([0.0, 0.5, 1.0])}, "spacing is 0 x 0.5 x 1 mm"),
    "skew": ({"space directions": [[0.5, 0, 0], [0.2, 0.5, 0], [0, 0, 1.0]]}, "from perpendicular"),
    "units": ({"space units": ["m", "m", "m"]}, "lengths are in m; .* --units mm"),
}


@pytest.mark.parametrize("header", NRRD)
def test_nrrd_headers_that_say_nothing_clear(tmp_path, header):
    changes, message = NRRD[header]
    path = TUBE.nrrd(tmp_path / "good.nrrd")
    data, fields = nrrd.read(str(path))
    fields |= changes
    if fields["space"] is None:
        fields["space dimension"] = 3
    path = tmp_path / "bad.nrrd"
    nrrd.write(str(path), data, {key: value for key, value in fields.items() if value is not None})
    with refused(path, message):
        read_mask(path, *TUBE.points[[0, -1]])


def test_an_nrrd_of_vectors(tmp_path):
    path = tmp_path / "bad.nrrd"
    directions = np.vstack([[np.nan] * 3, np.diag(SPACING)])
    nrrd.write(
        str(path),
        np.stack([TUBE.voxels] * 3),
        {
            "space": "RAS",
            "space directions": directions,
            "space origin": [0, 0, 0],
            "kinds": ["vector"] + ["domain"] * 3,
        },
    )
    with refused(path, "dimension is 4; it must be 3"):
        read_mask(path, *TUBE.points[[0, -1]])


@pytest.mark.parametrize("name", ["entry", "target"])
@pytest.mark.parametrize("point", [(1.0, 2.0), (np.nan, 0.0, 0.0)], ids=["two numbers", "not finite"])
def test_points_that_are_none(tmp_path, name, point):
    path = TUBE.nifti(tmp_path / "mask.nii")
    with refused(path, f"{name} is .* three finite numbers in mm"):
        read_mask(path, **({"entry": RAS_ENDS[0], "target": RAS_ENDS[1]} | {name: point}))


@pytest.mark.parametrize("which", [0, 1], ids=["entry", "target"])
def test_a_point_outside_the_mask(tmp_path, which):
    path = TUBE.nifti(tmp_path / "mask.nii")
    ends = RAS_ENDS.copy()
    ends[which, 0] += 8.0
    near = ", ".join(rf"-?{abs(x):.1f}".replace(".", r"\.") for x in ends[which] - [4.75, 0.0, 0.0])
    message = rf"{('entry', 'target')[which]} .* is 4\.75 mm outside the mask; .* lumen is \({near}\), .* RAS$"
    with refused(path, message):
        read_mask(path, *ends)


def test_a_point_in_the_other_coordinate_system_is_noticed(tmp_path):
    path = tmp_path / "mask.nii"
    away = TUBE.affine.copy()
    away[:3, 3] += [30.0, 20.0, 0.0]
    nibabel.save(nibabel.Nifti1Image(TUBE.voxels, LPS @ away), path)
    lps = TUBE.points[[0, -1]] + [30.0, 20.0, 0.0]
    with refused(path, r"RAS; with x and y negated it does"):
        read_mask(path, *lps)


def test_a_point_just_outside_is_taken_to_the_lumen(tmp_path):
    path = TUBE.nifti(tmp_path / "mask.nii")
    outside = RAS_ENDS[0] - [0.0, 0.0, 3.7]
    branch = read_mask(path, outside, RAS_ENDS[1]).branches[0]
    assert branch.points[0, 2] == pytest.approx(-3.0, abs=1.0)


def test_a_lumen_in_two_parts(tmp_path):
    voxels = TUBE.voxels.copy()
    voxels[:, :, 25] = 0
    path = changed_nifti(tmp_path, voxels)
    with refused(path, "separate parts of the mask"):
        read_mask(path, *RAS_ENDS)


def test_entry_and_target_at_one_place(tmp_path):
    path = TUBE.nifti(tmp_path / "mask.nii")
    with refused(path, r"entry and target are 0 mm apart; they must be at least"):
        read_mask(path, RAS_ENDS[0], RAS_ENDS[0])


def test_entry_and_target_across_the_lumen(tmp_path):
    tube = Tube(curve(straight, 7.0), axes=np.eye(3))
    path = tube.nifti(tmp_path / "mask.nii")
    middle = tube.points[110] @ LPS[:3, :3]
    with refused(path, "must be longer than the lumen is wide"):
        read_mask(path, middle - np.array([6, 0, 0]), middle + np.array([6, 0, 0]))
