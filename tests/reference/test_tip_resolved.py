"""Tip steering with its redundancy resolved: the tip goes where it is asked, and the null space does the rest."""

import numpy as np
import pytest
from common import named_problem
from reference import reference_frames
from reference.tip_resolved import TipSteering

from ctr_nlp import Robot, Settings, Tube, table_i_robot
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.planning.per_frame import march

pytestmark = pytest.mark.interpreted
ROBOT, ELASTIC = table_i_robot(), KINEMATIC_MODELS["elastic"]


def tip(x):
    """Of the robot at unknowns x, by the model itself."""
    return ELASTIC.points(ROBOT, x[None], np.ones(1))[0, 0]


def standing(alpha=(0.4, -0.5, 0.3), beta=(25.0, 60.0, 100.0)):
    return ELASTIC.rest(ROBOT, np.array([*alpha, *beta, 0.1, -0.1]))


def steered(steering, x, goal, steps):
    for _ in range(steps):
        x, *_ = steering.step(x, goal)
    return x


def test_the_tip_goes_to_where_another_configuration_had_it():
    goal = tip(standing((0.9, -0.2, 0.6), (28.0, 66.0, 104.0)))
    x = steered(TipSteering(ROBOT), standing(), goal, 60)
    assert np.linalg.norm(tip(x) - goal) < 1e-3
    q = ELASTIC.configuration(ROBOT, x[None])[0]
    ROBOT.check(q)


def test_a_motor_at_its_limit_stays_there_and_the_others_do_its_work():
    """The inner tube is out as far as it goes, and the tip is asked to go further along."""
    beta = (20.0, 60.0, ROBOT.upper[5])
    x = standing((0.8, -0.9, 0.0), beta)
    ahead = tip(x) + 2.0 * ELASTIC.tangents(ROBOT, x[None], np.ones(1))[0, 0]
    new = steered(TipSteering(ROBOT), x, ahead, 60)
    q = ELASTIC.configuration(ROBOT, new[None])[0]
    ROBOT.check(q)
    assert np.linalg.norm(tip(new) - ahead) < 0.05
    assert q[5] > ROBOT.upper[5] - 1.0


def test_near_the_snap_the_null_space_leads_away_from_it_while_the_tip_stays():
    x = ELASTIC.rest(ROBOT, np.array([3.1, 0.0, 0.0, 40.0, 90.0, 140.0, 0.0, 0.0]))
    before = ELASTIC.margins(ROBOT, x[None])[0]
    assert before < 0.3
    goal = tip(x)
    new = steered(TipSteering(ROBOT), x, goal, 200)
    assert np.linalg.norm(tip(new) - goal) < 0.02
    assert ELASTIC.margins(ROBOT, new[None])[0] > before + 0.3


def test_a_lone_tube_cannot_snap_and_its_tip_is_steered_too():
    lone = Robot((Tube(150, 100, 0.01, 2.0, 1.0),))
    steering = TipSteering(lone)
    x = ELASTIC.rest(lone, np.array([0.3, 50.0, 0.0, 0.0]))
    goal = ELASTIC.points(lone, np.array([[0.6, 60.0, 0.1, -0.1]]), np.ones(1))[0, 0]
    for _ in range(60):
        x, distance, _ = steering.step(x, goal)
    assert distance < 1e-3


def test_a_plan_tells_the_model_that_it_was_made_on():
    problem = named_problem("arc", 6)
    plan = march(problem, reference_frames(problem, "tip-resolved", Settings()), "forward")
    assert plan.meta["model"] == "elastic"
    reached = plan.success
    assert reached[:4].all()
    ends = np.array([sample.points[-1] for sample in problem.target_frames])
    assert np.linalg.norm(plan.shape[reached, -1] - ends[reached], axis=1).max() < 0.05
