"""Corrections, whatever is wanted: limits of position, order, carriages, speed and acceleration are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench import homing_hardware, plan_of, sweep

from ctr_nlp import table_i_robot
from ctr_nlp.hardware.guiding.corrected_trajectory import FIRST_CORRECTED_KNOT
from ctr_nlp.hardware.guiding.leeway import Leeway
from ctr_nlp.hardware.motion.trajectory import Patch, Trajectory, remaining_trajectory, trajectory_of

SHARE = 0.6
SIZE = np.array([1.0, 1.0, 1.0, 6.0, 6.0, 6.0, 0.2, 0.2])
"""By how much corrections are wanted, rad and mm."""


def from_nothing(frames: int = 40, gap: float | None = None) -> Trajectory:
    """Tubes that start all in and one in the other, reach their ends, and come back a bit: limits all the way."""
    t = np.linspace(0.0, 1.0, frames)[:, None]
    out = np.minimum(1.25 * t, 1.0) - 0.3 * np.maximum(t - 0.9, 0.0)
    beta = np.array([50.0, 107.0, 150.0]) * out
    q = np.hstack([0.8 * t, -0.6 * np.sin(2.5 * t), 0.4 * t**2, beta, 0 * t, 0 * t])
    robot = table_i_robot() if gap is None else table_i_robot().with_limits(carriage_gap=gap)
    return trajectory_of(plan_of(q, 0.2, robot), homing_hardware(), share=SHARE)


def wild(trajectory: Trajectory, seed: int, scale: float) -> tuple[Leeway, np.ndarray]:
    """Offsets at knots that try to go anywhere."""
    leeway, random = Leeway(trajectory), np.random.default_rng(seed)
    offsets = np.zeros((len(leeway.knots), 8))
    for knot in range(FIRST_CORRECTED_KNOT, len(offsets)):
        offsets[knot] = leeway.nearest_allowed_offset(
            knot, offsets[knot - 1], scale * SIZE * random.standard_normal(8)
        )
    return leeway, offsets


def shifted(trajectory: Trajectory, leeway: Leeway, offsets: np.ndarray) -> Trajectory:
    """The trajectory through these, by their definition."""
    path = trajectory.motion.path
    k = np.clip(np.searchsorted(leeway.knots, path.x, "right") - 1, 0, len(leeway.knots) - 2)
    length = np.diff(leeway.knots)[k][:, None]
    x = np.clip((path.x - leeway.knots[k])[:, None] / length, 0.0, 1.0)
    change = np.diff(offsets, axis=0)[k]
    q = path(path.x) + offsets[k] + change * (3 * x**2 - 2 * x**3)
    return trajectory.apply_patch(Patch(0, q, path(path.x, 1) + change * (6 * x * (1 - x)) / length))


def check(trajectory: Trajectory) -> None:
    robot, hardware = trajectory.robot, trajectory.hardware
    q, speed, acceleration = trajectory.at(np.linspace(0.0, trajectory.duration, 20000))
    assert (q >= robot.lower - 1e-9).all()
    assert (q <= robot.upper + 1e-9).all()
    growth = np.diff(q[:, 3:6], axis=1)
    assert growth.min() >= -1e-9
    assert (growth <= robot.max_extension_differences + 1e-9).all()
    assert (abs(speed) <= robot.speed * (1 + 1e-6)).all()
    assert (abs(acceleration) <= robot.acceleration * (1 + 1e-6)).all()
    positions = trajectory.commands().positions
    for k, axis in enumerate(hardware.axes):
        assert axis.range[0] - 1e-9 <= positions[:, k].min() <= positions[:, k].max() <= axis.range[1] + 1e-9


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("gap", [None, 20.0])
def test_all_limits_are_kept_whatever_is_wanted(gap, scale):
    trajectory = from_nothing(gap=gap)
    for seed in range(10):
        leeway, offsets = wild(trajectory, seed, scale)
        assert abs(offsets).max(axis=0)[:6].min() > 0.01
        check(shifted(trajectory, leeway, offsets))


def test_limits_are_kept_where_play_in_the_drives_is_made_up_for():
    rig = homing_hardware()
    axes = tuple(replace(axis, backlash=0.4) for axis in rig.axes)
    trajectory = trajectory_of(sweep(40, 0.1), replace(rig, axes=axes), share=SHARE)
    for seed in range(5):
        check(shifted(trajectory, *wild(trajectory, seed, 1.0)))


def test_what_is_left_after_a_stop_keeps_them_too():
    whole = from_nothing()
    led = shifted(whole, *wild(whole, 3, 1.0))
    rest = remaining_trajectory(led, 0.3 * float(whole.knots[-1]))
    for seed in range(5):
        check(shifted(rest, *wild(rest, seed, 1.0)))


def test_from_anywhere_it_goes_back_to_the_plan_within_limits():
    trajectory = from_nothing()
    leeway, offsets = wild(trajectory, 1, 10.0)
    middle = len(offsets) // 2
    assert offsets[middle].any()
    offsets[middle:] = leeway.offsets_back_to_plan(middle, offsets[middle])
    check(shifted(trajectory, leeway, offsets))
    assert not offsets[-1].any()


def test_what_is_wanted_within_reach_is_done_and_beyond_it_comes_as_near_as_it_may():
    trajectory = from_nothing()
    leeway = Leeway(trajectory)
    middle, still = len(leeway.knots) // 2, np.zeros(8)
    low, high = leeway.box(middle, still)
    assert leeway.nearest_allowed_offset(middle, still, 0.5 * high)[:3] == pytest.approx(0.5 * high[:3])
    assert leeway.nearest_allowed_offset(middle, still, np.full(8, 100.0))[:3] == pytest.approx(high[:3])
    assert leeway.nearest_allowed_offset(middle, still, np.full(8, -100.0))[:3] == pytest.approx(low[:3])
    assert not leeway.nearest_allowed_offset(middle, still, np.full(8, 100.0))[-2:].any()


def test_a_knot_is_at_least_a_fifth_of_a_second_after_the_one_before():
    leeway = Leeway(from_nothing(200))
    assert np.diff(leeway.time).min() >= 0.2
    assert leeway.frames[[0, -1]].tolist() == [1, 200]
