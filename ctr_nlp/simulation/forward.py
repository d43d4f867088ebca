"""Numeric shapes of a robot on any model, and a shape as a curve to follow."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.models import Model, Snap, model_named
from ctr_nlp.models.dominant import Dominant, shape
from ctr_nlp.models.protocol import SUBSTEPS
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import configuration
from ctr_nlp.support.equal import Kept
from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import floats, instance
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Index

DOMINANT = Dominant()
REMEMBERED = 4
"""Motions whose simulations a Simulator keeps."""


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
    described, q = model_named(model), _checked(robot, q)
    described.check(robot)
    if len(q) == 1 and described.bears is None:
        rest = described.at_rest(robot, q, SIGMA)
        return Simulation(rest.points, rest.tips, rest.margins, rest.margins, rest.x, ())
    found = described.follow(robot, q)
    return Simulation(
        described.points(robot, found.x, SIGMA),
        described.tangents(robot, found.x, np.ones(1))[:, 0],
        found.stability,
        found.stability_between,
        found.x,
        found.snaps,
    )


def shapes_between(robot: Robot, q: Array, model: str | Model, substeps: int = SUBSTEPS) -> Between:
    """Shapes of a robot on the way from frame to frame, and in the frames.

    Configurations are linear between frames. The robot is moved as :func:`simulated` moves it: one sub-step after
    the other from the first frame on, so that it is on the same branch of equilibria in every frame.

    Parameters
    ----------
    robot : Robot
        The robot.
    q : (T, 2d + 2) array
        Configurations of the frames; rad, mm and rad.
    model : str or Model
        The kinematic model.
    substeps : int
        Steps from frame to frame.

    Returns
    -------
    Between
        One row for the first frame and `substeps` rows for each further one.
    """
    described, q = model_named(model), _checked(robot, q)
    part = np.arange(1, substeps + 1)[:, None] / substeps
    between = q[:-1, None] + part * (q[1:] - q[:-1])[:, None]
    # The last sub-step is the frame itself, also where rounding or a frame without a configuration says otherwise.
    between[:, -1] = q[1:]
    every = np.concatenate([q[:1], between.reshape(-1, q.shape[1])])
    frames = np.concatenate([[0], np.repeat(np.arange(1, len(q)), substeps)])
    found = described.follow(robot, every, substeps=1) if len(q) > 1 else None
    x = described.rest(robot, q[0])[None] if found is None else found.x
    return Between(frames, robot.split(every)[1], described.points(robot, x, SIGMA))


class Between(NamedTuple):
    """Shapes of a robot in M places of a motion.

    frames (M,): the frame, from 0, that a place belongs to or is on the way to. beta (M, d) mm: extensions. shape
    (M, 101, 3) mm: points at uniform sigma.
    """

    frames: Index
    beta: Array
    shape: Array


class Simulator:
    """A robot on a model, moved through every motion once: what came of the last REMEMBERED ones is kept."""

    def __init__(self, robot: Robot, model: str | Model) -> None:
        self.robot, self.model = robot, model_named(model)
        self._through = functools.lru_cache(REMEMBERED)(self._moved)

    def __call__(self, q: Array) -> Simulation:
        """The robot moved through q (T, 2d + 2); arrays are not to be changed."""
        return self._through(np.asarray(q, dtype=float).tobytes())

    def _moved(self, q: bytes) -> Simulation:
        return simulated(self.robot, np.frombuffer(q).reshape(-1, len(self.robot.axes)), self.model)


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
    held = Shape(robot, floats(RobotError, "q", q, (len(robot.axes),)))
    return Curve(float(held.beta[-1]), held.point, held.tangent, held.curvature)


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
        return shape.curvature(self.robot.tube_numbers, self.beta.tolist(), s, lambda x: np.heaviside(x, 0.0), np)
