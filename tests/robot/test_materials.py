"""Tubes that are not nitinol, and straight tubes: what a robot file may say, and what follows from it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from ctr_nlp import Limits, Robot, Tube, solve_per_frame, table_i_robot
from ctr_nlp.anatomy.problem_files import problem_from_file
from ctr_nlp.exceptions import ProblemError, RobotError
from ctr_nlp.models import KINEMATIC_MODELS

CURVED = Tube(200, 60, 0.02, 2.0, 1.4)


def polymer_file(folder, shared_data, *limits):
    """The printed pair of the shared cases, with these strain limits for its tubes; None for no entry."""
    head, *tubes = (shared_data / "cases/robots/polymer_pair.toml").read_text().split("[[tubes]]")
    entries = ["" if limit is None else f"max_strain = {limit}\n" for limit in limits]
    text = head + "".join(f"[[tubes]]{tube.rstrip()}\n{entry}" for tube, entry in zip(tubes, entries, strict=True))
    (folder / "robot.toml").write_text(text)
    return folder / "robot.toml"


def test_a_printed_pair_is_read_with_its_own_strain_limit(shared_data, tmp_path):
    robot = Robot.from_toml(polymer_file(tmp_path, shared_data, 0.2, 0.2))
    assert [tube.max_strain for tube in robot.tubes] == [0.2, 0.2]
    (tmp_path / "again.toml").write_text(robot.to_toml())
    assert (
        Robot.from_toml(tmp_path / "again.toml")
        == robot
        == Robot.from_dict(json.loads(json.dumps(robot.to_dict())))
    )


def test_without_a_strain_limit_the_message_names_the_entry(shared_data, tmp_path):
    with pytest.raises(
        RobotError, match=r"number 1.*16\.7 %, and nitinol allows 8 %.*another material give max_strain"
    ):
        Robot.from_toml(polymer_file(tmp_path, shared_data, None, None))


def test_a_strain_limit_that_is_exceeded_is_named(shared_data, tmp_path):
    with pytest.raises(RobotError, match=r"16\.7 %, and its max_strain allows 12 %"):
        Robot.from_toml(polymer_file(tmp_path, shared_data, 0.12, None))


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        (17, r"did you mean 0\.17 \(17 %\)"),
        (0, r"must lie in \(0, 0\.5\]"),
        (-0.1, "must lie in"),
        (float("nan"), "max_strain"),
    ],
)
def test_a_strain_limit_in_percent_is_refused(limit, message):
    with pytest.raises(RobotError, match=message):
        dataclasses.replace(CURVED, max_strain=limit)


@pytest.mark.parametrize("seed", range(20))
def test_each_tube_keeps_its_own_strain_limit(seed):
    rng = np.random.default_rng(seed)
    limit, diameter = rng.uniform(0.01, 0.4), rng.uniform(1, 6)
    allowed = 2 * limit / diameter
    if allowed * 1.02 < 0.5:
        with pytest.raises(RobotError, match="its max_strain allows"):
            Tube(200, 60, allowed * 1.01, diameter, 0.5, max_strain=limit)
    Tube(200, 60, min(allowed, 0.5) * 0.99, diameter, 0.5, max_strain=limit)


def test_the_deployed_strain_has_the_limit_of_the_tube():
    outer = Tube(90, 50, 0.0, 4.0, 2.2)
    with pytest.raises(RobotError, match=r"nitinol allows 6 % there.*give max_strain"):
        Robot((outer, Tube(200, 100, 0.075, 2.0, 1.0)))
    Robot((outer, Tube(200, 100, 0.075, 2.0, 1.0, max_strain=0.2)))
    with pytest.raises(RobotError, match=r"tube 2 is strained by 0\.9.* its max_strain allows 0\.5 % there"):
        Robot((dataclasses.replace(outer, curvature=0.014), Tube(200, 100, 0.004, 2.0, 1.0, max_strain=0.005)))


def test_moduli_of_other_materials_are_no_mistake_of_units():
    soft = Tube(90, 50, 0.01, 4.0, 2.4, youngs_modulus=80)
    wire = Tube(200, 60, 0.01, 2.0, 1.4, youngs_modulus=60_000)
    with pytest.raises(RobotError, match=r"GPa.*give the max_strain of the softer one"):
        Robot((soft, wire))
    assert Robot((dataclasses.replace(soft, max_strain=0.2), wire)).d == 2


def test_robots_without_a_strain_limit_are_described_as_before():
    described = table_i_robot().to_dict()
    assert "max_strain" not in described["tubes"][0]
    assert "max_strain" not in table_i_robot().to_toml()


@pytest.mark.parametrize("number", range(3))
def test_a_straight_tube_may_go_to_its_length(number):
    tubes = [Tube(100, 50, 0.01, 4.0, 3.2), Tube(150, 60, 0.012, 3.0, 2.2), Tube(200, 70, 0.015, 2.0, 1.0)]
    tubes[number] = dataclasses.replace(tubes[number], curvature=0, curved_length=0)
    robot = Robot(tuple(tubes))
    expected = [tube.length if tube.is_straight else tube.curved_length for tube in tubes]
    np.testing.assert_array_equal(robot.upper[3:6], expected)
    assert not any(robot.structure.transmission_emerges)
    given = Robot(tuple(tubes), Limits(beta=[(0, tube.curved_length) for tube in tubes]))
    np.testing.assert_array_equal(given.upper[3:6], [tube.curved_length for tube in tubes])


def test_a_stiff_straight_sheath_around_a_strongly_curved_tube_stays_a_robot():
    """Held straight, the inner tube has the strain of its pre-curvature, 7 %, which is allowed."""
    sheath = Tube(150, 0, 0.0, 4.0, 2.2, youngs_modulus=5.0)
    assert Robot((sheath, Tube(300, 100, 0.07, 2.0, 1.0))).max_extensions[0] == 100


@pytest.mark.parametrize("name", ["straight_wire", "rigid_sheath"])
@pytest.mark.parametrize("model", ["elastic", "dominant"])
def test_robots_with_straight_tubes_follow_a_line(name, model, shared_data):
    robot = Robot.from_toml(shared_data / f"cases/robots/{name}.toml")
    problem = problem_from_file(shared_data / "cases/line60.csv", robot, frames=4)
    plan = solve_per_frame(problem, model=model)
    assert plan.complete
    assert plan.verdicts.follows.number < 2
    assert plan.beta[:, [tube.is_straight for tube in robot.tubes]].max() > 20


@pytest.mark.parametrize("seed", range(5))
def test_shapes_with_straight_tubes_are_those_of_sections_that_are_divided(seed):
    """A straight tube has the same shape whichever part of it counts as curved."""
    rng = np.random.default_rng(seed)
    inner, limits = Tube(300, 90, 0.02, 2.0, 1.4), Limits(beta=[(0, 80), (0, 90)])
    whole, none = (Robot((Tube(100, part, 0.0, 4.0, 2.6), inner), limits) for part in (80, 0))
    assert whole.structure == none.structure
    q = np.array([*rng.uniform(-3, 3, 2), *np.sort(rng.uniform(5, 80, 2)), 0, 0])
    for model in ("dominant", "elastic"):
        described = KINEMATIC_MODELS[model]
        shapes = [
            described.points(robot, described.rest(robot, q)[None], np.linspace(0, 1, 9))
            for robot in (whole, none)
        ]
        np.testing.assert_allclose(*shapes, atol=1e-9)


def test_a_path_that_limits_make_too_long_names_them(shared_data):
    robot = Robot.from_toml(shared_data / "cases/robots/straight_wire.toml")
    limited = robot.with_limits(beta=[(0, 30), (0, 30), (0, 40)])
    with pytest.raises(ProblemError, match=r"--trim end.*limits of the robot let beta_3 go to 40 of 200 mm"):
        problem_from_file(shared_data / "cases/line60.csv", limited)
