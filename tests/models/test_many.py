"""Thousands of equilibria of robots whose tubes differ, against the same found one by one, without a compiler."""

from __future__ import annotations

import numpy as np
import pytest
import truth
from frames import configuration

from ctr_nlp import Limits, Robot, Tube, table_i_robot
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.models.elastic import stability
from ctr_nlp.models.elastic.equilibria import Equilibria, EquilibriumState
from ctr_nlp.models.elastic.following import solve_rest_unknowns
from ctr_nlp.paths.target import SIGMA_GRID

COMPARED = 8


def draws(d, count):
    """Robots of one structure and a configuration of each, many of them near a snap."""
    generator = np.random.default_rng(d)
    outer, robots, q = 2 - 0.4 * np.arange(d), [], np.zeros((count, 2 * d + 2))
    for row in q:
        curved = np.cumsum(generator.uniform(15, 45, d))
        lengths = np.maximum.accumulate(curved + generator.uniform(0, 60, d))
        curvatures = generator.uniform(0.003, 0.03, d)
        parts = zip(lengths, curved, curvatures, outer, outer - 0.2, strict=True)
        robots.append(Robot(tuple(Tube(*part) for part in parts), Limits()))
        row[:d] = generator.uniform(-np.pi, np.pi, d)
        row[d : 2 * d] = np.maximum.accumulate(generator.uniform(0.3, 1, d) * curved)
    return robots, q


def at_rest(structure, numbers, q):
    """Unknowns and margins of robots at rest, in one call."""
    found = KINEMATIC_MODELS["elastic"].rest_batch(structure, numbers, q, np.ones(1))
    return found.x, found.margins


def _holds(d, count, monkeypatch):
    robots, q = draws(d, count)
    x, margins = at_rest(robots[0].structure, np.array([robot.numbers for robot in robots]), q)
    found = np.vstack([configuration(robot, row[None]) for robot, row in zip(robots, x, strict=True)])
    np.testing.assert_allclose(found, q, atol=1e-9)
    assert margins.min() > 0
    near = [*np.argsort(margins)[: COMPARED // 2], *range(COMPARED // 2)]
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    for row in near:
        np.testing.assert_allclose(solve_rest_unknowns(robots[row], q[row]), x[row], atol=1e-9)
        (margin,) = stability.margins(robots[row].tube_numbers, x[row][None])
        assert margins[row] == pytest.approx(margin, abs=1e-8)


@pytest.mark.parametrize("d", [2, 3])
def test_robots_that_differ_settle_together_as_alone(d, monkeypatch):
    _holds(d, 200, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3, 4])
def test_ten_thousand_robots_that_differ_all_settle(d, monkeypatch):
    _holds(d, 10_000, monkeypatch)


def test_without_a_compiler_the_same_are_found(monkeypatch):
    robots, q = draws(2, 5)
    numbers = np.array([robot.numbers for robot in robots])
    q[3] = np.nan
    fast = at_rest(robots[0].structure, numbers, q)
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    slow = at_rest(robots[0].structure, numbers, q)
    for one, other in zip(fast, slow, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)
        assert np.isnan(one[3]).all()


@pytest.mark.parametrize("count", [40, pytest.param(3000, marks=pytest.mark.slow)])
def test_falls_without_a_compiler_end_where_those_in_c_do(count, monkeypatch):
    """Of the paper's robot, whose branches end under every seventh of these configurations."""
    robot, rng = table_i_robot(), np.random.default_rng(5)
    q = np.zeros((count, 8))
    q[:, :3] = rng.uniform(-np.pi, np.pi, (count, 3))
    q[:, 3:6] = np.sort(rng.random((count, 3)), axis=1) * robot.upper[3:6]
    falls = list[EquilibriumState]()
    fallen = Equilibria._fall_off_branch
    numbers = np.repeat(robot.numbers[None], count, axis=0)
    fast, margins = at_rest(robot.structure, numbers, q)
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    monkeypatch.setattr(Equilibria, "_fall_off_branch", lambda *given: falls.append(given[1]) or fallen(*given))
    slow, others = at_rest(robot.structure, numbers, q)
    assert len(falls) > 2
    np.testing.assert_allclose(fast, slow, atol=1e-8)
    np.testing.assert_allclose(margins, others, atol=1e-8)


def test_the_base_to_tip_shooting_of_the_tests_finds_the_same():
    shot = truth.shot("two tubes, both within their curved parts")
    x, margins = at_rest(shot.robot.structure, shot.robot.numbers[None], shot.q[None])
    assert margins[0] == pytest.approx(shot.margin(), abs=0.001)
    np.testing.assert_allclose(configuration(shot.robot, x)[0], shot.q, atol=1e-9)


def test_a_robot_at_rest_in_many_poses_is_the_same_without_a_compiler(monkeypatch):
    robot, (_, q) = table_i_robot(), draws(3, 12)
    q[:, 3:6] *= np.minimum(1, robot.upper[3:6] / q[:, 3:6])
    q[:, -2:] = np.linspace(-0.4, 0.4, 24).reshape(12, 2)
    q[-1] = np.nan
    fast = KINEMATIC_MODELS["elastic"].rest_states(robot, q, SIGMA_GRID)
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    slow = KINEMATIC_MODELS["elastic"].rest_states(robot, q[:-1], SIGMA_GRID)
    for one, other in zip(fast, slow, strict=True):
        np.testing.assert_allclose(one[:-1], other, atol=1e-8)
        assert np.isnan(one[-1]).all()


def test_poses_in_one_call_are_found_as_alone():
    """More than fit side by side or into one piece of memory, some of which make the robot fall, some unknown."""
    robot, rng = table_i_robot(), np.random.default_rng(3)
    q = np.zeros((600, 8))
    q[:, :3] = rng.uniform(-2 * np.pi, 2 * np.pi, (600, 3))
    q[:, 3:6] = np.sort(rng.random((600, 3)), axis=1) * robot.upper[3:6]
    q[::50, 0] = np.nan
    together = KINEMATIC_MODELS["elastic"].rest_states(robot, q, SIGMA_GRID)
    alone = [KINEMATIC_MODELS["elastic"].rest_states(robot, row[None], SIGMA_GRID) for row in q]
    for one, others in zip(together, zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(one, np.concatenate(others), atol=1e-9)
        assert (np.isnan(one).reshape(600, -1).all(axis=1) == np.isnan(q[:, 0])).all()
