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
from ctr_nlp.plan.batch import check_device
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import RobotSamples
from ctr_nlp.support.threads import count_threads, map_in_threads, split_rows
from ctr_nlp.typing import Array, Index

SAMPLE_SUBSTEPS_PER_FRAME = 4
"""Sub-steps from frame to frame in the simulation of samples."""
MAX_TIP_DIFFERENCE_FROM_NOMINAL_RAD = 1.0
"""Difference of relative tip angles from the nominal robot's, rad, beyond which a robot is on another branch."""


SAMPLES_PER_THREAD = 32
"""Samples that a thread follows together: a multiple of the lanes of vectors, so that results are the same."""


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


def simulate_samples(
    robot: Robot,
    samples: RobotSamples,
    q: Array,
    model: str | Model = "elastic",
    *,
    device: str = "cpu",
    threads: int | None = None,
) -> SampleMotions:
    """Simulate samples of a robot whose motors move through a motion, starting from aligned tubes.

    Forces at the tips of samples come in the first frame and go in the last one.

    Parameters
    ----------
    robot : Robot
        The nominal robot.
    samples : RobotSamples
        The n perturbed robots, such as those of :func:`sample_robots`.
    q : (T, 2d + 2) array
        Configurations of the motors in the frames; rad, mm and rad. They are linear in between, in
        :data:`SAMPLE_SUBSTEPS_PER_FRAME` sub-steps.
    model : str or Model
        Kinematic model.
    device : str
        ``"cpu"``; see :func:`batch`.
    threads : int, optional
        Number of threads that share the robots on models that can; by default that of ``OMP_NUM_THREADS``, or else
        one for each core. The result does not depend on it.

    Returns
    -------
    SampleMotions
        Shapes (n, T, 101, 3) in mm, margins, and the frames in which robots snap or fail.

    Raises
    ------
    OptionError
        The model cannot follow such robots, or the device cannot be used.
    LoadError
        Forces act on a robot without Young's moduli in MPa.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> robot = ctr.table_i_robot()
    >>> q = np.linspace([0.0, 0.0, 0.0, 10, 20, 30, 0, 0], [0.5, 1.0, 1.5, 40, 90, 150, 0, 0], 5)
    >>> found = ctr.simulate_samples(robot, ctr.sample_robots(robot, count=16, seed=0), q)
    >>> found.shape.shape, int((found.lost > 0).sum())
    ((16, 5, 101, 3), 0)
    """
    check_device(device)
    shape = np.empty((len(samples), len(q), len(SIGMA_GRID), 3))
    found, lost = _follow_samples(robot, samples, q, model_named(model), threads, shape=shape)
    return SampleMotions(
        shape,
        np.array([each.x for each in found]),
        np.array([each.stability for each in found]),
        np.array([each.stability_between for each in found]),
        _first_snap_frames(found),
        lost,
    )


def find_failure_frames(
    robot: Robot, samples: RobotSamples, q: Array, model: str | Model, threads: int | None = None
) -> Index:
    """Return the frame (n,), from 1, in which each of n samples first fails on a motion q (T, 2d + 2), or 0.

    robot: the nominal one. samples: n perturbed ones. model: kinematic model. threads: as in simulate_samples.
    Margins are not computed, which is faster.
    """
    return _follow_samples(robot, samples, q, model_named(model), threads, margins=False)[1]


def _follow_samples(
    robot: Robot,
    samples: RobotSamples,
    q: Array,
    model: Model,
    threads: int | None,
    margins: bool = True,
    shape: Array | None = None,
) -> tuple[list[EquilibriumPath], Index]:
    """Follow samples along a motion q (T, 2d + 2); return their paths, and the frames (n,) in which they fail.

    threads: as in simulate_samples. margins: whether stability margins are computed. shape (n, T, 101, 3): where
    shapes in mm are written, if at all.
    """
    model.check(robot)
    model_with_tip_forces(model, samples.forces).check(robot)
    way = subdivide_motion(np.asarray(q, dtype=float), SAMPLE_SUBSTEPS_PER_FRAME)

    def follow(part: slice) -> list[EquilibriumPath]:
        """Follow some of the samples, and write their shapes."""
        some = samples[part]
        apart = model_with_tip_forces(model, some.forces)
        places = some.tube_configurations(way.q, way.fresh)
        found = apart.follow_batch(some.structure, some.numbers, way, places, margins)
        if shape is not None:
            x = np.array([each.x for each in found])
            shape[part] = apart.points_batch(some.structure, some.numbers, x, SIGMA_GRID)
        return found

    workers = count_threads(threads)
    parts = [slice(0, len(samples))]
    if model.batches_in_threads(samples.structure):
        parts = split_rows(len(samples), SAMPLES_PER_THREAD)
    found = [path for paths in map_in_threads(follow, parts, workers) for path in paths]
    lost = _first_failure_frames(
        model, robot, way, np.array([each.x for each in found]), _first_snap_frames(found)
    )
    return found, lost


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
