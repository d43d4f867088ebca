"""Markups of 3D Slicer, written here after its schema: what they mean, and what is refused."""

import contextlib
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctr_nlp import curve_from_points, read_csv
from ctr_nlp.anatomy.branch_selection import select_branch
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.exceptions import CurveError

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
FLIP = np.array([-1.0, -1.0, 1.0])
ARC = np.column_stack(
    [30 * np.cos(np.linspace(0, 1, 9)), 30 * np.sin(np.linspace(0, 1, 9)), np.linspace(0, 40, 9)]
)


def control(number, position, **more):
    return {
        "id": str(number),
        "label": f"C-{number}",
        "position": [float(x) for x in position],
        "orientation": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0],
        "selected": True,
        "positionStatus": "defined",
        **more,
    }


def curve(points=ARC, radius=None, **more):
    """A markup as Slicer writes it, with SlicerVMTK's radius."""
    measurements = [{"name": "length", "enabled": False, "units": "mm", "value": 1.0}]
    if radius is not None:
        measurements.append(
            {"name": "Radius", "enabled": True, "units": "mm", "controlPointValues": [float(r) for r in radius]}
        )
    return {
        "type": "Curve",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": [control(k, point) for k, point in enumerate(points, start=1)],
        "measurements": measurements,
        "display": {"visibility": True},
        **more,
    }


