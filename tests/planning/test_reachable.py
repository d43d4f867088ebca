"""Shapes that a robot can take are found again: by the paper's robot and by random ones of two to five tubes."""

import numpy as np
import pytest
from strategies import drawn

from ctr_nlp import Problem, growing, shape_curve, solve_per_frame, summary, table_i_robot

NEAR = 0.01
"""mm: e3 of a shape that was found again."""


def errors(robots, seed):
    """e3 (n,) in mm of one frame each, whose target is the robot's shape somewhere within its limits."""
    rng, found = np.random.default_rng(seed), list[float]()
    for robot in robots:
        d, q = robot.d, np.zeros(2 * robot.d + 2)
        q[:d] = rng.uniform(-np.pi, np.pi, d)
        beta = np.sort(rng.uniform(0.1, 1, d)) * robot.upper[d : 2 * d]
        q[d : 2 * d] = np.clip(np.maximum.accumulate(beta), robot.lower[d : 2 * d], robot.upper[d : 2 * d])
        q[-2:] = rng.uniform(-0.2, 0.2, 2)
        plan = solve_per_frame(Problem("reachable", robot, growing(shape_curve(robot, q), 1)), model="dominant")
        assert plan.complete
        found.append(summary(plan)["e3"])
    return np.array(found)


@pytest.mark.parametrize("count", [10, pytest.param(300, marks=pytest.mark.slow)])
def test_reachable_targets_are_found(count):
    found = errors([table_i_robot()] * count, 1)
    assert found.max() < 0.5
    assert np.mean(found < NEAR) >= 0.98


@pytest.mark.parametrize(
    ("d", "count", "part"),
    [
        (2, 10, 1.0),
        (3, 10, 1.0),
        pytest.param(2, 50, 1.0, marks=pytest.mark.slow),
        pytest.param(3, 50, 0.98, marks=pytest.mark.slow),
        pytest.param(4, 50, 0.9, marks=pytest.mark.slow),
        pytest.param(5, 50, 0.75, marks=pytest.mark.slow),
    ],
)
def test_reachable_targets_of_random_robots_are_found(d, count, part):
    rng = np.random.default_rng(10 + d)
    found = errors([drawn(rng, d) for _ in range(count)], d)
    assert found.max() < 0.5
    assert np.mean(found < NEAR) >= part
