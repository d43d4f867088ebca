"""Live steering without a screen: what is asked of the robot is done within its limits, and told as it is."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from common import named_problem
from hypothesis import given
from hypothesis import strategies as st
from lumens import straight
from strategies import numbers, robots_with_q

from ctr_nlp import Load, Plan, Problem, Settings, Steerer, growing, shapes, summary, table_i_robot
from ctr_nlp.cli.main import COMMANDS, load
from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.paths.target import QUADRATURE, SIGMA_GRID
from ctr_nlp.robot.tolerances import Tolerances
from ctr_nlp.view.live import Session
from ctr_nlp.view.live.page.colours import rate_numbers
from ctr_nlp.view.live.page.messages import status_message
from ctr_nlp.view.live.page.panel import PathScale
from ctr_nlp.view.live.steered.free import free_problem
from ctr_nlp.view.live.steered.goal import HANDLES, Goal
from ctr_nlp.view.live.steered.joints import slide_joint, slider_ranges, step_towards
from ctr_nlp.view.live.steered.session import HAND_METHOD, MAX_SAMPLED_ROBOTS, SHAPE_METHOD, TIP_METHOD

STEPS = 90
ALONG = 0.6
"""Of the path, where most of these sessions stand."""
GAP = table_i_robot().with_limits(carriage_gap=60.0)
NITINOL = with_modulus(table_i_robot(), 60_000)
COMPILED_S = 300.0
"""Within which programs are compiled."""


@pytest.fixture
def session():
    return Session(named_problem("arc", 20), model="dominant")


def steps(session, count=STEPS):
    """What is seen in so many steps; every one keeps the robot's limits and speeds."""
    robot, before, found = session.problem.robot, session.q, []
    for _ in range(count):
        found.append(session.step())
        robot.check(session.q)
        assert (np.abs(session.q - before) <= robot.speed * session.dt * (1 + 1e-9) + 1e-9).all()
        np.testing.assert_array_equal(found[-1].q, session.q)
        before = session.q
    return found


def settled(session, along=ALONG):
    session.goal.advance(along)
    return steps(session)[-1]


# Following


def test_the_robot_comes_to_a_target_that_stands_still(session):
    seen = settled(session)
    assert seen.e2 < 1.0
    shape = shapes(session.problem.robot, seen.q[None])[0]
    np.testing.assert_allclose(seen.shape, shape, atol=1e-9)
    distance = np.sqrt(((shape - session.goal.points) ** 2).sum(axis=1))
    np.testing.assert_allclose(seen.error, distance, atol=1e-9)
    assert seen.e2 == pytest.approx(math.sqrt(np.sum(QUADRATURE * distance**2)))
    assert math.isnan(seen.margin)
    assert seen.clearance is None


def test_a_pulled_tip_is_followed_by_the_tip_alone_more_closely_than_by_the_shape(session):
    settled(session)
    session.pull(HANDLES - 1, session.goal.handles[-1] + [6.0, 5.0, -4.0])
    by_shape = steps(session)[-1]
    session.follow(TIP_METHOD)
    by_tip = steps(session)[-1]
    assert by_tip.error[-1] < 0.1 < by_shape.error[-1]
    assert by_shape.e2 < by_tip.e2
    session.follow(SHAPE_METHOD)
    assert steps(session)[-1].e2 == pytest.approx(by_shape.e2, rel=0.05)


def test_a_pulled_handle_takes_the_target_there_and_leaves_its_root(session):
    goal = Goal(session.problem.target_frames, session.problem.robot.reach)
    goal.advance(ALONG)
    path, there = goal.points.copy(), goal.handles[1] + [0.0, 4.0, 0.0]
    goal.pull(1, there)
    assert np.linalg.norm(goal.points - there, axis=1).min() < 0.5
    np.testing.assert_allclose(goal.points[0], 0.0, atol=1e-9)
    between = np.linalg.norm(np.diff(goal.points, axis=0), axis=1)
    assert np.ptp(between) < 0.01 * between.mean()
    goal.release()
    np.testing.assert_array_equal(goal.points, path)


def test_a_target_pulled_too_far_is_as_long_as_the_robot_reaches(session):
    reach = session.problem.robot.reach
    goal = Goal(session.problem.target_frames, reach)
    goal.advance(1.0)
    goal.pull(HANDLES - 1, goal.handles[-1] * 2)
    assert np.linalg.norm(np.diff(goal.points, axis=0), axis=1).sum() == pytest.approx(reach, rel=1e-3)


