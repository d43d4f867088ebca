"""Plants: the drawn robots, step by step, with what motors and bodies do besides."""

import numpy as np
import pytest
from loops_of import ROBOT, made_plan, robots
from near_fold import LONG, near_the_fold, plan_through

from ctr_nlp import Tolerances
from ctr_nlp.exceptions import RobotError
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.plan.backlash import BacklashAndDrag
from ctr_nlp.plan.sample_motions import simulate_samples
from ctr_nlp.robot.samples import perturb_robot


@pytest.fixture(scope="module")
def plan():
    return made_plan()


def led(plant, plan):
    return np.array([plant.move_to(q, t).shape for q, t in zip(plan.q, plan.time, strict=True)])


def test_a_plant_is_a_draw_moved_open_loop(plan):
    draws = robots(3, tolerances=Tolerances(0.1, 0.1, motor_zero=0.05, rotation_lag=0.1))
    found = simulate_samples(ROBOT, draws, plan.q, "elastic")
    for k in range(3):
        assert led(Plant(ROBOT, draws[k : k + 1]), plan) == pytest.approx(found.shape[k], abs=5e-3)


def test_the_same_calls_give_the_same_motion(plan):
    draw = robots(1)
    first, second = (led(Plant(ROBOT, draw, steps=0.01), plan) for _ in range(2))
    assert (first == second).all()


def test_motors_stop_at_their_steps(plan):
    plant = Plant(ROBOT, robots(1), steps=[0.1, 0.1, 1.0, 1.0, 0.0, 0.0])
    moved = plant.move_to(plan.q[20], 0.0)
    assert moved.q[:2] / 0.1 == pytest.approx(np.round(moved.q[:2] / 0.1), abs=1e-9)
    assert moved.q[2:4] == pytest.approx(np.round(plan.q[20, 2:4]))
    assert (moved.q[4:] == plan.q[20, 4:]).all()


def test_bending_that_no_model_knows_grows_with_the_square_of_length(plan):
    draw = robots(1)
    straight, bent = Plant(ROBOT, draw), Plant(ROBOT, draw, bending=(2.0, -1.0))
    shapes = [plant.move_to(plan.q[-1], 0.0).shape for plant in (straight, bent)]
    off, out = shapes[1] - shapes[0], (plan.q[-1, 3] / ROBOT.reach) ** 2
    assert off[-1] == pytest.approx(np.array([2.0, -1.0, 0.0]) * out)
    assert off[50] == pytest.approx(off[-1] / 4)


def test_a_snap_is_seen_in_the_frame_on_the_way_to_which_it_is():
    plan = plan_through(near_the_fold())
    plant = Plant(LONG, perturb_robot(LONG, np.zeros((1, 2, 5)), np.zeros((1, 2))))
    led(plant, plan)
    assert not plant.has_snapped
    beyond = plan.q[-1].copy()
    beyond[0] += 0.4
    assert plant.move_to(beyond, 99.0).jumps
    assert plant.has_snapped


def test_sensors_see_what_the_shape_shows(plan):
    plant = Plant(ROBOT, robots(1))
    shape = plant.move_to(plan.q[20], 0.0).shape
    seen = plant.sample_shape(np.array([0.25, 1.0]))
    assert seen.points == pytest.approx(shape[[25, 100]])
    assert seen.length == plan.q[20, 3]


def test_a_plant_is_one_robot():
    with pytest.raises(RobotError, match="one robot; sample has 2"):
        Plant(ROBOT, robots(2))


def test_motors_that_make_up_for_a_growing_lag_lead_the_plant_along_the_plan(plan):
    """A lag that grows with the overlap of the tubes, as a calibration finds it."""
    lag = BacklashAndDrag([0.05, 0.1], [0.0, 0.001])
    draw = perturb_robot(ROBOT, np.zeros((1, 2, 5)), np.zeros((1, 2)))
    wanted = led(Plant(ROBOT, draw), plan)
    away = []
    for motors in (plan.q, lag.compensate_motion(ROBOT, plan.q, plan.time)):
        plant = Plant(ROBOT, draw, lag=lag)
        shapes = np.array([plant.move_to(q, t).shape for q, t in zip(motors, plan.time, strict=True)])
        away.append(np.linalg.norm(shapes - wanted, axis=2).max())
    assert away[0] > 0.5
    assert away[1] < 0.01


def test_a_plant_lags_as_tubes_of_its_lag(plan):
    lag = BacklashAndDrag([0.02, 0.1], [0.0005, 0.001], [0.1, 0.0])
    plant = Plant(ROBOT, perturb_robot(ROBOT, np.zeros((1, 2, 5)), np.zeros((1, 2))), lag=lag)
    found = [plant.move_to(q, t) for q, t in zip(plan.q, plan.time, strict=True)][-1]
    there = lag.apply_to_motion(ROBOT, plan.q, plan.time)[-1]
    same = Plant(ROBOT, perturb_robot(ROBOT, np.zeros((1, 2, 5)), np.zeros((1, 2)))).move_to(there, 0.0)
    assert found.shape == pytest.approx(same.shape, abs=0.05)
    with pytest.raises(RobotError, match="play of a lag has 3 numbers"):
        Plant(ROBOT, robots(1), lag=BacklashAndDrag(np.zeros(3)))
