"""What robustness costs and brings: plans for more and less of the tolerances, judged on the same draws."""

import csv
import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Problem, growing
from ctr_nlp.cli.studies import trade as command
from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.robot.tolerances import Tolerances
from ctr_nlp.studies.robustness_trade_off import (
    RobustnessPoint,
    choice_sentence,
    choose_plan,
    plan_for_tolerances,
    requested_plans,
    scale_tolerances,
)

CURVE = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)


def _point(amount, mean, lost, solved=True):
    return RobustnessPoint("bend", amount, 0.1, 0.5, mean, lost, 500, solved)


def test_the_least_mean_is_chosen_of_plans_that_lose_few():
    points = [_point(0, 1.0, 6), _point(0.5, 1.1, 0, False), _point(1, 1.3, 5), _point(1.5, 1.4, 0)]
    assert choose_plan(points) is points[2]
    assert choose_plan(points, 0.002) is points[3]
    assert choose_plan(points[:2]) is None
    assert "for 1 × the tolerances" in choice_sentence(points)
    assert choice_sentence(points[:2]).startswith("No plan is chosen")


def test_no_plan_is_asked_for_twice():
    assert requested_plans((0, 1), (0.1, 0.5)) == [(0.0, 0.1), (0.0, 0.5), (1.0, 0.1)]
    assert requested_plans((1.0,), ()) == [(1.0, 0.1)]
    with pytest.raises(OptionError, match="stability_margin is 2"):
        requested_plans((1.0,), (2.0,))


def test_what_cannot_be_drawn_is_refused_before_anything_is_planned(problem, monkeypatch):
    monkeypatch.setattr(
        "ctr_nlp.studies.robustness_trade_off.solve_horizon", lambda *a, **k: pytest.fail("planned")
    )
    for wrong in ({"samples": 0}, {"amounts": (0, -1.0)}, {"amounts": (0, 1e9)}):
        with pytest.raises((OptionError, RobotError)):
            plan_for_tolerances(problem, **wrong)


def test_so_much_of_every_tolerance_is_planned_for():
    own = Tolerances(curvature=(0.02, 0.04), curved_length=1.0, rotation_lag=0.1, distribution="normal")
    half = scale_tolerances(replace(TWO, tolerances=own), 0.5).tolerances
    assert half.curvature == (0.01, 0.02)
    assert (half.curved_length, half.rotation_lag, half.motor_zero) == (0.5, 0.05, 0.01)
    assert half.distribution == "normal"
    known = Tolerances(distribution="normal", covariance=1e-4 * np.eye(10))
    twice = scale_tolerances(replace(TWO, tolerances=known), 2.0)
    np.testing.assert_allclose(twice.tolerances.covariance, 4e-4 * np.eye(10))


@pytest.fixture
def problem():
    return Problem("bend", TWO, growing(CURVE, 10))


def test_the_command_writes_all_that_it_says(problem, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command.problems, "load_all", lambda names, arguments: [problem])
    out = tmp_path / "trade"
    given = ["bend", "--amounts", "0", "1", "--margins", "0.5", "--draws", "20", "--out", str(out)]
    assert command.main(given) == 0
    rows = json.loads((out / "trade.json").read_text())
    assert [(row["amount"], row["margin"]) for row in rows] == [(0.0, 0.1), (0.0, 0.5), (1.0, 0.1)]
    assert sum(row["chosen"] for row in rows) == 1
    assert all(row["solved"] and row["draws"] == 20 and row["mean"] > 0 for row in rows)
    with (out / "trade.csv").open() as file:
        assert [float(row["mean"]) for row in csv.DictReader(file)] == [row["mean"] for row in rows]
    assert (out / "bend.png").stat().st_size > 10_000
    assert (out / "bend.pdf").read_bytes().startswith(b"%PDF")
    told = capsys.readouterr().out
    assert "Chosen: the plan for" in told
    assert "bend.pdf, bend.png, trade.csv" in told


def test_plans_are_judged_on_the_whole_tolerances(problem):
    (less,) = plan_for_tolerances(problem, (0.5,), (), 5, 3)
    (same,) = plan_for_tolerances(replace(problem, robot=scale_tolerances(problem.robot, 0.5)), (1.0,), (), 5, 3)
    assert less.planned == pytest.approx(same.planned, rel=1e-6)
    assert less.mean > same.mean