def test_clearance_is_what_is_left_beside_the_path_of_a_straight_lumen():
    wall = straight(6.0)
    session = Session(
        Problem("tube", table_i_robot(), growing(wall.part(0.0, 100.0), 10)), model="dominant", settings=Settings()
    )
    seen = settled(session)
    beta = seen.q[3:6]
    outer = np.array([tube.outer_diameter / 2 for tube in session.problem.robot.tubes])
    over = outer[(SIGMA_GRID[:, None] * beta[-1] > beta[:-1] + 1e-9).sum(axis=1)]
    left = 6.0 - np.hypot(*seen.shape[:, :2].T) - over
    np.testing.assert_allclose(seen.clearance, left, atol=1e-6)


# By hand


@given(robots_with_q(), st.data())
def test_a_joint_that_is_slid_takes_others_along_and_keeps_limits_and_order(robot_q, data):
    robot, q = robot_q
    joint = data.draw(st.integers(0, len(q) - 1))
    low, high = slider_ranges(robot)[joint]
    found = slide_joint(robot, q, joint, data.draw(numbers(low, high)))
    robot.check(found)
    others = [j for j in range(len(q)) if j != joint and not (robot.d <= joint < 2 * robot.d > j >= robot.d)]
    np.testing.assert_allclose(found[others], q[others])


@given(st.integers(3, 5), numbers(0, 150))
def test_carriages_stay_apart_when_a_tube_is_slid(joint, value):
    q = slide_joint(GAP, np.zeros(8), joint, value)
    GAP.check(q)
    assert q[joint] == pytest.approx(min(value, GAP.max_extensions[joint - 3]))


def test_sliders_lead_at_the_robots_speed_until_they_are_reached(session):
    settled(session)
    goal = slide_joint(session.problem.robot, session.q, 4, 20.0)
    session.slide(4, 20.0)
    assert session.method == HAND_METHOD
    assert steps(session)[-1].q == pytest.approx(goal)
    session.pull(0, session.goal.handles[0] + [1.0, 0.0, 0.0])
    assert session.method == SHAPE_METHOD
    assert steps(session)[-1].e2 < 1.5


def test_motors_arrive_together():
    robot, q, goal = table_i_robot(), np.zeros(8), np.array([1.0, 0.5, 0, 0, 10, 40, 0.1, 0])
    part = step_towards(robot, q, goal, 0.05)
    assert np.ptp(part[goal > 0] / goal[goal > 0]) < 1e-12
    np.testing.assert_array_equal(step_towards(robot, q, goal, 100.0), goal)


# Recording


def test_a_recorded_motion_is_a_plan_that_can_be_played(session, tmp_path, capsys):
    settled(session, 0.2)
    session.record()
    seen = []
    for progress in np.linspace(0.2, 0.4, 30):
        session.goal.advance(progress)
        seen += steps(session, 1)
    plan = session.plan()
    assert session.moment_count is None
    np.testing.assert_allclose(plan.q, [one.q for one in seen])
    np.testing.assert_allclose(plan.shape, [one.shape for one in seen], atol=1e-9)
    np.testing.assert_allclose(plan.target, [one.target for one in seen], atol=0.02)
    np.testing.assert_allclose(np.diff(plan.time), session.dt)
    assert summary(plan)["e3"] == pytest.approx(seen[-1].e3, abs=0.02)
    assert plan.complete
    plan.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").meta["formulation"] == "live"
    assert (
        load(COMMANDS["play"])([str(tmp_path / "plan.npz"), "--dry-run", "--tempo", "0.2", "--uncertified"]) == 0
    )
    assert "nothing was sent" in capsys.readouterr().out


def test_nothing_recorded_is_no_plan(session):
    for begin in (lambda: None, session.record):
        begin()
        with pytest.raises(OptionError, match="nothing has been recorded"):
            session.plan()


def test_a_recording_is_played_back_as_it_was_steered(session):
    settled(session, 0.2)
    session.record()
    session.advance(0.4)
    recorded = [one.q for one in steps(session, 20)]
    plan = session.plan()
    settled(session, 0.0)
    session.play_back(plan)
    assert session.is_playing_back
    seen = steps(session, STEPS)
    assert not session.is_playing_back
    first = next(k for k, one in enumerate(seen) if np.allclose(one.q, recorded[0], atol=1e-9))
    np.testing.assert_allclose([one.q for one in seen[first : first + len(recorded)]], recorded, atol=1e-8)
    np.testing.assert_array_equal(seen[first + 1].target, plan.target[1])


