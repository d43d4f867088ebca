"""The rest of a motion planned anew while the robot moves: nearer to the target, safe, and never too late."""

from dataclasses import replace

import numpy as np
import pytest
from loops_of import OFF, ROBOT, SENSORS, made_plan, robots
from near_fold import plan_through

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.feed import Feed
from ctr_nlp.identify.closed_loop.parameter_differences import ParameterDifferences
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.replanning.replanner import Replanner, problem_of
from ctr_nlp.identify.closed_loop.replanning.replanning import REPLANNING_LEAD_S, Replanning
from ctr_nlp.identify.closed_loop.runs import closed_loop
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.robot.tolerances import DEVIATION_NAMES

DRAWS = 3


@pytest.fixture(scope="module")
def plan():
    return made_plan()


def led(plan, k, replanning=None):
    plant = Plant(ROBOT, robots(DRAWS)[k : k + 1])
    return closed_loop(plan, plant, Feed(plant, SENSORS, k), Tracker(plan, SENSORS, OFF), replanning)


def remaining(run, plan):
    """Root mean square over frames of e2 where replanning may have led, mm."""
    return float(np.sqrt((run.e2[plan.time >= 2 * REPLANNING_LEAD_S + plan.dt] ** 2).mean()))


@pytest.fixture(scope="module")
def runs(plan):
    """Of every draw along its plan, and planned anew; the target is straight, and the plan far from it."""
    replanner = Replanner(plan)
    return [(led(plan, k), led(plan, k, Replanning(replanner, plan.time))) for k in range(DRAWS)]


def test_what_is_planned_anew_comes_nearer_to_the_target_and_is_safe(runs, plan):
    for kept, anew in runs:
        assert any(each.adopted_plan for each in anew.replannings)
        assert remaining(anew, plan) < 0.9 * remaining(kept, plan)
        assert not anew.first_failed_frame
        assert not anew.first_snap_frame
        assert not anew.stopped


def test_it_keeps_limits_where_one_way_leads_into_another(runs, plan):
    for _, run in runs:
        assert (abs(np.diff(run.q, axis=0)) <= ROBOT.speed * plan.dt + 1e-9).all()
        assert (run.q >= ROBOT.lower - 1e-9).all()
        assert (run.q <= ROBOT.upper + 1e-9).all()
        assert (np.diff(run.q[:, 2:4], axis=1) >= -1e-9).all()


def test_nothing_changes_before_it_may(runs, plan):
    for kept, anew in runs:
        first = min(each.first for each in anew.replannings if each.adopted_plan)
        assert plan.time[first - 1] >= 2 * REPLANNING_LEAD_S
        np.testing.assert_array_equal(anew.q[: first - 1], kept.q[: first - 1])


def test_a_robot_as_it_is_estimated_has_its_numbers_and_doubts():
    differences = ParameterDifferences.of(ROBOT, OFF)
    values = np.linspace(-0.04, 0.05, len(differences))
    found = differences.robot_at(values, differences.covariance)
    np.testing.assert_allclose(found.numbers, differences.numbers(values), rtol=1e-12)
    doubts = found.tolerances.covariance_root(found.tubes) @ found.tolerances.covariance_root(found.tubes).T
    for k, (tube, name) in enumerate(differences.entries):
        own = doubts[
            tube * len(DEVIATION_NAMES) + DEVIATION_NAMES.index(name),
            tube * len(DEVIATION_NAMES) + DEVIATION_NAMES.index(name),
        ]
        scale = 1.0 if name == "motor_zero" else 1 + values[k]
        assert own == pytest.approx(differences.covariance[k, k] / scale**2)


def test_limits_of_tubes_are_those_of_motors_beside_their_zeros():
    limited = replace(ROBOT, limits=replace(ROBOT.limits, alpha=(-1.0, 2.0)))
    differences = ParameterDifferences.of(limited, OFF)
    values = np.full(len(differences), 0.03)
    found = differences.robot_at(values, differences.covariance)
    np.testing.assert_allclose(found.lower[:2], [-0.97, -0.97])
    np.testing.assert_allclose(found.upper[:2], [2.03, 2.03])


def test_the_problem_of_a_plan_is_what_it_follows(plan):
    found = problem_of(plan, 10)
    assert found.frames == len(plan.time) - 10
    assert found.dt == pytest.approx(plan.dt)
    for frame, points in zip(found.target_frames, plan.target[10:], strict=True):
        np.testing.assert_allclose(frame.points, points, atol=1e-3)


def test_a_target_that_is_shorter_than_a_path_may_be_is_followed_too(plan):
    short = plan_through(np.repeat(plan.q, 10, axis=0), ROBOT)[:4]
    found = problem_of(short)
    assert max(found.target.lengths) < 1.0
    for frame, points in zip(found.target_frames, short.target, strict=True):
        np.testing.assert_allclose(frame.points, points, atol=1e-3)


def test_plans_on_a_model_without_equilibria_to_lose_are_refused(plan):
    with pytest.raises(OptionError, match="dominant; re-planning needs the elastic model without a load"):
        Replanner(plan.evaluate_on("dominant"))
