"""Equilibria along motions: the branch that a robot is on, and where it snaps."""

from __future__ import annotations

import numpy as np
import pytest
import truth
from frames import configuration, follow, settled, untwisted
from frames import elastic_shapes as shapes
from frames import elastic_tangents as tangents
from hypothesis import given
from strategies import numbers, robots_with_q

from ctr_nlp import Robot, Tube, table_i_robot
from ctr_nlp.models.elastic import Elastic, stability
from ctr_nlp.models.elastic.following import follow_robot_batch, follow_substeps
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.robot.samples import perturb_robot, sample_robots

LONG = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
BETA = 60.0, 80.0


pytestmark = pytest.mark.interpreted


@pytest.fixture
def compiled(monkeypatch):
    """Asks for compiled code."""
    monkeypatch.setenv("CTR_NLP_COMPILE", "now")


def branch(count=20001):
    """Angles of LONG's outer tube between the tips, and those between the motors: the whole S-shaped curve."""
    phi = np.linspace(0, 2 * np.pi, count)
    x = np.column_stack([phi, 0 * phi, np.tile([*BETA, 0, 0], (count, 1))])
    alpha = configuration(LONG, x)[:, :2]
    return x, alpha[:, 0] - alpha[:, 1]


def turning(start, end, frames=81):
    """LONG with its outer tube turned against the inner one."""
    q = np.zeros((frames, 6))
    q[:, 0], q[:, 2:4] = np.linspace(start, end, frames), BETA
    return q


@pytest.mark.parametrize("number", range(0, truth.CASES, 3))
def test_settled_is_where_the_motors_are(shared_data, number):
    case = truth.case(shared_data, number)
    x = settled(case.robot, case.q)
    np.testing.assert_allclose(configuration(case.robot, x[None])[0], case.q, atol=1e-10)
    assert stability.margins(case.robot.tube_numbers, x[None])[0] > 0


