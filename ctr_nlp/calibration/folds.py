"""Folds of observations for errors held out, such that what is held out was not seen elsewhere."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ctr_nlp.calibration.measurements import Measurements
from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import number, whole_number
from ctr_nlp.typing import Index

NEAR = 1.0
"""mm: poses whose q differ by less, with 10 mm to the rad, are the same."""
BLOCK = 3.0
"""s of a motion that stay together."""


def same_poses(robot: Robot, measured: Measurements, near: float = NEAR) -> Index:
    """For every observation the first one that has its pose, or one near it, (T,).

    Near is what differs by less than so many mm, robot.mm_per_unit to the rad. Poses are compared with those that
    stand for others, so that a slow motion is not one pose from end to end. Recordings share their poses.
    """
    scaled, found = measured.q * robot.mm_per_unit, np.full(len(measured), -1)
    around = cKDTree(scaled).query_ball_point(scaled, near)
    for row, others in enumerate(around):
        if found[row] < 0:
            found[row] = row
            late = [other for other in others if found[other] < 0]
            found[late] = row
    return found


def folds(
    robot: Robot, measured: Measurements, count: int = 5, block: float = BLOCK, near: float = NEAR, seed: int = 0
) -> Index:
    """To which of so many folds, from 0, each observation belongs, (T,); raises OptionError.

    Poses that are repeated or retraced are in the fold of the first of them. Those of a motion are dealt out in
    blocks of so many seconds, in turn; poses measured one by one at random, by a seed.
    """
    count = whole_number(OptionError, "number of folds", count, 2)
    number(OptionError, "block of a fold", block, lambda s: s > 0, "be positive", " s")
    first = same_poses(robot, measured, near)
    leaders = np.unique(first)
    if measured.timed:
        begins = np.array([measured.time[measured.recording == k].min() for k in range(measured.recordings)])
        blocks = np.floor((measured.time - begins[measured.recording]) / block).astype(int)
        _, together = np.unique(np.stack([measured.recording, blocks])[:, leaders], axis=1, return_inverse=True)
        groups = together.ravel()
        own = groups % count
    else:
        groups = np.random.default_rng(seed).permutation(len(leaders))
        own = groups % count
    if groups.max() + 1 < count:
        raise OptionError(
            f"{groups.max() + 1} different poses or blocks of {block:g} s cannot be dealt out to {count} folds; "
            "ask for fewer folds, or shorter blocks"
        )
    by_leader = np.empty(len(measured), dtype=int)
    by_leader[leaders] = own
    return by_leader[first]


def retraced(robot: Robot, measured: Measurements, block: float = BLOCK, near: float = NEAR) -> Index:
    """Observations with the first one that had the same pose, in a motion by more than block s away, (n, 2)."""
    first = same_poses(robot, measured, near)
    again = first != np.arange(len(measured))
    if measured.timed:
        again &= (abs(measured.time - measured.time[first]) > block) | (
            measured.recording != measured.recording[first]
        )
    return np.stack([np.flatnonzero(again), first[again]], axis=1)
