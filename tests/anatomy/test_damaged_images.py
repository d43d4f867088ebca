"""Damaged VTK files and masks: each is read to the same path, or with a note, or refused with the cause."""

from collections import Counter
from itertools import pairwise

import nibabel
import numpy as np
import pytest
import pyvista
from scipy.spatial.transform import Rotation
from test_mask import LPS, Tube, curve
from test_networks import bifurcating

from ctr_nlp.anatomy.branch import transform_points
from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.paths.curve import curve_from_points

LINES_IN_CI, LINES_IN_ALL = 75, 700
MASKS_IN_CI, MASKS_IN_ALL = 16, 300
ALLOWED_MM = 0.5
"""How far a path that is read without a note may be from the right one."""


class Lines:
    """A VTK file before it is damaged: parts, pairs of points (n, 3) and radii (n,); what else stands in it."""

    def __init__(self, random):
        whole, cut = bifurcating(2, 30, int(random.integers(1000)))
        turn = Rotation.random(random_state=int(random.integers(1000))).as_matrix()
        parts = [whole, cut][random.integers(2)]
        self.parts = [((points @ turn).copy(), radius.copy()) for points, radius in parts]
        self.truth = whole[random.integers(len(whole))][0] @ turn
        self.radius_name = ["Radius", "MaximumInscribedSphereRadius", None][random.integers(3)]
        self.space = ["LPS", None][random.integers(2)]
        self.arrays, self.extra_lines = {}, []
        self.edit = lambda raw: raw
        self.suffix = [".vtp", ".vtk"][random.integers(2)]

    def write(self, folder):
        points = np.vstack([points for points, _ in self.parts] + self.extra_lines)
        counts = [len(points) for points, _ in self.parts] + [len(line) for line in self.extra_lines]
        starts = np.cumsum([0, *counts])
        mesh = pyvista.PolyData(points, lines=np.concatenate([[b - a, *range(a, b)] for a, b in pairwise(starts)]))
        width = np.concatenate([radius for _, radius in self.parts] + [np.ones(len(x)) for x in self.extra_lines])
        if self.radius_name is not None:
            mesh.point_data[self.radius_name] = width
        for name, values in self.arrays.items():
            mesh.point_data[name] = np.resize(values, len(points))
        if self.space is not None:
            mesh.field_data["SPACE"] = [self.space]
        path = folder / f"tree{self.suffix}"
        mesh.save(path)
        path.write_bytes(self.edit(path.read_bytes()))
        return path


def some_part(lines, random):
    return lines.parts[random.integers(len(lines.parts))]


def line_order(lines, random):
    points, radius = some_part(lines, random)
    kind = random.integers(4)
    count = len(points)
    if kind == 0:
        order = np.roll(np.arange(count), 1 if random.random() < 0.5 else -1)
    elif kind == 1:
        a, b = np.sort(random.choice(count, 2, replace=False))
        order = np.arange(count)
        order[[a, b]] = order[[b, a]]
    elif kind == 2:
        a, b = np.sort(random.choice(count, 2, replace=False))
        order = np.concatenate([np.arange(a), np.arange(a, b + 1)[::-1], np.arange(b + 1, count)])
    else:
        order = random.permutation(count)
    points[:], radius[:] = points[order], radius[order]


def line_scale(lines, random):
    factor = [0.1, 0.001, 10, 1000, 0.01][random.integers(5)]
    for points, radius in lines.parts:
        points *= factor
        radius *= factor


def line_mirror(lines, random):
    axis = random.integers(3)
    for points, _ in lines.parts:
        points[:, axis] *= -1


def line_axes(lines, random):
    for points, _ in lines.parts:
        points[:] = points[:, [1, 0, 2]]


def line_space(lines, random):
    lines.space = ["RAS", "scanner", "LPS", ""][random.integers(4)] or None


def line_twice(lines, random):
    points, radius = some_part(lines, random)
    k = random.integers(len(points))
    lines.parts.append((points[: k + 1].copy(), radius[: k + 1].copy()))


def line_repeats(lines, random):
    for k, (points, radius) in enumerate(lines.parts):
        index = np.repeat(np.arange(len(points)), random.integers(1, 3, len(points)))
        lines.parts[k] = points[index], radius[index]


