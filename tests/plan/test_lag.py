"""Tubes that lag behind their motors, and sensors that are late."""

import itertools

import numpy as np
import pytest

from ctr_nlp import table_i_robot
from ctr_nlp.exceptions import RobotError
from ctr_nlp.plan.backlash import BacklashAndDrag, delay_configurations, overlaps
from ctr_nlp.robot.samples import perturb_robot

ROBOT = table_i_robot()
NONE = np.zeros(3)


def there_and_back(speed, seconds=10.0, steps=400):
    """Every tube turned against the one around it, to one side and back at a speed, half pushed out."""
    time = np.linspace(0, seconds, steps)
    q = np.zeros((steps, 8))
    q[:, :3] = (speed * np.minimum(time, seconds - time))[:, None] * np.array([1, 2, 3])
    q[:, 3:6] = 20.0, 50.0, 80.0
    return q, time


def test_without_lag_tubes_are_where_motors_are():
    q, time = there_and_back(1.0)
    np.testing.assert_array_equal(BacklashAndDrag(NONE, NONE, NONE).apply_to_motion(ROBOT, q, time), q)


def test_constant_play_is_that_of_draws():
    """Where one tube turns, and those within it with it, it lags as a draw's tube does."""
    q, time = there_and_back(0.7)
    q[:, 1:3] = q[:, :1]
    lags = np.array([0.1, 0.0, 0.0])
    draws = perturb_robot(ROBOT, np.zeros((1, 3, 5)), lags[None])
    fresh = np.arange(len(q)) == 0
    np.testing.assert_allclose(
        BacklashAndDrag(lags, NONE, NONE).apply_to_motion(ROBOT, q, time),
        draws.tube_configurations(q, fresh)[0],
        atol=1e-14,
    )


def test_tubes_that_turn_together_do_not_hold_each_other():
    q, time = there_and_back(0.7)
    q[:, 0], q[:, 2] = 0.0, q[:, 1]
    found = BacklashAndDrag(np.full(3, 0.1), NONE, np.full(3, 0.2)).apply_to_motion(ROBOT, q, time)
    np.testing.assert_array_equal(found[:, [0, 2]], q[:, [0, 2]])
    assert (q[100, 1] - found[100, 1]) > 0.1


def test_play_grows_with_what_of_the_curved_part_is_hidden():
    q = np.array([0, 0, 0, 20.0, 50.0, 80.0, 0, 0])
    np.testing.assert_allclose(overlaps(ROBOT, q), [50 - 20, 107 - 30, 150 - 30])
    q[3:6] = 50.0, 107.0, 150.0
    np.testing.assert_allclose(overlaps(ROBOT, q), [0, 50, 107])
    moved, time = there_and_back(1.0)
    found = BacklashAndDrag(NONE, np.full(3, 0.001), NONE).apply_to_motion(ROBOT, moved, time)
    behind = moved[150, :3] - found[150, :3]
    np.testing.assert_allclose(behind, 0.001 * overlaps(ROBOT, moved[150]), atol=1e-12)


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_drag_is_proportional_to_the_speed_and_play_is_not(speed):
    q, time = there_and_back(speed, 20.0, 4000)
    found = BacklashAndDrag(np.full(3, 0.03), NONE, np.full(3, 0.4)).apply_to_motion(ROBOT, q, time)
    for row, sign in ((1900, 1), (3900, -1)):
        np.testing.assert_allclose(q[row, :3] - found[row, :3], sign * (0.03 + 0.4 * speed), rtol=0.01)


def integrated(q, time, play, drag, steps=4000):
    """The same of one tube, by tiny steps of drag * d alpha / dt = (what play leaves) - alpha."""
    alpha, found = q[0], [q[0]]
    for (a, b), (s, t) in zip(itertools.pairwise(q), itertools.pairwise(time), strict=True):
        for goal in np.linspace(a, b, steps + 1)[1:]:
            alpha += (t - s) / steps * (np.clip(alpha, goal - play, goal + play) - alpha) / drag
        found.append(alpha)
    return np.array(found)


@pytest.mark.parametrize(("play", "drag"), [(0.1, 0.2), (0.0, 0.5), (0.3, 0.05)])
def test_tubes_follow_as_the_equation_of_play_and_drag_says(play, drag):
    random = np.random.default_rng(1)
    time = np.cumsum(random.uniform(0.05, 0.4, 30))
    turned = np.cumsum(random.uniform(-0.4, 0.4, 30) * (random.uniform(size=30) < 0.8))
    q = np.zeros((30, 8))
    q[:, 1], q[:, 2], q[:, 3:6] = turned, turned, (20.0, 50.0, 80.0)
    found = BacklashAndDrag(np.full(3, play), NONE, np.full(3, drag)).apply_to_motion(ROBOT, q, time)
    np.testing.assert_allclose(found[:, 1], integrated(turned, time, play, drag), atol=2e-4)


def test_between_samples_of_a_steady_motion_nothing_depends_on_how_often_one_looks():
    ends = []
    for steps in (2, 11, 101):
        time = np.linspace(0, 0.4, steps)
        q = np.zeros((steps, 8))
        q[:, :3] = np.outer(time, [2.0, 1.0, -1.0])
        ends.append(BacklashAndDrag(np.full(3, 0.03), NONE, np.full(3, 0.4)).apply_to_motion(ROBOT, q, time)[-1])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)
    np.testing.assert_allclose(ends[0], ends[2], atol=1e-12)


