"""Malformed centrelines and masks in files: each is one clear error or rightly accepted."""

from __future__ import annotations

import functools
import json
import math

import numpy as np
import pytest
from malformed import (
    ENTRY,
    NRRD_HEADER,
    TARGET,
    changed,
    helix,
    judge,
    legacy_vtk,
    markups,
    mask,
    of_file,
    spoilt,
    table,
    voxels,
    written,
)

from ctr_nlp import problem_from_file, read_csv
from ctr_nlp.exceptions import CtrError, CurveError

ROWS = table().splitlines()
TABLES = [
    ("nothing", "", "is not a centreline: its first line is ''"),
    ("header alone", ROWS[0], "points of a centreline is 0; it must be at least 4"),
    ("no header", "\n".join(ROWS[1:]), "is not a centreline: its first line is '0.0"),
    ("two points", "\n".join(ROWS[:3]), "points of a centreline is 2; it must be at least 4"),
    ("three points", "\n".join(ROWS[:4]), "points of a centreline is 3; it must be at least 4"),
    ("a word", spoilt(table(), "0.000000", "zero"), "row 2 is 'zero,"),
    ("NaN", spoilt(table(), "0.000000", "nan"), "point 1 in row 2 is .nan, .*finite"),
    ("infinity", spoilt(table(), "0.000000", "inf"), "point 1 in row 2 is .inf, .*finite"),
    ("a missing cell", spoilt(table(), "0.000000,", ""), "row 2 has 3 cells, but the header has 4"),
    ("a decimal comma", spoilt(table(), "0.000000", "0,000000"), "row 2 has 5 cells, but the header has 4"),
    ("semicolons", table().replace(",", ";"), None),
    ("metres", table(helix() / 1000),
     r"span 0\.0\d+ mm .*; in m that would be .* State the unit with --units m,"),
    ("kilometres", table(helix() * 1e5), r"mm; at most 100000 mm are allowed"),
    ("a point twice", table(np.insert(helix(), 5, helix()[5], axis=0)), None),
    ("one point over and over", table(np.ones((9, 3))), "points are all the same"),
    ("as long there as back", table(np.vstack([helix(), helix()[::-1][1:]])), "turns by 180 .* runs back"),
    ("a radius of 0", table(radius=0.0), None),
    ("a negative radius", table(radius=-1.0), "lumen radius at point 1 is -1"),
    ("a radius of NaN", table(radius=math.nan), None),
    ("a column twice", spoilt(table(), "radius_mm", "x_mm"), "columns 'x_mm' and 'x_mm' may both be x"),
    ("other units in the header", spoilt(table(), "x_mm", "x_m"), "units of columns 'x_m', .* differ"),
    ("binary", b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "cannot be read"),
    ("UTF-16", table().encode("utf-16"), None),
    ("a byte order mark", b"\xef\xbb\xbf" + table().encode(), None),
    ("empty lines", table().replace("\n", "\n\n"), None),
    ("longer than the robot", table(helix() * 3),
     r"mm long and the robot reaches 150.00 mm.*--trim start moves .* mm inwards, --trim end stops"),
]  # fmt: skip

