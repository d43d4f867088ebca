"""A plan as commands: when frames are passed, straight pieces, going on, coming to the start, play, G-code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bench import homing_hardware, plan_of, sweep
from hypothesis import given
from hypothesis import strategies as st
from strategies import numbers

from ctr_nlp import table_i_robot
from ctr_nlp.exceptions import OptionError, TrajectoryError
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.motion import gcode
from ctr_nlp.hardware.motion.lookahead import MAX_PIECE_DURATION_S, FollowedPath
from ctr_nlp.hardware.motion.trajectory import approach_to, digests, remaining_trajectory, trajectory_of
from ctr_nlp.hardware.playing.record import Recorder
from ctr_nlp.plan.backlash import BacklashAndDrag

OVER = 1e-3


@pytest.fixture(scope="module")
def trajectory():
    return trajectory_of(sweep(), homing_hardware())


def loose(backlash=0.4):
    """Hardware whose drives all have play."""
    rig = homing_hardware()
    axes = tuple(replace(a, backlash=backlash, range=(a.range[0] - 1, a.range[1] + 1)) for a in rig.axes)
    return replace(rig, axes=axes)


def speeds(trajectory, commands, start):
    """Largest part of the axes' speeds that straight pieces use."""
    steps = np.diff(np.vstack([start, commands.positions]), axis=0)
    rate = abs(steps) / np.diff(commands.time, prepend=0.0)[:, None]
    return (rate / [axis.speed for axis in trajectory.hardware.axes]).max()


def test_frames_are_passed_where_and_in_the_order_the_plan_says(trajectory):
    plan = sweep()
    np.testing.assert_array_equal(trajectory.frames, np.arange(1, 21))
    assert trajectory.frame_time[0] == 0
    assert (np.diff(trajectory.frame_time) >= 0.1 * (1 - 1e-9)).all()
    assert trajectory.frame_time[-1] == pytest.approx(trajectory.duration)
    np.testing.assert_allclose(trajectory.at(trajectory.frame_time)[0], plan.q, atol=1e-6)
    np.testing.assert_allclose(
        trajectory.positions(trajectory.frame_time),
        trajectory.hardware.positions(trajectory.robot, plan.q),
        atol=1e-5,
    )
    np.testing.assert_array_equal(trajectory.at(np.array([0.0, trajectory.duration]))[1][0], 0)


@pytest.mark.parametrize("tempo", [0, -1, 1.1, np.nan, True])
def test_a_tempo_outside_of_0_to_1_is_refused(tempo):
    with pytest.raises(OptionError, match=r"tempo is .*; it must lie in \(0, 1\]"):
        trajectory_of(sweep(), homing_hardware(), tempo)


def test_half_the_tempo_takes_twice_the_time():
    plan, rig = sweep(), homing_hardware()
    half = trajectory_of(plan, rig, 0.5)
    inner = np.diff(half.frame_time)[2:-2]
    np.testing.assert_allclose(inner, 0.2, rtol=2e-3)
    assert trajectory_of(plan, rig).duration < half.duration


@given(longest=st.sampled_from([MAX_PIECE_DURATION_S, 0.02, 0.3, 10.0]))
def test_pieces_are_short_end_at_frames_and_keep_all_limits(trajectory, longest):
    commands = trajectory.commands(longest)
    length = np.diff(commands.time, prepend=0.0)
    assert (length > 0).all()
    assert length.max() <= longest * (1 + 1e-5)
    ends = [np.flatnonzero(abs(commands.time - t) < 1e-9) for t in trajectory.frame_time[1:]]
    assert all(len(end) == 1 for end in ends)
    np.testing.assert_array_equal(commands.frame[np.concatenate(ends)], trajectory.frames[1:])
    assert (np.diff(commands.frame) >= 0).all()
    np.testing.assert_array_equal(commands.positions, trajectory.positions(commands.time))
    assert speeds(trajectory, commands, trajectory.positions(np.zeros(1))) <= 1 + OVER
    for q in trajectory.at(commands.time)[0]:
        trajectory.robot.check(q)


@given(part=numbers(0.0, 0.999))
def test_the_rest_goes_on_along_the_same_way(trajectory, part):
    """From anywhere on the path: the same path, the same frame numbers, none twice and none lost."""
    s = trajectory.knots[0] + part * (trajectory.knots[-1] - trajectory.knots[0])
    rest = remaining_trajectory(trajectory, s)
    place = trajectory.motion.path(s)
    np.testing.assert_allclose(rest.at(np.zeros(1))[0][0], place, atol=1e-9)
    behind = int((trajectory.knots <= s + 1e-5).sum())
    np.testing.assert_array_equal(rest.frames, np.arange(behind, 21))
    np.testing.assert_array_equal(rest.knots[1:], trajectory.knots[behind:])
    np.testing.assert_allclose(rest.at(rest.frame_time[1:])[0], sweep().q[behind:], atol=1e-6)
    np.testing.assert_array_equal(np.unique(rest.commands().frame), rest.frames[1:])
    assert rest.digests == trajectory.digests
    assert abs(rest.at(np.array([0.0, rest.duration]))[1]).max() < 1e-6


