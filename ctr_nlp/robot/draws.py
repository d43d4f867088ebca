"""Robots that a robot may be, with the zeros of their motors and the lags of their tubes; and the one it is."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.robot.limits import Limits
from ctr_nlp.robot.robot import Robot
from ctr_nlp.robot.structure import NUMBERS, Structure
from ctr_nlp.robot.tolerances import NAMES, Tolerances
from ctr_nlp.robot.tube import Tube
from ctr_nlp.support.equal import Kept
from ctr_nlp.support.values import whole_number
from ctr_nlp.typing import Array, Flags

MOST_CORNERS = 2**16
"""Corners that are given, at most; each takes some milliseconds to be moved through a plan."""
LEAST = 0.05
"""The least part of a curvature, a stiffness or a length that a normal draw leaves of it."""


@dataclass(frozen=True, eq=False)
class Draws(Kept):
    """Robots that differ in numbers (n, d, 8), in the order of structure.NUMBERS, and share a structure.

    offsets (n, d): what alpha of a tube exceeds its motor's by, rad. lags (n, d): by which angle a tube may stay
    behind its motor, rad. forces (n, 3): that act at the tips, N, in the directions of the base. parts (n, d, 5):
    by how much they differ from the robot described, as NAMES.
    """

    structure: Structure
    numbers: Array
    offsets: Array
    lags: Array
    forces: Array
    parts: Array

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, chosen: Any) -> Draws:
        """Some of them."""
        rows = (each[chosen] for each in (self.numbers, self.offsets, self.lags, self.forces, self.parts))
        return Draws(self.structure, *rows)

    def turned(self, q: Array, fresh: Flags) -> Array:
        """The configurations (n, T, 2d + 2) of the draws' tubes where motors move a robot through q (T, 2d + 2).

        Rows of q are places between which every motor turns one way; at those that are fresh (T,), the first of
        them one, the robot comes from where all tubes are aligned at alpha_d. A tube whose motor has turned by
        more than its lag follows it at that angle, and stands still while a motor that turns back takes up the
        play.
        """
        found = np.repeat(q[None], len(self), axis=0)
        d = self.offsets.shape[1]
        if self.lags.any():
            alpha = found[:, 0, :d]
            for j, goal in enumerate(q[:, :d]):
                alpha = dragged(np.full_like(alpha, goal[-1]) if fresh[j] else alpha, goal, self.lags)
                found[:, j, :d] = alpha
        found[..., :d] += self.offsets[:, None]
        return found


def dragged(alpha: Array, goal: Array, play: Array) -> Array:
    """Where tubes at alpha (.., d) come to whose motors go to goal, with play (.., d) to either side; all rad."""
    found: Array = np.clip(alpha, goal - play, goal + play)
    return found


def drawn(robot: Robot, count: int, seed: int) -> Draws:
    """So many robots that a robot with its tolerances may be, drawn at random; raises RobotError.

    Where a force may act at the tip, all of it does, in a direction of each robot's own.
    seed: of numpy's default generator; the same seed gives the same draws, and fewer are the first of more.
    """
    count, seed = whole_number(RobotError, "draws", count), whole_number(RobotError, "seed of draws", seed, 0)
    tolerances, d = robot.tolerances, robot.d
    random, shares, sections = (np.random.default_rng([seed, stream]) for stream in range(3))
    if tolerances.distribution == "uniform":
        bands = tolerances.stated(d)
        parts = random.uniform(-1.0, 1.0, (count, *bands.shape)) * bands
        off = sections.uniform(-1.0, 1.0, (count, d, 2)) * tolerances.diameters(d)[:, None]
        stiffness = parts[..., NAMES.index("bending_stiffness")]
        stiffness[:] = (1 + stiffness) * _stiffened(robot, off) - 1
    else:
        root = tolerances.root(robot.tubes)
        parts = (random.standard_normal((count, len(root))) @ root.T).reshape(count, d, len(NAMES))
    lags = shares.uniform(0.0, 1.0, (count, d)) * tolerances.lags(d)
    return drawn_from(robot, parts, lags, _forces(robot, count, seed))


def corners(robot: Robot, most: int = MOST_CORNERS) -> Draws:
    """The robots at the corners of what a robot may be within its tolerances: all, or so many at random.

    Every independent quantity is as far off as at the end of a uniform band: sqrt(3) standard deviations. Tubes
    with a lag have all of it. Where a force may act at the tip, all of it does, in a direction of each one's own.
    """
    root = robot.tolerances.root(robot.tubes)
    deviations = root[:, abs(root).max(axis=0) > 0]
    count = deviations.shape[1]
    if 2**count <= most:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=count))).reshape(-1, count)
    else:
        signs = np.random.default_rng(0).choice((-1.0, 1.0), (most, count))
    parts = math.sqrt(3) * signs @ deviations.T
    lags = np.tile(robot.tolerances.lags(robot.d), (len(signs), 1))
    return drawn_from(robot, parts.reshape(-1, robot.d, len(NAMES)), lags, _forces(robot, len(signs), 0))


def _forces(robot: Robot, count: int, seed: int) -> Array:
    """At tips (n, 3) N, each as large as may be, in directions that are uniform over the sphere."""
    directions = np.random.default_rng([seed, 3]).standard_normal((count, 3))
    return robot.tolerances.tip_force * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _stiffened(robot: Robot, off: Array) -> Array:
    """By what factors (n, d) bending stiffnesses change with both diameters off (n, d, 2) mm, outer and inner."""
    described = np.array([(tube.outer_diameter, tube.inner_diameter) for tube in robot.tubes])
    fourth = np.maximum(described + off, 0.0) ** 4
    whole = described**4
    return np.asarray((fourth[..., 0] - fourth[..., 1]) / (whole[:, 0] - whole[:, 1]))


def drawn_from(robot: Robot, parts: Array, lags: Array, forces: Array | None = None) -> Draws:
    """Robots that differ from one by parts (n, d, 5), as NAMES, with lags (n, d) rad.

    forces (n, 3): at their tips, N; none by default.
    """
    forces = np.zeros((len(parts), 3)) if forces is None else forces
    numbers = np.repeat(robot.numbers[None], len(parts), axis=0)
    factors = {
        "root_curvature": parts[..., 0],
        "tip_curvature": parts[..., 0],
        "bending_stiffness": parts[..., 1],
        "torsional_ratio": parts[..., 2],
    }
    for name, part in factors.items():
        numbers[..., NUMBERS.index(name)] *= np.maximum(1 + part, LEAST)
    length, curved = (NUMBERS.index(name) for name in ("length", "curved_length"))
    described = robot.numbers[:, curved]
    numbers[..., curved] = np.clip(described + parts[..., 3], LEAST * described, numbers[..., length])
    reach = robot.upper[robot.d : 2 * robot.d]
    shown = tuple((numbers[..., curved] < reach).any(axis=0) | np.array(robot.structure.shown))
    structure = replace(robot.structure, shown=tuple(map(bool, shown)))
    return Draws(structure, numbers, parts[..., 4], lags, forces, parts)


def known_robot(robot: Robot, parts: Array, covariance: Array, rotation_lag: Any) -> Robot:
    """The robot whose tubes differ from those described by parts (d, 5), as robot.tolerances.NAMES has them.

    covariance (5 d, 5 d): of what is left to doubt of these parts; the robot has it, as parts of its own tubes, as
    its tolerances, and rotation_lag, rad, beside it. Motors' zeros are no numbers of tubes: what they are off by
    is left to the caller, and only what is left to doubt of it is in the tolerances. Stiffness is told by
    youngs_modulus. Raises RobotError where no such tubes can be made.
    """
    tubes = tuple(_tube(tube, own) for tube, own in zip(robot.tubes, parts, strict=True))
    scale = np.ones(parts.shape)
    scale[:, :3] = 1 / (1 + parts[:, :3])
    left = covariance * np.outer(scale.ravel(), scale.ravel())
    tolerances = Tolerances(rotation_lag=rotation_lag, distribution="normal", covariance=(left + left.T) / 2)
    return replace(robot, tubes=tubes, limits=_limits(robot), tolerances=tolerances)


def _tube(tube: Tube, parts: Array) -> Tube:
    curvature, stiffness, ratio, length, _ = parts.tolist()
    return replace(
        tube,
        curvature=(tube.root_curvature * (1 + curvature), tube.tip_curvature * (1 + curvature)),
        youngs_modulus=tube.youngs_modulus * (1 + stiffness),
        poisson_ratio=(1 + tube.poisson_ratio) * (1 + ratio) - 1,
        curved_length=tube.curved_length + length,
    )


def _limits(robot: Robot) -> Limits:
    """Those of the robot, of which positions do not change with the lengths found."""
    beta = zip(*(robot.split(ends)[1].tolist() for ends in (robot.lower, robot.upper)), strict=True)
    return replace(robot.limits, beta=tuple(beta))
