"""Balanced pairs, of equal stiffness or with the inner tube the stiffer one, are planned on the elastic model."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from frames import follow
from methods.comparison import compare, parse_variant
from reference import REFERENCE_METHODS, reference_frames

from ctr_nlp import (
    Limits,
    Plan,
    Problem,
    Robot,
    Settings,
    Tube,
    curve_from_formula,
    growing,
    shape_curve,
    shapes,
    solve_horizon,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import suits
from ctr_nlp.view.exchange.configurations import plan_through

OUTER = Tube(90, 60, 0.008, outer_diameter=2.4, inner_diameter=2.2)
STIFFER = Robot((OUTER, Tube(150, 100, 0.012, 2.0, 1.0)))
EQUAL = Robot((OUTER, Tube(150, 100, 0.012, 1.9, (1.9**4 - 2.4**4 + 2.2**4) ** 0.25)))


def problem(robot):
    path = curve_from_formula(lambda u: (100 - 100 * ca.cos(u), 0, 100 * ca.sin(u)), 0.0, 0.9)
    return Problem("balanced", robot, growing(path, 4), duration=4.0)


@pytest.mark.parametrize("robot", [STIFFER, EQUAL], ids=["the inner stiffer", "equal"])
def test_a_balanced_pair_is_planned_on_the_elastic_model_from_end_to_end(robot, tmp_path):
    """An aligned pair bends to between its pre-curvatures, 1/125 and 1/83 mm: an arc of 100 mm is well within."""
    plan = solve_per_frame(problem(robot), model="elastic", direction="backward")
    assert plan.complete
    assert summary(plan)["e3"] < 0.5
    assert plan.stability_between.min() >= Settings().stability_margin - 0.01
    np.testing.assert_allclose(follow(robot, plan.q).x, follow(robot, plan.evaluate_on("elastic").q).x)
    plan.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again.robot == robot
    with pytest.raises(OptionError, match=r"tube 1 is not stiffer than tube 2 .*--model elastic"):
        again.evaluate_on("dominant")


def test_a_balanced_pair_is_planned_over_a_horizon():
    plan = solve_horizon(problem(STIFFER), model="elastic")
    assert plan.complete
    assert summary(plan)["e3"] < 0.5


@pytest.mark.parametrize("robot", [STIFFER, EQUAL], ids=["the inner stiffer", "equal"])
@pytest.mark.parametrize(
    "ask",
    [
        lambda robot: shapes(robot, np.zeros((1, 6))),
        lambda robot: shape_curve(robot, np.array([0, 0, 10, 20, 0, 0.0])),
        lambda robot: solve_per_frame(problem(robot), model="dominant"),
        lambda robot: solve_per_frame(problem(robot), "two-stage"),
        lambda robot: solve_horizon(problem(robot), model="dominant"),
        *(
            lambda robot, name=name: reference_frames(problem(robot), name, Settings())
            for name, reference in REFERENCE_METHODS.items()
            if reference.model == "dominant"
        ),
        lambda robot: compare([problem(robot)], [parse_variant("joint:ipopt")]),
    ],
)
def test_whatever_rests_on_the_dominant_model_refuses_it_by_name(robot, ask):
    with pytest.raises(OptionError, match=r"dominant.*stiffer than tube 2.*elastic"):
        ask(robot)


def test_a_comparison_on_the_elastic_model_leaves_the_dominant_figures_out():
    found = compare([problem(STIFFER)], [parse_variant("joint:ipopt:elastic")])
    (row,) = found.rows
    assert row["dominant_e3"] is None
    assert row["elastic_e3"] == row["e3"] < 0.5


def test_the_seed_and_a_lone_tube_suit_both_models(robot):
    for each in (robot, Robot(robot.tubes[:1])):
        assert suits(each, "dominant")
        assert suits(each, "elastic")
    assert not suits(STIFFER, "dominant")
    assert not suits(STIFFER, "rigid")


def pair(ratio, curvatures=(0.008, 0.012), beta=None):
    """Two nested tubes of which the outer one is `ratio` times as stiff as the inner one."""
    inner = Tube(150, 100, curvatures[1], 1.9, 1.4)
    outer = Tube(90, 60, curvatures[0], 2.4, 2.0)
    modulus = ratio * inner.bending_stiffness / outer.bending_stiffness
    return Robot((dataclasses.replace(outer, youngs_modulus=modulus), inner), Limits(beta=beta))


@pytest.mark.parametrize("seed", range(12))
def test_plans_on_the_dominant_model_need_a_stiffness_ratio_of_three(seed):
    ratio = float(np.random.default_rng(seed).uniform(1.01, 5))
    robot = pair(ratio)
    shapes(robot, np.zeros((1, 6)))  # a given configuration is evaluated all the same
    assert suits(robot, "dominant") == (ratio >= 3)
    if ratio < 3:
        for plan in (solve_per_frame, solve_horizon):
            with pytest.raises(OptionError, match=r"only [\d.]+ times as stiff as tube 2.*--model elastic"):
                plan(problem(robot), model="dominant")
        with pytest.raises(OptionError, match="only"):
            solve_per_frame(problem(robot), "two-stage")
        with pytest.raises(OptionError, match="only"):
            plan_through(problem(robot), np.zeros((4, 6)), model="dominant")


@pytest.mark.parametrize("ratio", [0.5, 1.75])
def test_tubes_that_cannot_bend_each_other_need_no_stiffness_ratio(ratio):
    assert suits(pair(ratio, curvatures=(0, 0)), "dominant")
    assert suits(pair(ratio, beta=[(0, 0), (0, 100)]), "dominant")
    assert not suits(pair(ratio, curvatures=(0, 0.01)), "dominant")
    assert not suits(pair(ratio, curvatures=(0.01, 0)), "dominant")


def test_shipped_robots_suit_the_dominant_model():
    examples = Path(__file__).parents[2] / "examples"
    for literal in (False, True):
        assert suits(table_i_robot(literal), "dominant")
    for file in ("robot", "airway_tubes", "bronchus_tubes"):
        assert suits(Robot.from_toml(examples / f"{file}.toml"), "dominant")


def test_a_balanced_pair_from_a_file_is_refused_on_the_dominant_model(shared_data, tmp_path, capsys):
    cases = shared_data / "cases"
    options = ["--robot", str(cases / "robots/balanced_pair.toml"), "--model", "dominant", "--frames", "5"]
    out = tmp_path / "plan"
    assert main(["plan", str(cases / "half_curvature.csv"), *options, "--out", str(out)]) == 2
    assert "only 1.02 times as stiff as tube 2" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
