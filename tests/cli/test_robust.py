"""`ctr-nlp robust`, what plans say of draws by themselves, and what is not played without them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from near_fold import near_the_fold, plan_through

from ctr_nlp import Plan, Tolerances
from ctr_nlp.cli.commands.play import main as play
from ctr_nlp.cli.commands.robust import main as robust
from ctr_nlp.cli.main import main as command
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.summary_text import remarks
from ctr_nlp.view.report import page

SMALL = """
[[tubes]]
length = 90
curved_length = 45
curvature = [0.01, 0.025]
outer_diameter = 4
inner_diameter = 3.2
[[tubes]]
length = 110
curved_length = 80
curvature = 0.02
outer_diameter = 2.6
inner_diameter = 1.6
[limits]
beta = [[0, 60], [0, 110]]
[tolerances]
curvature = 0.03
"""


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Two plans, one near a fold and one far from it."""
    folder = tmp_path_factory.mktemp("plans")
    for name, last in (("near", 4.2), ("far", 1.0)):
        plan_through(near_the_fold(last)).save(folder / f"{name}.npz")
    return folder


@pytest.mark.parametrize(("name", "loses", "word"), [("near", True, "no"), ("far", False, "yes")])
def test_samples_decide_the_verdict(saved, tmp_path, capsys, name, loses, word):
    ends = "--arrival-tolerance", "500", "--contact-allowed", "500"
    asked = "--draws", "20", "--seed", "4", *ends, "--out", str(tmp_path / "out")
    found = robust([str(saved / f"{name}.npz"), *asked])
    told = capsys.readouterr().out
    assert found == 1
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    assert (len(plan.drawn), plan.drawn.seed) == (20, 4)
    assert plan.verdicts.holds.word == word
    assert plan.verdicts.holds.value in told
    assert ("frames in which samples first fail" in told) == loses
    assert "motor zero" in told
    numbers = json.loads((tmp_path / "out" / "summary.json").read_text())["robustness"]
    assert numbers["lost"] == plan.drawn.lost_count
    assert "e2_draws_95" in (tmp_path / "out" / "errors.csv").read_text().splitlines()[0]
    assert (tmp_path / "out" / "robustness.png").stat().st_size > 10_000


