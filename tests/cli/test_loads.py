"""Commands on robots that bear a load: `ctr-nlp under`, `ctr-nlp force`, and the files that they write."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from loaded_plans import turned

from ctr_nlp import Load, Plan, read_load, solve_horizon
from ctr_nlp.cli.main import main
from ctr_nlp.models import model_with_load
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.planning.horizon.loaded_horizon import LoadedHorizon
from ctr_nlp.problems import named_problem
from ctr_nlp.view.figures.shape_comparison import shapes_compared

NITINOL = "--youngs-modulus", "60000"


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A folder with plan.npz of a robot whose moduli are ratios."""
    monkeypatch.chdir(tmp_path)
    turned().save(tmp_path / "plan.npz")
    return tmp_path


def run(*argv: str) -> int:
    return main([str(each) for each in argv])


def test_a_plan_is_moved_under_a_load_of_a_file(saved, capsys):
    assert run("new", "load", "mine.toml") == 0
    assert "next: ctr-nlp under PLAN.npz --load mine.toml" in capsys.readouterr().out
    load = read_load("mine.toml")
    assert load == Load(force=(0.0, 0.05, 0.0))
    assert run("under", "plan.npz", "--load", "mine.toml", *NITINOL) == 1, "its tip is 31 mm off"
    out = capsys.readouterr().out
    assert "under a tip force of (0, 0.05, 0) N" in out
    found = Plan.load("runs/turned-under/plan.npz")
    assert found == turned().with_modulus(60_000).with_load(load)
    told = json.loads((saved / "runs/turned-under/summary.json").read_text())
    assert told["load"] == str(load)
    assert (saved / "runs/turned-under/stability.png").is_file()
    assert (saved / "runs/turned-under/beside.png").is_file()


def test_a_plan_that_knew_the_load_is_shown_beside(saved):
    own, load = turned().with_modulus(60_000), Load(force=(0.0, 0.05, 0.0))
    under = own.with_load(load)
    under.save("knew.npz")
    asked = "under", "plan.npz", "--force", "0", "0.05", "0", "--beside", "knew.npz", *NITINOL
    assert run(*asked) == 1
    assert (saved / "runs/turned-under/beside.png").is_file()
    figure = shapes_compared({"without": own, "under it": under}, "both", [2, len(own.time)])
    rows = [axes.get_ylabel() for axes in figure.axes[::2]]
    assert rows == ["without\nz (mm)", "under it\nz (mm)"]
    drawn = figure.axes[-1]
    tip = np.concatenate([line.get_xydata() for line in drawn.lines[: own.robot.d]])[-1]
    sideways = int("xy".index(drawn.get_xlabel()[0]))
    np.testing.assert_allclose(tip, under.shape[-1, -1, [sideways, 2]])
    assert len(drawn.texts) == sideways  # the arrow of a force along y


def test_a_tip_force_needs_no_file(saved):
    assert run("under", "plan.npz", "--force", "0", "-0.05", "0", "--no-figures", "--out", "here", *NITINOL) == 1
    assert Plan.load("here/plan.npz").evaluated_load == Load(force=(0, -0.05, 0))
    assert not (saved / "here/shapes.png").exists()


