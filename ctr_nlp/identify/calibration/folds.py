"""Folds of observations for cross-validation, such that no held-out pose is in another fold.

Neighbours in time, and repetitions of a pose, have nearly the same residuals. Spread over folds at random they
would make held-out errors too small; so a pose, and a block of a motion, is in one fold as a whole.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import number, whole_number
from ctr_nlp.typing import Index

SAME_POSE_DISTANCE_MM = 1.0
"""Poses whose q differ by less, in mm and with 10 mm to the rad, are the same."""
FOLD_BLOCK_S = 3.0
"""Length of the blocks of a motion that are in one fold, s."""


def same_poses(robot: Robot, measured: Measurements, near: float = SAME_POSE_DISTANCE_MM) -> Index:
    """Find for every observation the first one that has its pose.

    Poses are compared only with the first ones, not with neighbours of neighbours, so that a slow motion is not
    one pose from end to end. Recordings share their poses.

    Parameters
    ----------
    robot : Robot
        The robot, whose ``mm_per_unit`` (10 mm to the rad) makes one distance of all entries of q.
    measured : Measurements
        T observations.
    near : float
        Distance within which poses count as the same, mm.

    Returns
    -------
    (T,) array of int
        The first observation of each one's pose, from 0.
    """
    scaled = measured.q * robot.mm_per_unit
    found = np.full(len(measured), -1)
    around = cKDTree(scaled).query_ball_point(scaled, near)
    for row, others in enumerate(around):
        if found[row] < 0:
            found[row] = row
            # An observation that belongs to an earlier pose already is left there.
            late = [other for other in others if found[other] < 0]
            found[late] = row
    return found


def assign_folds(
    robot: Robot,
    measured: Measurements,
    count: int = 5,
    block: float = FOLD_BLOCK_S,
    near: float = SAME_POSE_DISTANCE_MM,
    seed: int = 0,
) -> Index:
    """Assign observations to folds.

    Repeated poses are in the fold of the first of them. Motions are assigned in blocks of time, one fold after the
    other; poses measured one by one at random.

    Parameters
    ----------
    robot : Robot
        The robot.
    measured : Measurements
        T observations.
    count : int
        Number of folds, at least 2.
    block : float
        Length of the blocks of a motion, s.
    near : float
        Distance within which poses count as the same, mm; see :func:`same_poses`.
    seed : int
        Seed of the random order.

    Returns
    -------
    (T,) array of int
        The fold of every observation, from 0.

    Raises
    ------
    OptionError
        `count` or `block` is out of its range, or there are fewer different poses or blocks than folds.
    """
    count = whole_number(OptionError, "number of folds", count, 2)
    number(OptionError, "block of a fold", block, lambda s: s > 0, "be positive", " s")
    # Folds are assigned to the first observations of poses; all others of a pose follow theirs.
    first = same_poses(robot, measured, near)
    leaders = np.unique(first)
    if measured.has_times:
        begins = np.array([measured.time[measured.recording == k].min() for k in range(measured.recordings)])
        blocks = np.floor((measured.time - begins[measured.recording]) / block).astype(int)
        _, together = np.unique(np.stack([measured.recording, blocks])[:, leaders], axis=1, return_inverse=True)
        groups = together.ravel()
        # In turn, so that every fold has blocks from all parts of a motion.
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


def find_repeated_poses(
    robot: Robot, measured: Measurements, block: float = FOLD_BLOCK_S, near: float = SAME_POSE_DISTANCE_MM
) -> Index:
    """Find observations whose pose had been measured before.

    Parameters
    ----------
    robot : Robot
        The robot.
    measured : Measurements
        The observations.
    block : float
        Time, s, that must lie between two observations of one motion; neighbours are no repetition.
    near : float
        Distance within which poses count as the same, mm; see :func:`same_poses`.

    Returns
    -------
    (n, 2) array of int
        Such observations, and the first ones that had their pose; from 0.
    """
    first = same_poses(robot, measured, near)
    again = first != np.arange(len(measured))
    if measured.has_times:
        again &= (abs(measured.time - measured.time[first]) > block) | (
            measured.recording != measured.recording[first]
        )
    return np.stack([np.flatnonzero(again), first[again]], axis=1)
