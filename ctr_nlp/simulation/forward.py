"""Numeric shapes of a robot on any model, and a shape as a curve to follow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.models import Model, Snap, model_named
from ctr_nlp.models.dominant import Dominant, shape
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import configuration
from ctr_nlp.support.values import floats, instance
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array

DOMINANT = Dominant()


def shapes(robot: Robot, q: Array, sigma: Array = SIGMA) -> Array:
    """Points (T, n, 3) in mm of the dominant model at q (T, 2d + 2) and sigma (n,) or (T, n).

    Raises RobotError, and OptionError where that model does not describe the robot.
    """
    q = _checked(robot, q)
    DOMINANT.check(robot)
    return DOMINANT.points(robot, q, sigma)


def tangents(robot: Robot, q: Array, sigma: Array = SIGMA) -> Array:
    """Unit tangents (T, n, 3) of the dominant model at q (T, 2d + 2) and sigma (n,)."""
    q = _checked(robot, q)
    DOMINANT.check(robot)
    return DOMINANT.tangents(robot, q, sigma)


class Simulation(NamedTuple):
    """A robot moved through configurations q (T, 2d + 2), as it would really be.

    shape (T, 101, 3) mm at uniform sigma; tip_direction (T, 3); stability, stability_between (T,): margins, NaN
    where nothing can be unstable; x (T, 2d + 2): the unknowns of its equilibria; snaps: where it leaves one for
    another.
    """

    shape: Array
    tip_direction: Array
    stability: Array
    stability_between: Array
    x: Array
    snaps: tuple[Snap, ...]


def simulated(robot: Robot, q: Array, model: str | Model) -> Simulation:
    """The robot moved through q, frame by frame, on a model."""
    described = model_named(model)
    described.check(robot)
    found = described.follow(robot, _checked(robot, q))
    return Simulation(
        described.points(robot, found.x, SIGMA),
        described.tangents(robot, found.x, np.ones(1))[:, 0],
        found.stability,
        found.stability_between,
        found.x,
        found.snaps,
    )


def _checked(robot: Robot, q: Array) -> Array:
    instance(RobotError, "robot", robot, Robot)
    q = configuration("q", q)
    if q.ndim != 2 or q.shape[1] != len(robot.axes):
        raise RobotError(f"q has shape {q.shape}; it must be (n, {len(robot.axes)}): {', '.join(robot.axes)}")
    return q


def other_way(robot: Robot, q: Array) -> Array:
    """The other way to write the shapes of q (.., 2d + 2), up to whole turns of any angle.

    R(theta_x, theta_y) Rz(alpha) = R(pi - theta_x, theta_y + pi) Rz(alpha + pi).
    """
    turned = np.array(q, dtype=float)
    turned[..., : robot.d] += np.pi
    turned[..., -2] = np.pi - turned[..., -2]
    turned[..., -1] += np.pi
    return turned


def shape_curve(robot: Robot, q: Array) -> Curve:
    """The dominant model's shape at q (2d + 2,) as a curve with its exact curvature; raises as `shapes`."""
    instance(RobotError, "robot", robot, Robot)
    DOMINANT.check(robot)
    q = floats(RobotError, "q", q, (len(robot.axes),))
    beta = robot.split(q)[1]

    def jump(x: Array) -> Array:
        return np.heaviside(x, 0.0)

    return Curve(
        float(beta[-1]),
        lambda s: shapes(robot, q[None], s / beta[-1])[0],
        lambda s: tangents(robot, q[None], s / beta[-1])[0],
        lambda s: shape.curvature(robot.tube_numbers, beta, s, jump, np),
    )
