"""Configurations for joints that are moved by hand: limits, order and speeds of the robot are kept.

Extensions beta obey low_i <= beta_i <= high_i and 0 <= beta_{i+1} - beta_i <= g_i, with g_i from the gap between
carriages (infinite without one).
"""

from __future__ import annotations

import math

import numpy as np

from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

SLIDER_TURNS = 1.0
"""Whole turns to either side that a slider offers for an angle without limits."""


def slide_joint(robot: Robot, q: Array, joint: int, value: float) -> Array:
    """Return the configuration (2d + 2,) in which one joint of q has been taken to a value, within the robot's
    limits.

    robot: whose limits count. q (2d + 2,): rad and mm. joint: index in q. value: rad or mm. A tube takes its
    neighbours along where order or the gap between carriages would be violated: outer ones do not come out further
    than inner ones. Where those cannot follow, it stops with them.
    """
    found = np.array(q, dtype=float)
    d = robot.d
    found[joint] = value
    found = np.clip(found, robot.lower, robot.upper)
    if d <= joint < 2 * d:
        _enforce_order(robot, found[d : 2 * d], joint - d)
    return found


def _enforce_order(robot: Robot, beta: Array, moved: int) -> None:
    """Move all of beta (d,), mm, in place with tube `moved`, from 0, which stops where others are at their
    limits.
    """
    d = robot.d
    growth = robot.max_extension_differences
    low = robot.lower[d : 2 * d]
    high = robot.upper[d : 2 * d]
    least = low.copy()
    most = high.copy()
    # Both sweeps narrow each tube's limits by those of its neighbours (bound propagation along a chain). Then
    # every value within least_i, most_i can be completed by values of all other tubes.
    for i in range(1, d):
        least[i] = max(least[i], least[i - 1])
        most[i] = min(most[i], most[i - 1] + growth[i - 1])
    for i in range(d - 2, -1, -1):
        least[i] = max(least[i], least[i + 1] - growth[i])
        most[i] = min(most[i], most[i + 1])
    beta[moved] = min(max(beta[moved], least[moved]), most[moved])
    for i in range(moved + 1, d):
        beta[i] = min(max(beta[i], beta[i - 1], least[i]), beta[i - 1] + growth[i - 1], most[i])
    for i in range(moved - 1, -1, -1):
        beta[i] = max(min(beta[i], beta[i + 1], most[i]), beta[i + 1] - growth[i], least[i])


def step_towards(robot: Robot, q: Array, goal: Array, dt: float) -> Array:
    """Return the configuration (2d + 2,) that motors reach in one step towards a goal, all arriving together.

    robot: with the motors' speeds. q, goal (2d + 2,): present and wanted configuration. dt: time of the step, s.
    Order and carriage gap are kept on the way where both ends keep them, since these are linear.
    """
    away = goal - q
    parts = robot.speed * dt / np.maximum(np.abs(away), 1e-12)
    return np.asarray(q + min(1.0, float(parts.min())) * away)


def slider_ranges(robot: Robot) -> Array:
    """Return the range (2d + 2, 2) of each joint's slider: the limits of `robot`, of angles within SLIDER_TURNS
    turns.
    """
    ends = np.stack([robot.lower, robot.upper], axis=1)
    angles = np.ones(2 * robot.d + 2, dtype=bool)
    angles[robot.d : 2 * robot.d] = False
    wide = SLIDER_TURNS * 2 * math.pi
    ends[angles] = np.clip(ends[angles], -wide, wide)
    return ends


def retracted_configuration(robot: Robot, path: Array) -> Array:
    """Return the configuration (2d + 2,) with all tubes as far in as limits allow, turned to where a path bends.

    robot: whose limits count. path (n, 3) mm: from the insertion point; the tubes bend towards the side on which
    most of it lies.
    """
    aside = path.mean(axis=0)
    q = np.zeros(2 * robot.d + 2)
    q[: robot.d] = math.atan2(aside[1], aside[0])
    q = np.clip(q, robot.lower, robot.upper)
    return slide_joint(robot, q, robot.d, q[robot.d])
