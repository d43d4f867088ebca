"""Plans for robots at whose tips a force may act: tolerances, draws, scenarios, and what is refused."""

from __future__ import annotations

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from loaded_plans import TWO, made, through_the_pole

from ctr_nlp import Load, Loaded, LoadOverTime, Plan, Problem, Robot, Settings, Tolerances, Tube, growing
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, OptionError, RobotError
from ctr_nlp.models import KINEMATIC_MODELS, model_with_load
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.curve import curve_from_formula, curve_from_points
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.sample_motions import find_failure_frames, simulate_samples
from ctr_nlp.robot.samples import box_vertices_of, perturb_robot, sample_robots
from ctr_nlp.robust import solve_robust, solve_robust_per_frame
from ctr_nlp.robust.tolerance_scenarios import (
    loaded_unknowns,
    resolve_scenarios,
    scenarios_from_tolerances,
    with_forces,
)

FORCE, FRAMES = 2.0, 4
SIDES = [np.array(each) for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)]
"""26 directions."""
NO_END = Settings(arrival_weight=0.0)
"""Where the tip is to arrive, the plan that knows of no force happens to bear one, too."""


def tolerant(force, robot=TWO, **others):
    """The robot of Nitinol, with a force that may act at its tip."""
    return replace(with_modulus(robot, 60_000), tolerances=Tolerances(tip_force=force, **others))


LONG = Robot((Tube(190, 70, 0.015, 4.0, 3.2), Tube(340, 90, 0.02, 2.6, 1.6)))
"""Long transmissions, which snap easily."""
ONE = {"bending_stiffness": 0.0, "motor_zero": 0.0}
"""Curvatures alone differ, so that few robots stand for all."""
SNAPPING = tolerant(FORCE, LONG, **ONE)


@pytest.fixture(scope="module")
def problem():
    """A bend in space that two tubes cannot follow exactly."""
    curve = curve_from_formula(lambda u: (8 - 8 * ca.cos(u / 25), 6 * ca.sin(u / 30), u), 0.0, 70.0)
    return Problem("bend", SNAPPING, growing(curve, FRAMES), duration=2.0)


@pytest.fixture(scope="module")
def found(problem):
    return solve_robust(problem, margins=(0.1,), settings=NO_END)


@pytest.fixture(scope="module")
def without(problem):
    """For the tolerances of the tubes alone."""
    return solve_robust(replace(problem, robot=tolerant(0.0, LONG, **ONE)), margins=(0.1,), settings=NO_END)


def _lost_in_any(plan, robot):
    """How many of 30 robots are lost in any of 26 directions of the force."""
    draws = sample_robots(replace(robot, tolerances=Tolerances(**ONE)), 30, 7)
    lost = np.zeros(len(draws), dtype=bool)
    for side in SIDES:
        load = Load(force=tuple(FORCE * side / np.linalg.norm(side)))
        lost |= find_failure_frames(robot, draws, plan.q, model_with_load("elastic", load)) > 0
    return int(lost.sum())


def test_a_plan_for_forces_loses_no_robot_under_them_that_a_plan_without_does(found, without):
    assert found.complete
    assert found.meta["certificate"]["held"]
    assert _lost_in_any(found, SNAPPING) == 0
    assert _lost_in_any(without, SNAPPING) > 0


WEIGHT = Load(densities=21.0, down=(1, 0, 0))
LOADS = [WEIGHT, LoadOverTime([Load(), replace(WEIGHT, force=(0.0, 0.03, 0.0))], [0.0, 1.0])]


@pytest.mark.parametrize(
    "load", [pytest.param(LOADS[0], marks=pytest.mark.slow), LOADS[1]], ids=["weight", "over time"]
)
def test_robots_within_tolerances_bear_a_known_load_together(problem, load):
    """Tubes are soft, so that their weight counts; a draw without a deviation moves as the robot described."""
    robot = replace(with_modulus(TWO, 200), tolerances=Tolerances(**ONE))
    found = solve_robust(replace(problem, robot=robot), model=Loaded(load), margins=(0.1,))
    assert found.complete
    assert found.evaluated_load == load
    assert found.meta["certificate"]["held"]
    blind = solve_robust(replace(problem, robot=robot), margins=(0.1,))
    assert e3(found) < 0.5 * e3(blind.with_load(load))
    same = perturb_robot(robot, np.zeros((1, robot.d, 5)), np.zeros((1, robot.d)))
    np.testing.assert_allclose(
        simulate_samples(robot, same, found.q, Loaded(load)).shape[0], found.shape, atol=1e-6
    )
    assert found.robustness(30, 3).lost_count == 0