def line_gap(lines, random):
    k = int(random.integers(len(lines.parts)))
    points, radius = lines.parts[k]
    a = int(random.integers(1, len(points) - 1))
    b = min(a + int(random.integers(1, 15)), len(points) - 1)
    lines.parts[k] = np.delete(points, slice(a, b), axis=0), np.delete(radius, slice(a, b))


def line_missing(lines, random):
    if len(lines.parts) > 1:
        del lines.parts[random.integers(len(lines.parts))]


def line_nan(lines, random):
    points, radius = some_part(lines, random)
    values = [points.ravel(), radius][random.integers(2)]
    values[random.integers(len(values))] = [np.nan, np.inf, -1e30][random.integers(3)]


def line_radius(lines, random):
    lines.radius_name = ["diameter", "Thickness", "rad", "Radius_mm", None][random.integers(5)]


def line_array(lines, random):
    lines.arrays[["Curvature", "radius", "GroupIds", "Width"][random.integers(4)]] = random.random(50)


def line_single(lines, random):
    lines.extra_lines.append(random.normal(size=(1, 3)) * 20)


def line_shortcut(lines, random):
    (one, _), (two, _) = some_part(lines, random), some_part(lines, random)
    a, b = one[random.integers(len(one))], two[random.integers(len(two))]
    if np.linalg.norm(b - a) > 1:
        lines.extra_lines.append(a + np.linspace(0, 1, 12)[:, None] * (b - a))


def line_cut(lines, random):
    part = random.uniform()
    lines.edit = lambda raw: raw[: int(part * len(raw))]


LINE_DAMAGES = (
    *(line_order, line_scale, line_mirror, line_axes, line_space, line_twice, line_repeats, line_gap),
    *(line_missing, line_nan, line_radius, line_array, line_single, line_shortcut, line_cut),
)


def compare(kind, path, ends, expected):
    """What becomes of a file: "same", "note", "refused", or "WRONG" with how far it is off."""
    usual = ("states no coordinate system", "has no radius", "name the point array")
    try:
        segment = read_branch_segment(path, entry=ends[0], target=ends[1])
    except (CurveError, OptionError):
        return kind, "refused"
    found = segment.followed_path.apply_transform(np.linalg.inv(segment.to_lps))
    s = np.linspace(0, 1, 200)
    off = np.linalg.norm(found.point(s * found.length) - expected.point(s * expected.length), axis=1).max()
    if off <= ALLOWED_MM and abs(found.length - expected.length) <= 2 * ALLOWED_MM:
        return kind, "same"
    notes = [note for note in segment.facts.notes if not any(part in note for part in usual)]
    return kind, "note" if notes else f"WRONG, {off:.1f} mm off"


def damaged_lines(folder, seed):
    random = np.random.default_rng(seed)
    damage = LINE_DAMAGES[seed % len(LINE_DAMAGES)]
    lines = Lines(random)
    truth = lines.truth
    damage(lines, random)
    kind = f"{damage.__name__}"
    found = compare(kind, lines.write(folder), (truth[0], truth[-1]), curve_from_points(truth))
    return (kind, f"{found[1]}: seed {seed}") if found[1].startswith("WRONG") else found


class Mask:
    """A mask before it is damaged: voxels, qform and sform, their codes, an edit of the bytes."""

    def __init__(self, tube):
        self.voxels = tube.voxels.copy()
        self.qform = LPS @ tube.affine
        self.sform = self.qform.copy()
        self.codes = [1, 1]
        self.edit = lambda raw: raw
        self.exchange = False
        self.middle = transform_points(tube.points, np.linalg.inv(tube.affine))

    def away_from(self, index):
        """Distance of all voxels from an index (3,), in voxels."""
        grid = np.stack(np.meshgrid(*map(np.arange, self.voxels.shape), indexing="ij"), axis=-1)
        return np.linalg.norm(grid - index, axis=-1)

    def write(self, folder):
        path = folder / "mask.nii"
        image = nibabel.Nifti1Image(self.voxels, None)
        image.set_qform(self.qform, code=self.codes[0])
        image.set_sform(self.sform, code=self.codes[1])
        nibabel.save(image, path)
        path.write_bytes(self.edit(path.read_bytes()))
        return path


def mask_labels(mask, random):
    half = random.integers(1, mask.voxels.shape[0])
    mask.voxels[:half] *= 2


def mask_second_label(mask, random):
    mask.voxels[:2, :2, :2] = random.integers(2, 9)


def mask_values(mask, random):
    mask.voxels = (mask.voxels * 0.9 + random.random(mask.voxels.shape) * 0.05).astype(np.float32)


