"""A plan of two tubes, robots that differ from its own, and what is needed to lead these through it."""

from dataclasses import replace

import numpy as np
from near_fold import LONG, plan_through

from ctr_nlp import Limits, Tolerances
from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.identify.closed_loop.sensors.points import ShapePointSensor, TipPositionSensor
from ctr_nlp.robot.samples import sample_robots

FRAMES = 40
OFF = Tolerances(0.1, 0.1, motor_zero=0.05)
ROBOT = replace(LONG, limits=Limits(alpha_speed=2.0, beta_speed=30.0, theta_speed=1.0), tolerances=OFF)
SENSORS = Sensors(TipPositionSensor(0.5), ShapePointSensor((1 / 3, 2 / 3), 0.5))


def made_plan():
    """From hardly out to nearly all out, the tubes turned against each other by half a turn less a bit."""
    part = np.linspace(0.05, 0.9, FRAMES)[:, None]
    turned = np.array([1.6, 0.2]) * part
    return plan_through(np.hstack([turned, part * ROBOT.upper[2:4], 0.1 * part, -0.2 * part]), ROBOT)


def robots(count, seed=1, tolerances=OFF):
    return sample_robots(replace(ROBOT, tolerances=tolerances), count, seed)