def test_forces_are_told_and_written(saved, capsys):
    assert run("force", "plan.npz", "--every", "2", "--directions", "6", *NITINOL) == 0
    out = capsys.readouterr().out
    assert "No tip force of up to 5 N, in 6 directions, snaps the robot." in out
    assert "A small tip force moves the tip by up to" in out
    folder = saved / "runs/turned-force"
    told = json.loads((folder / "forces.json").read_text())
    assert told["frames"] == [1, 3]
    assert told["least_to_snap"]["force_N"] is None
    with open(folder / "forces.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == ["1", "3"]
    softest = np.linalg.norm(told["compliance_mm_per_N"][0], 2)
    assert float(rows[0]["softest_mm_per_N"]) == pytest.approx(softest, abs=1e-3)
    assert (folder / "forces.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["force", "plan.npz"], "youngs_modulus of tube 1 is 1; under a load it must be in MPa"),
        (["force", "plan.npz", "--youngs-modulus", "60"], "did you mean 60000 MPa (60 GPa)"),
        (["force", "plan.npz", "--youngs-modulus", "6e10"], "did you mean 60000 MPa (6e+10 Pa)"),
        (["force", "plan.npz", "--youngs-modulus", "nan"], "youngs_modulus of a robot is nan"),
        (["force", "plan.npz", "--off", "1", *NITINOL], "off needs a wall, and the plan has none"),
        (["force", "plan.npz", "--most", "1e9", *NITINOL], "most is 1000000000.0 N; it must lie in (0, 100]"),
        (["force", "mine.toml"], "mine.toml is not a plan"),
        (["under", "plan.npz", "--force", "0", "0", "1e9", *NITINOL], "force of a load is 1e+09 N; it must be at"),
        (["under", "plan.npz", "--force", "0", "0", "nan", *NITINOL], "force of a load has nan at [3]"),
        (["under", "plan.npz", "--load", "none.toml", *NITINOL], "load file none.toml: "),
        (
            ["under", "plan.npz", "--force", "0", "0.05", "0", "--beside", "other.npz", *NITINOL],
            "--beside other.npz follows another target than the plan",
        ),
        (
            ["under", "plan.npz", "--load", "mine.toml", *NITINOL],
            "load file mine.toml: key 'tube' is unknown in a load",
        ),
        (["under", "plan.npz", "--load", "heavy.toml", *NITINOL], "densities of a load has 3 numbers"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(saved, capsys, argv, line):
    (saved / "mine.toml").write_text("tube = 4\n")
    (saved / "heavy.toml").write_text("densities = [6.4, 6.4, 6.4]\ndown = [0, 0, 1]\n")
    turned()[1:].save(saved / "other.npz")
    before = set(saved.rglob("*"))
    assert run(*argv) == 2
    told = capsys.readouterr().err
    assert line in told
    assert len([each for each in told.splitlines() if each.startswith("error: ")]) == 1
    assert set(saved.rglob("*")) == before


@pytest.mark.parametrize(
    ("command", "problem"), [("plan", "synthesis"), pytest.param("steer", "cos", marks=pytest.mark.slow)]
)
def test_a_loaded_plan_is_made_to_its_end(command, problem, tmp_path, monkeypatch):
    """Over the horizon the command once built a planner of its own, which found no motion where Python did."""
    monkeypatch.chdir(tmp_path)
    given = problem, "--model", "elastic", "--force", "0", "0.05", "0", *NITINOL, "--frames", "6"
    status = run(command, *given, "--no-figures", "--out", "out")
    plan = Plan.load("out/plan.npz")
    assert plan.complete
    assert status == bool(plan.verdicts.failed_names)
    assert plan.evaluated_load == Load(force=(0.0, 0.05, 0.0))
    assert plan.verdicts.stable.word == "yes"
    assert plan.verdicts.holds.word == "NOT CHECKED", "loaded samples are simulated only where that is asked for"


def test_the_command_plans_a_load_as_python_does(tmp_path, monkeypatch):
    asked = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LoadedHorizon, "solve", lambda self, *_, **__: asked.append(self) or pytest.fail("enough"))
    given = "synthesis", "--force", "0", "0.05", "0", *NITINOL, "--frames", "3", "--no-figures"
    with pytest.raises(pytest.fail.Exception):
        run("plan", *given)
    problem = named_problem("synthesis", 3)
    loaded = replace(problem, robot=with_modulus(problem.robot, 60_000))
    with pytest.raises(pytest.fail.Exception):
        solve_horizon(loaded, model=model_with_load("elastic", Load(force=(0.0, 0.05, 0.0))))
    assert len(asked) == 2
