"""Simulated robots that differ from the nominal one, moved open loop through a motion that was planned for that
one.

A robot is lost where it snaps, or where its tips are turned by more than APART against each other than the nominal
robot's: it is then on another branch of equilibria.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctr_nlp.models import Model, model_named, pushed
from ctr_nlp.models.protocol import Followed, Passage, passage
from ctr_nlp.robot import Robot
from ctr_nlp.robot.draws import Draws
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Index

SUBSTEPS = 4
"""Sub-steps from frame to frame in which simulated robots are followed."""
APART = 1.0
"""Difference of relative tip angles from the nominal robot's, rad, beyond which a robot is on another branch."""


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
    """The draws of a robot, moved by their motors through q (T, 2d + 2) from where all tubes are aligned.

    Forces at their tips come in the first frame and go in the last one. Raises OptionError where the model cannot
    follow such robots, and LoadError where forces act on a robot whose moduli are not told.
    """
    described = pushed(model, draws.forces)
    found, lost = _followed(robot, draws, q, model_named(model))
    x = np.array([each.x for each in found])
    return DrawnMotion(
        described.points_apart(draws.structure, draws.numbers, x, SIGMA),
        x,
        np.array([each.stability for each in found]),
        np.array([each.stability_between for each in found]),
        _snapped(found),
        lost,
    )


def lost_draws(robot: Robot, draws: Draws, q: Array, model: str | Model) -> Index:
    """In which frame, from 1, each of n draws is lost on a motion q (T, 2d + 2); 0 where it is not. (n,)"""
    return _followed(robot, draws, q, model_named(model), margins=False)[1]


def _followed(
    robot: Robot, draws: Draws, q: Array, model: Model, margins: bool = True
) -> tuple[list[Followed], Index]:
    """Follow draws along a motion; return what was found of each, and the frames in which they are lost."""
    model.check(robot)
    apart = pushed(model, draws.forces)
    apart.check(robot)
    way = passage(np.asarray(q, dtype=float), SUBSTEPS)
    found = apart.follow_apart(draws.structure, draws.numbers, way, draws.turned(way.q, way.fresh), margins)
    return found, _lost(model, robot, way, np.array([each.x for each in found]), _snapped(found))


def _snapped(found: Sequence[Followed]) -> Index:
    return np.array([min((snap.frame for snap in each.snaps), default=0) for each in found])


def _lost(model: Model, robot: Robot, way: Passage, x: Array, snapped: Index) -> Index:
    """Return the frames, from 1, in which robots are first lost, (n,); 0 where they are not."""
    away = np.zeros(x.shape[:2], dtype=bool)
    away[snapped > 0, snapped[snapped > 0] - 1] = True
    if model.several_equilibria:
        reached = np.unique(way.frames)
        # The nominal robot through the same sub-steps, for comparison.
        (own,) = model.follow_apart(robot.structure, robot.numbers[None], way, way.q[None], False)
        apart = abs(x - own.x)[:, reached, : robot.d - 1].max(axis=2, initial=0.0)
        # Negated, so that NaN, a robot without an equilibrium, counts as lost.
        away[:, reached] |= ~(apart <= APART)
    return np.where(away.any(axis=1), away.argmax(axis=1) + 1, 0)
