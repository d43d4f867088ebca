"""Numeric shapes of a robot on any model, and a shape as a curve to follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.models import check_model, dominant
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import configuration
from ctr_nlp.simulation import following as tracking
from ctr_nlp.support.equal import Kept
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import floats, instance
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Vector


def shapes(robot: Robot, q: Array, sigma: Array = SIGMA) -> Array:
    """Points (T, n, 3) in mm of the dominant model at q (T, 2d + 2) and sigma (n,) or (T, n).

    Raises RobotError, and OptionError where that model does not describe the robot.
    """
    return _stacked(_backbone(robot, q, sigma).points)


def tangents(robot: Robot, q: Array, sigma: Array = SIGMA) -> Array:
    """Unit tangents (T, n, 3) of the dominant model at q (T, 2d + 2) and sigma (n,)."""
    return _stacked(_backbone(robot, q, sigma).tangents)


def points_of(robot: Robot, x: Array, sigma: Array, model: str) -> Array:
    """Points (T, n, 3) in mm of a model with unknowns x (T, 2d + 2) at sigma (n,) or (T, n)."""
    return (shapes if model == "dominant" else tracking.shapes)(robot, x, sigma)


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
    snaps: tuple[tracking.Snap, ...]


def simulated(robot: Robot, q: Array, model: str) -> Simulation:
    """The robot moved through q, frame by frame, on a model."""
    check_model(robot, model)
    if model == "dominant":
        unknown = np.full(len(q), np.nan)
        return Simulation(shapes(robot, q), tangents(robot, q, np.ones(1))[:, 0], unknown, unknown, q, ())
    found = tracking.follow(robot, q)
    return Simulation(
        tracking.shapes(robot, found.x, SIGMA),
        tracking.tangents(robot, found.x, np.ones(1))[:, 0],
        found.stability,
        found.stability_between,
        found.x,
        found.snaps,
    )


def _backbone(robot: Robot, q: Array, sigma: Array) -> dominant.Backbone:
    instance(RobotError, "robot", robot, Robot)
    q = configuration("q", q)
    if q.ndim != 2 or q.shape[1] != len(robot.axes):
        raise RobotError(f"q has shape {q.shape}; it must be (n, {len(robot.axes)}): {', '.join(robot.axes)}")
    dominant.check_order(robot)
    return dominant.backbone(robot, dominant.columns_of(q), sigma, np)


def _stacked(vector: Vector) -> Array:
    return np.stack(np.broadcast_arrays(*vector), axis=-1)


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
    dominant.check_order(robot)
    shape = Shape(robot, floats(RobotError, "q", q, (len(robot.axes),)))
    return Curve(float(shape.beta[-1]), shape.point, shape.tangent, shape.curvature)


@packable("shape of a robot")
@dataclass(frozen=True, eq=False)
class Shape(Kept):
    """The dominant model's at q (2d + 2,), by arc length (n,) mm."""

    robot: Robot
    q: Array

    @property
    def beta(self) -> Array:
        """(d,) mm."""
        return np.asarray(self.robot.split(self.q)[1])

    def point(self, s: Array) -> Array:
        """(n, 3) mm."""
        return shapes(self.robot, self.q[None], s / self.beta[-1])[0]

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        return tangents(self.robot, self.q[None], s / self.beta[-1])[0]

    def curvature(self, s: Array) -> Array:
        """(n,) 1/mm."""
        return dominant.curvature(self.robot, self.beta.tolist(), s, lambda x: np.heaviside(x, 0.0), np)
