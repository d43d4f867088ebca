"""Where the checker is asked: before motors move, in reports and in studies."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_plans import random_plan

from ctr_nlp import Study
from ctr_nlp.cli import second_opinion
from ctr_nlp.cli.main import main
from ctr_nlp.studies.grid.measures import MEASURES

pytestmark = pytest.mark.interpreted
DRY_RUN = "--dry-run", "--uncertified"


@pytest.fixture(scope="module")
def plan():
    return random_plan(6)


def test_play_asks_the_checker_once_for_each_file(plan, tmp_path, monkeypatch):
    plan.save(tmp_path / "plan.npz")
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "cache"))
    asked = []
    check_plan = second_opinion.check_plan
    monkeypatch.setattr(second_opinion, "check_plan", lambda *given: asked.append(given) or check_plan(*given))
    for _ in range(2):
        assert main(["play", str(tmp_path / "plan.npz"), *DRY_RUN]) == 0
    assert len(asked) == 1


@pytest.mark.hazard("mistake of the planner")
def test_play_refuses_a_plan_whose_record_does_not_fit(plan, tmp_path, capsys):
    late = replace(plan, time=2 * plan.time)
    late.save(tmp_path / "plan.npz")
    assert main(["play", str(tmp_path / "plan.npz"), *DRY_RUN]) == 2
    told = capsys.readouterr().err
    assert "independent check disagrees" in told
    assert "the problem takes 10 s" in told


@pytest.mark.hazard("what was not checked reads as passed")
def test_play_names_verdicts_that_are_not_covered(tmp_path, capsys):
    loaded = random_plan(63)
    assert loaded.evaluated_load is not None
    loaded.save(tmp_path / "plan.npz")
    main(["play", str(tmp_path / "plan.npz"), *DRY_RUN])
    told = capsys.readouterr().err
    assert "independent check disagrees" not in told
    assert "an independent check does not cover: " in told
    assert "an independent check agrees with the verdicts: " in told


@pytest.mark.hazard("what was not checked reads as passed")
def test_imported_motions_are_never_called_solved(plan, tmp_path, capsys):
    path = tmp_path / "plan.npz"
    replace(plan, kkt=np.full(len(plan.time), np.nan)).save(path)
    assert main(["check", str(path), "--json"]) == 0
    (table,) = json.loads(capsys.readouterr().out)["tables"]
    (row,) = (row for row in table["rows"] if row[0] == "solved")
    assert row[1:5] == ["NOT CHECKED", 0, "not covered", 0.0]
    assert main(["play", str(path), "--dry-run"]) == 2
    assert "solved: NOT CHECKED" in capsys.readouterr().err
    assert main(["play", str(path), *DRY_RUN]) == 0
    assert "solved: NOT CHECKED. 10 of 10 frames were given" in capsys.readouterr().err
    main(["report", str(path), "--out", str(tmp_path / "report")])
    text = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "10 of 10 frames were given, not solved" in text


def test_report_shows_the_check(plan, tmp_path):
    path = tmp_path / "plan.npz"
    replace(plan, stability=plan.stability + 0.1).save(path)
    assert main(["report", str(path), "--out", str(tmp_path / "report")]) == 0
    text = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "An independent check" in text
    assert "DISAGREES" in text
    assert "not covered" in text


def test_study_checks_every_plan(plan):
    study = {"problems": {"names": ["arc"]}, "frames": 3, "check": True}
    (case,) = Study.from_dict(study, Path()).cases
    assert case.measures == ("check",)
    (other,) = Study.from_dict(study | {"check": False}, Path()).cases
    assert other.digest != case.digest
    found = MEASURES["check"](plan, None)
    assert found["check_agrees"]
    assert found["check_disagrees"] == ""
    assert "holds" in found["check_not_covered"]
    wrong = MEASURES["check"](replace(plan, shape=plan.shape + 1.0), None)
    assert not wrong["check_agrees"]
    assert "shapes" in wrong["check_disagrees"]
