"""The checker beside plans of both models, and alone, without the rest of the package."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_plans import SAMPLES, random_plan

from ctr_nlp import (
    Plan,
    Problem,
    Robot,
    Tube,
    curve_from_points,
    growing,
    plan_through,
    problem_from_file,
    table_i_robot,
)
from ctr_nlp.check.checker import NO, NOT_COVERED, VERDICTS, YES
from ctr_nlp.check.comparison import compare_verdicts
from ctr_nlp.check.plan_file import CheckError, read_plan_file
from ctr_nlp.check.records import RECORDS, check_plan
from ctr_nlp.cli.main import main
from ctr_nlp.plan.simulation import simulate_motion
from ctr_nlp.problems import named_problem

pytestmark = pytest.mark.interpreted

ALONE = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        own = name == "ctr_nlp" or name == "ctr_nlp.check" or name.startswith("ctr_nlp.check.")
        if (name.startswith("ctr_nlp") and not own) or name.split(".")[0] in ("casadi", "matplotlib", "rich"):
            raise ImportError(f"{name} is blocked")
sys.meta_path.insert(0, Blocked())
from ctr_nlp.check.comparison import compare_verdicts
from ctr_nlp.check.records import check_plan
found = check_plan(sys.argv[1], samples=3)
assert all(opinion.agrees for opinion in compare_verdicts(found, {}))
print({name: finding.word for name, finding in found.findings.items()})
"""


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A plan in a lumen on the elastic model, with simulated robots, and its file."""
    path = tmp_path_factory.mktemp("checked") / "plan.npz"
    plan = random_plan(6, samples=True)
    plan.save(path)
    return plan, path


def words(path, samples=0, **options):
    return {name: finding.word for name, finding in check_plan(path, samples, **options).findings.items()}


@pytest.mark.hazard("mistake of the planner")
def test_checker_runs_without_rest_of_package(saved):
    run = subprocess.run([sys.executable, "-c", ALONE, str(saved[1])], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert "'shapes': 'yes'" in run.stdout


@pytest.mark.hazard("robot differs from its description")
def test_checker_agrees_with_plan_on_elastic_model(saved):
    plan, path = saved
    found = check_plan(path, samples=SAMPLES)
    opinions = compare_verdicts(found, plan.verdicts._asdict())
    assert [each.name for each in opinions] == [*VERDICTS, *RECORDS]
    assert all(each.agrees for each in opinions)
    assert {each.name for each in opinions if each.word == NOT_COVERED} == {"frames_of_reference"}
    np.testing.assert_allclose(found.shape, plan.shape, atol=1e-3)
    np.testing.assert_allclose(found.margin[:, -1], plan.stability, atol=1e-3)
    assert found.findings["arrives"].number == pytest.approx(plan.verdicts.arrives.number, abs=1e-3)


def test_dominant_plan_is_checked_on_both_models(tmp_path):
    path = tmp_path / "plan.npz"
    plan = random_plan(1)
    assert plan.meta["model"] == "dominant"
    plan.save(path)
    found = check_plan(path)
    assert found.findings["shapes"].word == YES
    assert found.findings["margins"].word == NOT_COVERED
    assert all(each.agrees for each in compare_verdicts(found, plan.verdicts._asdict()))
    elastic = plan.evaluate_on("elastic").shape
    assert not found.snaps
    np.testing.assert_allclose(found.shape, elastic, atol=1e-3)
    for part in (plan, plan.reversed(), plan[3:]):
        part.save(path)
        assert words(path)["clearances"] == YES
        replace(part, clearance_between=part.clearance_between + 0.2).save(path)
        assert words(path)["clearances"] == NO


@pytest.mark.hazard("what was not checked reads as passed")
def test_loaded_plan_is_not_covered(tmp_path):
    path = tmp_path / "plan.npz"
    plan = random_plan(3)
    assert plan.evaluated_load is not None
    plan.save(path)
    found = words(path)
    uncovered = {name for name, word in found.items() if word == NOT_COVERED}
    assert {"arrives", "follows", "stable", "within_wall", "holds", "shapes", "margins"} <= uncovered
    assert found["within_limits"] == found["digest"] == YES


@pytest.mark.hazard("what was not checked reads as passed")
def test_plan_that_leans_on_a_wall_is_not_covered(saved, tmp_path):
    path = tmp_path / "plan.npz"
    replace(saved[0], meta={**saved[0].meta, "wall_contact": {"limit_N": 0.2}}).save(path)
    found = words(path)
    uncovered = {name for name, word in found.items() if word == NOT_COVERED}
    assert {"arrives", "follows", "stable", "within_wall", "holds", "shapes", "margins"} <= uncovered


def test_motion_that_begins_deployed_is_checked(saved, tmp_path):
    path = tmp_path / "plan.npz"
    for part in (saved[0].reversed(), saved[0][3:]):
        part.save(path)
        found = check_plan(path, samples=2)
        assert all(each.agrees for each in compare_verdicts(found, part.verdicts._asdict()))
        recorded = {found.findings[name].word for name in ("shapes", "margins", "clearances", "times")}
        assert recorded == {found.findings["stable"].word} == {YES}
        assert found.findings["holds"].word in (YES, NO)
        wrong = part.shape + np.array([0.1, 0, 0])
        replace(part, shape=wrong).save(path)
        assert words(path)["shapes"] == NO
    saved[0][:6].save(path)
    assert words(path)["shapes"] == YES


def test_deployed_start_is_on_the_branch_of_the_record(tmp_path):
    """Tubes turned while retracted are on a branch that turning them where they are now does not reach."""
    tubes = Tube(150, 50, 0.03, 3.0, 2.0, 0.3), Tube(150, 50, 0.03, 1.9, 0.5, 0.3)
    out = np.interp(np.arange(12), [0, 5, 11], [2.0, 2.0, 48.0])
    turn = np.interp(np.arange(12), [0, 5, 11], [0.0, 5.0, 5.0])
    q = np.stack([turn, 0 * turn, out, out + 1, 0 * turn, 0 * turn], axis=1)
    path_points = np.linspace([0, 0, 0], [0, 5, 48], 20)
    problem = Problem("turned", Robot(tubes), growing(curve_from_points(path_points), 12), duration=10.0)
    plan = plan_through(problem, q, model="elastic")
    assert not plan.meta["snaps"]
    path = tmp_path / "plan.npz"
    part = plan[9:]
    turned_there = simulate_motion(part.robot, q[9:], "elastic")
    assert abs(turned_there.shape - part.shape).max() > 1.0
    part.save(path)
    found = check_plan(path, samples=2)
    np.testing.assert_allclose(found.shape, part.shape, atol=1e-3)
    assert found.findings["stable"].word == found.findings["margins"].word == YES
    assert found.findings["holds"].word == NOT_COVERED


def test_samples_are_not_covered_where_the_robot_snaps(tmp_path):
    path = tmp_path / "plan.npz"
    problem = named_problem("arc", frames=6)
    turn = np.linspace(0.1, 1, 6)[:, None] * np.array([0, 6, 0, 45, 100, 140, 0, 0])
    plan = plan_through(problem, turn, model="elastic")
    assert plan.meta["snaps"]
    plan.save(path)
    found = check_plan(path, samples=2)
    assert found.findings["stable"].word == NO
    assert found.findings["holds"].word == found.findings["arrives"].word == NOT_COVERED
    assert all(each.agrees for each in compare_verdicts(found, plan.verdicts._asdict()))


def test_samples_without_results_are_drawn_from_tolerances(saved, tmp_path):
    path = tmp_path / "plan.npz"
    replace(saved[0], drawn=None).save(path)
    found = check_plan(path, samples=4)
    assert found.moved == 4
    assert found.findings["holds"].word in (YES, NO)
    assert found.findings["samples"].word == NOT_COVERED


@pytest.mark.hazard("wrong frame of reference")
def test_axes_of_centreline_are_compared(shared_data, tmp_path):
    source = shared_data / "airways" / "chaste_ts002_RLL.csv"
    problem = problem_from_file(source, robot=table_i_robot(), frames=2, trim="start")
    path = tmp_path / "plan.npz"
    plan = plan_through(problem, np.tile([0, 0, 0, 20, 40, 60, 0, 0], (2, 1)), model="dominant")
    plan.save(path)
    assert words(path, source=source)["frames_of_reference"] == YES
    turned = replace(plan, to_robot=plan.to_robot @ np.diag([-1.0, -1, 1, 1]))
    turned.save(path)
    assert words(path)["frames_of_reference"] == NOT_COVERED
    assert words(path, source=source)["frames_of_reference"] == NO
    with pytest.raises(CheckError, match="centreline"):
        check_plan(path, source=tmp_path / "missing.csv")


@pytest.mark.parametrize("content", [b"", b"no archive", "pickle"])
def test_files_that_are_no_plans_are_refused(content, tmp_path):
    path = tmp_path / "plan.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, meta=np.array(json.dumps({"robot": {}, "problem": {}, "model": "m"})))
    with pytest.raises(CheckError, match="plan"):
        read_plan_file(path)
    assert main(["check", str(path)]) == 2


def test_file_of_an_older_version_is_checked():
    path = Path(__file__).parents[1] / "data" / "before" / "plan.npz"
    found = check_plan(path, samples=2)
    assert found.findings["within_limits"].word == YES
    assert found.findings["digest"].word == NOT_COVERED
    assert all(each.agrees for each in compare_verdicts(found, Plan.load(path).verdicts._asdict()))


@pytest.mark.parametrize("part", ["tubes", "limits", "length", "duration", "time", "alpha", "target"])
def test_damaged_file_is_refused(part, saved, tmp_path):
    with np.load(saved[1]) as data:
        arrays = {name: data[name] for name in data.files}
    meta = json.loads(str(arrays["meta"]))
    if part in arrays:
        arrays[part] = arrays[part][:-1]
    elif part == "duration":
        meta["problem"][part] = "long"
    elif part == "length":
        meta["robot"]["tubes"][0][part] = "long"
    else:
        meta["robot"][part] = []
    path = tmp_path / "plan.npz"
    np.savez(path, **arrays | {"meta": np.array(json.dumps(meta))})
    with pytest.raises(CheckError, match="damaged"):
        check_plan(path)


def test_command_shows_both_opinions(saved, capsys):
    assert main(["check", str(saved[1]), "--json"]) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    rows = {row[0]: row for row in table["rows"]}
    assert rows["arrives"][1] in (YES, NO)
    assert rows["arrives"][1] == rows["arrives"][3]
    assert rows["holds"][3] == NOT_COVERED
    assert "--samples N" in rows["holds"][6]
    assert rows["shapes"][3] == YES


def test_second_check_of_samples_comes_from_the_cache(saved, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path))
    shown = []
    for _ in range(2):
        assert main(["check", str(saved[1]), "--samples", "5", "--json"]) == 0
        shown.append(json.loads(capsys.readouterr().out)["tables"])
    assert shown[0] == shown[1]


def test_command_fails_where_record_does_not_fit(saved, tmp_path, capsys):
    path = tmp_path / "plan.npz"
    plan = saved[0]
    replace(plan, shape=plan.shape + np.array([0.2, 0, 0]), drawn=None).save(path)
    assert Plan.load(path)
    for _ in range(2):  # the second time from the cache
        assert main(["check", str(path)]) == 1
        assert "The checker disagrees: " in capsys.readouterr().out


def test_command_checks_files_that_the_package_refuses(saved, tmp_path, capsys):
    path = tmp_path / "plan.npz"
    with np.load(saved[1]) as data:
        arrays = {name: data[name] for name in data.files}
    arrays["beta"] = arrays["beta"] * 1.01
    np.savez(path, **arrays)
    assert main(["check", str(path)]) == 1
    told = capsys.readouterr().out
    assert "disagrees" in told
    assert "digest" in told
    assert "readable" in told


def test_a_robot_of_one_tube_is_checked_within_its_wall(tmp_path):
    """It has no outer tube whose end could lie between two points."""
    bend = curve_from_points([[0.002 * z**2, 0, z] for z in range(0, 61, 5)], [4.0] * 13)
    rod = Robot((Tube(200, 100, 0.004, 1.5, 1.0),))
    q = np.array([[0.0, 20 * (j + 1), 0.0, 0.0] for j in range(3)])
    plan = plan_through(Problem("rod", rod, growing(bend, 3)), q)
    plan.save(tmp_path / "plan.npz")
    result = check_plan(tmp_path / "plan.npz")
    assert result.findings["within_wall"].word == YES
    assert result.findings["clearances"].word == YES
    # The angle is that to the target of the last frame.
    cosine = plan.tip_direction[-1] @ plan.target_direction[-1]
    assert result.tip_degrees == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.01)


def test_helices_turn_as_they_do_in_the_package(tmp_path):
    tubes = Tube(200, 60, 0.01, 2.4, 1.8, pre_torsion=0.03), Tube(300, 100, 0.008, 1.6, 1.0, pre_torsion=-0.02)
    q = np.array([[0.3, -0.4, 20.0 * j, 30.0 * j, 0.0, 0.0] for j in (1, 2, 3)])
    path = curve_from_points([[0, 0, z] for z in range(0, 101, 5)])
    plan = plan_through(Problem("helices", Robot(tubes), growing(path, 3)), q)
    assert abs(plan.shape[-1, -1, :2]).min() > 1.0
    plan.save(tmp_path / "plan.npz")
    assert words(tmp_path / "plan.npz")["shapes"] == YES