@pytest.mark.parametrize("before", [1e-6, 1e-9, 1e-12, 1e-15])
def test_what_stands_a_hair_before_a_frame_stands_at_it(trajectory, before):
    """Resumed at a frame, rounding must not make a piece of no length of the path to it."""
    at, near = (
        remaining_trajectory(trajectory, trajectory.knots[7]),
        remaining_trajectory(trajectory, trajectory.knots[7] - before),
    )
    np.testing.assert_array_equal(near.frames, at.frames)
    assert near.duration == pytest.approx(at.duration, rel=1e-4)
    with pytest.raises(TrajectoryError, match="nothing is left of this trajectory: it has reached its last frame"):
        remaining_trajectory(trajectory, trajectory.knots[-1] - before)


@pytest.mark.parametrize("part", [1.0, 0.1])
def test_the_approach_to_the_start_is_straight_and_slow(part):
    trajectory = trajectory_of(sweep(), homing_hardware(approach=part))
    standing = np.array([-1.0, -1, -1, 90, 0, -45])
    approach = approach_to(trajectory, standing, np.zeros(2))
    start = trajectory.positions(np.zeros(1))[0]
    time = np.linspace(0, approach.duration, 200)
    positions = approach.positions(time)
    np.testing.assert_allclose(positions[0], standing, atol=1e-9)
    np.testing.assert_allclose(positions[-1], start, atol=1e-6)
    gone = (positions - standing) @ (start - standing) / ((start - standing) ** 2).sum()
    np.testing.assert_allclose(positions, standing + gone[:, None] * (start - standing), atol=1e-6)
    rate = abs(np.diff(positions, axis=0)) / time[1]
    used = (rate / [axis.speed for axis in trajectory.hardware.axes]).max()
    assert used <= part * (1 + OVER)
    assert used > 0.1 * part
    np.testing.assert_array_equal(approach.frames, [0, 1])


def test_the_approach_to_where_a_rest_starts_belongs_to_the_frame_ahead(trajectory):
    rest = remaining_trajectory(trajectory, float(trajectory.knots[4:6].mean()))
    approach = approach_to(rest, rest.positions(np.zeros(1))[0] + 0.1, np.zeros(2))
    np.testing.assert_array_equal(approach.frames, [5, 5])
    np.testing.assert_array_equal(np.unique(approach.commands().frame), [5])


def test_the_approach_from_the_start_to_the_start_is_short(trajectory):
    approach = approach_to(trajectory, trajectory.positions(np.zeros(1))[0], np.zeros(2))
    assert approach.duration < 0.1
    np.testing.assert_allclose(
        approach.positions(np.linspace(0, approach.duration, 9)), approach.positions(np.zeros(9)), atol=1e-9
    )


# Play


def held(axis, backlash, first):
    """Where joints with play are: pushed up by the axis, pulled down backlash later."""
    joints = [np.array(first, dtype=float)]
    for position in axis[1:]:
        joints.append(np.clip(joints[-1], position, position + backlash))
    return np.array(joints)


@pytest.mark.parametrize("tempo", [1.0, 0.3])
def test_joints_with_play_are_at_their_frames(tempo):
    """Every frame of a motion with reversals; the drives never exceed what they can do while they take play up."""
    t = np.linspace(0, 2 * np.pi, 25)[:, None]
    q = np.hstack([np.sin(t), np.cos(2 * t), 0 * t, 20 + 4 * np.sin(t), 40 + 4 * np.cos(t), 60 + t, 0 * t, 0 * t])
    trajectory = trajectory_of(plan_of(q, 0.1), loose(), tempo)
    fine = np.unique(np.append(np.linspace(0, trajectory.duration, 4001), trajectory.frame_time))
    axis = trajectory.positions(fine)
    wanted = trajectory.hardware.positions(trajectory.robot, q)
    joints = held(axis, 0.4, wanted[0])[np.searchsorted(fine, trajectory.frame_time)]
    np.testing.assert_allclose(joints, wanted, atol=0.01 * 0.4 + 1e-6)
    even = np.linspace(0, trajectory.duration, 4001)
    rate = np.diff(trajectory.positions(even), axis=0) / even[1]
    change = np.diff(rate, axis=0) / even[1]
    assert (abs(rate) / [a.speed for a in trajectory.hardware.axes]).max() <= 1 + OVER
    assert (abs(change) / [a.acceleration for a in trajectory.hardware.axes]).max() <= 1 + OVER
    assert np.ptp(trajectory.lash(trajectory.knots), axis=0)[[0, 1, 3, 4]] == pytest.approx(0.4)