def test_a_little_drag_shows_in_proportion():
    """A fit that begins without drag must see where more of it leads."""
    q, time = there_and_back(0.5)
    found = [BacklashAndDrag(NONE, NONE, np.full(3, drag)).apply_to_motion(ROBOT, q, time) for drag in (0.0, 1e-6)]
    np.testing.assert_allclose((found[0] - found[1])[5:100, :3] / 1e-6, 0.5, rtol=1e-3)
    q[:, 3:6] *= np.linspace(0.5, 1.2, len(q))[:, None]  # whose play becomes less on the way
    found = [
        BacklashAndDrag(NONE, np.full(3, 0.002), np.full(3, drag)).apply_to_motion(ROBOT, q, time)
        for drag in (0.0, 1e-6)
    ]
    assert abs(found[0] - found[1]).max() < 1e-5


def test_several_robots_at_once_are_each_by_itself():
    q, time = there_and_back(0.9)
    play, drag = np.array([[0.1, 0, 0], [0, 0.2, 0.05]]), np.array([[0, 0.1, 0], [0.3, 0, 0]])
    both = BacklashAndDrag(play, np.zeros((2, 3)), drag).apply_to_motion(ROBOT, q, time)
    for k in range(2):
        np.testing.assert_allclose(
            both[k], BacklashAndDrag(play[k], NONE, drag[k]).apply_to_motion(ROBOT, q, time), atol=1e-14
        )


def test_a_delay_holds_back_all_axes_and_stops_where_a_recording_begins():
    time = np.array([0.0, 1.0, 2.0, 0.0, 1.0, 2.0])
    q = np.arange(6.0)[:, None] * np.ones(8)
    fresh = np.array([True, False, False, True, False, False])
    found = delay_configurations(q, time, 0.5, fresh)
    np.testing.assert_allclose(found[:, 0], [0, 0.5, 1.5, 3, 3.5, 4.5])
    np.testing.assert_allclose(found, np.repeat(found[:, :1], 8, axis=1))


def test_lags_that_cannot_be_are_refused():
    with pytest.raises(RobotError, match=r"drag of a lag is -0\.1; it must be at least 0"):
        BacklashAndDrag(NONE, NONE, np.array([0, -0.1, 0]))
    with pytest.raises(RobotError, match="play of a lag has nan"):
        BacklashAndDrag(np.array([np.nan, 0, 0]), NONE, NONE)


def tubes_of(seed, frames=12):
    """A random motion of tubes that turn to and fro, while they come out."""
    random = np.random.default_rng(seed)
    q = np.zeros((frames, 8))
    q[:, :3] = np.cumsum(random.uniform(-0.4, 0.4, (frames, 3)), axis=0)
    q[:, 3:6] = np.cumsum(random.uniform(0.0, 3.0, (frames, 3)), axis=0) + np.array([5.0, 20.0, 50.0])
    return q, np.cumsum(random.uniform(0.1, 0.3, frames))


@pytest.mark.parametrize("seed", range(8))
def test_motors_that_are_led_bring_tubes_with_play_where_they_are_to_be(seed):
    q, time = tubes_of(seed)
    lag = BacklashAndDrag([0.0, 0.05, 0.03], [0.001, 0.0, 0.0005])
    motors = lag.compensate_motion(ROBOT, q, time)
    assert abs(motors - q).max() > 0.03
    np.testing.assert_allclose(lag.apply_to_motion(ROBOT, motors, time), q, atol=1e-12)


def test_drag_is_led_against_too():
    time = np.linspace(0, 10, 401)
    q = np.zeros((401, 8))
    q[:, 2], q[:, 3:6] = 1.5 * np.sin(0.5 * time), (20.0, 50.0, 80.0)
    lag = BacklashAndDrag(0.03, 0.0002, 0.3)
    plain, led = (
        abs(lag.apply_to_motion(ROBOT, m, time) - q).max() for m in (q, lag.compensate_motion(ROBOT, q, time))
    )
    assert plain > 0.25
    assert led < 0.02
    q[:, 1] = np.sin(0.8 * time)  # the play of the tube around it is taken up at once, which drag answers late
    plain, led = (
        np.std(lag.apply_to_motion(ROBOT, m, time) - q) for m in (q, lag.compensate_motion(ROBOT, q, time))
    )
    assert led < plain / 3


def test_tubes_that_do_not_turn_are_not_led():
    q = np.zeros((5, 8))
    q[:, 3:6] = 10.0, 20.0, 30.0
    np.testing.assert_array_equal(BacklashAndDrag(0.1, 0.001, 0.2).compensate_motion(ROBOT, q, np.arange(5.0)), q)


def test_a_lag_of_too_many_tubes_is_refused():
    BacklashAndDrag(0.1, [0, 0, 0.001]).check(ROBOT)
    with pytest.raises(RobotError, match="play of a lag has 2 numbers, and the robot 3 tubes"):
        BacklashAndDrag([0.1, 0.1]).check(ROBOT)
