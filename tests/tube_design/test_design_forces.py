"""Designs for robots that something pushes: under a known load, and under forces that may come from any side."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import (
    Load,
    Loaded,
    LoadOverTime,
    Manufacture,
    Problem,
    Robot,
    Tolerances,
    design,
    growing,
    solve_horizon,
)
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.plan.measures import e3
from ctr_nlp.robust.tolerance_scenarios import scenarios_from_tolerances

FORCE = 0.5
ACROSS = Load(force=(0.0, FORCE, 0.0))
TURNING = LoadOverTime([ACROSS, Load(force=(FORCE, 0.0, 0.0))], [0.0, 1.0])
LOADS = pytest.mark.parametrize("load", [ACROSS, TURNING], ids=["constant", "over time"])
RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)
NITINOL = with_modulus(Robot(TWO.tubes), 60_000)
BENDS = {"bend": (12.0, 0.0), "turn": (18.0, 4.0)}


def _task(robot, name="bend"):
    bend, twist = BENDS[name]
    curve = curve_from_formula(lambda u: (bend * (1 - ca.cos(u / 40)), twist * ca.sin(u / 60), u), 0.0, 70.0)
    return Problem(name, robot, growing(curve, 6), duration=3.0)


def _pushed(**others):
    return replace(NITINOL, tolerances=Tolerances(tip_force=FORCE, **others))


@pytest.mark.slow
@LOADS
def test_tubes_for_a_load_follow_under_it_better_than_tubes_for_none(load):
    tasks, model = [_task(NITINOL, name) for name in BENDS], Loaded(load)
    free = design(tasks, nominal=True, rules=RULES, starts=2)
    found = design(tasks, nominal=True, model=model, rules=RULES, starts=2)
    for plan in found.plans:
        assert plan.complete
        assert plan.evaluated_load == load
        assert plan.verdicts.stable.word == "yes"
    assert all(rule.lower <= rule.value <= rule.upper for rule in found.rules)
    knowing = [solve_horizon(replace(task, robot=free.robot), model=model) for task in tasks]
    assert _rms(found.plans) < 0.9 * _rms(knowing)


def _rms(plans):
    return float(np.sqrt(np.mean([e3(plan) ** 2 for plan in plans])))


@pytest.mark.slow
def test_tubes_are_designed_for_their_own_weight():
    """Of a soft and heavy material: those that were designed without it follow less well, though plans know it."""
    weight = Loaded(Load(densities=21.0, down=(0, 1, 0)))
    tasks = [_task(with_modulus(Robot(TWO.tubes), 300), name) for name in BENDS]
    free = design(tasks, nominal=True, rules=RULES, starts=2)
    found = design(tasks, nominal=True, model=weight, rules=RULES, starts=2)
    assert all(plan.complete and plan.evaluated_load == weight.load for plan in found.plans)
    knowing = [solve_horizon(replace(task, robot=free.robot), model=weight) for task in tasks]
    assert _rms(found.plans) < 0.9 * _rms(knowing)


@pytest.mark.parametrize(
    "load", [pytest.param(ACROSS, marks=pytest.mark.slow), TURNING], ids=["constant", "over time"]
)
@pytest.mark.slow
def test_a_design_for_tolerances_may_bear_a_load_as_well(load):
    (plan,) = design([_task(NITINOL)], model=Loaded(load), rules=RULES, starts=1).plans
    assert plan.evaluated_load == load
    assert plan.meta["certificate"]["held"]


def test_tubes_for_forces_from_any_side_are_bent_by_them_less():
    blind, found = (design([_task(robot)], rules=RULES, starts=1) for robot in (NITINOL, _pushed()))
    assert found.plans[0].meta["certificate"]["held"]
    errors = []
    for one in (blind, found):
        plan = one.plans[0]
        robot = replace(plan.robot, tolerances=Tolerances(tip_force=FORCE))
        told = replace(plan, meta=plan.meta | {"robot": robot.to_dict()}).robustness(60, 3)
        errors.append(told.errors.mean)
    assert told.lost_count == 0, "the tubes that were designed for these forces"
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize("others", [{}, {"curvature": 0.0, "bending_stiffness": 0.0, "motor_zero": 0.0}])
def test_pushed_scenarios_have_the_mean_and_the_covariance_of_forces_from_all_sides(others):
    robot = _pushed(**others)
    found, without = (
        scenarios_from_tolerances(robot, with_tip_force=True),
        scenarios_from_tolerances(_pushed(curvature=0.03)),
    )
    counted = found.weights > 0
    assert not found.forces[~counted].any()
    assert not without.has_tip_forces
    forces = found.forces[counted]
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), FORCE)
    np.testing.assert_allclose(forces.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cov(forces.T, bias=True), FORCE**2 / 3 * np.eye(3), atol=1e-12)
    for apart in (found.numbers - found.numbers[0], found.offsets):
        np.testing.assert_allclose(forces.T @ apart[counted].reshape(len(forces), -1), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("robot", "model", "nominal"),
    [
        (Robot(TWO.tubes), Loaded(ACROSS), True),
        (replace(Robot(TWO.tubes), tolerances=Tolerances(tip_force=0.1)), "elastic", False),
    ],
)
def test_moduli_are_asked_for_before_anything_is_solved(robot, model, nominal):
    with pytest.raises(LoadError, match="modul"):
        design([_task(robot)], model=model, nominal=nominal, progress=_never)


def _never(*_told):
    raise AssertionError("something was solved")


def test_what_a_design_cannot_bear_is_said_first():
    with pytest.raises(OptionError, match="dominant"):
        design([_task(_pushed())], model="dominant", progress=_never)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--nominal", "--tip-force", "0.1", "--youngs-modulus", "60000"], "--nominal leaves out"),
        (["--force", "0", "0.1", "0"], "modul"),
        (["--tip-force", "0.1"], "modul"),
        (["--model", "dominant", "--force", "0", "0.1", "0", "--youngs-modulus", "60000"], "dominant"),
    ],
)
def test_the_command_says_so_in_one_line(given, said, tmp_path, capsys):
    assert main(["design", "arc", "--frames", "6", *given, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err.strip()
    assert said in told
    assert len(told.splitlines()) == 1
    assert not (tmp_path / "out").exists()
