"""Simulated robots that differ from the nominal one, moved open loop through a motion that was planned for that
one.

A robot is lost where it snaps, or where its tips are turned by more than MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD
against each other than the nominal robot's: it is then on another branch of equilibria.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctr_nlp.models import Model, model_named, model_with_tip_forces
from ctr_nlp.models.protocol import EquilibriumPath, MotionSubsteps, subdivide_motion
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import RobotSamples
from ctr_nlp.typing import Array, Index

SAMPLE_SUBSTEPS_PER_FRAME = 4
"""Sub-steps from frame to frame in which simulated robots are followed."""
MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD = 1.0
"""Difference of relative tip angles from the nominal robot's, rad, beyond which a robot is on another branch."""


class SampleMotions(NamedTuple):
    """n robots moved through T frames: what a motion becomes on each of them.

    shape (n, T, 101, 3) mm at uniform sigma; x (n, T, n_x): their unknowns; stability, stability_between (n, T):
    margins, NaN where nothing can be unstable. snapped (n,): the frame on the way to which a robot first snaps;
    lost (n,): the first in which it has snapped, has no equilibrium, or its tips are turned by more than
    MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD against each other than the described robot's; from 1, and 0 where there is
    none.
    """

    shape: Array
    x: Array
    stability: Array
    stability_between: Array
    snapped: Index
    lost: Index


def simulate_samples(robot: Robot, samples: RobotSamples, q: Array, model: str | Model) -> SampleMotions:
    """The draws of a robot, moved by their motors through q (T, 2d + 2) from where all tubes are aligned.

    Forces at their tips come in the first frame and go in the last one. Raises OptionError where the model cannot
    follow such robots, and LoadError where forces act on a robot whose moduli are not told.
    """
    described = model_with_tip_forces(model, samples.forces)
    found, lost = _follow_samples(robot, samples, q, model_named(model))
    x = np.array([each.x for each in found])
    return SampleMotions(
        described.points_batch(samples.structure, samples.numbers, x, SIGMA_GRID),
        x,
        np.array([each.stability for each in found]),
        np.array([each.stability_between for each in found]),
        _first_snap_frames(found),
        lost,
    )


def find_failure_frames(robot: Robot, samples: RobotSamples, q: Array, model: str | Model) -> Index:
    """In which frame, from 1, each of n draws is lost on a motion q (T, 2d + 2); 0 where it is not. (n,)"""
    return _follow_samples(robot, samples, q, model_named(model), margins=False)[1]


def _follow_samples(
    robot: Robot, samples: RobotSamples, q: Array, model: Model, margins: bool = True
) -> tuple[list[EquilibriumPath], Index]:
    """Follow draws along a motion; return what was found of each, and the frames in which they are lost."""
    model.check(robot)
    apart = model_with_tip_forces(model, samples.forces)
    apart.check(robot)
    way = subdivide_motion(np.asarray(q, dtype=float), SAMPLE_SUBSTEPS_PER_FRAME)
    found = apart.follow_batch(
        samples.structure, samples.numbers, way, samples.tube_configurations(way.q, way.fresh), margins
    )
    return found, _first_failure_frames(
        model, robot, way, np.array([each.x for each in found]), _first_snap_frames(found)
    )


def _first_snap_frames(found: Sequence[EquilibriumPath]) -> Index:
    return np.array([min((snap.frame for snap in each.snaps), default=0) for each in found])


def _first_failure_frames(model: Model, robot: Robot, way: MotionSubsteps, x: Array, snapped: Index) -> Index:
    """Return the frames, from 1, in which robots are first lost, (n,); 0 where they are not."""
    away = np.zeros(x.shape[:2], dtype=bool)
    away[snapped > 0, snapped[snapped > 0] - 1] = True
    if model.several_equilibria:
        reached = np.unique(way.frames)
        # The nominal robot through the same sub-steps, for comparison.
        (own,) = model.follow_batch(robot.structure, robot.numbers[None], way, way.q[None], False)
        apart = abs(x - own.x)[:, reached, : robot.d - 1].max(axis=2, initial=0.0)
        # Negated, so that NaN, a robot without an equilibrium, counts as lost.
        away[:, reached] |= ~(apart <= MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD)
    return np.where(away.any(axis=1), away.argmax(axis=1) + 1, 0)