MARKUPS = [
    ("markups", [], 'it must have a list "markups"'),
    ("markups", {"a": 1}, 'it must have a list "markups"'),
    ("markups.0", 3, 'it must have a list "markups"'),
    ("markups.0.type", "Fiducial", "is of type 'Fiducial'; it must be an open curve"),
    ("markups.0.type", ["Curve"], "is of type .'Curve'."),
    ("markups.0.type", ..., "is of type None"),
    ("markups.0.coordinateSystem", "XYZ", "coordinateSystem of 'path' is 'XYZ'; it must be one of LPS, RAS"),
    ("markups.0.coordinateSystem", ["LPS"], "coordinateSystem of 'path'"),
    ("markups.0.coordinateSystem", ..., "coordinateSystem of 'path' is missing"),
    ("markups.0.coordinateUnits", "m", "the unit that the file states.; in mm that would be"),
    ("markups.0.coordinateUnits", {"a": 1}, "coordinateUnits of 'path'"),
    ("markups.0.controlPoints", 7, "controlPoints of 'path' must be a list"),
    ("markups.0.controlPoints", [], "has 16 values for 0 control points"),
    ("markups.0.controlPoints.2", 7, "controlPoints of 'path' must be a list"),
    (
        "markups.0.controlPoints.2.position",
        [1, 2],
        "control point 3 of 'path' is at .1, 2.; it must be three numbers",
    ),
    ("markups.0.controlPoints.2.position", [1, 2, "3mm"], "control point 3 of 'path'"),
    ("markups.0.controlPoints.2.position", ..., "control point 3 of 'path' is at None"),
    ("markups.0.controlPoints.2.position", [1, 2, [3]], "control point 3 of 'path'"),
    ("markups.0.controlPoints.2.position", [0, 0, 10**400], "control point 3|finite"),
    ("markups.0.controlPoints.2.positionStatus", {"a": 1}, "control point 3|positionStatus"),
    ("markups.0.measurements.0.controlPointValues", [5.0], "has 1 values for 16 control points"),
    ("markups.0.measurements.0.controlPointValues", "5", "has no numbers for 16 control points"),
    ("markups.0.measurements.0.controlPointValues", [-5.0] * 16, "lumen radius at point 1 is -5"),
    ("markups.0.measurements.0.units", "ft", "the unit of measurement 'Radius' of 'path' is 'ft'"),
    ("markups.0.measurements", 4, "measurements of 'path' must be a list"),
    ("markups.0.name", {"a": 1}, None),
    ("markups.0.measurements", None, None),
]
WHOLE_MARKUPS = [
    ("", "cannot be read"),
    ("{", "cannot be read"),
    ("[]", "not a markups file"),
    ("null", "not a markups file"),
    ("[" * 100_000, "cannot be read"),
    ('{"markups": [{"type": "Curve", "coordinateSystem": "LPS"}]}', "controlPoints of"),
]

