"""The path between frames: through all of them, steady, smooth; and what makes up for play in the drives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.optimize import minimize
from strategies import seeds

from ctr_nlp import Limits, Robot
from ctr_nlp.hardware.motion.path import backlash_compensation, path_through

NEAR = 1e-9
"""What rounding and the solver may leave, as a part of the largest value."""


def neighbours(q, d):
    """What must be steady besides the joints: distances between tubes."""
    return np.diff(q[..., d : 2 * d], axis=-1)


def overshoot(sample, frames):
    """By how much a sample (T - 1, n, k) between frames (T, k) leaves what its two frames span, at most."""
    low, high = np.minimum(frames[:-1], frames[1:])[:, None], np.maximum(frames[:-1], frames[1:])[:, None]
    return max((low - sample).max(), (sample - high).max())


def sampled(path, n=12):
    """Points (T - 1, n, k) of a path from every frame to the next."""
    steps = np.linspace(0, 1, n)
    return path(path.x[:-1, None] + np.diff(path.x)[:, None] * steps)


def check(robot, time, q, path):
    """What is promised of every path."""
    scale = NEAR * (1 + abs(q).max())
    np.testing.assert_allclose(path(time), q, atol=scale)
    sample = sampled(path)
    assert overshoot(sample, q) <= scale
    assert overshoot(neighbours(sample, robot.d), neighbours(q, robot.d)) <= scale
    h = 1e-6 * np.diff(time)[:, None]
    after, before = (path(time[:-1] + h[:, 0]) - q[:-1]) / h, (q[1:] - path(time[1:] - h[:, 0])) / h
    atol = 1e-5 * abs(np.diff(q, axis=0) / np.diff(time)[:, None]).max() + 1e-13 * (1 + abs(q).max()) / h.min()
    np.testing.assert_allclose(after[1:], before[:-1], atol=atol)


def bending(path, robot):
    """The integral of |W q''|^2, by Simpson's rule, exact for what is quadratic between frames."""
    middle = (path.x[:-1] + path.x[1:]) / 2
    step = np.diff(path.x)
    inner = 1e-9 * step
    ends = [path(place, 2) for place in (path.x[:-1] + inner, middle, path.x[1:] - inner)]
    first, half, last = ((robot.mm_per_unit * end) ** 2 for end in ends)
    return float((step[:, None] / 6 * (first + 4 * half + last)).sum())


@st.composite
def motions(draw, robot, least=2, most=25):
    """Frames within limits and order, as noise, walks, whole numbers with ties, or rests."""
    rng, frames = np.random.default_rng(draw(seeds)), draw(st.integers(least, most))
    size = draw(st.sampled_from([1e-9, 1e-3, 0.1, 1.0]))
    noise = rng.standard_normal((frames, 2 * robot.d + 2))
    kind = draw(st.sampled_from(["noise", "walk", "whole", "rests"]))
    if kind == "walk":
        noise = noise.cumsum(axis=0)
    if kind == "whole":
        noise, size = np.round(noise), 1.0
    if kind == "rests":
        noise = noise[np.maximum.accumulate(np.arange(frames) * (rng.random(frames) < 0.4))]
    q = size * noise
    beta = np.maximum.accumulate(q[:, robot.d : 2 * robot.d] * 20 + 5, axis=1)
    q[:, robot.d : 2 * robot.d] = np.clip(
        beta, robot.lower[robot.d : 2 * robot.d], robot.upper[robot.d : 2 * robot.d]
    )
    step = draw(st.sampled_from([1e-3, 0.1, 10.0])) * rng.uniform(0.5, 1.5, frames)
    return np.cumsum(step), q


@given(data=st.data())
def test_a_path_goes_steadily_through_every_frame(robot, data):
    time, q = data.draw(motions(robot))
    check(robot, time, q, path_through(robot, time, q))


@given(data=st.data())
def test_order_positions_and_carriage_gaps_hold_where_frames_keep_them(robot, data):
    """Both ends of beta's limits, tubes in contact that part again, and carriages that touch."""
    gapped = Robot(robot.tubes[:2], Limits(beta=[(0, 50), (0, 150)], carriage_gap=20.0))
    rng = np.random.default_rng(data.draw(seeds))
    frames = data.draw(st.integers(2, 15))
    first = rng.choice([0.0, 10.0, 30.0, 50.0], frames)
    second = first + rng.choice([0.0, 0.0, 40.0, 92.0, 92.0], frames)
    q = np.column_stack([rng.standard_normal((frames, 2)), first, second, np.zeros((frames, 2))])
    path = path_through(gapped, np.arange(frames) * 0.1, q)
    for place in sampled(path, 7).reshape(-1, 6):
        gapped.check(place, tolerance=1e-9)
    check(gapped, path.x, q, path)


