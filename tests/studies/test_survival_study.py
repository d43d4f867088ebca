"""How plans of airways survive: what the study measures, what it keeps when it is stopped, and what it says."""

import csv

import numpy as np
import pytest

from ctr_nlp.cli.commands.new import template
from ctr_nlp.cli.main import main
from ctr_nlp.studies.airways import synthetic_problem
from ctr_nlp.studies.robustness_trade_off import COMPARED_STABILITY_MARGINS, RobustnessPoint, plan_for_tolerances
from ctr_nlp.studies.survival.cases import Airway, from_rows
from ctr_nlp.studies.survival.distributions import distributions
from ctr_nlp.studies.survival.report import findings, page, write

pytest.importorskip("distributed", reason="the extra `study` is not installed")

FILES = ["survival.csv", "survival.md", "survival.pdf", "survival.png"]


def airway(seed, means, losses, robust=(1.2, 0), solved=True):
    """Of made-up plans with these mean errors, mm, and draws lost of 100."""
    each = zip(COMPARED_STABILITY_MARGINS, means, losses, strict=True)
    plans = [
        RobustnessPoint(f"synthetic {seed}", 0.0, margin, 1.0, mean, lost, 100, True)
        for margin, mean, lost in each
    ]
    best = RobustnessPoint(f"synthetic {seed}", 1.0, 0.1, 1.1, *robust, 100, solved)
    return Airway(f"synthetic {seed}", 100, tuple(plans), best)


CLEAR = airway(0, (8.0, 4.0, 2.0, 1.9), (60, 30, 0, 0))
CLOSE = airway(1, (8.0, 1.5, 1.1, None), (60, 1, 2, 100), (1.2, 1), solved=False)


def test_the_best_margin_loses_fewest_then_errs_least():
    assert (CLEAR.plain.margin, CLEAR.best.margin, CLOSE.best.margin) == (0.1, 0.7, 0.3)


def test_findings_tell_where_robust_plans_are_worse():
    told = " ".join(findings([CLEAR, CLOSE]))
    assert "plain: 120 of 200 draws are lost, at most 1% in 0 of 2 airways" in told
    assert "best margin: 1 of 200 draws" in told
    assert "robust: 1 of 200 draws are lost, at most 1% in 2 of 2" in told
    assert "lose no more draws than any margin in 2 of 2 airways, and have no larger mean e3 than any in 1" in told
    assert "not solved: plans of synthetic 1" in told
    rows = [line for line in page([CLEAR, CLOSE]).splitlines() if line.startswith("| robust |")]
    assert rows[0] == "| robust | 1.20 | 1.20 | 1.20 | 1.20 | 1.20 | 1.20 |"
    assert rows[1] == "| robust | 0.0% | 0.2% | 0.5% | 0.8% | 1.0% | 0.5% |"
    assert len(distributions([CLEAR, CLOSE]).axes) == 2


def row(plan):
    """Of a study, of a plan."""
    return {
        "problem": plan.problem.replace(" ", ":"),
        "status": "done",
        "method": "robust-horizon" if plan.amount else "horizon",
        "set_stability_margin": np.nan if plan.amount else plan.margin,
        "frames": 100.0,
        "e3": plan.planned,
        "robustness_e3_mean": plan.mean,
        "robustness_lost": float(plan.lost),
        "robustness_draws": float(plan.draws),
        "complete": plan.solved,
    }


def test_airways_are_read_from_rows_in_any_order():
    rows = [row(plan) for one in (CLEAR, CLOSE) for plan in one.plans]
    assert from_rows(rows[::-1]) == [CLOSE, CLEAR]
    assert from_rows(rows[:-1]) == [CLEAR]
    assert from_rows([rows[-1]]) == []


def test_all_files_are_written(tmp_path):
    write([CLEAR, CLOSE], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES
    with (tmp_path / "survival.csv").open() as file:
        assert [line["airway"] for line in csv.DictReader(file)] == ["synthetic 0"] * 5 + ["synthetic 1"] * 5


@pytest.mark.slow
def test_plans_of_an_airway_are_those_of_the_trade(tmp_path, capsys):
    text = template("survival.toml").replace("frames = 100", "frames = 6").replace("draws = 100", "draws = 10")
    (tmp_path / "s.toml").write_text(text.replace("synthetic = 100", "synthetic = 1"), encoding="utf-8")
    assert main(["study", str(tmp_path / "s.toml"), "--out", str(tmp_path / "out")]) == 1
    told = capsys.readouterr().out
    assert "- robust: 0 of 10 draws are lost" in told
    assert "survival.csv, survival.md, survival.pdf, survival.png" in told
    with (tmp_path / "out" / "survival.csv").open() as file:
        found = list(csv.DictReader(file))
    assert [float(plan["margin"]) for plan in found[:-1]] == list(COMPARED_STABILITY_MARGINS)
    (known,) = plan_for_tolerances(synthetic_problem(0, 6), (), (0.5,), 10, 20270000)
    np.testing.assert_allclose(float(found[2]["mean"]), known.mean, rtol=1e-9)
    assert (float(found[-1]["amount"]), int(found[-1]["lost"])) == (1, 0)