def test_tubes_that_lag_are_at_their_frames():
    """Motors of tubes with play that grows with their overlap, within what the drives can do."""
    t = np.linspace(0, 2 * np.pi, 25)[:, None]
    q = np.hstack([np.sin(t), np.cos(2 * t), 0 * t, 20 + 4 * np.sin(t), 40 + 4 * np.cos(t), 60 + t, 0 * t, 0 * t])
    rig = replace(homing_hardware(), lag=BacklashAndDrag([0.02, 0.05, 0.1], [0.0, 0.001, 0.0005]))
    trajectory, free = (trajectory_of(plan_of(q, 0.1), each) for each in (rig, replace(rig, lag=None)))
    fine = np.unique(np.append(np.linspace(0, trajectory.duration, 4001), trajectory.frame_time))
    motors = trajectory.hardware.joints(trajectory.robot, trajectory.positions(fine), trajectory.tilt(fine))
    tubes = rig.lag.apply_to_motion(trajectory.robot, motors, fine)[np.searchsorted(fine, trajectory.frame_time)]
    assert abs(tubes - q).max() < 1e-3
    assert abs(motors[np.searchsorted(fine, trajectory.frame_time)] - q).max() > 0.1
    assert trajectory.joints(fine, trajectory.positions(fine)) == pytest.approx(trajectory.at(fine)[0])
    rate = abs(np.diff(motors[:, :3], axis=0)) / np.diff(fine)[:, None]
    assert (rate / trajectory.robot.speed[:3]).max() <= 1 + OVER
    assert trajectory.duration > free.duration
    assert trajectory.digests.hardware != free.digests.hardware


def test_the_first_frame_is_come_to_from_where_the_axes_stand():
    """From above the drive ends lower by its play, and on from there nothing is taken up twice."""
    plan, rig = sweep(), loose()
    start = rig.positions(rig.apply_limits(plan.robot), plan.q)[0]
    trajectory = trajectory_of(plan, rig, standing=start + np.array([5.0, 5, 5, -5, -5, -5]))
    np.testing.assert_allclose(trajectory.positions(np.zeros(1))[0] - start, [-0.4] * 3 + [0] * 3, atol=1e-9)
    approach = approach_to(trajectory, start + 5.0, np.zeros(2))
    np.testing.assert_allclose(
        approach.positions(np.array([approach.duration]))[0], trajectory.positions(np.zeros(1))[0], atol=1e-9
    )


def test_without_play_positions_are_those_of_the_joints(trajectory):
    time = np.linspace(0, trajectory.duration, 50)
    joints = trajectory.hardware.positions(trajectory.robot, trajectory.at(time)[0])
    np.testing.assert_array_equal(trajectory.positions(time), joints)


# Names of what is played


def test_the_digest_of_plan_or_hardware_changes_with_everything_in_it():
    plan, rig = sweep(), homing_hardware()
    known = digests(plan, rig)
    last = np.zeros(20)
    last[-1] = 1e-12
    slower = plan.robot.with_limits(alpha_speed=1.9)
    first, *others = rig.axes
    changed = [
        (replace(plan, time=plan.time + last), rig),
        *((replace(plan, **{n: getattr(plan, n) + last[:, None]}), rig) for n in ("alpha", "beta", "theta")),
        (replace(plan, success=plan.success & (last == 0)), rig),
        (replace(plan, meta=plan.meta | {"robot": slower.to_dict()}), rig),
        *(
            (plan, replace(rig, axes=(replace(first, **change), *others)))
            for change in (
                {"letter": "U"}, {"sign": 1}, {"zero": -1.5}, {"backlash": 0.1}, {"speed": 49.0},
                {"acceleration": 199.0}, {"range": (-50.5, -1.0)},
            )
        ),
        (replace(plan, shape=plan.shape + 1e-9), rig),
        (replace(plan, meta=plan.meta | {"solver": "another"}), rig),
        (plan, replace(rig, arm=simulated_hardware(plan.robot).arm)),
        (plan, replace(rig, connection=replace(rig.connection, baud=9600))),
        (plan, replace(rig, approach=0.5)),
    ]  # fmt: skip
    found = [digests(*case) for case in changed]
    assert len({known, *found}) == 1 + len(changed)
    assert all((names.plan == known.plan) is (case[0] is plan) for names, case in zip(found, changed, strict=True))