def test_without_pictures_there_is_none_and_bad_counts_are_refused(saved, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    robust([str(saved / "far.npz"), "--draws", "3", "--no-figures", *out])
    assert not (tmp_path / "out" / "robustness.png").exists()
    assert robust([str(saved / "far.npz"), "--draws", "0", *out]) == 2
    assert "draws is 0; it must be a whole number of at least 1" in capsys.readouterr().err
    assert robust([str(saved / "far.npz"), "--seed", "-1", *out]) == 2
    assert robust([str(tmp_path / "none.npz"), *out]) == 2


def test_samples_on_a_model_without_snaps_are_not_checked(saved, tmp_path, capsys):
    of_dominant = Plan.load(saved / "near.npz").evaluate_on("dominant")
    of_dominant.save(tmp_path / "plan.npz")
    given = [str(tmp_path / "plan.npz"), "--draws", "20", "--seed", "4", "--no-figures"]
    given += ["--out", str(tmp_path / "o")]
    robust([*given, "--evaluate", "dominant"])
    plan = Plan.load(tmp_path / "o" / "plan.npz")
    assert (plan.verdicts.holds.word, plan.verdicts.holds.number) == ("NOT CHECKED", None)
    assert plan.verdicts.arrives.word != "yes"
    assert "NOT CHECKED" in capsys.readouterr().out
    for more in ([], ["--evaluate", "elastic"]):
        assert robust([*given, *more]) == 1, "the elastic model is the default here, too"
        found = Plan.load(tmp_path / "o" / "plan.npz")
        assert found.evaluated_model_name == "elastic"
        assert found.verdicts.holds.word == "no"


@pytest.mark.parametrize("model", ["elastic", "dominant"])
def test_every_plan_is_tried_on_200_samples_by_itself(tmp_path, capsys, model):
    given = ["arc", "--frames", "4", "--formulation", "joint", "--no-figures", "--stability-margin", "0.1"]
    status = command(["steer", *given, "--model", model, "--out", str(tmp_path / "out")])
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    assert len(plan.drawn) == 200
    assert status == int("no" in [verdict.word for verdict in plan.verdicts])
    assert "of 200 simulated robots hold" in " ".join(capsys.readouterr().out.split())
    command(["steer", *given, "--model", model, "--samples", "0", "--out", str(tmp_path / "none")])
    assert Plan.load(tmp_path / "none" / "plan.npz").verdicts.holds.word == "NOT CHECKED"


@pytest.fixture
def small(tmp_path):
    """Options of a problem of two tubes and few frames."""
    (tmp_path / "robot.toml").write_text(SMALL)
    points = "".join(f"0,0,{z}\n" for z in range(0, 101, 5))
    (tmp_path / "path.csv").write_text(f"x_mm,y_mm,z_mm\n{points}")
    return [str(tmp_path / "path.csv"), "--robot", str(tmp_path / "robot.toml"), "--frames", "8", "--no-figures"]


@pytest.mark.parametrize("formulation", ["horizon", "joint"])
def test_a_robust_plan_is_tried_on_draws_and_holds_what_came_of_planning(small, tmp_path, capsys, formulation):
    given = ["--formulation", formulation, "--robust", "--most-lost", "0.02"]
    command(["plan", *small, *given, "--out", str(tmp_path / "out")])
    told = " ".join(capsys.readouterr().out.split())
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    assert plan.meta["model"] == "elastic"
    assert len(plan.drawn) == plan.meta["certificate"]["samples"] == 200
    assert plan.drawn.lost_share <= 0.01
    assert "holds on built robots" in told
    certificate = plan.meta["certificate"]
    assert certificate["held"]
    assert certificate["most_lost"] == 0.02
    assert certificate["lost"] <= 0.02 * certificate["draws"]
    assert certificate["certified"] == (certificate["holds_at_least"] >= 0.95)
    assert "certificate: " in told
    assert "ctr-nlp plan --robust" not in told


def test_all_robots_within_the_tolerances_are_planned_for_by_default(small, tmp_path, capsys):
    out = tmp_path / "out"
    command(["plan", *small, "--out", str(out)])
    told = " ".join(capsys.readouterr().out.split())
    plan, nominal = Plan.load(out / "plan.npz"), Plan.load(out / "nominal" / "plan.npz")
    assert plan.meta["formulation"] == "robust-horizon"
    assert nominal.meta["formulation"] == "horizon"
    assert nominal.verdicts.holds.word == "NOT CHECKED"
    assert plan.verdicts.holds.word != "NOT CHECKED"
    assert told.index("the robot as described ends with its tip ") < told.index("holds on built robots ")
    assert not (out / "nominal" / "shapes.png").exists(), "--no-figures was given"
    assert command(["plan", *small, "--out", str(out)]) in (0, 1), "the folder is one of ours"


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["--nominal"], ""),
        (["--starts", "1"], "planned for the robot as described alone: --starts does not go with --robust"),
        (["--model", "dominant"], ""),
        (["--robot", "exact.toml"], "planned for the robot as described alone: all tolerances of the robot are 0"),
    ],
    ids=["asked for", "an option", "a model", "no tolerances"],
)
def test_plans_of_the_described_robot_alone_say_why(small, tmp_path, monkeypatch, capsys, more, why):
    monkeypatch.chdir(tmp_path)
    exact = "\n[tolerances]\ncurvature = 0.0\nbending_stiffness = 0.0\nmotor_zero = 0.0\n"
    (tmp_path / "exact.toml").write_text(SMALL.split("[tolerances]")[0] + exact)
    command(["plan", *small, "--no-evaluate", *more])
    told = " ".join(capsys.readouterr().out.split())
    (folder,) = (tmp_path / "runs").iterdir()
    assert Plan.load(folder / "plan.npz").meta["formulation"] == "horizon"
    assert not (folder / "nominal").exists()
    assert ("nominal" in folder.name) == ("dominant" not in more)
    assert why in told
    assert ("as described alone" in told) == bool(why)


def test_robust_and_nominal_exclude_each_other(small, capsys):
    with pytest.raises(SystemExit, match="2"):
        command(["plan", *small, "--robust", "--nominal"])
    assert "not allowed with argument" in capsys.readouterr().err