def mask_nan(mask, random):
    mask.voxels = mask.voxels.astype(np.float32)
    mask.voxels[random.random(mask.voxels.shape) < 0.001] = np.nan


def mask_forms(mask, random):
    mask.sform[:3, 3] += random.uniform(1, 20, 3)


def mask_no_form(mask, random):
    mask.codes = [0, 0]


def mask_scale(mask, random):
    factor = [0.1, 0.001, 10, 1000, 2][random.integers(5)]
    mask.qform[:3] *= factor
    mask.sform[:3] *= factor


def mask_mirror(mask, random):
    axis = random.integers(3)
    mask.voxels = np.flip(mask.voxels, axis)


def mask_axes(mask, random):
    mask.voxels = np.ascontiguousarray(mask.voxels.swapaxes(*random.choice(3, 2, replace=False)))


def mask_exchanged(mask, random):
    mask.exchange = True


def mask_leak(mask, random):
    """A blob twice as wide as the lumen, in its last two thirds: one at the entry is a lumen that narrows."""
    at = mask.middle[int(random.uniform(0.35, 1.0) * (len(mask.middle) - 1))]
    mask.voxels[mask.away_from(at) < random.uniform(10, 14)] = 1


def mask_gap(mask, random):
    at = mask.middle[int(random.uniform(0.2, 0.8) * (len(mask.middle) - 1))]
    mask.voxels[mask.away_from(at) < 8] = 0


def mask_header(mask, random):
    at, value = int(random.integers(0, 348)), int(random.integers(256))
    mask.edit = lambda raw: raw[:at] + bytes([value]) + raw[at + 1 :]


def mask_cut(mask, random):
    part = random.uniform()
    mask.edit = lambda raw: raw[: int(part * len(raw))]


MASK_DAMAGES = (
    *(mask_labels, mask_second_label, mask_values, mask_nan, mask_forms, mask_no_form, mask_scale, mask_mirror),
    *(mask_axes, mask_exchanged, mask_leak, mask_gap, mask_header, mask_cut, mask_header, mask_header),
)


@pytest.fixture(scope="module")
def tapered():
    """A lumen that no mirror takes to itself."""

    def rising(u):
        return np.stack([30 * np.cos(1.8 * u), 30 * np.sin(1.8 * u), 45 * u**2], axis=1)

    return Tube(curve(rising, lambda u: 5.5 - 2 * u), np.full(3, 1.0))


@pytest.fixture(scope="module")
def expected(tapered, tmp_path_factory):
    """The right path, in the file's coordinates."""
    path = tapered.nifti(tmp_path_factory.mktemp("good") / "good.nii")
    return curve_from_points(tapered.read(path).points @ LPS[:3, :3])


def damaged_mask(folder, tube, expected, seed):
    random = np.random.default_rng(seed)
    damage = MASK_DAMAGES[seed % len(MASK_DAMAGES)]
    mask = Mask(tube)
    damage(mask, random)
    ends = tube.points[[0, -1]] @ LPS[:3, :3]
    found = compare(damage.__name__, mask.write(folder), ends[::-1] if mask.exchange else ends, expected)
    return (found[0], f"{found[1]}: seed {seed}") if found[1].startswith("WRONG") else found


def check(found):
    counts = Counter(found)
    print("\n".join(f"{kind:18} {result:10} {count}" for (kind, result), count in sorted(counts.items())))
    assert [each for each in counts if each[1].startswith("WRONG")] == []


def test_no_damaged_vtk_file_gives_a_wrong_path_silently(tmp_path):
    check(damaged_lines(tmp_path, seed) for seed in range(LINES_IN_CI))


def test_no_damaged_mask_gives_a_wrong_path_silently(tmp_path, tapered, expected):
    check(damaged_mask(tmp_path, tapered, expected, seed) for seed in range(MASKS_IN_CI))


@pytest.mark.slow
def test_no_vtk_file_of_many_gives_a_wrong_path_silently(tmp_path):
    check(damaged_lines(tmp_path, seed) for seed in range(10_000, 10_000 + LINES_IN_ALL))


@pytest.mark.slow
def test_no_mask_of_many_gives_a_wrong_path_silently(tmp_path, tapered, expected):
    check(damaged_mask(tmp_path, tapered, expected, seed) for seed in range(10_000, 10_000 + MASKS_IN_ALL))
