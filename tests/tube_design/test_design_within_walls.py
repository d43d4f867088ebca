"""Designs within walls: tubes are chosen so that the end is reached, not for the mean error alone."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from truth import TWO

from ctr_nlp import Manufacture, Problem, Robot, Settings, curve_from_points, design, divide_problems, growing
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.paths.curve import curve_from_formula
from ctr_nlp.plan.verdicts import REACHED_VERDICT_NAMES, YES
from ctr_nlp.tube_design.leave_one_out import leave_one_out
from ctr_nlp.tube_design.request import search_for
from ctr_nlp.tube_design.search import SHAPE_ALONE, nominal_scenario

PAIR = Robot(TWO.tubes)
RULES = Manufacture(channel=0.3, wall=0.1, outer=4.0)
FRAMES = 10


def _task(name, bend, radius=None):
    """A bend of 60 mm, within a lumen of a radius where one is given."""
    z = np.linspace(0.0, 60.0, 31)
    points = np.stack([bend * (1 - np.cos(z / 30)), 1e-5 * bend * z**3 / 3, z], axis=-1)
    lumen = None if radius is None else np.full(len(z), radius)
    return Problem(name, PAIR, growing(curve_from_points(points, lumen), FRAMES), duration=5.0)


@pytest.fixture(scope="module")
def task():
    return _task("bend", 14.0, 2.8)


@pytest.fixture(scope="module")
def walled(task):
    return design([task], nominal=True, walls=True, rules=RULES, starts=1)


@pytest.mark.slow
def test_end_is_reached_on_tubes_designed_within_walls(task, walled):
    (plan,) = walled.plans
    assert plan.robot == walled.robot
    nominal = [name for name in REACHED_VERDICT_NAMES if name != "holds"]
    assert [name for name in nominal if getattr(plan.verdicts, name).word != YES] == [], plan.verdicts
    assert plan.clearance.min() > -0.5


@pytest.mark.slow
def test_tubes_designed_within_walls_satisfy_the_rules(walled):
    assert all(rule.lower <= rule.value <= rule.upper for rule in walled.rules)
    assert walled.robot.tubes[0].outer_diameter <= 4.0


@pytest.mark.slow
def test_an_end_is_not_reached_before_samples_were_simulated(walled):
    (plan,) = walled.plans
    assert "holds" in REACHED_VERDICT_NAMES
    assert not plan.verdicts.end_reached
    assert plan.verdicts.holds.word == "NOT CHECKED"


def test_design_within_walls_needs_a_wall():
    bare = _task("bare", 14.0)
    with pytest.raises(ProblemError, match="none is known around bare"):
        design([bare], nominal=True, walls=True, rules=RULES)


@pytest.mark.interpreted
def test_wall_is_measured_from_the_designed_tubes(task):
    """The wall near the robot depends on the tubes' numbers, which are unknowns, not on those of the start."""
    search = search_for([task], "dominant", rules=RULES, walls=True)
    p = search.tubes.nominal_unknowns
    (plan,) = search.shape_alone.plan_on_tubes(p)
    motions = search.shape_alone.motions_of(p, [plan])
    program = search.motion(p, motions.q, nominal_scenario, 0.0)
    given = (
        program.common.factors
        * program.common.program.functions.value(p, program.common.parameters)[1]
        .full()[: program.common.factors.shape[1]]
        .ravel()
    )
    here = program.local_parameters(program.unknowns(motions.q, motions.phi, given))["wall"]
    names = search.tubes.free_number_names
    assert "curvature" in names
    bent = given.copy()
    bent[:, : len(search.tubes.names) - 3 * PAIR.d] *= 1.2
    there = program.local_parameters(program.unknowns(motions.q, motions.phi, bent))["wall"]
    assert here.shape == there.shape
    assert abs(here - there).max() > 0.01
    # The same robot as one that is given, with no unknown numbers.
    assert isinstance(nominal_scenario(PAIR), Scenarios)
    centres = here[0, 0, :, :3]
    lumen = task.sampled_lumen.table[:, :3]
    apart = np.linalg.norm(centres[:, None] - lumen[None], axis=-1).min(axis=1)
    assert apart.max() < 0.5


@pytest.mark.interpreted
def test_errors_count_contact_within_walls_alone(task):
    walled = search_for([task], "dominant", rules=RULES, walls=True)
    free = walled.shape_alone
    assert free.priorities == SHAPE_ALONE
    p = walled.tubes.nominal_unknowns
    plans = free.plan_on_tubes(p)
    assert walled.motions_of(p, plans).rms > free.motions_of(p, plans).rms


@pytest.mark.slow
def test_ends_hold_on_built_robots_after_a_design_for_tolerances(task):
    found = design([task], walls=True, rules=RULES, starts=2)
    (plan,) = found.plans
    again = plan.with_samples(200, seed=5)
    assert again.verdicts.end_reached, again.verdicts


@pytest.mark.slow
def test_groups_within_walls_come_with_their_tubes():
    tasks = [replace(_task(f"bend {bend:g}", bend, 3.0), robot=PAIR) for bend in (6.0, 14.0)]
    groups = divide_problems(tasks, 2, rules=RULES, walls=True)
    assert sorted(task.name for group in groups for task in group) == ["bend 14", "bend 6"]
    assert all(task.robot != PAIR for group in groups for task in group)


def test_leave_one_out_needs_two_anatomies(task):
    with pytest.raises(OptionError, match="at least two anatomies; there is 1"):
        leave_one_out([[task]], 1)


@pytest.mark.slow
def test_an_alike_anatomy_is_reached_by_robots_for_the_others():
    anatomies = [[_task("one", 10.0, 3.0)], [_task("two", 11.0, 3.0)]]
    found = leave_one_out(anatomies, 1, nominal=True, rules=RULES, settings=Settings())
    assert [(end.anatomy, end.name) for end in found] == [(0, "one"), (1, "two")]
    assert all(end.choice.reaches for end in found)


def test_leave_one_out_command_needs_walls(tmp_path, capsys):
    curve = curve_from_formula(lambda u: (0.0, 10 * (1 - ca.cos(u / 40)), u), 0.0, 60.0)
    table = tmp_path / "path.csv"
    np.savetxt(
        table, curve.point(np.linspace(0, curve.length, 20)), delimiter=",", header="x_mm,y_mm,z_mm", comments=""
    )
    assert main(["design", str(table), "--leave-one-out", "--out", str(tmp_path / "out")]) == 2
    assert "--leave-one-out goes with --walls" in capsys.readouterr().err
    asked = ["design", str(table), "--branches", "1", "2", "--branch", "1", "--out", str(tmp_path / "out")]
    assert main(asked) == 2
    assert "--branches does not go with --branch" in capsys.readouterr().err
