"""When a path is where: within all limits, at the plan's pace where they allow it, and hardly later where not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from strategies import numbers, seeds

from ctr_nlp.hardware.motion.timing import TimedPath, compute_time_scaling

OVER = 1e-3
"""Part of a limit that finite differences may show more of."""


def path_of(spline):
    return lambda s, order=0: np.asarray(spline(s, order))


def straight(frames, dt, goal):
    """A path along a line: parameters of its frames, and the path."""
    knots = dt * np.arange(frames)
    ends = np.outer(knots / knots[-1], goal)
    return knots, path_of(CubicHermiteSpline(knots, ends, np.tile(np.array(goal) / knots[-1], (frames, 1))))


@st.composite
def paths(draw):
    """Steady paths of three joints through random frames, some of which rest: (knots, path)."""
    rng, frames = np.random.default_rng(draw(seeds)), draw(st.integers(2, 15))
    q = draw(st.sampled_from([0.01, 1.0, 30.0])) * rng.standard_normal((frames, 3))
    if draw(st.booleans()):
        q = q[np.maximum.accumulate(np.arange(frames) * (rng.random(frames) < 0.6))]
    dt = draw(st.sampled_from([1e-3, 0.1, 5.0]))
    knots = dt * np.cumsum(rng.uniform(0.7, 1.3, frames))
    return knots, path_of(PchipInterpolator(knots, q)) if frames > 2 else straight(2, dt, q[1] - q[0])[1]


limits = st.tuples(
    *[st.sampled_from([1e-2, 1.0, 30.0, np.inf])] * 3, *[st.sampled_from([0.1, 5.0, 1e3, np.inf])] * 3
)
"""Largest speeds and accelerations of three joints."""


def within(motion, speed, acceleration):
    """Largest parts of both limits that finite differences of positions use, and of speed that at() tells."""
    time = np.linspace(0, motion.duration, 4001)
    step = time[1]
    place = motion.at(time)[0]
    rate = np.diff(place, axis=0) / step
    change = np.diff(rate, axis=0) / step
    rounding = 1e-15 * (1 + abs(place).max())
    return (
        float(((abs(rate) - 4 * rounding / step) / speed).max()),
        float(((abs(change) - 8 * rounding / step**2) / acceleration).max()),
    )


@given(case=paths(), limit=limits, tempo=st.sampled_from([1.0, 0.4]))
def test_speeds_and_accelerations_keep_limits_from_rest_to_rest(case, limit, tempo):
    knots, path = case
    speed, acceleration = np.array(limit[:3]), np.array(limit[3:])
    motion = compute_time_scaling(path, path, knots, speed, acceleration, tempo)
    fastest, hardest = within(motion, speed, acceleration)
    assert fastest <= 1 + OVER
    assert hardest <= 1 + OVER
    assert motion.pace[0] == pytest.approx(0, abs=1e-6)
    assert motion.pace[-1] == pytest.approx(0, abs=1e-6)
    assert motion.pace.max() <= tempo * (1 + 1e-6)
    assert (np.diff(motion.time) > 0).all()
    np.testing.assert_array_equal(motion.s[[0, -1]], knots[[0, -1]])
    assert motion.duration >= (knots[-1] - knots[0]) / tempo


@given(case=paths(), limit=limits)
def test_velocities_and_accelerations_are_derivatives(case, limit):
    """Central differences over 1e-5 of the shortest cell, away from its ends."""
    knots, path = case
    motion = compute_time_scaling(path, path, knots, np.array(limit[:3]), np.array(limit[3:]), 1.0)
    cells = np.diff(motion.time)
    wide = cells > 0.1 * cells.max()
    middle, h = (motion.time[:-1] + 0.4 * cells)[wide], 1e-3 * cells[wide]
    before, now, after = (motion.at(time) for time in (middle - h, middle, middle + h))
    scale = abs(now[1]).max() + 1e-12
    np.testing.assert_allclose((after[0] - before[0]) / (2 * h[:, None]), now[1], atol=1e-4 * scale)
    rate = abs(now[2]).max() + 1e-12
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h[:, None]), now[2], atol=1e-3 * rate)


@given(case=paths(), limit=limits, part=numbers(0, 1))
def test_when_and_parameter_are_inverse(case, limit, part):
    knots, path = case
    motion = compute_time_scaling(path, path, knots, np.array(limit[:3]), np.array(limit[3:]), 1.0)
    span = knots[-1] - knots[0]
    s = knots[0] + span * np.sort(np.append(np.linspace(0, 1, 57), part))
    time = motion.when(s)
    np.testing.assert_allclose(motion.parameter(time), s, atol=1e-9 * span)
    assert (np.diff(time) >= 0).all()
    assert time[0] == 0
    np.testing.assert_allclose(time[-1], motion.duration, rtol=1e-6)
    np.testing.assert_allclose(motion.when(motion.s), motion.time, rtol=1e-6)
    assert motion.parameter(-1.0) == knots[0]
    assert motion.parameter(2 * motion.duration) == pytest.approx(knots[-1])


@pytest.mark.parametrize("tempo", [1.0, 0.5, 0.01])
def test_what_the_limits_allow_is_played_at_the_plans_pace(tempo):
    """Only the first and last cells, in which it starts and stops, cost time: each as much again."""
    knots, path = straight(31, 0.1, [3.0, -1.0])
    motion = compute_time_scaling(path, path, knots, np.array([1e3, 1e3]), np.array([1e5, 1e5]), tempo)
    inner = (motion.s > 0.1) & (motion.s < 2.9)
    np.testing.assert_allclose(motion.pace[inner], tempo, rtol=1e-4)
    assert motion.duration == pytest.approx((3.0 + 2 * 0.1 / 6) / tempo, rel=1e-4)


def test_a_slow_place_does_not_slow_the_rest():
    """One joint must be ten times slower between two frames; elsewhere hardly anything is lost."""
    knots = 0.1 * np.arange(31)
    q = np.where(knots < 1.45, 0.0, 1.0)[:, None]
    path = path_of(PchipInterpolator(knots, np.hstack([q, knots[:, None]])))
    motion = compute_time_scaling(path, path, knots, np.array([1.5, 100.0]), np.array([50.0, 1e4]), 1.0)
    away = ((motion.s > 0.1) & (motion.s < 1.2)) | ((motion.s > 1.7) & (motion.s < 2.9))
    assert (motion.pace[away] > 0.85).all()
    assert motion.pace.min(where=(motion.s > 0.1) & (motion.s < 2.9), initial=1.0) == pytest.approx(0.1, rel=0.15)


@pytest.mark.parametrize("dt", [1e-4, 1e-2])
@pytest.mark.parametrize("frames", [10, 100])
@pytest.mark.parametrize(
    ("speed", "acceleration"), [(5.0, 10.0), (50.0, 10.0), (1.0, 4.0), (np.inf, 3.0), (0.1, 1.0)]
)
def test_a_straight_way_takes_as_long_as_bang_bang(speed, acceleration, frames, dt):
    """10 mm: full acceleration, full speed if it comes to that, full deceleration; also where the plan's pace is
    far beyond what the drive can do."""
    knots, path = straight(frames, dt, [10.0])
    motion = compute_time_scaling(path, path, knots, np.array([speed]), np.array([acceleration]), 1.0)
    cruises = speed**2 / acceleration < 10.0
    least = 10.0 / speed + speed / acceleration if cruises else 2 * np.sqrt(10.0 / acceleration)
    assert least <= motion.duration <= 1.05 * max(least, knots[-1])


@pytest.mark.parametrize(("speed", "acceleration"), [(np.inf, np.inf), (1e9, 1e12), (1e-6, 1e-6), (1e6, 1e-9)])
def test_limits_of_any_size(speed, acceleration):
    knots, path = straight(20, 0.1, [1.0, 0.0])
    motion = compute_time_scaling(path, path, knots, np.full(2, speed), np.full(2, acceleration), 1.0)
    least = max(1.9, 1 / speed, 2 * np.sqrt(1 / acceleration) if np.isfinite(acceleration) else 0)
    assert least <= motion.duration <= 1.05 * least


def test_a_path_that_stands_still_takes_its_time():
    """No joint moves at all, or only in the middle: the clock goes on at the plan's pace."""
    knots = 0.1 * np.arange(21)
    rests = path_of(CubicHermiteSpline(knots, np.zeros((21, 2)), np.zeros((21, 2))))
    motion = compute_time_scaling(rests, rests, knots, np.ones(2), np.ones(2), 1.0)
    assert motion.duration == pytest.approx(2.0, rel=0.03)
    np.testing.assert_array_equal(motion.at(np.linspace(0, 2, 9))[0], 0)
    q = np.interp(knots, [0, 0.8, 1.2, 2.0], [0, 0, 0.1, 0.1])[:, None]
    pauses = path_of(PchipInterpolator(knots, q))
    motion = compute_time_scaling(pauses, pauses, knots, np.ones(1), np.full(1, 100.0), 1.0)
    assert motion.duration == pytest.approx(2.0, rel=0.03)
    assert (motion.at(np.linspace(0, 0.7, 9))[0] == 0).all()


