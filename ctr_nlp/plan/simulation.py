"""Numeric shapes of a robot on any model: of single configurations, along a motion, and as a curve to follow."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.models import Model, Snap, model_named
from ctr_nlp.models.dominant import Dominant, shape
from ctr_nlp.models.protocol import STABILITY_SUBSTEPS_PER_FRAME
from ctr_nlp.paths.curve import Curve
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import configuration
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import check_instance, floats
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Index

DOMINANT = Dominant()
MAX_REMEMBERED_SIMULATIONS = 4
"""Number of simulations that a Simulator caches."""


def shapes(robot: Robot, q: Array, sigma: Array = SIGMA_GRID) -> Array:
    """Compute shapes of a robot on the dominant stiffness model, eqs. (1) and (4).

    For other models, see :func:`simulate_motion`: there the shape depends on the motion before.

    Parameters
    ----------
    robot : Robot
        The robot.
    q : (T, 2d + 2) array
        Configurations (alpha_1..d, beta_1..d, theta_x, theta_y), eq. (5); rad, mm and rad.
    sigma : (n,) or (T, n) array
        Arc lengths as parts of beta_d, in [0, 1]; by default 101 even ones.

    Returns
    -------
    (T, n, 3) array
        Points in the robot's base frame, mm.

    Raises
    ------
    RobotError
        `robot` is no robot, or `q` is no array of such rows.
    OptionError
        The dominant model does not describe the robot: a tube is no stiffer than the one within it.

    Examples
    --------
    >>> import numpy as np
    >>> import ctr_nlp as ctr
    >>> q = np.array([[0.0, 1.2, 2.4, 40.0, 90.0, 150.0, 0.0, 0.0]])
    >>> ctr.shapes(ctr.table_i_robot(), q)[0, -1].round(1).tolist()  # the tip
    [33.7, 68.1, 109.6]
    """
    q = _check_configurations(robot, q)
    DOMINANT.check(robot)
    return DOMINANT.points(robot, q, sigma)


def tangents(robot: Robot, q: Array, sigma: Array = SIGMA_GRID) -> Array:
    """Compute unit tangents of a robot's shapes on the dominant stiffness model.

    Parameters
    ----------
    robot : Robot
        The robot.
    q : (T, 2d + 2) array
        Configurations; rad, mm and rad.
    sigma : (n,) or (T, n) array
        Arc lengths as parts of beta_d, in [0, 1]; by default 101 even ones.

    Returns
    -------
    (T, n, 3) array
        Tangents in the robot's base frame, towards the tip.

    Raises
    ------
    RobotError
        `robot` is no robot, or `q` is no array of such rows.
    OptionError
        The dominant model does not describe the robot.
    """
    q = _check_configurations(robot, q)
    DOMINANT.check(robot)
    return DOMINANT.tangents(robot, q, sigma)


class Simulation(NamedTuple):
    """A robot simulated through T configurations.

    Attributes
    ----------
    shape : (T, 101, 3) array
        Points at uniform sigma in the base frame, mm; NaN where no equilibrium of the robot is known.
    tip_direction : (T, 3) array
        Unit tangents at the tip.
    stability, stability_between : (T,) array
        Stability margins in the frames, and the least ones over the sub-steps to each; NaN where nothing can be
        unstable.
    x : (T, n) array
        The model's unknowns at these equilibria.
    snaps : tuple of Snap
        Where the robot jumps from one branch of equilibria to another.
    """

    shape: Array
    tip_direction: Array
    stability: Array
    stability_between: Array
    x: Array
    snaps: tuple[Snap, ...]


def simulate_motion(robot: Robot, q: Array, model: str | Model) -> Simulation:
    """Simulate a robot through configurations, frame by frame, on a model.

    Where a configuration has several equilibria, the robot is in the one on the branch of the frame before. A
    single configuration has no history: the robot is turned to it from aligned tubes.

    Parameters
    ----------
    robot : Robot
        The robot.
    q : (T, 2d + 2) array
        Configurations of the frames, between which the robot moves linearly; rad, mm and rad.
    model : str or Model
        The kinematic model.

    Returns
    -------
    Simulation
        Shapes, margins and snaps.

    Raises
    ------
    RobotError
        `robot` is no robot, or `q` is no array of such rows.
    OptionError, LoadError
        The model is unknown or does not describe the robot, or the model's load does not fit it.

    Examples
    --------
    >>> import numpy as np
    >>> import ctr_nlp as ctr
    >>> q = np.array([[0.0, 1.2, 2.4, 40.0, 90.0, 150.0, 0.0, 0.0]])
    >>> found = simulate_motion(ctr.table_i_robot(), q, "elastic")
    >>> found.shape[0, -1].round(1).tolist(), found.snaps  # the tip
    ([75.2, 59.4, 82.0], ())
    """
    described = model_named(model)
    q = _check_configurations(robot, q)
    described.check(robot)
    # One configuration has no way between frames, on which margins could be less than at rest.
    if len(q) == 1 and described.applied_load is None:
        rest = described.rest_states(robot, q, SIGMA_GRID)
        return Simulation(rest.points, rest.tips, rest.margins, rest.margins, rest.x, ())
    found = described.follow(robot, q)
    return Simulation(
        described.points(robot, found.x, SIGMA_GRID),
        described.tangents(robot, found.x, np.ones(1))[:, 0],
        found.stability,
        found.stability_between,
        found.x,
        found.snaps,
    )


def shapes_between(
    robot: Robot, q: Array, model: str | Model, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
) -> IntermediateShapes:
    """Compute the shapes of a robot in its frames and in sub-steps between them.

    Configurations are linear between frames. The robot is simulated as by :func:`simulate_motion`, one sub-step
    after the other from the first frame on, so that it is on the same branch of equilibria in every frame.

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
    IntermediateShapes
        One row for the first frame and `substeps` rows for each further one.
    """
    described = model_named(model)
    q = _check_configurations(robot, q)
    part = np.arange(1, substeps + 1)[:, None] / substeps
    between = q[:-1, None] + part * (q[1:] - q[:-1])[:, None]
    # The last sub-step is the frame itself: exactly, and also where the frame before it is NaN.
    between[:, -1] = q[1:]
    every = np.concatenate([q[:1], between.reshape(-1, q.shape[1])])
    frames = np.concatenate([[0], np.repeat(np.arange(1, len(q)), substeps)])
    found = described.follow(robot, every, substeps=1) if len(q) > 1 else None
    x = described.rest(robot, q[0])[None] if found is None else found.x
    return IntermediateShapes(frames, robot.split(every)[1], described.points(robot, x, SIGMA_GRID))


class IntermediateShapes(NamedTuple):
    """Shapes of a robot at M instants of a motion, in frames and between them.

    Attributes
    ----------
    frames : (M,) array of int
        The frame, from 0, at the end of the sub-steps that an instant belongs to.
    beta : (M, d) array
        Extensions, mm.
    shape : (M, 101, 3) array
        Points at uniform sigma in the base frame, mm.
    """

    frames: Index
    beta: Array
    shape: Array


class Simulator:
    """Simulates motions of a robot on a model, and caches the last :data:`MAX_REMEMBERED_SIMULATIONS` of them.

    Parameters
    ----------
    robot : Robot
        The robot.
    model : str or Model
        The kinematic model.
    """

    def __init__(self, robot: Robot, model: str | Model) -> None:
        self.robot = robot
        self.model = model_named(model)
        # Keyed by the bytes of q: arrays are not hashable, and those with NaN, frames not reached, equal nothing.
        self._through = functools.lru_cache(MAX_REMEMBERED_SIMULATIONS)(self._simulate_bytes)

    def __call__(self, q: Array) -> Simulation:
        """Return the Simulation of the robot moved through q (T, 2d + 2), whose arrays must not be changed."""
        return self._through(np.asarray(q, dtype=float).tobytes())

    def _simulate_bytes(self, q: bytes) -> Simulation:
        """Simulate a motion whose q (T, 2d + 2) is given as the bytes of a float array, which can be a key."""
        return simulate_motion(self.robot, np.frombuffer(q).reshape(-1, len(self.robot.axes)), self.model)


def _check_configurations(robot: Robot, q: Array) -> Array:
    """Return q as an array (n, 2d + 2) of floats; raise RobotError where `robot` or q is something else."""
    check_instance(RobotError, "robot", robot, Robot)
    q = configuration("q", q)
    if q.ndim != 2 or q.shape[1] != len(robot.axes):
        raise RobotError(f"q has shape {q.shape}; it must be (n, {len(robot.axes)}): {', '.join(robot.axes)}")
    return q


def equivalent_configurations(robot: Robot, q: Array) -> Array:
    """Return the other configurations that have the same shapes, up to whole turns of any angle.

    R(theta_x, theta_y) Rz(alpha) = R(pi - theta_x, theta_y + pi) Rz(alpha + pi), with R of eq. (4).

    Parameters
    ----------
    robot : Robot
        The robot.
    q : (.., 2d + 2) array
        Configurations; rad, mm and rad.

    Returns
    -------
    (.., 2d + 2) array
        Configurations of the same shapes.
    """
    # With R = Ry(theta_y) Rx(theta_x): Ry(pi) Rx(pi) = Rz(pi), and Rz(pi) Rx(-a) = Rx(a) Rz(pi).
    turned = np.array(q, dtype=float)
    turned[..., : robot.d] += np.pi
    turned[..., -2] = np.pi - turned[..., -2]
    turned[..., -1] += np.pi
    return turned


def shape_curve(robot: Robot, q: Array) -> Curve:
    """Return the shape of one configuration on the dominant model as a curve to follow, with its exact curvature.

    Parameters
    ----------
    robot : Robot
        The robot.
    q : (2d + 2,) array
        Configuration; rad, mm and rad.

    Returns
    -------
    Curve
        Of length beta_d, in the robot's base frame, mm.

    Raises
    ------
    RobotError
        `robot` is no robot, or `q` is no such row.
    OptionError
        The dominant model does not describe the robot.

    Examples
    --------
    >>> import numpy as np
    >>> import ctr_nlp as ctr
    >>> ctr.shape_curve(ctr.table_i_robot(), np.array([0.0, 1.2, 2.4, 40.0, 90.0, 150.0, 0.0, 0.0]))
    Curve(150.00 mm)
    """
    check_instance(RobotError, "robot", robot, Robot)
    DOMINANT.check(robot)
    held = DominantShape(robot, floats(RobotError, "q", q, (len(robot.axes),)))
    return Curve(float(held.beta[-1]), held.point, held.tangent, held.curvature)


@packable("shape of a robot")
@dataclass(frozen=True, eq=False)
class DominantShape(ReadOnlyValue):
    """The shape of a robot at one q (2d + 2,) on the dominant model, as functions of arc length in mm."""

    robot: Robot
    q: Array

    @property
    def beta(self) -> Array:
        """Extensions (d,) of the configuration, mm."""
        return np.asarray(self.robot.split(self.q)[1])

    def point(self, s: Array) -> Array:
        """Points (n, 3) in the base frame, mm, at arc lengths s (n,) mm."""
        return shapes(self.robot, self.q[None], s / self.beta[-1])[0]

    def tangent(self, s: Array) -> Array:
        """Unit tangents (n, 3) in the base frame at arc lengths s (n,) mm."""
        return tangents(self.robot, self.q[None], s / self.beta[-1])[0]

    def curvature(self, s: Array) -> Array:
        """Unsigned curvature (n,) 1/mm at arc lengths s (n,) mm; it jumps where a tube ends."""
        # At s = beta_i the curvature is still that of tube i: eq. (10) has k_i on (beta_{i-1}, beta_i].
        return shape.curvature(self.robot.tube_numbers, self.beta.tolist(), s, lambda x: np.heaviside(x, 0.0), np)
