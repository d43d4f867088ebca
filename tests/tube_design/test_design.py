"""Designs: tubes fit their tasks better than those that they began as, can be made, and carry the plans."""

from __future__ import annotations

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import shooting
from truth import TWO

from ctr_nlp import Manufacture, Plan, Problem, Robot, Settings, design, growing, solve_horizon, summary
from ctr_nlp.cli import problems
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.ocp.shared.design import DesignedTubes
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.studies.workers.clients import local_client
from ctr_nlp.tube_design.starts import generate_start_tubes

PAIR = Robot(TWO.tubes)
RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)
FRAMES = 6


def _task(name, bend, twist):
    curve = curve_from_formula(lambda u: (bend * (1 - ca.cos(u / 40)), twist * ca.sin(u / 60), u), 0.0, 70.0)
    return Problem(name, PAIR, growing(curve, FRAMES), duration=3.0)


@pytest.fixture(scope="module")
def tasks():
    """Two bends that one robot of two tubes follows, and not exactly."""
    return [_task("bend", 12.0, 0.0), _task("turn", 18.0, 4.0)]


@pytest.fixture(scope="module")
def nominal(tasks):
    return design(tasks, nominal=True, rules=RULES, starts=2)


@pytest.fixture(scope="module")
def tolerant(tasks):
    """A design for the first task and the robot's tolerances."""
    return design(tasks[:1], rules=RULES, starts=1)


def _rms(plans):
    return float(np.sqrt(np.mean([summary(plan)["e3"] ** 2 for plan in plans])))


def test_designed_tubes_are_better_than_those_they_began_as(tasks, nominal):
    far = Settings(contact_weight=0.0)
    own = [solve_horizon(task, model="elastic", settings=far) for task in tasks]
    assert _rms(nominal.plans) < 0.5 * _rms(own)
    assert all(plan.success.all() for plan in nominal.plans)
    assert all(plan.robot == nominal.robot for plan in nominal.plans)


@pytest.mark.slow
def test_tubes_are_designed_on_the_dominant_model_too(tasks):
    own = [solve_horizon(task, model="dominant", settings=Settings(contact_weight=0.0)) for task in tasks]
    found = design(tasks, nominal=True, model="dominant", rules=RULES, starts=1)
    assert all(plan.success.all() and plan.meta["model"] == "dominant" for plan in found.plans)
    again = [solve_horizon(replace(task, robot=found.robot), model="dominant") for task in tasks]
    assert _rms(found.plans) == pytest.approx(_rms(again), rel=0.02)
    assert _rms(again) < 0.5 * _rms(own)
    assert all(rule.lower <= rule.value <= rule.upper for rule in found.rules)


def test_designed_tubes_can_be_made(nominal):
    for rule in nominal.rules:
        assert rule.lower <= rule.value <= rule.upper, rule
    outer, inner = nominal.robot.tubes
    assert inner.inner_diameter >= 0.3
    assert outer.outer_diameter <= 4.0
    assert outer.inner_diameter - inner.outer_diameter >= 0.1
    for tube in nominal.robot.tubes:
        assert tube.outer_diameter - tube.inner_diameter >= 0.2
        assert tube.largest_curvature * tube.outer_diameter / 2 <= 0.04


@pytest.mark.slow
def test_no_tubes_nearby_are_better(tasks):
    """A minimum: tubes that differ a little have no smaller errors, but for what motion costs.

    Arcs: with curvatures that vary, errors are so small that the cost of motion decides.
    """
    arcs = design(tasks, nominal=True, rules=RULES, starts=1, constant_curvature=True)
    tubes = DesignedTubes(arcs.robot, RULES)
    far, least = Settings(contact_weight=0.0), _rms(arcs.plans)
    assert least > 0.02
    for k, name in enumerate(tubes.names[:2]):
        for factor in (0.97, 1.03):
            p = tubes.nominal_unknowns.copy()
            p[k] *= factor
            if tubes.satisfies_rules(p):
                moved = [replace(task, robot=tubes.robot_of(p)) for task in tasks]
                found = _rms([solve_horizon(task, model="elastic", settings=far) for task in moved])
                assert found > 0.98 * least, name


@pytest.mark.slow
def test_rules_that_bind_are_remarked_with_their_price(tasks, nominal):
    tight = design(tasks, nominal=True, rules=replace(RULES, strain_made=0.008), starts=1)
    assert _rms(tight.plans) > _rms(nominal.plans)
    bound = [remark for remark in tight.remarks if "when made" in remark.rule.name]
    assert bound
    assert bound[0].gain > 0.001
    assert "is at its bound, 0.008; easing the bound by 10 % would lower e3 by" in str(bound[0])


@pytest.mark.slow
def test_fixed_numbers_stay(tasks):
    found = design(tasks[:1], nominal=True, rules=RULES, fixed=["outer_diameter_1"], starts=1)
    assert found.robot.tubes[0].outer_diameter == PAIR.tubes[0].outer_diameter


def test_random_tubes_to_start_from_can_be_made_and_come_again():
    tubes = DesignedTubes(PAIR, RULES)
    first, again = (
        [next(kind) for _ in range(5)] for kind in (generate_start_tubes(tubes, 3), generate_start_tubes(tubes, 3))
    )
    for (name, p), (same, q) in zip(first[1:], again[1:], strict=True):
        assert name == same
        assert tubes.satisfies_rules(p)
        np.testing.assert_array_equal(p, q)
    assert len({tuple(p) for _, p in first}) == 5


@pytest.mark.slow
def test_a_design_for_tolerances_survives_its_draws(tasks):
    found = design(tasks, rules=RULES, starts=2)
    for plan in found.plans:
        assert plan.meta["certificate"]["held"]
        assert plan.robustness(200, 7).lost_count <= 2