def test_the_same_plan_and_hardware_have_the_same_digests():
    plan, rig = sweep(), homing_hardware()
    copied = replace(plan, time=plan.time.copy(), meta=dict(plan.meta))
    assert digests(copied, replace(homing_hardware(), commissioned={"1": "255"})) == digests(plan, rig)


# G-code, paths and records


def test_lines_say_position_and_inverse_time():
    lines = gcode.lines("XA", np.zeros(2), np.array([[1.0, -2], [1.23456, 0]]), np.array([0.05, 0.15]))
    assert lines == ["N1 G1 X1.0000 A-2.0000 F1200.0000", "N2 G1 X1.2346 A0.0000 F600.0000"]


def test_lines_of_a_program_come_back(trajectory):
    commands = trajectory.commands()
    lines = gcode.lines(
        trajectory.hardware.letters, trajectory.positions(np.zeros(1))[0], commands.positions, commands.time
    )
    words = np.array([[float(word[1:]) for word in line.split()] for line in lines])
    np.testing.assert_array_equal(words[:, 0], np.arange(1, len(lines) + 1))
    np.testing.assert_allclose(words[:, 2:-1], commands.positions, atol=5.1e-5)
    np.testing.assert_allclose(np.cumsum(60 / words[:, -1]), commands.time, atol=1e-5)


@given(part=numbers(0.01, 0.99), away=numbers(0, 0.9))
def test_the_nearest_place_on_a_way_is_found(trajectory, part, away):
    """A place on a piece is where it is; beside the path, no other place is nearer."""
    commands = trajectory.commands()
    path = FollowedPath(trajectory.positions(np.zeros(1))[0], commands, trajectory.hardware.tolerance)
    k = int(part * len(commands.time))
    start, end = path.points[k], path.points[k + 1]
    place = path.nearest(start + 0.25 * (end - start), 0, len(commands.time))
    assert place.away < 1e-9
    assert place.line == k
    assert place.time == pytest.approx(path.ends[k] + 0.25 * (path.ends[k + 1] - path.ends[k]))
    assert path.nearest(end, 0, len(commands.time)).line == k + 1
    beside = start + away * trajectory.hardware.tolerance * [1, 0, 0, 0, 0, 0]
    assert path.nearest(beside, 0, len(commands.time)).away <= away + 1e-12


def test_a_recorder_tells_what_was_late_but_not_what_was_paused(trajectory):
    """Half a second behind from the middle on, and a pause of 3 s that does not count; 0.1 mm off all along."""
    recorder, paused = Recorder(), 0.0
    assert recorder.tracking() is None
    for time in np.linspace(0, trajectory.duration, 400):
        late = 0.5 if time > 1.0 else 0.0
        if time > 0.5 and not paused:
            position = trajectory.positions(np.array([time]))[0]
            for stamp in (0.0, 1.5):
                recorder(trajectory, MotionProgress("held", time, position, 7 + time + stamp, 0.0))
            paused = 3.0
        position = trajectory.positions(np.array([time]))[0] + 0.1
        recorder(trajectory, MotionProgress("running", time, position, 7 + time + late + paused, 0.0))
    found = recorder.tracking()
    np.testing.assert_array_equal(found.frame, trajectory.frames)
    np.testing.assert_array_equal(found.time, trajectory.frame_time)
    np.testing.assert_allclose(found.late, 0.5 * (trajectory.frame_time > 1.0), atol=0.01)
    np.testing.assert_allclose(found.error[trajectory.frame_time < 1.0], 0.1, atol=1e-3)


def test_the_digest_of_hardware_has_every_number_of_the_mounted_robot():
    """It is that of versions before tubes had a strain limit and robots a short summary."""
    robot = table_i_robot()
    rig = replace(simulated_hardware(robot), robot=robot)
    known = digests(sweep(), rig).hardware
    assert known == "99e533e506c1ee3fd0ec6f9d84743a03133de6dacc2ff3850c48101cc03166e8"
    first, *others = robot.tubes
    changed = [
        replace(robot, tubes=(replace(first, poisson_ratio=0.31), *others)),
        replace(robot, tubes=(replace(first, max_strain=0.1), *others)),
        robot.with_limits(theta_speed=0.79),
        replace(robot, tolerances=replace(robot.tolerances, motor_zero=0.021)),
    ]
    found = {digests(sweep(), replace(rig, robot=each)).hardware for each in changed}
    assert len(found | {known}) == 1 + len(changed)
