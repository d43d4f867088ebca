"""Folds that cannot leak: poses that are repeated or retraced are held out together."""

import numpy as np
import pytest
from sensed import TWO, observations

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.calibration.folds import assign_folds, find_repeated_poses, same_poses


def poses(count, seed=0):
    random = np.random.default_rng(seed)
    q = np.zeros((count, 6))
    q[:, :2] = random.uniform(-3, 3, (count, 2))
    q[:, 2:4] = np.sort(random.uniform(5, 80, (count, 2)), axis=1)
    return q


def seen(q, time=None):
    return observations(q, tip=np.random.default_rng(1).standard_normal((len(q), 3)), time=time)


def test_repeated_poses_are_in_one_fold_however_they_are_shuffled():
    q, order = poses(40), np.random.default_rng(2).permutation(160)
    near = np.tile(q, (4, 1)) + np.random.default_rng(3).uniform(-0.02, 0.02, (160, 6))
    measured = seen(near[order])
    found = assign_folds(TWO, measured, 5)
    for k in range(40):
        assert len(set(found[order % 40 == k])) == 1
    assert set(found) == set(range(5))
    assert len(find_repeated_poses(TWO, measured)) == 120


def test_a_motion_that_goes_back_is_in_the_fold_of_its_way_there():
    time = np.arange(0, 60, 0.1)
    there = np.minimum(time, 60 - time)
    q = np.zeros((len(time), 6))
    q[:, 0], q[:, 1], q[:, 2], q[:, 3] = there / 5, -there / 3, 20 + there, 50 + there
    measured = seen(q, time)
    found = assign_folds(TWO, measured, 5, block=3.0)
    mirror = np.argmin(abs(there[:, None] - there[None, :300]), axis=1)
    assert (found == found[mirror]).mean() > 0.99
    assert (found[:30] == found[0]).all()
    assert set(found) == set(range(5))
    again = find_repeated_poses(TWO, measured, block=3.0)
    assert len(again) > 250
    assert (abs(time[again[:, 0]] - time[again[:, 1]]) > 3.0).all()


def test_a_slow_motion_is_not_one_pose_from_end_to_end():
    time = np.arange(0, 30, 0.1)
    q = np.zeros((300, 6))
    q[:, 2], q[:, 3] = 20.0, 40 + time
    measured = seen(q, time)
    first = same_poses(TWO, measured)
    assert (abs(q[first, 3] - q[:, 3]) <= 1.0).all()
    assert len(set(first)) > 10
    assert len(find_repeated_poses(TWO, measured)) == 0


def test_too_many_folds_are_refused():
    with pytest.raises(OptionError, match="3 different poses or blocks"):
        assign_folds(TWO, seen(poses(3)), 5)
    with pytest.raises(OptionError, match="number of folds is 1"):
        assign_folds(TWO, seen(poses(9)), 1)
    with pytest.raises(OptionError, match="block of a fold is 0 s; it must be positive"):
        assign_folds(TWO, seen(poses(9)), 3, block=0)