def test_a_tip_turns_without_leaps_where_its_tube_is_twisted_by_more_than_half_a_turn():
    """A draft has some frames only, and what is read off between two of them must not lie half a turn away."""
    angles = np.linspace(3.0, 1.5, 31)
    x = np.column_stack([angles, 0 * angles, np.tile([-150.0, -290.0, 0.0, 0.0], (31, 1))])
    q = KINEMATIC_MODELS["elastic"].configuration(LONG, x)
    assert np.ptp(q[:, 1] - x[:, 1]) > np.pi
    model = model_with_load("elastic", Load())
    bearing = loaded_unknowns(with_modulus(LONG, 60_000), model, q, x)
    assert abs(np.diff(bearing[:, 1])).max() < 0.2
    apart = model.configuration(with_modulus(LONG, 60_000), bearing) - q
    apart[:, :2] -= 2 * np.pi * np.round(apart[:, 1:2] / (2 * np.pi))
    assert abs(apart).max() < 0.01


def test_what_is_planned_is_told_of_the_robot_without_a_load(found):
    assert found.evaluated_load is None
    assert found.meta["model"] == "elastic"
    assert "planned_load" not in found.meta
    assert found.robot.tolerances.tip_force == FORCE
    expected = found.evaluated_model.follow(found.robot, found.q)
    np.testing.assert_allclose(found.stability, expected.stability)


def test_its_own_draws_bear_forces(found):
    drawn_so = found.robustness(20, 3)
    bare = replace(found.robot, tolerances=replace(found.robot.tolerances, tip_force=0.0))
    pushed = simulate_samples(found.robot, sample_robots(found.robot, 20, 3), found.q, "elastic")
    without = simulate_samples(bare, sample_robots(bare, 20, 3), found.q, "elastic")
    np.testing.assert_allclose(drawn_so.cloud[-1, :, -1], pushed.shape[:, -1, -1], atol=1e-4)
    tips = np.linalg.norm(pushed.shape[:, -1, -1] - without.shape[:, -1, -1], axis=1)
    assert tips.min() > 0.1
    assert drawn_so.lost_count == 0
    told = found.with_samples(20, 3).verdicts.holds.why
    assert told.endswith("Each has a tip force of 2 N in a random direction.")


def test_frame_by_frame_it_is_planned_for_forces_too(problem):
    found = solve_robust_per_frame(problem, direction="forward", rounds=1)
    assert found.success.all()
    assert found.evaluated_load is None
    assert found.meta["certificate"]["held"]
    assert _lost_in_any(found, SNAPPING) == 0


@pytest.mark.slow
def test_a_robust_plan_may_bear_a_load_all_the_time():
    """Beside which nothing pulls at it: on reachable targets of a robot so loaded, errors are small."""
    robot, load = tolerant(0.0, **ONE), Load(force=(0.0, 4.0, 0.0))
    q = np.zeros((4, 6))
    q[:, 0], q[:, 2], q[:, 3] = np.linspace(0, 0.6, 4), np.linspace(20, 60, 4), np.linspace(40, 80, 4)
    reached = made(robot, q).with_load(load).shape
    problem = Problem("reached", robot, growing(curve_from_formula(lambda u: (0.0 * u, 0.0 * u, u), 0, 80), 4))
    target = replace(problem.target, curves=_through(reached), lengths=tuple(q[:, 3]))
    found = solve_robust(replace(problem, target=target), model=Loaded(load), margins=(0.1,), guards=False)
    assert found.evaluated_load == load
    assert found.complete
    assert e3(found) < 0.1 * e3(found.evaluate_on("elastic"))


@pytest.mark.slow
def test_a_base_may_be_led_through_the_pole_of_its_tilt():
    """At theta_x = 90 deg theta_y does not follow from where the base points."""
    robot = tolerant(0.05, **ONE)
    q = through_the_pole()
    reached = made(robot, q).shape
    problem = Problem("pole", robot, growing(curve_from_formula(lambda u: (0.0 * u, 0.0 * u, u), 0, 80), 5))
    target = replace(problem.target, curves=_through(reached), lengths=tuple(q[:, 3]))
    found = solve_robust(replace(problem, target=target), initial=[q], margins=(), guards=False)
    assert found.complete
    assert e3(found) < 0.1
    assert found.q[0, 4] < np.pi / 2 - 0.2
    assert found.q[-1, 4] > np.pi / 2 + 0.2


def _through(shapes):
    return tuple(curve_from_points(shape) for shape in shapes)


