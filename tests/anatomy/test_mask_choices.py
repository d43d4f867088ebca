"""Images that hold more than one thing, or leave their position open: what counts is stated, not guessed."""

import nibabel
import nrrd
import numpy as np
import pytest
from test_mask import LPS, Tube, arc, curve

from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.reading import GIVEN, STATED, ReadOptions
from ctr_nlp.anatomy.segmentation.mask import read_mask
from ctr_nlp.exceptions import CurveError

ENDS = (12, 15, 116), (46, 15, 16)
"""Entry and target of the shared cases, in their files' coordinates."""
CASES = {
    "M1_two_labels.nii.gz": ({"labels": (1, 2)}, "labels 1 .4823 voxels., 2 .4619 voxels.; .* --label N"),
    "M2_qform_and_sform_differ.nii.gz": ({"form": "qform"}, "--form qform or --form sform says which counts"),
    "M3_no_form.nii.gz": ({"space": "RAS"}, "no coordinate system.* --space RAS"),
    "M10_probability.nii.gz": ({"threshold": 0.5}, "between 0.01 and 0.97 .* --threshold 0.5"),
    "S1_two_segments.seg.nrrd": (
        {"segment": "airway"},
        "'airway' .9442 voxels., 'nodule' .150 voxels.; .*--segment",
    ),
    "S2_overlapping_4D.seg.nrrd": ({"segment": "airway"}, "segments 'airway' .* 'nodule' .*--segment NAME"),
}


def write_nifti(path, voxels, affine, **codes):
    image = nibabel.Nifti1Image(voxels, None)
    image.set_qform(affine, code=codes.get("qform", 1))
    image.set_sform(affine, code=codes.get("sform", 1))
    nibabel.save(image, path)
    return path


@pytest.fixture(scope="module")
def tube():
    return Tube(curve(arc, lambda u: 4.5 - u), np.full(3, 1.0))


@pytest.fixture(scope="module")
def ends(tube):
    return tube.points[[0, -1]] @ LPS[:3, :3]


@pytest.mark.parametrize("name", CASES)
def test_what_an_image_leaves_open_is_asked_for_and_read(shared_data, name):
    options, message = CASES[name]
    path = shared_data / "cases" / name
    with pytest.raises(CurveError, match=message):
        read_branches(path, *ENDS)
    found = read_branches(path, *ENDS, ReadOptions(**options))
    (branch,) = found.branches
    assert branch.length == pytest.approx(111, abs=1)
    assert branch.radius[[0, -1]] == pytest.approx([6, 4], abs=0.4)


def test_thick_slices_are_read_with_a_note_on_accuracy(shared_data):
    found = read_branches(shared_data / "cases" / "M8_3mm_slices.nii.gz", *ENDS)
    assert found.branches[0].length == pytest.approx(111, abs=1)
    assert found.branches[0].radius[[0, -1]] == pytest.approx([6, 4], abs=0.4)
    assert any("0.664 x 0.664 x 3 mm" in note for note in found.facts.notes)


def test_the_form_that_counts_moves_the_lumen(tmp_path, tube, ends):
    path = tmp_path / "two.nii"
    image = nibabel.Nifti1Image(tube.voxels, None)
    image.set_qform(LPS @ tube.affine, code=1)
    moved = LPS @ tube.affine
    moved[:3, 3] += [30, 0, 0]
    image.set_sform(moved, code=1)
    nibabel.save(image, path)
    for form, shift in (("qform", 0), ("sform", 30)):
        found = read_mask(path, *(ends + np.array([shift, 0, 0])), ReadOptions(form=form))
        assert found.branches[0].points[0] == pytest.approx(tube.points[0] - [shift, 0, 0], abs=1.5)
        assert found.facts.space_known == GIVEN


def test_a_form_with_code_zero_counts_where_it_is_asked_for(tmp_path, tube, ends):
    path = write_nifti(tmp_path / "uncoded.nii", tube.voxels, LPS @ tube.affine, qform=0, sform=0)
    with pytest.raises(CurveError, match="no coordinate system"):
        read_mask(path, *ends)
    found = read_mask(path, *ends, ReadOptions(form="sform"))
    assert any("code in the header is 0" in note for note in found.facts.notes)


def test_labels_are_joined_and_unknown_ones_listed(tmp_path, tube, ends):
    half = np.argwhere(tube.voxels)[:, 2].mean()
    labels = tube.voxels * np.where(np.arange(tube.voxels.shape[2]) > half, 5, 7).astype(np.uint8)
    labels[0, 0, 0] = 9
    path = write_nifti(tmp_path / "labels.nii", labels, LPS @ tube.affine)
    with pytest.raises(CurveError, match=r"labels 5 \(\d+ voxels\), 7 .*, 9 \(1 voxels\)"):
        read_mask(path, *ends)
    with pytest.raises(CurveError, match="no voxel has the label 6: it has the labels 5"):
        read_mask(path, *ends, ReadOptions(labels=(5, 6)))
    with pytest.raises(CurveError, match="label is 0, which is the background"):
        read_mask(path, *ends, ReadOptions(labels=(0, 5)))
    whole = read_mask(path, *ends, ReadOptions(labels=(5, 7))).branches[0]
    expected = tube.read(tube.nifti(tmp_path / "whole.nii"))
    np.testing.assert_allclose(whole.points, expected.points, atol=1e-6)


