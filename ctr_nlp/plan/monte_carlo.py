"""Monte Carlo evaluation of a plan: on robots within the tolerances, and on robots that differ by one tolerance.

The share of samples that fail estimates the share of all such robots. What each tolerance costs is found one at a
time, on two robots that differ by plus and minus one standard deviation of a single parameter.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from ctr_nlp.paths.walls import WallGeometry
from ctr_nlp.plan.measures import rms_over_sigma
from ctr_nlp.plan.motion_evaluation import clearance_from_wall, parts_of
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.plan.robustness import COSTLY, Robustness
from ctr_nlp.plan.sample_motions import SampleMotions, simulate_samples
from ctr_nlp.robot import Robot
from ctr_nlp.robot.samples import RobotSamples, perturb_robot, sample_robots
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.typing import Array, Index

DEFAULT_PLAN_SAMPLES, DEFAULT_PLAN_SAMPLE_SEED = 200, 0
"""Number and seed of the simulated robots where none are given."""
PLAN_SAMPLES_PER_BATCH = 64
"""Simulated robots whose whole shapes are in memory at once."""
CLOUD_FRAME_COUNT, CLOUD_POINT_STRIDE = 5, 4
"""Number of frames whose shapes are kept, evenly spaced up to the last one, and the stride of the kept samples
along the robot.
"""


def robustness(
    plan: PlanData, count: int = DEFAULT_PLAN_SAMPLES, seed: int = DEFAULT_PLAN_SAMPLE_SEED
) -> Robustness:
    """Simulate a plan on `count` robots sampled within the tolerances, on the model that it is evaluated on.

    seed: of the samples. Raises RobotError, and OptionError where that model cannot follow such robots.
    """
    draws = sample_robots(plan.robot, count, seed)
    # The grid begins one frame before the first, which is dropped, so that it is even and ends in the last frame.
    frames = np.unique(np.linspace(-1, len(plan.time) - 1, CLOUD_FRAME_COUNT + 1)[1:].round().astype(int))
    parts = [
        _measure_samples(plan, draws[first : first + PLAN_SAMPLES_PER_BATCH], frames)
        for first in range(0, count, PLAN_SAMPLES_PER_BATCH)
    ]
    arrays: list[Any] = [np.concatenate(each) for each in zip(*(part[:-1] for part in parts), strict=True)]
    cloud = np.concatenate([part[-1] for part in parts], axis=1)
    growth, lost_alone = _measure_tolerance_costs(plan)
    ends: list[Any] = [cloud, frames + 1, growth, lost_alone, plan.beta[:, -1]]
    return Robustness(*[seed, draws.deviations, draws.backlash, *arrays, *ends])


def _measure_samples(plan: PlanData, draws: RobotSamples, frames: Index) -> tuple[Any, ...]:
    """Simulate a batch of robots; return the fields of Robustness from e2 to cloud, in its order.

    draws: the samples. frames: those of the cloud, from 0.
    """
    found = simulate_samples(plan.robot, draws, plan.q, plan.evaluated_model)
    distance = _distance(plan, found)
    margins = np.fmin(found.stability, found.stability_between)
    clearance = contact = np.full(len(draws), np.nan)
    if plan.wall is not None:
        least = clearances(plan.robot, plan.wall, plan.beta, found.shape)
        clearance = np.fmin.reduce(least, axis=1)
        contact = np.nansum(np.maximum(-least, 0.0), axis=1)
    # e2 and the cloud are most of a plan's file: single precision is exact to 1e-5 mm and halves them.
    return (
        *(
            rms_over_sigma(distance).astype(np.float32),
            np.fmax.reduce(distance, axis=(1, 2)),
            found.lost,
            found.snapped,
        ),
        *(np.fmin.reduce(margins, axis=1), clearance, contact),
        found.shape[:, frames, ::CLOUD_POINT_STRIDE].swapaxes(0, 1).astype(np.float32),
    )


def clearances(robot: Robot, wall: WallGeometry, beta: Array, shape: Array) -> Array:
    """Compute the least clearance of several robots from the wall in every frame.

    Parameters
    ----------
    robot : Robot
        The nominal robot; samples have its diameters.
    wall : WallGeometry
        A lumen, or the nearest of several walls.
    beta : ndarray
        Extensions (T, d), mm, which samples share.
    shape : ndarray
        Shapes (n, T, 101, 3) of the robots at uniform sigma, mm.

    Returns
    -------
    ndarray
        Least clearance (n, T) over each body, mm; negative beyond the wall, NaN where a robot has no shape. The
        least of each robot is exact: it is measured at the triangles of walls that have some.
    """
    each = [clearance_from_wall(robot, part, beta, shape, axes=(1, 2)).min(axis=2) for part in parts_of(wall)]
    return np.asarray(np.min(each, axis=0))


def _distance(plan: PlanData, found: SampleMotions) -> Array:
    """Return the distances (n, T, 101) in mm of simulated shapes from the plan's targets at equal sigma."""
    away = found.shape - plan.target
    return np.asarray(np.sqrt(np.einsum("ntsk,ntsk->nts", away, away)))


def _measure_tolerance_costs(plan: PlanData) -> tuple[Array, Index]:
    """Return the growth of e3 (d, 6) in mm by each tolerance alone, and how many of its two robots fail (d, 6).

    Each robot is off by one standard deviation to either side; a lag, which has one side, is as large as its root
    mean square. NaN and 0 where a tolerance is 0.
    """
    cases = list(_single_tolerance_cases(plan))
    parts, lags = (np.array(arrays) for arrays in zip(*((part, lag) for _, part, lag in cases), strict=True))
    found = simulate_samples(plan.robot, perturb_robot(plan.robot, parts, lags), plan.q, plan.evaluated_model)
    squares = np.nanmean(rms_over_sigma(_distance(plan, found)) ** 2, axis=1)
    growth = np.full((plan.robot.d, len(COSTLY)), np.nan)
    lost = np.zeros(growth.shape, dtype=int)
    # Row 0 is the nominal robot. The mean square over the two robots of a tolerance is that over its whole band,
    # as far as squared errors are quadratic in it.
    for place in {place for place, *_ in cases[1:]}:
        rows = [row for row, (other, *_) in enumerate(cases) if other == place]
        growth[place] = math.sqrt(squares[rows].mean()) - math.sqrt(squares[0])
        lost[place] = (found.lost[rows] > 0).sum()
    return growth, lost


def _single_tolerance_cases(plan: PlanData) -> Iterator[tuple[tuple[int, int] | None, Array, Array]]:
    """Yield the nominal robot, then those that differ by one tolerance.

    Each is its place (tube, tolerance), None for the nominal one, its deviations (d, 5), and its lags (d,), rad.
    """
    d = plan.robot.d
    tolerances = plan.robot.tolerances
    bands = tolerances.bands(plan.robot.tubes)
    lags = tolerances.max_backlash(d)
    yield None, np.zeros_like(bands), np.zeros(d)
    for (i, k), sign in itertools.product(np.ndindex(d, len(COSTLY)), (-1.0, 1.0)):
        parts = np.zeros_like(bands)
        lag = np.zeros(d)
        # Over a band of half-width b, uniform values have the standard deviation b / sqrt(3).
        if k < len(DEVIATION_NAMES):
            parts[i, k] = sign * bands[i, k] / math.sqrt(3)
        else:
            lag[i] = lags[i] / math.sqrt(3)
        if parts.any() or lag.any():
            yield (i, k), parts, lag
