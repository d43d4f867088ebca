"""Whether joints rest, from joint states that come often, rarely or with gaps."""

from __future__ import annotations

import numpy as np
import pytest

from ctr_nlp import table_i_robot
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.devices.ros2.joints import AGREEING, Joints
from ctr_nlp.hardware.devices.ros2.messages import JointStates


def joints_after(times, last_axis):
    """Joints of a bench that has told states at times (s), its last axis (rad) at last_axis, all others at 0."""
    hardware = simulated_hardware(table_i_robot())
    joints = Joints(hardware, hardware.tolerance / 10)
    for time, turned in zip(times, last_axis, strict=True):
        position = [0.0] * (len(joints.names) - 1) + [turned]
        joints.take([JointStates(time, joints.names, position, [])], 1000.0 + time)
    return joints


@pytest.mark.parametrize("period", [0.002, 0.01, 0.1, 0.3])
def test_joints_that_do_not_move_are_still_however_often_they_are_told(period):
    times = period * np.arange(200)
    assert joints_after(times, np.zeros(200)).still()


def test_joints_stay_still_over_a_gap_in_the_states():
    """A busy machine tells nothing for a while: that is no motion."""
    times = np.append(0.01 * np.arange(20), [0.27, 0.28])
    for told in range(10, len(times)):
        assert joints_after(times[:told], np.zeros(told)).still(), times[told - 1]


@pytest.mark.parametrize("period", [0.002, 0.01, 0.1])
def test_joints_that_move_are_not_still(period):
    times = period * np.arange(200)
    assert not joints_after(times, 0.3 * times).still()


def test_too_few_states_tell_nothing():
    times = 0.1 * np.arange(AGREEING - 1)
    assert not joints_after(times, np.zeros(AGREEING - 1)).still()
