"""Robots that are not quite the one described, moved open loop through a motion that was planned for that one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.models import Model, model_named
from ctr_nlp.models.protocol import Passage, passage
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Index

SUBSTEPS = 4
"""Steps from frame to frame in which draws are followed."""
APART = 1.0
"""rad: tubes that are turned by more against each other than the described robot's are on another branch."""


class DrawnMotion(NamedTuple):
    """n robots moved through T frames: what a motion becomes on each of them.

    shape (n, T, 101, 3) mm at uniform sigma; x (n, T, n_x): their unknowns; stability, stability_between (n, T):
    margins, NaN where nothing can be unstable. snapped (n,): the frame on the way to which a robot first snaps;
    lost (n,): the first in which it has snapped, has no equilibrium, or its tips are turned by more than APART
    against each other than the described robot's; from 1, and 0 where there is none.
    """

    shape: Array
    x: Array
    stability: Array
    stability_between: Array
    snapped: Index
    lost: Index


def drawn_motion(robot: Robot, draws: Draws, q: Array, model: str | Model) -> DrawnMotion:
    """The draws of a robot, moved by their motors through q (T, 2d + 2) from where all tubes are aligned."""
    described, way = model_named(model), passage(np.asarray(q, dtype=float), SUBSTEPS)
    described.check(robot)
    found = described.follow_apart(draws.structure, draws.numbers, way, draws.turned(way.q, way.fresh))
    x = np.array([each.x for each in found])
    n, frames = x.shape[:2]
    numbers = np.repeat(draws.numbers, frames, axis=0)
    shape = described.points_apart(draws.structure, numbers, x.reshape(n * frames, -1), SIGMA)
    snapped = np.array([min((snap.frame for snap in each.snaps), default=0) for each in found])
    return DrawnMotion(
        shape.reshape(n, frames, *shape.shape[1:]),
        x,
        np.array([each.stability for each in found]),
        np.array([each.stability_between for each in found]),
        snapped,
        _lost(described, robot, way, x, snapped),
    )


def _lost(model: Model, robot: Robot, way: Passage, x: Array, snapped: Index) -> Index:
    """The first frames in which robots are not where the one described is."""
    away = np.zeros(x.shape[:2], dtype=bool)
    away[snapped > 0, snapped[snapped > 0] - 1] = True
    if model.several_equilibria:
        reached = np.unique(way.frames)
        (own,) = model.follow_apart(robot.structure, robot.numbers[None], way, way.q[None])
        apart = abs(x - own.x)[:, reached, : robot.d - 1].max(axis=2, initial=0.0)
        away[:, reached] |= ~(apart <= APART)
    return np.where(away.any(axis=1), away.argmax(axis=1) + 1, 0)
