"""Perturbed robots simulated open loop through a motion that was planned for the nominal one.

A sample fails where it snaps, has no equilibrium, or is on another branch of equilibria: its tips are turned
against each other by over MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD more or less than the nominal robot's. The last is
needed because near a bifurcation a robot slides onto another branch without any jump.
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
"""Sub-steps from frame to frame in the simulation of samples."""
MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD = 1.0
"""Difference of relative tip angles from the nominal robot's, rad, beyond which a robot is on another branch."""


class SampleMotions(NamedTuple):
    """Motions of n robots through T frames.

    shape (n, T, 101, 3): in mm at uniform sigma. x (n, T, n_x): unknowns of the model. stability,
    stability_between (n, T): margins, NaN where nothing can be unstable. snapped (n,): frame, from 1, on the way
    to which a robot first snaps. lost (n,): frame, from 1, in which it first fails (see the top of this module).
    Both are 0 where there is none.
    """

    shape: Array
    x: Array
    stability: Array
    stability_between: Array
    snapped: Index
    lost: Index


def simulate_samples(robot: Robot, samples: RobotSamples, q: Array, model: str | Model) -> SampleMotions:
    """Simulate samples of a robot whose motors move through q (T, 2d + 2), starting from aligned tubes.

    robot: the nominal one. samples: n perturbed ones; forces at their tips come in the first frame and go in the
    last one. model: kinematic model. Raises OptionError where the model cannot follow such robots, and LoadError
    where forces act on a robot without Young's moduli in MPa.
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
    """Return the frame (n,), from 1, in which each of n samples first fails on a motion q (T, 2d + 2), or 0.

    robot: the nominal one. samples: n perturbed ones. model: kinematic model. Margins are not computed, which is
    faster.
    """
    return _follow_samples(robot, samples, q, model_named(model), margins=False)[1]


def _follow_samples(
    robot: Robot, samples: RobotSamples, q: Array, model: Model, margins: bool = True
) -> tuple[list[EquilibriumPath], Index]:
    """Follow samples along a motion q (T, 2d + 2); return their paths, and the frames (n,) in which they fail.

    margins: whether stability margins are computed.
    """
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
    """Return the frames (n,), from 1, in which samples first fail, 0 where they do not.

    way: sub-steps of the motion. x: (n, T, n_x), unknowns of the samples. snapped: (n,), frames of their snaps.
    """
    away = np.zeros(x.shape[:2], dtype=bool)
    away[snapped > 0, snapped[snapped > 0] - 1] = True
    if model.several_equilibria:
        reached = np.unique(way.frames)
        # The nominal robot through the same sub-steps. Compared are tips relative to the innermost one, the first
        # d - 1 unknowns: an offset of all motors alike turns the shape and is no other branch.
        (own,) = model.follow_batch(robot.structure, robot.numbers[None], way, way.q[None], False)
        apart = abs(x - own.x)[:, reached, : robot.d - 1].max(axis=2, initial=0.0)
        # Negated, so that NaN, a robot without an equilibrium, counts as lost.
        away[:, reached] |= ~(apart <= MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD)
    return np.where(away.any(axis=1), away.argmax(axis=1) + 1, 0)