@pytest.mark.parametrize("moving", [[0], [3], [3, 4], [6], []], ids=str)
def test_what_stands_still_does_not_disturb_what_moves(robot, moving, capfd):
    """All others rest in every frame; CasADi has nothing to say about it."""
    time = np.arange(10) * 0.1
    q = np.tile([0, 0, 0, 10, 20, 30, 0, 0.0], (10, 1))
    q[:, moving] += 0.5 * np.sin(10 * time)[:, None]
    path = path_through(robot, time, q)
    check(robot, time, q, path)
    rest = [i for i in range(8) if i not in moving]
    np.testing.assert_array_equal(sampled(path)[..., rest], np.broadcast_to(q[0, rest], (9, 12, len(rest))))
    if moving:
        assert (path(time[:2], 1)[:, moving] > 0.1).all()
    assert capfd.readouterr() == ("", "")


def test_two_frames_are_joined_by_a_straight_line(robot):
    q = np.array([[0, 1, 2, 10, 20, 30, 0, 0], [1, -1, 2, 15, 25, 28, 0.1, 0.0]])
    path = path_through(robot, np.array([1.0, 3.0]), q)
    np.testing.assert_allclose(path([1.0, 2.0, 3.0], 1), np.tile((q[1] - q[0]) / 2, (3, 1)), atol=1e-6)


def test_four_hundred_frames(robot):
    rng = np.random.default_rng(0)
    q = 0.1 * rng.standard_normal((400, 8)).cumsum(axis=0)
    q[:, 3:6] = np.clip(np.maximum.accumulate(20 + 5 * q[:, 3:6], axis=1), 0, [50, 107, 150])
    time = np.linspace(0.1, 40.0, 400)
    check(robot, time, q, path_through(robot, time, q))


@pytest.mark.parametrize("dt", [1e-3, 0.1, 10.0])
def test_where_nothing_binds_it_is_the_natural_spline(robot, dt):
    """Smooth monotone frames, whose natural cubic spline (the least integral of all) is steady as well."""
    t = np.linspace(0.0, 1.0, 15)[:, None]
    alpha = np.hstack([t + 0.1 * np.sin(3 * t), -2 * t - 0.1 * t**2, 0.5 * np.exp(t)])
    beta = np.hstack([2 + 10 * t, 4 + 16 * t + np.sin(2 * t), 8 + 40 * t + 3 * t**2])
    q = np.hstack([alpha, beta, 0.2 * t, 0.3 * np.tanh(t)])
    time = dt * np.arange(15)
    path, natural = path_through(robot, time, q), CubicSpline(time, q, bc_type="natural")
    np.testing.assert_allclose(sampled(path), sampled(natural), atol=1e-6)


def steady(chord):
    """Slopes (least, most) between which a cubic with these chords is monotone: to three times the lesser."""
    turns = chord[1:] * chord[:-1] <= 0
    inner = np.where(turns, 0.0, 3 * np.where(abs(chord[1:]) < abs(chord[:-1]), chord[1:], chord[:-1]))
    ends = np.concatenate([3 * chord[:1], inner, 3 * chord[-1:]])
    return np.minimum(ends, 0), np.maximum(ends, 0)


