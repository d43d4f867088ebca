"""Configurations that a hand may ask for by moving one joint: limits, order and speed are kept."""

from __future__ import annotations

import math

import numpy as np

from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

SLIDER_TURNS = 1.0
"""Whole turns to either side that a slider offers of an angle that has no limits."""


def slide_joint(robot: Robot, q: Array, joint: int, value: float) -> Array:
    """The configuration (2d + 2,) where one joint of q, from 0, is taken to a value, rad or mm, within its limits.

    A tube takes its neighbours along where order or the gap between carriages would not be kept: outer ones do
    not come out further than inner ones. Where those cannot follow, it stops with them.
    """
    found = np.array(q, dtype=float)
    d = robot.d
    found[joint] = value
    found = np.clip(found, robot.lower, robot.upper)
    if d <= joint < 2 * d:
        _enforce_order(robot, found[d : 2 * d], joint - d)
    return found


def _enforce_order(robot: Robot, beta: Array, moved: int) -> None:
    """Let all tubes follow the one that was moved, from 0, and that one follow those that are at their limits."""
    d = robot.d
    growth = robot.max_extension_differences
    low = robot.lower[d : 2 * d]
    high = robot.upper[d : 2 * d]
    least = low.copy()
    most = high.copy()
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
    """Return the configuration to which motors at q (2d + 2,) come in dt s on their way to a goal (2d + 2,), all
    arriving at once.

    Order and carriage gap are kept on the way where both ends keep them, since these are linear.
    """
    away = goal - q
    parts = robot.speed * dt / np.maximum(np.abs(away), 1e-12)
    return np.asarray(q + min(1.0, float(parts.min())) * away)


def slider_ranges(robot: Robot) -> Array:
    """Return the range of each joint's slider, (2d + 2, 2): the joint's limits, those of angles within
    `SLIDER_TURNS` turns to either side.
    """
    ends = np.stack([robot.lower, robot.upper], axis=1)
    angles = np.ones(2 * robot.d + 2, dtype=bool)
    angles[robot.d : 2 * robot.d] = False
    wide = SLIDER_TURNS * 2 * math.pi
    ends[angles] = np.clip(ends[angles], -wide, wide)
    return ends


def retracted_configuration(robot: Robot, path: Array) -> Array:
    """The configuration (2d + 2,) with all tubes as far in as limits allow, turned to where a path bends.

    path (n, 3) mm: from the insertion point. The tubes' curves lie then towards the side on which most of it is.
    """
    aside = path.mean(axis=0)
    q = np.zeros(2 * robot.d + 2)
    q[: robot.d] = math.atan2(aside[1], aside[0])
    q = np.clip(q, robot.lower, robot.upper)
    return slide_joint(robot, q, robot.d, q[robot.d])
