"""What clearance costs and brings: the study's claims on some airways, and what it writes."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from lumens import straight

from ctr_nlp import Problem, growing, table_i_robot
from ctr_nlp.cli.commands.new import template
from ctr_nlp.cli.main import main
from ctr_nlp.plan.measures import depth
from ctr_nlp.steer import solve_horizon
from ctr_nlp.studies.airways import synthetic_problem
from ctr_nlp.studies.clearance.alone import Alone
from ctr_nlp.studies.clearance.cases import FIRST, WITH, Airway
from ctr_nlp.studies.clearance.report import claims, findings, page

pytest.importorskip("distributed", reason="the extra `study` is not installed")

FRAMES = 12
"""Of the thin slice."""
CASE = Airway("one", True, 100, 150.0, True, 3.0, 1.0, 1.05, 1.4, 20.0, 4.0, 0.0, 9, 3, 0, 1.0, 2.0, 6.0, 1.5, 1)


def rows(folder):
    with open(folder / "clearance.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def held(row):
    """The three claims on a row of the file, by its own numbers."""
    numbers = {key: float(row[key]) for key in row if key not in ("name", "synthetic", "solved")}
    assert row["solved"] == "True"
    assert numbers["e3_with"] <= 1.1 * numbers["e3_without"] + 1e-9
    assert numbers["contact_with"] < numbers["contact_without"] or numbers["contact_without"] == 0
    assert numbers["contact_with"] == 0 or numbers["alone_clear"] < numbers["frames_with"]


def done(folder, frames, synthetic, airways=None):
    """The output folder of the study of the template, with other airways."""
    text = template("clearance.toml").replace("frames = 100", f"frames = {frames}")
    text = text.replace("synthetic = 100", f"synthetic = {synthetic}")
    if airways is not None:
        text = text.replace('# folder = "airways"', f'folder = "{airways}"')
    (folder / "clearance.toml").write_text(text, encoding="utf-8")
    assert main(["study", str(folder / "clearance.toml"), "--out", str(folder / "out")]) == 1
    return folder / "out"


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """The output folder of two airways."""
    return done(tmp_path_factory.mktemp("study"), FRAMES, 2)


def test_claims_hold_in_a_thin_slice(studied):
    found = rows(studied)
    assert [row["name"] for row in found] == ["synthetic 0", "synthetic 1"]
    for row in found:
        assert float(row["contact_without"]) > 0
        held(row)


def test_a_page_has_a_row_for_every_airway_and_its_picture(studied):
    text = (studied / "clearance.md").read_text(encoding="utf-8")
    for row in rows(studied):
        number = row["name"].removeprefix("synthetic ")
        assert f"\n| {number} | {float(row['e3_without']):.3f} |" in text
    assert "(clearance.png)" in text
    assert (studied / "clearance.png").read_bytes().startswith(b"\x89PNG")
    assert str(studied) not in text


def test_clearance_alone_may_not_stay_short():
    """Where a plan that puts clearance first retreats from the wall, clearance alone has to stay in contact."""
    problem = synthetic_problem(1, FRAMES)
    kept, first = (solve_horizon(problem, model="dominant", settings=settings) for settings in (WITH, FIRST))
    frame = int(depth(kept).argmax())
    assert depth(first)[frame] == 0
    assert first.beta[frame, -1] < problem.target.lengths[frame] - 1
    (left,) = Alone(problem).least([first.q, kept.q], [frame])
    assert 0.1 < left < depth(kept)[frame]


@pytest.mark.parametrize(("radius", "expected"), [(5.0, 0.0), (0.5, None)])
def test_clearance_alone_is_what_room_there_is(radius, expected):
    """None in a wide lumen; in one narrower than the outer tube, what the tube is thicker by, at least."""
    robot, lumen = table_i_robot(), straight(radius, 100.0)
    problem = Problem("straight", robot, growing(lumen, 4))
    motion = np.zeros((4, len(robot.axes)))
    left = Alone(problem).least([motion], [0, 1])
    if expected is not None:
        np.testing.assert_array_equal(left, expected)
    else:
        assert (left >= robot.tubes[0].outer_diameter / 2 - radius - 1e-9).all()


def test_exceptions_are_named():
    dear = replace(CASE, name="dear", e3_with=1.2)
    useless = replace(CASE, name="useless", contact_with=20.0)
    missed = replace(CASE, name="missed", alone=0.0, alone_clear=3)
    all_clear = replace(CASE, name="clear", contact_with=0.0, frames_with=0, alone=0.0, alone_clear=0)
    found = claims([CASE, dear, useless, missed, all_clear])
    assert [[case.name for case in claim.exceptions] for claim in found] == [["dear"], ["useless"], ["missed"]]
    assert [len(claim.about) for claim in found] == [5, 5, 4]
    text = " ".join(findings([CASE, dear, useless, missed, replace(CASE, name="stuck", solved=False)]))
    for named in ("not in dear", "not in useless", "not in missed", "in 7 of these, in 5 cases", "frames: stuck"):
        assert named in text
    assert "| missed | 1.000 | 1.050 | 5.0 |" in page([replace(missed, synthetic=False), CASE])


def test_airways_without_all_their_plans_are_no_page(tmp_path, capsys):
    text = 'frames = 4\nreport = "clearance"\nmodels = "dominant"\nmeasures = ["contact"]\n'
    text += "[problems]\nsynthetic = 1\n"
    (tmp_path / "s.toml").write_text(text, encoding="utf-8")
    assert main(["study", str(tmp_path / "s.toml"), "--workers", "1", "--out", str(tmp_path / "out")]) == 2
    assert "no problem of the study has all the plans that a clearance report" in capsys.readouterr().err


@pytest.mark.slow
def test_claims_hold_in_real_airways_and_ten_synthetic_ones(shared_data, tmp_path):
    found = rows(done(tmp_path, 100, 10, shared_data / "airways"))
    assert len(found) == 14
    for row in found:
        held(row)