@given(seed=seeds, dt=st.sampled_from([1e-3, 0.1, 10.0]), size=st.sampled_from([1e-3, 1.0]))
def test_no_other_steady_path_of_one_tube_bends_less(robot, seed, dt, size):
    """The integral is convex: if steps towards random steady slopes do not lessen it, no steady slopes do."""
    rng = np.random.default_rng(seed)
    lone = Robot(robot.tubes[-1:])
    q = size * rng.standard_normal((12, 4)).cumsum(axis=0)
    time = dt * np.arange(12)
    path = path_through(lone, time, q)
    slopes, (low, high) = path(time, 1), steady(np.diff(q, axis=0) / dt)
    assert (slopes >= low - 1e-9 * abs(low).max()).all()
    assert (slopes <= high + 1e-9 * abs(high).max()).all()
    for _ in range(10):
        other = slopes + 0.1 * (rng.choice([low, high, slopes]) - slopes) * (rng.random((12, 4)) < 0.2)
        assert bending(CubicHermiteSpline(time, q, other), lone) >= bending(path, lone) * (1 - 1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_tubes_that_hold_each_other_bend_as_little_as_another_solver_finds(robot, seed):
    """Distances between tubes bind in these frames; SLSQP solves the same problem, posed anew."""
    rng = np.random.default_rng(seed)
    time, q = 0.1 * np.arange(6), np.zeros((6, 8))
    q[:, 3:6] = np.sort(rng.uniform(0, 10, (6, 3)).cumsum(axis=0) * 1.5, axis=1)
    path = path_through(robot, time, q)
    chord = np.diff(q[:, 3:6], axis=0) / 0.1
    low, high = steady(chord)
    apart_low, apart_high = steady(np.diff(chord, axis=1))

    def spline(x):
        return CubicHermiteSpline(time, q, np.hstack([np.zeros((6, 3)), x.reshape(6, 3), np.zeros((6, 2))]))

    def room(x):
        apart = np.diff(x.reshape(6, 3), axis=1)
        return np.concatenate([(apart - apart_low).ravel(), (apart_high - apart).ravel()])

    found = minimize(
        lambda x: bending(spline(x), robot) / 1e5,
        np.zeros(18),
        method="SLSQP",
        bounds=list(zip(low.ravel(), high.ravel(), strict=True)),
        constraints={"type": "ineq", "fun": room},
        options={"ftol": 1e-12, "maxiter": 500},
    )
    assert found.success
    free = path_through(Robot(robot.tubes[-1:]), time, q[:, [0, 5, 6, 7]])
    assert abs(free(time, 1)[:, 1] - path(time, 1)[:, 5]).max() > 1e-3, "nothing binds"
    assert bending(path, robot) == pytest.approx(1e5 * found.fun, rel=1e-5)
    assert room(path(time, 1)[:, 3:6].ravel()).min() > -1e-6


# Play in the drives


def joint_of(axis, backlash, first):
    """Where a joint with play is, by the play operator: pushed up by the axis, pulled down backlash later."""
    joints, joint = [], first
    for position in axis:
        joint = min(max(joint, position), position + backlash)
        joints.append(joint)
    return np.array(joints)


@given(seed=seeds, frames=st.integers(2, 20), down=st.booleans())
def test_play_does_not_show_at_frames(seed, frames, down):
    """A drive with play, moved along the made-up positions, has its joint where the plan's frames are."""
    rng = np.random.default_rng(seed)
    backlash = np.array([0.5, 1.3])
    positions = rng.integers(-3, 4, (frames, 2)).astype(float)
    time = np.arange(frames) * 0.1
    before = -backlash * down
    added = backlash_compensation(time, positions, backlash, before)
    fine = np.unique(np.concatenate([np.linspace(0, time[-1], 40 * frames), time]))
    plain = np.stack([np.interp(fine, time, column) for column in positions.T], axis=1)
    axis = plain + added(fine)
    for k in range(2):
        joint = joint_of(axis[:, k], backlash[k], positions[0, k])
        np.testing.assert_allclose(joint[np.searchsorted(fine, time)], positions[:, k], atol=1e-9)
        assert (added(fine)[:, k] >= -backlash[k] - 1e-12).all()
        assert (added(fine)[:, k] <= 1e-12).all()


@given(seed=seeds)
def test_the_joint_follows_all_along_but_where_play_is_taken_up(seed):
    rng = np.random.default_rng(seed)
    positions = rng.integers(-3, 4, (15, 1)).astype(float)
    time = np.arange(15.0)
    added = backlash_compensation(time, positions, np.array([0.4]), np.zeros(1))
    fine = np.linspace(0, 14, 14 * 50 + 1)
    plain = np.interp(fine, time, positions[:, 0])
    joint = joint_of(plain + added(fine)[:, 0], 0.4, positions[0, 0])
    taken = np.diff(added(time)[:, 0]) != 0
    within = np.append(np.repeat(taken, 50), taken[-1]) | np.append(taken[0], np.repeat(taken, 50))
    np.testing.assert_allclose(joint[~within], plain[~within], atol=1e-9)
    assert not taken[0] or positions[1, 0] < positions[0, 0]


@given(seed=seeds)
def test_without_play_nothing_is_added(seed):
    positions = np.random.default_rng(seed).standard_normal((10, 3))
    added = backlash_compensation(np.arange(10.0), positions, np.zeros(3), np.zeros(3))
    np.testing.assert_array_equal(added(np.linspace(0, 9, 50)), 0)


@pytest.mark.parametrize("part", [0.009, 0.02])
def test_a_hundredth_of_the_play_is_no_reversal(part):
    """Up, then noise; only more than a hundredth of the play is followed down."""
    noise = part * 0.5 * np.array([0.0, -1, 0, -1, 0, -1])
    positions = np.append([0.0, 1, 2], 3 + noise)[:, None]
    added = backlash_compensation(np.arange(9.0), positions, np.array([0.5]), np.zeros(1))
    assert bool(added(np.arange(9.0)).any()) == (part > 0.01)


def test_noise_that_creeps_is_a_reversal_in_the_end():
    """Each step back is too small to count; together they are not."""
    positions = np.append([0.0, 1.0], 1.0 - 0.004 * np.arange(1, 8))[:, None]
    added = backlash_compensation(np.arange(9.0), positions, np.array([1.0]), np.zeros(1))(np.arange(9.0))[:, 0]
    np.testing.assert_array_equal(added, [0, 0, 0, 0, -1, -1, -1, -1, -1])


def test_what_is_added_comes_and_goes_at_rest():
    """No jump of speed at frames, and never beyond one and a half times the mean speed of the take-up."""
    positions = np.array([[0.0], [2], [1], [0], [3]])
    added = backlash_compensation(np.arange(5.0), positions, np.array([0.8]), np.zeros(1))
    np.testing.assert_allclose(added(np.arange(5.0))[:, 0], [0, 0, -0.8, -0.8, 0], atol=1e-12)
    np.testing.assert_array_equal(added(np.arange(5.0), 1), 0)
    assert abs(added(np.linspace(0, 4, 401), 1)).max() == pytest.approx(1.2)
