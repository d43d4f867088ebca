"""`ctr-nlp inspect`: what is read from a file, how it is known, and what was repaired."""

import json

import numpy as np
import pytest

from ctr_nlp.cli.commands.inspect import main
from ctr_nlp.cli.commands.plan import plan

ANGLE = np.linspace(0, 1.2, 61)
ARC = 80 * np.column_stack([1 - np.cos(ANGLE), 0 * ANGLE, np.sin(ANGLE)])


@pytest.fixture
def table(tmp_path):
    """A table in cm with a point saved twice, and a column that is not used."""
    rows = [
        f"{x:.5f},{y:.5f},{z:.5f},0.4,{k}" for k, (x, y, z) in enumerate(np.insert(ARC, 9, ARC[9], axis=0) / 10)
    ]
    path = tmp_path / "path.csv"
    path.write_text("\n".join(["x_cm,y_cm,z_cm,radius_cm,torsion", *rows]) + "\n")
    return path


def test_it_says_what_was_read_and_repaired(table, capsys):
    assert main([str(table)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for text in (
        "kind table of points",
        "unit cm stated in the file",
        "coordinates xyz the file's own axes",
        "1 path 61 96.0 (0, 0, 0) (51, 0, 74.6) 4.00 to 4.00",
        "note: column not used: torsion",
        "note: left out a point that repeats the one before it (11)",
    ):
        assert text in shown


def test_what_a_person_states_is_told_apart(table, capsys):
    assert main([str(table), "--units", "cm", "--space", "RAS", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    rows = dict(row[:2] for row in found["tables"][0]["rows"])
    assert rows == {"kind": "table of points", "unit": "cm", "coordinates": "RAS"}
    assert {row[2] for row in found["tables"][0]["rows"]} == {"", "given"}
    assert any("column not used" in line for line in found["lines"])


def test_what_is_refused_says_why(table, capsys):
    table.write_text(table.read_text().replace("_cm", "_mm"))
    assert main([str(table)]) == 2
    assert "State the unit with --units cm" in capsys.readouterr().err


def test_voxels_of_a_mask_are_listed_by_value(tmp_path, capsys):
    nibabel = pytest.importorskip("nibabel")
    voxels = np.zeros((4, 5, 6), np.uint8)
    voxels[1:3, 1:3, 1:3] = 7
    image = nibabel.Nifti1Image(voxels, np.diag([1.0, 1.0, 2.0, 1.0]))
    nibabel.save(image, tmp_path / "mask.nii.gz")
    assert main([str(tmp_path / "mask.nii.gz")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for text in (
        "mask in a NIfTI file",
        "voxels 4 x 5 x 6",
        "1 x 1 x 2",
        "coordinates RAS",
        "7 8",
        "--entry X Y Z",
    ):
        assert text in shown


@pytest.mark.parametrize(("trim", "words"), [("start", "moved so far inwards"), ("end", "stops so far before")])
@pytest.mark.parametrize("given", [False, True])
def test_plan_says_how_much_of_the_path_is_left_out(tmp_path, capsys, trim, words, given):
    points = np.column_stack([np.zeros(101), np.zeros(101), np.linspace(0, 200, 101)])
    path = tmp_path / "long.csv"
    path.write_text("\n".join(["x_mm,y_mm,z_mm", *(",".join(map(str, point)) for point in points.tolist())]))
    ends = ["--entry", "0", "0", "10", "--target", "0", "0", "190"] if given else []
    arguments = [str(path), "--trim", trim, *ends, "--frames", "2", "--model", "dominant", "--no-figures"]
    plan([*arguments, "--no-evaluate", "--out", str(tmp_path / "out")])
    seen = capsys.readouterr().err
    assert f"note: --trim {trim} leaves out {30 if given else 50}.0 mm" in seen
    assert words in seen
    assert ("that was given" in seen) == given
