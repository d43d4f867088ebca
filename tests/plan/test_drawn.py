"""Draws moved through motions: each is the robot of its numbers, and lost where that leaves its branch."""

from dataclasses import replace

import numpy as np
import pytest
import truth
from frames import configuration, elastic_shapes, follow

from ctr_nlp import Robot, Tolerances, Tube, shapes, table_i_robot
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, Model
from ctr_nlp.models.elastic import stability
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.plan.sample_motions import simulate_samples
from ctr_nlp.robot.samples import perturb_robot, sample_robots
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES

pytestmark = pytest.mark.interpreted
LONG = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
SOME = Tolerances(0.05, 0.04, 0.03, 0.5, 0.05, 0.1)


def motion(robot, frames=4, most=0.6):
    """Frames from hardly out to nearly all out, with some turning."""
    part = np.linspace(0.3, 0.9, frames)[:, None]
    turned = np.linspace(-most, most, robot.d) * (1 - part)
    tilt = np.array([0.1, -0.2]) * part
    return np.hstack([turned, part * robot.upper[robot.d : 2 * robot.d], tilt])


def itself(robot, draws, k):
    """The robot that draw k is, as anybody would describe it."""
    tubes = []
    for tube, numbers in zip(robot.tubes, draws.numbers[k], strict=True):
        of = dict(zip(TUBE_NUMBER_NAMES, numbers.tolist(), strict=True))
        tubes.append(
            replace(
                tube,
                curved_length=of["curved_length"],
                curvature=(of["root_curvature"], of["tip_curvature"]),
                youngs_modulus=tube.youngs_modulus * of["bending_stiffness"] / tube.bending_stiffness,
                poisson_ratio=of["torsional_ratio"] - 1,
            )
        )
    beta = list(zip(robot.lower[robot.d : 2 * robot.d], robot.upper[robot.d : 2 * robot.d], strict=True))
    return Robot(tuple(tubes), replace(robot.limits, beta=beta))


@pytest.mark.parametrize("robot", [table_i_robot(), truth.TWO], ids=["three arcs", "curvature varies"])
def test_draws_are_the_robots_that_their_numbers_describe(robot):
    robot = replace(robot, tolerances=SOME)
    draws, q = sample_robots(robot, 3, 7), motion(robot)
    found = simulate_samples(robot, draws, q, "elastic")
    way = subdivide_motion(q, 4)
    for k in range(3):
        own, turned = itself(robot, draws, k), draws.tube_configurations(way.q, way.fresh)[k]
        ends = turned[np.searchsorted(way.frames, range(len(q)), side="right") - 1]
        np.testing.assert_allclose(configuration(own, found.x[k]), ends, atol=1e-7)
        assert (abs(ends - q - np.pad(draws.offsets[k], (0, robot.d + 2))) <= 0.1 + 1e-12).all()
        np.testing.assert_allclose(elastic_shapes(own, found.x[k]), found.shape[k], atol=1e-9)
        np.testing.assert_allclose(found.stability[k], stability.margins(own.tube_numbers, found.x[k]), atol=1e-7)
        there = follow(own, turned, substeps=1)
        np.testing.assert_allclose(there.x[-1], found.x[k, -1], atol=1e-7)


def test_the_robot_described_is_a_draw_without_differences():
    robot = table_i_robot()
    q = motion(robot)
    none = perturb_robot(robot, np.zeros((2, 3, 5)), np.zeros((2, 3)))
    found, there = simulate_samples(robot, none, q, "elastic"), follow(robot, q, substeps=4)
    for k in range(2):
        np.testing.assert_allclose(found.x[k], there.x, atol=1e-9)
        np.testing.assert_allclose(found.stability_between[k], there.stability_between, atol=1e-8)
    assert (found.lost == 0).all()


def test_shapes_differ_on_the_dominant_model_too():
    robot = replace(table_i_robot(), tolerances=Tolerances())
    draws, q = sample_robots(robot, 3, 7), motion(robot)
    found = simulate_samples(robot, draws, q, "dominant")
    for k in range(3):
        own = q.copy()
        own[:, :3] += draws.offsets[k]
        np.testing.assert_allclose(found.shape[k], shapes(itself(robot, draws, k), own), atol=1e-9)
    assert np.isnan(found.stability).all()
    assert not found.lost.any()


def test_a_model_that_only_defines_its_frame_shows_draws():
    class Plain(type(KINEMATIC_MODELS["dominant"])):
        name = "plain"
        points_batch = Model.points_batch

    robot = table_i_robot()
    draws, q = sample_robots(robot, 2, 7), motion(robot, 2)
    there = simulate_samples(robot, draws, q, "dominant").shape
    np.testing.assert_allclose(simulate_samples(robot, draws, q, Plain()).shape, there, atol=1e-9)

    class Hidden(Plain):
        name, several_equilibria = "hidden", True

    with pytest.raises(OptionError, match="does not follow robots that differ"):
        simulate_samples(robot, draws, q, Hidden())


def turned_apart(last, frames=30):
    """LONG with its outer tube turned against the inner one."""
    q = np.zeros((frames, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0.0, last, frames), (60.0, 80.0)
    return q


def test_what_snaps_is_lost_and_when():
    """The robot described stops just before its branch ends; a zero that is off takes one of two draws over it."""
    snap = follow(LONG, turned_apart(5.0, 300)).snaps[0]
    last = 5.0 * (snap.frame - 2) / 299 - 0.02
    parts = np.zeros((2, 2, 5))
    parts[:, 0, 4] = 0.05, -0.05
    found = simulate_samples(LONG, perturb_robot(LONG, parts, np.zeros((2, 2))), turned_apart(last), "elastic")
    np.testing.assert_array_equal(found.snapped, [30, 0])
    np.testing.assert_array_equal(found.lost, [30, 0])
    assert found.stability_between[0, -1] <= 0 < found.stability_between[1].min()


def test_what_rests_on_another_branch_is_lost_without_a_snap():
    """In a single frame nothing jumps, but past half a turn tubes come to rest on the other side of a fork."""
    parts = np.zeros((2, 2, 5))
    parts[:, 0, 4] = 0.3, 0.0
    robot = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
    snap = follow(LONG, turned_apart(5.0, 300)).snaps[0]
    q = turned_apart(5.0 * (snap.frame - 2) / 299 - 0.02)[-1:]
    found = simulate_samples(robot, perturb_robot(robot, parts, np.zeros((2, 2))), q, "elastic")
    np.testing.assert_array_equal(found.lost, [1, 0])


def test_frames_that_were_not_reached_are_passed_over():
    robot, q = table_i_robot(), motion(table_i_robot(), 6)
    q[[0, 3]] = np.nan
    way = subdivide_motion(q, 4)
    assert way.frames.tolist() == [1, 2, 2, 2, 2, 4, 5, 5, 5, 5]
    np.testing.assert_array_equal(np.flatnonzero(way.fresh), [0, 5])
    found = simulate_samples(robot, sample_robots(robot, 2, 0), q, "elastic")
    assert np.isnan(found.shape[:, [0, 3]]).all()
    assert np.isfinite(found.shape[:, [1, 2, 4, 5]]).all()
    assert not found.lost.any()


def test_margins_do_not_depend_on_the_rows_before():
    robot = table_i_robot()
    x = KINEMATIC_MODELS["elastic"].guess(robot, motion(robot, 60, 3.0))
    together = stability.margins(robot.tube_numbers, x)
    alone = [float(stability.margins(robot.tube_numbers, row[None])[0]) for row in x]
    np.testing.assert_allclose(together, alone, atol=3e-8)
    assert together.min() < 0 < together.max()