def test_a_robust_plan_on_the_dominant_model_is_judged_on_the_elastic_one(small, tmp_path):
    given = ["--model", "dominant", "--robust", "--samples", "30", "--out", str(tmp_path / "out")]
    command(["plan", *small, *given])
    plan = Plan.load(tmp_path / "out" / "plan.npz")
    assert plan.meta["formulation"] == "robust-horizon"
    assert (plan.evaluated_model_name, len(plan.drawn)) == ("elastic", 30)
    assert plan.verdicts.holds.word in ("yes", "no")


def test_robust_and_plain_plans_have_folders_of_their_own(small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for more in ([], ["--robust"]):
        command(["plan", *small, "--frames", "4", "--formulation", "joint", "--no-evaluate", *more])
    names = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert names == ["path-joint-elastic-on-robot", "path-joint-elastic-robust-on-robot"]


def test_a_plan_that_loses_too_many_says_what_it_would_bear(saved):
    plan = Plan.load(saved / "near.npz").with_samples(20, 4)
    assert plan.verdicts.holds.why.endswith("`ctr-nlp plan --robust` plans for such robots.")
    certificate = {"held": False, "most_lost": 0.01, "draws": 50, "lost": 7, "lost_in": {"3": 6, "5": 1}}
    for borne, more in ((0.5, 1), (0.0, 0)):
        robust_plan = replace(plan, meta=plan.meta | {"certificate": certificate | {"borne": borne}})
        told = remarks(robust_plan, summary(robust_plan))
        lost = "7 of 50 new samples, first in frames 3 (6), 5 (1); at most 1.00% of all robots may fail"
        assert sum(lost in each for each in told) == 1
        assert sum(each.startswith("the plan would hold with tolerances of curvature ") for each in told) == more
        assert not robust_plan.verdicts.holds.why.endswith("plans for such robots.")


def test_what_it_would_bear_includes_the_force_at_the_tip(saved):
    plan = Plan.load(saved / "near.npz")
    robot = replace(plan.robot, tolerances=Tolerances(tip_force=0.2, rotation_lag=0.1))
    certificate = {"held": False, "most_lost": 0.01, "draws": 50, "lost": 7, "lost_in": {"3": 7}, "borne": 0.5}
    robust_plan = replace(plan, meta=plan.meta | {"robot": robot.to_dict(), "certificate": certificate})
    assert remarks(robust_plan, summary(robust_plan))[-1].endswith("rotation lag 0.05 rad, tip force 0.1 N")


def test_an_elastic_plan_is_not_played_untried_nor_where_draws_fail(saved, tmp_path, capsys):
    plan = Plan.load(saved / "near.npz")
    plan.with_samples(20, 4).save(tmp_path / "failing.npz")
    for path in (saved / "near.npz", tmp_path / "failing.npz"):
        assert play([str(path), "--out", str(tmp_path / "play")]) == 2
        told = capsys.readouterr().err
        verdict = Plan.load(path).verdicts[-1]
        assert f"{verdict.matter}: {verdict.word} ({verdict.why.rstrip('.')})" in told
        assert "--uncertified" in told
        assert not (tmp_path / "play").exists()


def test_a_robust_plan_is_asked_for_clearance(tmp_path, monkeypatch):
    asked = []

    def planned(problem, **named):
        asked.append(named["settings"])
        raise OptionError("that is all")

    monkeypatch.setattr("ctr_nlp.robust.solve_robust", planned)
    given = ["--clearance", "0.2", "--arrival-weight", "9", "--contact-weight", "7", "--contact-allowed", "0.3"]
    whole = ["plan", "bronchus", "--frames", "4", "--model", "elastic", "--robust", "--out", str(tmp_path)]
    assert command([*whole, *given]) == 2
    (found,) = asked
    assert (found.clearance, found.arrival_weight, found.contact_weight, found.contact_allowed) == (
        0.2,
        9,
        7,
        0.3,
    )


def test_the_page_shows_errors_of_draws(saved):
    plan = Plan.load(saved / "far.npz").with_samples(5, 4)
    text = page([plan])
    assert "e2 of sampled robots (mm)" in text
    assert "holds on built robots" in text
    assert "e2 of sampled robots (mm)" not in page([Plan.load(saved / "far.npz")])
    assert np.isfinite(plan.drawn.e2).all()