VTK = legacy_vtk()
VTKS = [
    ("", "cannot be read"),
    (spoilt(VTK, "# vtk DataFile Version 3.0", "hello"), "cannot be read"),
    (spoilt(VTK, "POINTS 16", "POINTS 160"), "cannot be read|damaged|finite"),
    (spoilt(VTK, "POINTS 16", "POINTS sixteen"), "cannot be read|no lines|damaged"),
    (spoilt(VTK, "LINES 1 17", "VERTICES 1 17"), "it holds no lines"),
    (spoilt(VTK, " 15\n", " 99\n"), "a line passes point 100 of 16|damaged"),
    (spoilt(VTK, "SPACE=LPS", "SPACE=XYZ"), "SPACE is 'XYZ'; it must be one of LPS, RAS"),
    (spoilt(VTK, "DATASET POLYDATA", "DATASET STRUCTURED_POINTS"), "cannot be read"),
    (spoilt(VTK, "0.000000 0.000000 0.000000", "nan 0.000000 0.000000"), "point 1 is .nan.*finite|cannot be read"),
    (spoilt(VTK, "5.0 5.0", "-5.0 5.0"), "lumen radius at point 1 is -5"),
    (VTK[: len(VTK) // 2], "it holds no lines"),
    (spoilt(VTK, "ASCII", "BINARY"), "cannot be read|damaged|finite|span|no lines|repeated|same"),
    (spoilt(VTK, "LINES 1 17\n16 0", "LINES 1 2\n1 0"), "cannot be read"),
]  # fmt: skip
VTPS = ["", "<VTKFile/>", "<?xml version='1.0'?><VTKFile type='PolyData'><PolyData/></VTKFile>", "<a><b></a>", VTK]

MASKS = [
    ("cut short", mask()[:-500], "cannot be read|cut short"),
    ("nothing", b"", "does not begin with an NRRD header"),
    ("text", b"hello", "does not begin with an NRRD header"),
    ("all 0", mask(content=0 * voxels()), "its voxels are all 0"),
    ("all 1", mask(content=0 * voxels() + 1), "its voxels are all 1"),
    ("two labels", mask(content=voxels() * (1 + (np.arange(60) > 30)[:, None, None]).astype(np.uint8)),
     "choose those that are the lumen with --label"),
    ("two axes", mask(spoilt(NRRD_HEADER, "dimension: 3", "dimension: 2")), "its dimension is 2; it must be 3"),
    ("no space", mask(spoilt(NRRD_HEADER, "space: left-posterior-superior\n", "")), "its space is None"),
    ("another space", mask(spoilt(NRRD_HEADER, "left-posterior-superior", "scanner-xyz")),
     "its space is 'scanner-xyz'"),
    ("metres", mask(spoilt(NRRD_HEADER, "(1,0,0) (0,1,0) (0,0,1)", "(.001,0,0) (0,.001,0) (0,0,.001)")),
     "in metres"),
    ("sheared", mask(spoilt(NRRD_HEADER, "(0,1,0)", "(0.5,1,0)")), "degrees from perpendicular"),
    ("flat voxels", mask(spoilt(NRRD_HEADER, "(0,0,1)", "(0,0,19)")), "no side may be over 10 times another"),
    ("NaN axes", mask(spoilt(NRRD_HEADER, "(1,0,0)", "(nan,0,0)")), "they must be finite"),
    ("two directions", mask(spoilt(NRRD_HEADER, " (0,0,1)", "")), "its space directions is"),
    ("words", mask(spoilt(NRRD_HEADER, "(1,0,0)", "(one,0,0)")), "its space directions is"),
    ("no origin", mask(spoilt(NRRD_HEADER, "space origin: (0,0,0)\n", "")), "its space origin is missing"),
    ("another encoding", mask(spoilt(NRRD_HEADER, "raw", "morse")), "voxels cannot be read"),
    ("sizes of words", mask(spoilt(NRRD_HEADER, "16 16 60", "a b c")), "its sizes is a b c: "),
    ("other units", mask(spoilt(NRRD_HEADER, "kinds", 'space units: "cm" "cm" "cm"\nkinds')),
     "lengths are in cm; .* --units cm"),
]  # fmt: skip
POINTS = [
    ((8, 8, 2), (8, 8, 4), "entry and target are 2 mm apart"),
    ((1, 1, 2), (8, 8, 57), "entry .* is .* mm outside the mask"),
    ((-8, -8, 2), (8, 8, 57), "with x and y negated it does"),
    ((math.nan, 8, 2), (8, 8, 57), "entry is .nan, 8, 2.; it must be three finite numbers"),
    ((8, 8), (8, 8, 57), "entry is .8, 8.; it must be three finite numbers"),
    ("here", (8, 8, 57), "entry is 'here'; it must be three finite numbers"),
    (None, (30, 8, 57), "target .30, 8, 57. is .* mm away from branch 'branch 1'"),
    ((1, 1, 2), None, "entry .* is .* mm outside the mask"),
]


def cases():
    """All of the table."""
    for label, content, message in TABLES:
        error = None if message is None else CtrError
        yield of_file(problem_from_file, "path.csv", content, error, message or "a path all the same", label)
    for path, value, message in MARKUPS:
        content = json.dumps(changed(markups(), path, value))
        error = None if message is None else CurveError
        yield of_file(problem_from_file, "c.mrk.json", content, error, message or "", f"{path} = {value!r:.40}")
    for content, message in WHOLE_MARKUPS:
        yield of_file(problem_from_file, "c.mrk.json", content, CurveError, message, repr(content[:20]))
    for number, (content, message) in enumerate(VTKS):
        yield of_file(problem_from_file, "lines.vtk", content, CurveError, message, str(number))
    for number, content in enumerate(VTPS):
        yield of_file(problem_from_file, "lines.vtp", content, CurveError, "cannot be read|no lines", str(number))
    reader = functools.partial(problem_from_file, entry=ENTRY, target=TARGET)
    for label, content, message in MASKS:
        yield of_file(reader, "mask.nrrd", content, CurveError, message, label)
    for entry, target, message in POINTS:
        reader = functools.partial(problem_from_file, entry=entry, target=target)
        yield of_file(reader, "mask.nrrd", mask(), CtrError, message, f"{entry} {target}")


CASES = list(cases())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_malformed_file_is_one_clear_error_or_rightly_accepted(case, tmp_path):
    judge(case, tmp_path)


def test_the_good_files_that_the_table_spoils_are_good(tmp_path):
    assert read_csv(written(tmp_path, "path.csv", table())).length == pytest.approx(73, abs=2)
    for name, content in (("c.mrk.json", json.dumps(markups())), ("lines.vtk", VTK)):
        assert problem_from_file(written(tmp_path, name, content)).lumen is not None
    assert problem_from_file(written(tmp_path, "mask.nrrd", mask()), entry=ENTRY, target=TARGET).lumen is not None