def layered(path, tube, names, layer_axis=0, **more):
    """A segmentation as Slicer writes it, whose segments are the lumen and a block over its middle."""
    other = np.zeros_like(tube.voxels)
    other[:, :, other.shape[2] // 3 : other.shape[2] // 2] = 1
    header = {"space": "left-posterior-superior", "space origin": tube.affine[:3, 3]}
    directions = np.insert(tube.affine[:3, :3].T, layer_axis, np.nan, axis=0)
    header |= {"kinds": np.insert(["domain"] * 3, layer_axis, "list").tolist(), "space directions": directions}
    for k, name in enumerate(names):
        header |= {f"Segment{k}_ID": f"Segment_{k + 1}", f"Segment{k}_Name": name}
        header |= {f"Segment{k}_LabelValue": "1", f"Segment{k}_Layer": str(k)}
    nrrd.write(str(path), np.stack([tube.voxels, other], axis=layer_axis), header | more)
    return path


@pytest.mark.parametrize("layer_axis", [0, 3])
def test_overlapping_segments_are_read_by_name(tmp_path, tube, layer_axis):
    path = layered(tmp_path / "two.seg.nrrd", tube, ["Airway", "lesion"], layer_axis)
    lps = tube.points[[0, -1]]
    for name in ("Airway", "airway"):
        found = read_mask(path, *lps, ReadOptions(segment=name))
        assert found.branches[0].points[0] == pytest.approx(tube.points[0], abs=1.5)
        assert found.facts.kind == "segmentation of 3D Slicer"
        assert found.facts.space_known == STATED
    with pytest.raises(CurveError, match=r"no segment is named 'trachea': it has the segments 'Airway' "):
        read_mask(path, *lps, ReadOptions(segment="trachea"))


def test_segments_are_not_chosen_by_more_than_one_option(tmp_path, tube):
    path = layered(tmp_path / "two.seg.nrrd", tube, ["a", "b"])
    with pytest.raises(CurveError, match=r"--segment and --label exclude each other"):
        read_mask(path, *tube.points[[0, -1]], ReadOptions(segment="a", labels=(1,)))
    path = layered(tmp_path / "same.seg.nrrd", tube, ["a", "a"])
    with pytest.raises(CurveError, match="2 segments are named 'a'"):
        read_mask(path, *tube.points[[0, -1]], ReadOptions(segment="a"))


def test_a_probability_map_needs_a_threshold_within_its_values(tmp_path, tube, ends):
    smooth = tube.voxels * np.float32(0.9) + np.float32(0.02)
    path = write_nifti(tmp_path / "map.nii", smooth, LPS @ tube.affine)
    with pytest.raises(CurveError, match=r"--threshold 0\.5"):
        read_mask(path, *ends)
    with pytest.raises(CurveError, match=r"threshold is 50, but the voxels lie between 0\.02 and 0\.92"):
        read_mask(path, *ends, ReadOptions(threshold=50))
    expected = tube.read(tube.nifti(tmp_path / "whole.nii"))
    found = read_mask(path, *ends, ReadOptions(threshold=0.5)).branches[0]
    np.testing.assert_allclose(found.points, expected.points, atol=1e-6)


def test_voxels_that_are_no_numbers_are_outside(tmp_path, tube, ends):
    voxels = tube.voxels.astype(np.float32)
    voxels[0, 0, :3] = np.nan
    found = read_mask(write_nifti(tmp_path / "nan.nii", voxels, LPS @ tube.affine), *ends)
    assert any("3 voxels are no finite numbers" in note for note in found.facts.notes)


def test_exchanged_ends_are_refused_unless_accepted(tmp_path):
    tapered = Tube(curve(arc, lambda u: 6 - 2.5 * u), np.full(3, 1.0))
    ends = tapered.points[[0, -1]] @ LPS[:3, :3]
    path = tapered.nifti(tmp_path / "tapered.nii")
    assert read_mask(path, *ends).facts.notes == ()
    with pytest.raises(CurveError, match=r"mm at the entry and .* they seem exchanged.* --accept ends"):
        read_mask(path, *ends[::-1])
    found = read_mask(path, *ends[::-1], ReadOptions(accept=("ends",)))
    assert any("accepted" in note for note in found.facts.notes)


@pytest.mark.parametrize("place", [0.75, 1.0])
def test_a_leak_is_refused_with_its_place_unless_accepted(tmp_path, place):
    def leaking(u):
        return 5.5 - 2 * u + 6 * np.exp(-(((u - place) / 0.08) ** 2))

    tube = Tube(curve(arc, leaking), np.full(3, 1.0))
    ends = tube.points[[0, -1]] @ LPS[:3, :3]
    path = tube.nifti(tmp_path / "leak.nii")
    with pytest.raises(CurveError, match=r"radius grows from [34]\.\d mm at \(.*\) to .*leak.* --accept leak"):
        read_mask(path, *ends)
    options = ReadOptions(accept=("leak", "ends"))
    assert any("leak" in note for note in read_mask(path, *ends, options).facts.notes)


def test_units_that_are_no_millimetres_are_stated(tmp_path, tube, ends):
    path = write_nifti(tmp_path / "cm.nii", tube.voxels, np.diag([0.1, 0.1, 0.1, 1]) @ LPS @ tube.affine)
    found = read_mask(path, *ends, ReadOptions(units="cm"))
    assert found.branches[0].points[0] == pytest.approx(tube.points[0], abs=1.5)
    assert (found.facts.units, found.facts.units_known) == ("cm", GIVEN)
