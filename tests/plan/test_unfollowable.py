"""Paths that no such robot follows: a tip that reaches the end across a detour has not arrived."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import solve_per_frame
from ctr_nlp.anatomy.problem_files import problem_from_file
from ctr_nlp.plan.measures import describe_shortcut
from ctr_nlp.plan.verdicts import NO, YES
from ctr_nlp.problems import named_problem
from ctr_nlp.view.exchange.configurations import plan_through

OUT = np.array([0.0, 0.3, 0.1, 30, 70, 110, 0, 0])
SAMPLES = np.linspace(0, 1, 101)[:, None]


def plan_to(detour):
    """The plan of a robot that stands in one configuration, whose target ends at its tip after a detour.

    detour: function that maps points (101, 3) of the robot's shape to those of the target.
    """
    own = plan_through(named_problem("arc", frames=2), np.tile(OUT, (2, 1)))
    target = np.asarray(detour(own.shape[-1]))
    step = np.diff(target, axis=0)[-1]
    direction = np.tile(step / np.linalg.norm(step), (2, 1))
    return replace(own, target=np.tile(target, (2, 1, 1)), target_direction=direction)


def test_a_robot_on_its_path_arrives():
    plan = plan_to(lambda shape: shape)
    assert describe_shortcut(plan, 2.0) is None
    assert plan.verdicts.arrives.word == YES


@pytest.mark.parametrize("seed", range(10))
def test_a_tip_that_arrives_across_a_detour_has_not_arrived(seed):
    rng = np.random.default_rng(seed)
    side = rng.normal(size=3)
    side *= rng.uniform(40, 120) / np.linalg.norm(side)
    turns = rng.integers(1, 4)
    plan = plan_to(lambda shape: shape + np.sin(np.pi * turns * SAMPLES) * side)
    assert describe_shortcut(plan, 2.0)
    assert describe_shortcut(plan, 1000.0) is None
    assert plan.verdicts.arrives.word == plan.verdicts.follows.word == NO
    assert "along the path" in plan.verdicts.arrives.why


def test_simulated_robots_do_not_arrive_across_a_detour_either():
    plan = plan_to(lambda shape: shape + np.sin(np.pi * SAMPLES) * [80.0, 0, 0])
    holds = plan.with_samples(3).verdicts.holds
    assert holds.word == NO
    assert "3 do not arrive along the path" in holds.why


def test_a_tip_that_points_backwards_has_not_arrived():
    plan = plan_to(lambda shape: shape)
    backwards = replace(plan, target_direction=-plan.target_direction)
    assert backwards.verdicts.arrives.word == NO
    assert "180° away" in backwards.verdicts.arrives.why


@pytest.mark.parametrize("model", ["elastic", "dominant"])
def test_no_verdict_says_yes_to_a_u_turn(model, shared_data):
    problem = problem_from_file(shared_data / "cases/uturn.csv", frames=2)
    plan = solve_per_frame(problem, model=model).evaluate_on("elastic").with_samples(3)
    assert YES not in {plan.verdicts.arrives.word, plan.verdicts.follows.word, plan.verdicts.holds.word}
