"""The wall's forces on plans: what is told of them, files, and what is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from loaded_plans import TWO, made
from lumens import straight

from ctr_nlp import Load, Plan, wall_forces
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.loads.tissue import AIRWAY_WALL_STIFFNESS_N_PER_MM2
from ctr_nlp.loads.wall_picture import draw_wall_forces

pytestmark = pytest.mark.interpreted
FRAMES = 5


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Tubes that bend into the wall of a straight lumen of radius 4 mm as they are pushed out."""
    q = np.zeros((FRAMES, 6))
    q[:, 2], q[:, 3] = np.linspace(15, 60, FRAMES), np.linspace(20, 85, FRAMES)
    return made(TWO, q, straight(4.0, 88.0)).with_modulus(60_000)


@pytest.fixture(scope="module")
def found(plan):
    return wall_forces(plan)


def test_forces_grow_as_the_robot_is_pushed_into_the_wall(found, plan):
    assert found.in_equilibrium.all()
    assert found.total[0] == 0
    assert (np.diff(found.total)[1:] > 0).all()
    assert found.worst == FRAMES
    np.testing.assert_allclose(found.depth_alone, np.maximum(-plan.clearance.min(axis=1), 0), atol=1e-2)
    assert (found.depth.max(axis=1) <= found.depth_alone + 1e-2).all()
    assert found.tip[0] == pytest.approx(0, abs=1e-3)
    assert found.tip[-1] > 0.1


def test_a_wall_that_is_wider_than_the_robot_could_be_avoided(found, plan):
    np.testing.assert_allclose(found.avoidable, found.total)
    narrow = wall_forces(replace(plan, lumen=np.column_stack([plan.lumen[:, :3], 0 * plan.lumen[:, 3] + 1.5])))
    outer = narrow.along < plan.beta[:, :1]
    assert narrow.narrow[outer & (narrow.length > 1)].all()
    assert (narrow.avoidable < narrow.total)[narrow.total > 0].all()


def test_the_wall_acts_beside_the_load_that_a_plan_bears(found, plan):
    pulled = wall_forces(plan.with_load(Load(force=(0.3, 0.0, 0.0))))
    assert pulled.total[-1] > found.total[-1] + 0.01


def test_a_summary_is_strict_json_and_rows_are_frames(found):
    told = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert told["stiffness_N_per_mm2"] == AIRWAY_WALL_STIFFNESS_N_PER_MM2
    assert told["largest_total_N"] == pytest.approx(found.total.max())
    assert told["snaps_in_frame"] is None
    assert [row["frame"] for row in found.rows()] == list(range(1, FRAMES + 1))


def test_frames_after_a_snap_are_not_told(found):
    force = found.force.copy()
    force[3:] = np.nan
    lost = replace(found, force=force)
    assert lost.summary()["snaps_in_frame"] == 4
    assert lost.worst == 3
    assert lost.rows()[4]["total_N"] == ""
    json.dumps(lost.summary(), allow_nan=False)
    assert draw_wall_forces(lost, "lost").axes


def test_nothing_touched_is_told_as_such(plan, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    replace(plan, lumen=np.column_stack([plan.lumen[:, :3], 0 * plan.lumen[:, 3] + 60.0])).save("wide.npz")
    assert main(["contact", "wide.npz", "--no-figures", "--out", "here"]) == 0
    assert "touches the wall in no frame" in capsys.readouterr().out


def test_the_command_writes_all_and_refuses_what_cannot_be(plan, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plan.save("plan.npz")
    assert main(["contact", "plan.npz", "--out", "here"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "The wall presses most in frame 5" in out
    assert {path.name for path in (tmp_path / "here").iterdir()} >= {"contact.json", "contact.csv", "contact.png"}
    with open("here/contact.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == FRAMES
    for value in ("nan", "-1", "1e9"):
        assert main(["contact", "plan.npz", "--wall-stiffness", value, "--out", "no"]) == 2
        assert "stiffness of the wall" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def test_what_has_no_wall_or_no_moduli_is_refused(plan):
    with pytest.raises(OptionError, match="wall forces need a lumen or another wall"):
        wall_forces(replace(plan, lumen=None, clearance=None, lumen_radius=None))
    ratios = made(TWO, plan.q, straight(4.0, 88.0))
    with pytest.raises(LoadError, match="looks like a ratio"):
        wall_forces(ratios)