def test_a_hand_on_a_slider_ends_the_playback(session):
    session.record()
    steps(session, 2)
    session.play_back(session.plan())
    session.slide(0, 1.0)
    assert not session.is_playing_back
    other = Session(replace(session.problem, robot=GAP), model="dominant")
    session.record()
    steps(session, 1)
    with pytest.raises(OptionError, match="of another robot"):
        other.play_back(session.plan())


def test_moves_are_undone_one_by_one(session):
    session.advance(0.5)
    start = session.goal.handles.copy()
    for part in (0.5, 1.0):  # one drag is many changes
        session.pull(1, start[1] + [4.0 * part, 0.0, 0.0])
    session.slide(0, 1.0)
    assert session.method == HAND_METHOD
    session.undo()
    assert session.method == SHAPE_METHOD
    np.testing.assert_allclose(session.goal.handles[1], start[1] + [4.0, 0.0, 0.0])
    session.undo()
    np.testing.assert_allclose(session.goal.handles, start)
    session.undo()
    assert session.goal.progress == 0.0
    with pytest.raises(OptionError, match="no move to undo"):
        session.undo()


# Draws


def test_draws_within_no_tolerance_are_the_robot_itself():
    exact = Tolerances(curvature=0.0, bending_stiffness=0.0, motor_zero=0.0)
    problem = named_problem("arc", 20)
    robot = replace(problem.robot, tolerances=exact)
    session = Session(Problem("exact", robot, problem.target), model="dominant")
    session.set_sample_count(2)
    seen = settled(session)
    np.testing.assert_allclose(seen.ghosts, np.repeat(seen.shape[None, ::4], 2, axis=0), atol=1e-9)
    assert not seen.lost.any()


def test_draws_stand_beside_the_robot_and_their_number_is_limited(session):
    session.set_sample_count(3)
    seen = settled(session)
    away = np.linalg.norm(seen.ghosts - seen.shape[None, ::4], axis=2).max(axis=1)
    assert (away > 1e-3).all()
    assert (away < 30.0).all()
    with pytest.raises(OptionError, match=f"it must be at most {MAX_SAMPLED_ROBOTS}"):
        session.set_sample_count(MAX_SAMPLED_ROBOTS + 1)


# Models, and what is being compiled


def test_the_simplest_model_steers_until_another_one_is_compiled(monkeypatch):
    monkeypatch.setattr(Steerer, "create_if_compiled", lambda *_: None)
    session = Session(named_problem("bronchus", 20), "elastic")
    seen = settled(session, 0.2)
    assert (session.model, session.requested_model) == ("dominant", "elastic")
    assert seen.e2 < 3.0
    words = status_message(session, 0.0, False, "")
    assert "Compiling the code for the elastic model within the wall in the background" in words
    assert "steering uses the dominant model" in words


@pytest.mark.slow
def test_a_robot_that_bears_a_load_is_seen_and_steered_under_it():
    """Until its programs are compiled it bears none; what is recorded is a plan under the load."""
    problem, load = named_problem("bronchus", 20), Load(force=(0.0, 0.1, 0.0))
    problem = replace(problem, robot=with_modulus(problem.robot, 60_000))
    session = Session(problem, "elastic", load=load)
    assert session.active_load is None
    assert not session.step().force.any()
    assert "elastic model under a tip force of (0, 0.1, 0) N within the wall are being" in status_message(
        session, False, ""
    )
    begin = time.monotonic()
    while session.active_load is None and time.monotonic() - begin < COMPILED_S:
        session.step()
        time.sleep(0.1)
    assert session.active_load == load
    assert "The load on the robot is a tip force of (0, 0.1, 0) N." in status_message(session, 0.0, False, "")
    session.record()
    seen = settled(session, 0.5)
    np.testing.assert_array_equal(seen.force, load.force)
    assert seen.e2 < 2.0
    assert seen.clearance.min() > 0
    plan = session.plan()
    assert plan.evaluated_load == load
    np.testing.assert_allclose(plan.shape[-1], seen.shape, atol=1e-3)
    assert plan.stability[-1] == pytest.approx(seen.margin, abs=1e-4)