def test_what_is_limited_is_what_the_drives_do():
    """The path rests while its drive takes up 1 mm of play in a plan's 0.1 s, at 2 mm/s and 100 mm/s^2."""
    knots = 0.1 * np.arange(11)
    rests = path_of(CubicHermiteSpline(knots, np.zeros((11, 1)), np.zeros((11, 1))))
    takes = np.where(knots < 0.45, 0.0, 1.0)[:, None]
    drive = path_of(CubicHermiteSpline(knots, takes, np.zeros((11, 1))))
    motion = compute_time_scaling(rests, drive, knots, np.array([2.0]), np.array([100.0]), 1.0)
    driven = TimedPath(drive, motion.s, motion.pace)
    assert max(within(driven, np.array([2.0]), np.array([100.0]))) <= 1 + OVER
    assert motion.duration > 1.0 - 0.1 + 1.0 / 2.0
    np.testing.assert_array_equal(motion.at(np.linspace(0, 1, 5))[0], 0)


@given(seed=seeds, part=numbers(0.02, 0.98))
def test_the_rest_of_a_path_starts_and_ends_at_rest(seed, part):
    """From a place between two frames: the limits hold, and it takes no longer than the whole."""
    rng = np.random.default_rng(seed)
    knots = 0.1 * np.arange(12)
    path = path_of(PchipInterpolator(knots, rng.standard_normal((12, 2))))
    speed, acceleration = np.array([5.0, 20.0]), np.array([60.0, 200.0])
    whole = compute_time_scaling(path, path, knots, speed, acceleration, 1.0)
    s = part * knots[-1]
    rest = compute_time_scaling(path, path, np.append(s, knots[knots > s]), speed, acceleration, 1.0)
    assert max(within(rest, speed, acceleration)) <= 1 + OVER
    assert rest.duration <= whole.duration
    np.testing.assert_allclose(rest.at(np.zeros(1))[0][0], path(s))
    np.testing.assert_allclose(rest.at(np.array([rest.duration]))[0][0], path(knots[-1]), atol=1e-12)