def test_a_design_for_tolerances_carries_robust_plans(tolerant):
    assert tolerant.plans[0].meta["formulation"] == "robust-horizon"
    assert tolerant.plans[0].meta["certificate"]["held"]


@pytest.mark.slow
def test_two_processes_find_what_one_alone_finds(tasks):
    """The same work from the same starts: to the last bit."""
    alone, several = (design(tasks[:1], nominal=True, rules=RULES, starts=2, jobs=jobs) for jobs in (1, 2))
    assert alone.robot == several.robot
    assert alone.start_results == several.start_results
    np.testing.assert_array_equal(alone.plans[0].q, several.plans[0].q)


@pytest.mark.parametrize(
    ("kind", "asked"),
    [("nominal", {"nominal": True, "starts": 2}), pytest.param("tolerant", {"starts": 1}, marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_a_cluster_finds_what_one_process_finds(tasks, kind, asked, request):
    pytest.importorskip("distributed", reason="the extra `study` is not installed")
    alone = request.getfixturevalue(kind)
    with local_client(2) as client:
        several = design(tasks[: len(alone.plans)], rules=RULES, jobs=client, **asked)
    assert alone.robot == several.robot
    assert alone.start_results == several.start_results
    np.testing.assert_array_equal(alone.plans[0].q, several.plans[0].q)


def test_problems_of_several_robots_are_refused(tasks):
    with pytest.raises(ProblemError, match="the robot of turn is not that of bend"):
        design([tasks[0], replace(tasks[1], robot=PAIR.with_locked_tilt())], nominal=True)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"starts": 0}, "starts is 0"),
        ({"model": "rigid"}, "model of a design is 'rigid'"),
        ({"fixed": ["wall"]}, "'wall' cannot be fixed"),
    ],
)
def test_bad_input_is_refused(tasks, given, told):
    with pytest.raises(OptionError, match=told):
        design(tasks, nominal=True, rules=RULES, **given)


def test_no_problems_and_equal_names_are_refused(tasks):
    with pytest.raises(ProblemError, match="problems of a design is empty"):
        design([])
    with pytest.raises(ProblemError, match="the same name"):
        design([tasks[0], tasks[0]])


PROGRAM = """
import casadi as ca
from ctr_nlp import Problem, Robot, curve_from_formula, growing

def problem(frames, duration, robot):
    curve = curve_from_formula(lambda u: ({bend} * (1 - ca.cos(u / 40)), 0 * u, u), 0.0, 70.0)
    return Problem("{name}", robot, growing(curve, frames), duration=duration)
"""


def test_the_command_writes_a_robot_plans_and_a_sheet(tmp_path, capsys):
    (tmp_path / "two.toml").write_text(PAIR.to_toml(), encoding="utf-8")
    for name, bend in (("bend", 12), ("other", 15)):
        (tmp_path / f"{name}.py").write_text(PROGRAM.format(name=name, bend=bend), encoding="utf-8")
    out = tmp_path / "out"
    rules = ["--channel", "0.3", "--wall", "0.1", "--outer", "4"]
    asked = ["design", str(tmp_path / "bend.py"), "--hold-out", str(tmp_path / "other.py"), "--nominal"]
    asked += ["--robot", str(tmp_path / "two.toml"), "--frames", "5", "--starts", "1", "--out", str(out), *rules]
    assert main(asked) in (0, 1)
    printed = capsys.readouterr().out
    assert "held out" in printed
    assert f"wrote {out}" in printed
    written = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
    assert written == ["bend.npz", "design.json", "other.npz", "robot.toml", "sheet.pdf", "sheet.svg"]
    robot, plan = Robot.from_toml(out / "robot.toml"), Plan.load(out / "bend.npz")
    np.testing.assert_array_equal(plan.robot.numbers, robot.numbers)
    told = json.loads((out / "design.json").read_text())
    assert [row["problem"] for row in told["problems"]] == ["bend", "other"]
    assert told["problems"][0]["e3"] == pytest.approx(summary(plan)["e3"])
    assert told["problems"][0]["e3"] < told["problems"][0]["e3_before"]


def test_a_folder_stands_for_its_centrelines(tmp_path):
    for name in ("b.csv", "a.csv", "notes.txt"):
        (tmp_path / name).write_text("")
    given = [str(tmp_path), "cos"]
    assert problems.expand_folders(given) == [str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "cos"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(OptionError, match="has no centreline files"):
        problems.expand_folders([str(tmp_path / "empty")])


def test_problems_of_one_name_are_refused_before_anything_is_solved(tmp_path, capsys):
    assert main(["design", "cos", "--hold-out", "cos", "--out", str(tmp_path / "out")]) == 2
    assert "two problems are called cos" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_plans_on_designed_tubes_are_where_equations_say(nominal):
    """The shapes of a model of other make, which shoots, and no snap on the way; as near to a fold as may be."""
    for plan in nominal.plans:
        shot = shooting.followed(shooting.tubes(plan.robot, np.zeros((1, 2, 5))), plan.q, np.linspace(0, 1, 21))
        away = np.linalg.norm(shot.shapes[0] - plan.shape[:, ::5], axis=-1)
        assert shot.snapped[0] == 0
        assert away.max() < 0.01


@pytest.mark.slow
def test_tubes_shaped_like_an_s_are_found_unless_they_are_ruled_out(tasks, nominal):
    one_sided = design(tasks, nominal=True, rules=replace(RULES, one_sided=True), starts=2)
    assert min(tube.root_curvature for tube in nominal.robot.tubes) < 0
    assert min(tube.root_curvature for tube in one_sided.robot.tubes) >= 0
    assert _rms(nominal.plans) < _rms(one_sided.plans)