@pytest.mark.parametrize(
    ("robot", "model", "error", "match"),
    [
        (NITINOL, "dominant", OptionError, "a load does not go with the dominant model"),
        (table_i_robot(), "elastic", LoadError, "looks like a ratio"),
    ],
)
def test_what_bears_no_load_is_said_before_anything_is_shown(robot, model, error, match):
    with pytest.raises(error, match=match):
        Session(replace(named_problem("arc", 20), robot=robot), model, load=Load(force=(0.0, 0.1, 0.0)))


def test_a_robot_file_alone_is_a_problem():
    problem = free_problem("mine", table_i_robot())
    session = Session(problem, model="dominant")
    session.goal.advance(1.0)
    assert session.goal.points[-1] == pytest.approx(problem.target_frames[-1].points[-1])
    assert steps(session)[-1].e2 < 1.0


@pytest.mark.parametrize(
    ("act", "match"),
    [
        (lambda session: session.follow("tip"), "method is 'tip'"),
        (lambda session: session.use_model("stiff"), "model is 'stiff'"),
        (lambda session: session.slide(8, 0.0), "joint is 8"),
        (lambda session: session.slide(0, math.nan), "value of joint 0"),
        (lambda session: session.pull(HANDLES, np.zeros(3)), "handle is 4"),
        (lambda session: session.goal.advance(1.2), "progress is 1.2"),
    ],
)
def test_what_cannot_be_asked_is_refused(session, act, match):
    with pytest.raises(OptionError, match=match):
        act(session)


# Words and scales


def test_a_tip_that_misses_its_goal_is_warned_of(session):
    allowed = session.settings.arrival_tolerance
    assert "misses its goal" not in status_message(session, allowed, False, "")
    assert f"misses its goal by {allowed + 1:.1f} mm" in status_message(session, allowed + 1, False, "")
    seen = settled(session)
    rows = {row.name: row for row in rate_numbers(seen, session.problem, session.settings)}
    assert rows["tip error"].word == "at its goal"
    assert rows["tip, base frame"].number == ", ".join(f"{x:.1f}" for x in seen.shape[-1].round(1) + 0.0) + " mm"


def test_coordinates_are_those_of_the_scan_where_it_is_known(session):
    to_robot = np.eye(4)
    to_robot[:3, 3] = [10.0, 20.0, 30.0]
    problem = replace(session.problem, to_robot=to_robot, space="RAS")
    seen = session.step()
    rows = {row.name: row.number for row in rate_numbers(seen, problem, session.settings)}
    numbers = [float(x) for x in rows["goal, RAS"].removesuffix(" mm").split(", ")]
    np.testing.assert_allclose(numbers, seen.target[-1] - to_robot[:3, 3], atol=0.051)


def test_the_slider_along_the_path_is_in_mm(session):
    target = session.problem.target
    scale = PathScale.of_target(target, session.problem.duration)
    assert scale.name == "along the path, mm"
    assert scale.to_value(0.0) == pytest.approx(target.lengths[0])
    assert scale.to_value(1.0) == pytest.approx(target.lengths[-1])
    assert scale.to_progress(scale.to_value(0.37)) == pytest.approx(0.37)
    still = PathScale.of_target(replace(target, lengths=target.lengths[:1] * len(target.lengths)), 5.0)
    assert (still.name, still.to_value(0.5)) == ("time along the motion, s", 2.5)


# What sessions ask of a Steerer


def test_a_steerer_that_is_put_elsewhere_is_one_that_was_built_there(arc_problem):
    robot, target = arc_problem.robot, arc_problem.target_frames[2].points
    here, there = np.array([3.0, 3, 3, 30, 70, 105, 0, 0]), np.array([3.1, 3, 2.9, 20, 60, 95, 0.1, 0])
    moved, built = (
        Steerer(robot, here, 0.1, model="dominant"),
        Steerer(robot, there, 0.1, model="dominant", wait=False),
    )
    moved.step(target)
    moved.set_configuration(there)
    np.testing.assert_allclose(moved.step(target), built.step(target), atol=1e-9)
    with pytest.raises(OptionError, match="stride"):
        moved.set_shape_weights(ShapeDistance(stride=10))


def test_sliders_reach_every_limit():
    robot = table_i_robot().with_limits(alpha=(-3.0, 3.0))
    found = slider_ranges(robot)
    np.testing.assert_array_equal(found[:6], np.stack([robot.lower, robot.upper], axis=1)[:6])
    np.testing.assert_allclose(slider_ranges(table_i_robot())[:3], [[-2 * math.pi, 2 * math.pi]] * 3)