def test_draws_bear_forces_of_one_size_in_all_directions_and_are_otherwise_the_same():
    robot, bare = tolerant(0.2), tolerant(0.0)
    draws, others = sample_robots(robot, 400, 5), sample_robots(bare, 400, 5)
    np.testing.assert_array_equal(draws.numbers, others.numbers)
    np.testing.assert_array_equal(draws.offsets, others.offsets)
    assert not others.forces.any()
    np.testing.assert_allclose(np.linalg.norm(draws.forces, axis=1), 0.2)
    np.testing.assert_allclose(draws.forces.mean(axis=0), 0, atol=0.02)
    np.testing.assert_array_equal(sample_robots(robot, 10, 5).forces, draws.forces[:10])
    np.testing.assert_array_equal(draws[3:5].forces, draws.forces[3:5])
    np.testing.assert_allclose(np.linalg.norm(box_vertices_of(robot).forces, axis=1), 0.2)


def test_draws_under_forces_are_where_each_comes_to_under_its_own():
    q = np.zeros((3, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0, 0.8, 3), (60.0, 80.0)
    draws = sample_robots(tolerant(0.3), 3, 1)
    found = simulate_samples(tolerant(0.3), draws, q, "elastic")
    for k, force in enumerate(draws.forces):
        own = perturb_robot(tolerant(0.0), draws.deviations[k : k + 1], draws.backlash[k : k + 1])
        alone = simulate_samples(tolerant(0.0), own, q, Loaded(Load(force=tuple(force))))
        np.testing.assert_allclose(found.shape[k], alone.shape[0], atol=1e-9)
        np.testing.assert_allclose(found.stability[k], alone.stability[0], atol=1e-9)


def test_scenarios_are_joined_by_the_described_robot_under_forces_along_the_axes():
    robot = tolerant(0.2)
    model, scenarios = resolve_scenarios(robot, "elastic", None)
    own = scenarios_from_tolerances(robot)
    assert model == Loaded(Load())
    assert len(scenarios) == len(own) + 6
    np.testing.assert_allclose(sorted(map(tuple, scenarios.forces[-6:])), sorted(_axes(0.2)))
    assert not scenarios.weights[-6:].any()
    np.testing.assert_array_equal(scenarios.numbers[-1], robot.numbers)
    assert len(with_forces(own, 0.0)) == len(own)
    nothing = dict.fromkeys(("curvature", "bending_stiffness", "motor_zero"), 0.0)
    assert len(resolve_scenarios(tolerant(0.2, **nothing), "elastic", None)[1]) == 7


def _axes(size):
    return [tuple(each) for each in size * np.vstack([np.eye(3), -np.eye(3)])]


@pytest.mark.parametrize("value", [-0.1, 11.0, float("nan"), "strong", (0.1, 0.2)])
def test_a_force_that_cannot_be_is_refused(value):
    with pytest.raises(RobotError, match="tip_force of tolerances"):
        Tolerances(tip_force=value)


def test_what_forces_do_not_go_with_is_refused_in_one_sentence(problem):
    ratio = replace(TWO, tolerances=Tolerances(tip_force=0.1))
    with pytest.raises(LoadError, match="looks like a ratio"):
        solve_robust(replace(problem, robot=ratio))
    with pytest.raises(LoadError, match="looks like a ratio"):
        simulate_samples(ratio, sample_robots(ratio, 2, 0), np.zeros((1, 6)), "elastic")
    with pytest.raises(OptionError, match="a load does not go with the dominant model"):
        solve_robust(problem, model="dominant")


def test_the_command_plans_for_a_force(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two.toml").write_text(tolerant(0.0).to_toml())
    rows = "".join(f"{0.001 * z * z},0,{z}\n" for z in range(0, 81, 4))
    (tmp_path / "path.csv").write_text(f"x_mm,y_mm,z_mm\n{rows}")
    argv = ["plan", "path.csv", "--robot", "two.toml", "--frames", "3", "--no-figures", "--out", "here"]
    assert main([*argv, "--nominal", "--tip-force", "0.1"]) == 2
    assert "--tip-force needs --robust; it sets" in capsys.readouterr().err
    assert main([*argv, "--tip-force", "-1"]) == 2
    assert "tip_force of tolerances is -1" in capsys.readouterr().err
    assert main([*argv, "--tip-force", "0.1"]) in (0, 1)
    plan = Plan.load("here/plan.npz")
    assert plan.robot.tolerances.tip_force == 0.1
    assert plan.drawn.lost_count == 0