@pytest.fixture
def written(tmp_path):
    """A function that writes markups and returns the file's path."""

    def write(*markups):
        path = tmp_path / "airway.mrk.json"
        path.write_text(json.dumps({"@schema": SCHEMA, "markups": markups}), encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("space", ["LPS", "RAS"])
@pytest.mark.parametrize("name", ["chaste_ts002_LLL", "hra_vhm_left_main"])
def test_a_real_airway_comes_back(shared_data, written, space, name):
    file = shared_data / "airways" / f"{name}.csv"
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    points = table[:, :3] * (FLIP if space == "RAS" else 1)
    found = read_branches(written(curve(points, table[:, 3], coordinateSystem=space)))
    (branch,) = found.branches
    same, expected = curve_from_points(branch.points, branch.radius), read_csv(file)
    s = np.linspace(0, expected.length, 400)
    assert (found.space, branch.name) == (space, "airway")
    assert same.length == pytest.approx(expected.length, abs=1e-6)
    assert np.abs(same.point(s) - expected.point(s)).max() < 0.01
    assert np.abs(same.radius(s) - expected.radius(s)).max() < 0.01


def test_several_curves_are_branches_by_their_names(written):
    found = read_branches(written(curve(name="left"), curve(ARC + 5)))
    assert [branch.name for branch in found.branches] == ["left", "curve 2"]
    assert select_branch(found, "curve 2").points == pytest.approx(ARC + 5)


def test_to_lps_takes_the_coordinates_of_the_file_along(written):
    found = read_branches(written(curve(coordinateSystem="RAS")))
    assert found.branches[0].points == pytest.approx(ARC * FLIP)
    assert found.to_lps @ [*ARC[3], 1] == pytest.approx([*found.branches[0].points[3], 1])


def test_a_diameter_is_halved(written):
    diameters = {"name": "Diameter", "controlPointValues": [6.0] * 9}
    assert read_branches(written(curve(measurements=[diameters]))).branches[0].radius == pytest.approx(3.0)


@pytest.mark.parametrize("key", ["coordinateUnits", "coordinateSystem", "type"])
def test_a_message_shows_the_beginning_of_a_long_text(key, written):
    with pytest.raises(CurveError) as refused:
        read_branches(written(curve(**{key: "9" * 5000})))
    assert "9" * 40 in str(refused.value)
    assert "9" * 80 not in str(refused.value)


def test_units_may_be_a_coded_entry(written):
    assert read_branches(written(curve(coordinateUnits=["mm", "UCUM", "millimeter"])))


@pytest.mark.parametrize(("unit", "factor"), [("cm", 10), ("m", 1000), (["um", "UCUM", "micrometer"], 0.001)])
def test_units_of_the_file_are_converted_to_mm(written, unit, factor):
    radius = {"name": "Radius", "units": "cm", "controlPointValues": [0.3] * 9}
    (branch,) = read_branches(written(curve(ARC / factor, coordinateUnits=unit, measurements=[radius]))).branches
    assert branch.points == pytest.approx(ARC)
    assert branch.radius == pytest.approx(3.0)


@pytest.mark.parametrize("status", ["undefined", "preview", "missing"])
def test_points_that_were_not_placed_are_left_out_with_their_radius(written, status):
    markup = curve(radius=range(1, 10))
    markup["controlPoints"][2] |= {"positionStatus": status, "position": ""}
    (branch,) = read_branches(written(markup)).branches
    assert branch.points == pytest.approx(np.delete(ARC, 2, axis=0))
    assert branch.radius == pytest.approx([1, 2, 4, 5, 6, 7, 8, 9])


def without(key):
    return {name: value for name, value in curve().items() if name != key}


def unplaced():
    markup = curve()
    markup["controlPoints"][2]["position"] = ""
    return markup


REFUSED = {
    "no coordinate system": (without("coordinateSystem"), r"coordinateSystem of 'airway' is missing; .*LPS, RAS"),
    "a number for one": (curve(coordinateSystem="1"), r"coordinateSystem of 'airway' is '1'; .*LPS, RAS"),
    "voxels": (curve(coordinateSystem="IJK"), r"is 'IJK'; it must be one of LPS, RAS"),
    "metres by name": (curve(coordinateUnits="m"), r"its points span .* m \(the unit that the file states\)"),
    "another unit": (
        curve(coordinateUnits=["[in_i]", "UCUM", "inch"]),
        r"is '\[in_i\]'; it must be one of mm, cm",
    ),
    "metres": (curve(ARC / 1000), r"span 0\.0\d+ mm .* in m that would be .* State the unit with --units m,"),
    "fiducials": (curve(type="Fiducial"), r"of type 'Fiducial'; it must be an open curve"),
    "a closed curve": (curve(type="ClosedCurve"), r"of type 'ClosedCurve'; it must be an open curve.* no first"),
    "a region": (curve(type="ROI"), r"of type 'ROI'; it must be an open curve"),
    "too few radii": (curve(radius=[1.0] * 8), r"'Radius' of 'airway' has 8 values for 9 control points"),
    "a radius of zero": (curve(radius=[1.0, 0.0] + [1.0] * 7), r"radius at point 2 is 0; radii must be positive"),
    "radii in feet": (
        curve(measurements=[{"name": "radius", "units": "ft", "controlPointValues": [1.0] * 9}]),
        r"the unit of measurement 'radius' of 'airway' is 'ft'; it must be one of mm, cm",
    ),
    "a measurement that may be the radius": (
        curve(measurements=[{"name": "Mean radius", "units": "mm", "controlPointValues": [1.0] * 9}]),
        r"not certain what measurement 'Mean radius' of 'airway' means; .* name it Radius",
    ),
    "radii in words": (
        curve(measurements=[{"name": "radius", "controlPointValues": ["wide"] * 9}]),
        r"has no numbers for 9 control points",
    ),
    "three points": (curve(ARC[:3]), r"points of a centreline is 3; it must be at least 4"),
    "no points": (curve(ARC[:0]), r"points of a centreline is 0; it must be at least 4"),
    "points that are none": (curve(controlPoints="none"), r"must be a list of control points"),
    "a point without place": (unplaced(), r"control point 3 of 'airway' is at ''; it must be three numbers"),
    "not a number": (curve(ARC * [1, np.nan, 1]), r"point 1 is \[.*nan.*\]; coordinates must be finite"),
}


@pytest.mark.parametrize(("markup", "message"), REFUSED.values(), ids=REFUSED)
def test_bad_markups_are_refused(written, markup, message):
    with pytest.raises(CurveError, match=rf"airway\.mrk\.json: .*{message}"):
        read_branches(written(markup))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.just(10**400),
    lambda inside: st.lists(inside, max_size=4) | st.dictionaries(st.text(max_size=3), inside, max_size=2),
    max_leaves=6,
)
PLACES = [
    *(("markups", 0, key) for key in curve(name="")),
    *(("markups", 0, "controlPoints", 1, key) for key in control(1, (0, 0, 0))),
    *(("markups", 0, "measurements", 1, key) for key in ("name", "units", "controlPointValues")),
    *(("markups", 0, list_, 1) for list_ in ("controlPoints", "measurements")),
    ("markups", 0),
    ("markups",),
]


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(PLACES), JSON)
def test_whatever_stands_in_a_file_it_is_read_or_refused(tmp_path, place, value):
    found = {"markups": [curve(radius=[2.0] * 9, name="n")]}
    inside = found
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    path = tmp_path / "any.mrk.json"
    path.write_text(json.dumps(found), encoding="utf-8")
    with contextlib.suppress(CurveError):
        assert all(np.isfinite(branch.points).all() for branch in read_branches(path).branches)


@pytest.mark.hazard("wrong frame of reference")
def test_two_systems_in_one_file_are_refused(written):
    with pytest.raises(CurveError, match="different coordinate systems"):
        read_branches(written(curve(), curve(coordinateSystem="RAS")))


@pytest.mark.parametrize("text", ["[]", "{}", '{"markups": []}', '{"markups": [3]}', '{"markups": "none"}'])
def test_other_json_is_refused(tmp_path, text):
    path = tmp_path / "other.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CurveError, match=r'other\.json is not a markups file .*"markups"'):
        read_branches(path)


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe\x00", None])
def test_unreadable_files_are_refused(tmp_path, content):
    path = tmp_path / "bad.mrk.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CurveError, match=r"bad\.mrk\.json cannot be read"):
        read_branches(path)