def test_the_margin_is_zero_where_the_branch_turns_back():
    x, alpha = branch()
    fold = np.argmax(alpha[: len(alpha) // 2])
    assert alpha[fold] > np.pi + 0.5
    margins = stability.margins(LONG.tube_numbers, x[[fold - 50, fold, fold + 50]])
    assert margins[0] > 1e-3
    assert abs(margins[1]) < 2e-3
    assert margins[2] < -1e-3


def test_a_robot_snaps_where_its_branch_ends_and_elsewhere_on_the_way_back():
    """What is asked of the snap is read off the S-shaped curve of all equilibria, which takes no Newton steps."""
    x, alpha = branch()
    half = len(alpha) // 2
    fold, back = alpha[:half].max(), alpha[half:].min()
    q = turning(0.0, fold + 1)
    there = follow(LONG, q)
    (snap,) = there.snaps
    assert snap.frame == 1 + np.argmax(q[:, 0] > fold)
    assert snap.tubes == (1, 2)
    after = x[half:][np.argmin(abs(alpha[half:] - fold))]
    assert there.x[snap.frame - 2, 0] < np.pi < there.x[snap.frame - 1, 0]
    assert there.x[-1, 0] > after[0]
    assert np.nanmin(there.stability) > 0
    assert there.stability_between[snap.frame - 1] <= 0
    assert np.delete(there.stability_between, snap.frame - 1).min() > 0
    np.testing.assert_allclose(configuration(LONG, there.x), q, atol=1e-9)
    again = follow(LONG, q[::-1], there.x[-1])
    (other,) = again.snaps
    assert other.frame == 1 + np.argmax(q[::-1, 0] < back)
    assert q[::-1][other.frame - 1, 0] < q[snap.frame - 1, 0] - 0.5
    np.testing.assert_allclose(again.x[-1], there.x[0], atol=1e-9)


def test_where_a_robot_falls_is_the_other_end_of_the_jump():
    x, alpha = branch()
    half = len(alpha) // 2
    fold = np.argmax(alpha[:half])
    after = half + np.argmin(abs(alpha[half:] - alpha[fold]))
    (snap,) = follow(LONG, turning(0.0, alpha[fold] + 0.2)).snaps
    inner = -configuration(LONG, x[[fold, after]])[:, 1]
    jumps = np.diff(inner + x[[fold, after], 0]), np.diff(inner)
    assert snap.jump == pytest.approx(np.abs(jumps).max(), abs=0.01)


def test_a_shape_after_a_snap_is_the_mirror_image_of_that_on_the_way_back():
    q = turning(0.0, 2 * np.pi, 41)
    points = shapes(LONG, follow(LONG, q).x)
    np.testing.assert_allclose(points[-1], points[0], atol=1e-6)
    assert np.linalg.norm(np.diff(points[:, -1], axis=0), axis=1).max() > 10


def test_unstable_equilibria_are_called_so_and_followed():
    q = turning(np.pi, np.pi, 3)
    found = follow(LONG, q, untwisted(LONG, q[0]))
    np.testing.assert_allclose(found.x[:, 0], np.pi, atol=1e-9)
    assert (found.stability < 0).all()
    assert (found.stability_between < 0).all()
    assert found.snaps == ()


def test_opposed_tubes_that_are_pushed_out_leave_their_plane_before_they_are_unstable():
    q = turning(np.pi, np.pi, 41)
    q[:, 2:4] = np.linspace(0, 1, 41)[:, None] * BETA
    found = follow(LONG, q)
    assert found.snaps == ()
    assert found.stability.min() > 0
    assert abs(found.x[-1, 0] - np.pi) > 0.5
    assert stability.margins(LONG.tube_numbers, untwisted(LONG, q[-1:]))[0] < 0


def test_a_motion_goes_on_after_frames_that_are_not_known():
    q = turning(0.0, 2.0, 6)
    q[[0, 3]] = np.nan
    found = follow(LONG, q, q[1])
    assert np.isnan(found.x[[0, 3]]).all()
    for value in (found.stability, found.stability_between):
        np.testing.assert_array_equal(np.isnan(value), [True, False, False, True, False, False])
    np.testing.assert_allclose(found.x[4], settled(LONG, q[4]), atol=1e-9)
    assert found.stability_between[4] == found.stability[4]


def test_nothing_but_unknown_frames():
    found = follow(LONG, np.full((2, 6), np.nan))
    assert np.isnan(found.x).all()
    assert np.isnan(found.stability_between).all()


@given(robots_with_q(most=1))
def test_one_tube_follows_its_motor(case):
    robot, q = case
    motion = np.linspace(0 * q, q, 3)
    found = follow(robot, motion)
    np.testing.assert_allclose(found.x, motion, atol=1e-12)
    np.testing.assert_array_equal(found.stability_between, 1)


@given(numbers(-3, 3), numbers(-3, 3), numbers(0.2, 1), numbers(0.2, 1))
def test_motions_without_a_snap_end_where_a_robot_settles(first, second, part, other):
    robot = table_i_robot()
    goal = np.array([first, second, 0, 40 * part, 60 * part + 30 * other, 120, 0.3, -0.2])
    start = goal.copy()
    start[:3] = goal[2]
    found = follow(robot, np.linspace(start, goal, 5))
    if not found.snaps:
        np.testing.assert_allclose(found.x[-1], settled(robot, goal), atol=1e-8)
    assert found.stability.min() > 0
    assert (found.stability_between <= found.stability).all()


def test_compiled_code_finds_the_same(compiled, monkeypatch):
    q = turning(0.0, 6.0, 31)
    fast = follow(LONG, q)
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    slow = follow(LONG, q)
    np.testing.assert_allclose(fast.x, slow.x, atol=1e-9)
    assert [snap.frame for snap in fast.snaps] == [snap.frame for snap in slow.snaps]
    assert len(fast.snaps) == 1


def test_robots_abreast_go_where_each_goes_alone(compiled):
    """Eleven robots, of which those that snap need shorter steps; after unknown frames all settle anew."""
    q = turning(0.0, 6.0)
    q[60:63] = np.nan
    parts = np.zeros((11, 2, 5))
    parts[:, :, 0] = np.linspace(-0.5, 0.3, 11)[:, None]
    draws, way = perturb_robot(LONG, parts, np.zeros((11, 2))), subdivide_motion(q, 4)
    places = draws.tube_configurations(way.q, way.fresh)
    abreast = follow_robot_batch(LONG.structure, draws.numbers, way, places)
    alone = [follow_substeps(LONG.structure, own, way, at) for own, at in zip(draws.numbers, places, strict=True)]
    assert 0 < sum(bool(each.snaps) for each in alone) < 11
    for one, other in zip(abreast, alone, strict=True):
        np.testing.assert_allclose(one.x, other.x, atol=1e-9)
        assert [snap.frame for snap in one.snaps] == [snap.frame for snap in other.snaps]


def test_tangents_are_differences_of_points():
    x = settled(LONG, turning(2.0, 2.0, 1)[0])[None]
    sigma, h = np.linspace(0.1, 0.9, 9), 1e-6
    ahead, behind = shapes(LONG, x, sigma + h), shapes(LONG, x, sigma - h)
    np.testing.assert_allclose((ahead - behind) / (2 * h * BETA[1]), tangents(LONG, x, sigma), atol=1e-4)


NEAR_FOLDS = np.array(
    [
        [2.96, -2.406, 3.429, 33.006, 36.161, 45.029, 0.002, -0.1],
        [2.889, -1.796, 3.517, 41.9, 42.564, 50.144, -0, -0.105],
        [2.761, -1.129, 3.61, 47.222, 50.035, 55.176, 0.002, -0.115],
        [2.64, -0.51, 3.694, 49.296, 57.231, 60.068, 0.006, -0.144],
        [2.657, -0.311, 3.787, 50, 63.716, 64.872, 0.008, -0.169],
        [2.646, -0.324, 3.931, 49.732, 69.651, 69.651, 0.007, -0.173],
        [2.736, -0.285, 3.726, 49.822, 74.416, 74.416, -0.02, -0.153],
        [3.155, 0.372, 3.239, 43.591, 79.124, 79.124, 0.062, -0.201],
    ]
)
"""On the way to the last of these, some robots snap by half a radian, back to where they would have been."""


@pytest.mark.parametrize("substeps", [4, 8, 16, 32])
def test_small_snaps_are_seen_whatever_the_steps(substeps, compiled):
    """A step over a fold may end near its prediction by chance: where that is far away, it is taken in parts."""
    draws = sample_robots(table_i_robot(), 200, seed=3)[[10, 51, 88, 148, 166]]
    way = subdivide_motion(NEAR_FOLDS, substeps)
    for found in Elastic().follow_batch(
        draws.structure, draws.numbers, way, draws.tube_configurations(way.q, way.fresh)
    ):
        (snap,) = found.snaps
        assert snap.frame == 8
        assert 0.55 < snap.jump < 0.75
