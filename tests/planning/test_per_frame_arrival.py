"""Plans frame by frame, and steps of a Steerer, that lead the tip to the target's end within a lumen."""

import math
from pathlib import Path

import numpy as np
import pytest

from ctr_nlp import Robot, Settings, Steerer, solve_per_frame
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.simulation import simulate_motion
from ctr_nlp.problems import named_problem

EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES = 40
FOLLOWING_ALONE = Settings(arrival_weight=0.0)


@pytest.fixture(scope="module")
def problem():
    return named_problem("bronchus", FRAMES, robot=Robot.from_toml(EXAMPLES / "bronchus_tubes.toml"))


@pytest.fixture(scope="module")
def plan(problem):
    return solve_per_frame(problem, direction="forward")


def test_plans_frame_by_frame_arrive_within_the_wall(problem, plan):
    before = solve_per_frame(problem, direction="forward", settings=FOLLOWING_ALONE)
    assert plan.success.all()
    assert plan.verdicts.arrives.word == "yes"
    assert plan.verdicts.arrives.number < 0.5
    assert plan.verdicts.within_wall.word == "yes"
    assert before.verdicts.arrives.number > 2 * plan.verdicts.arrives.number


def last_tip(problem, q):
    """The robot moved through q (T, 2d + 2): distance in mm of its last tip from the target's end."""
    shape = simulate_motion(problem.robot, q, "elastic").shape
    return float(np.linalg.norm(shape[-1, -1] - problem.target_frames[-1].points[-1]))


@pytest.mark.parametrize("walled", [True, False])
def test_steps_that_know_how_much_has_passed_lead_the_tip_to_the_end(problem, plan, walled):
    missed = []
    for known in (True, False):
        lumen = problem.lumen if walled else None
        steerer = Steerer(problem.robot, plan.q[0], problem.dt, lumen=lumen)
        motion = [
            steerer.step(frame.points, frame.motion_fraction if known else 0.0)
            for frame in problem.target_frames
        ]  # fmt: skip
        missed.append(last_tip(problem, np.array(motion)))
    arrived, followed = missed
    assert arrived < 0.5
    assert followed > 2 * arrived


@pytest.mark.parametrize("part", [-0.1, 1.1, math.nan])
def test_a_part_that_is_none_is_refused_and_changes_nothing(problem, plan, part):
    steerer = Steerer(problem.robot, plan.q[0], problem.dt)
    before = steerer.q
    with pytest.raises(OptionError, match=r"part of a motion is .*; it must be a number from 0 to 1"):
        steerer.step(problem.target_frames[0].points, part)
    np.testing.assert_array_equal(steerer.q, before)
