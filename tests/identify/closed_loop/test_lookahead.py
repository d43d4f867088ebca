"""Closed loops stop before a robot snaps, say so, and say that it has snapped where it could not be foreseen."""

import numpy as np
import pytest
from loops_of import OFF, ROBOT, SENSORS, made_plan, robots
from near_fold import near_the_fold, plan_through

from ctr_nlp import Tolerances
from ctr_nlp.identify.closed_loop.feed import Feed
from ctr_nlp.identify.closed_loop.lookahead import SNAP_SAFETY_DEVIATIONS, objection
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.runs import closed_loop, open_loop
from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.identify.closed_loop.sensors.points import TipPositionSensor
from ctr_nlp.identify.closed_loop.tracker import Tracker, TrackerState
from ctr_nlp.robot.samples import perturb_robot

TIP = Sensors(TipPositionSensor(0.5))
LAST = 4.24  # rad, shortly before the robot as described snaps, at 4.29


def towards_the_fold(last=LAST, frames=40):
    """A plan that was not made for tolerances: it ends with next to no margin, all frames stable as described."""
    return plan_through(near_the_fold(last, frames), ROBOT)


def played(plan, draw, seed=0, sensors=SENSORS, tolerances=OFF):
    plant = Plant(ROBOT, draw)
    return closed_loop(plan, plant, Feed(plant, sensors, seed), Tracker(plan, sensors, tolerances))


@pytest.mark.parametrize("sensors", [SENSORS, TIP], ids=["points", "tip"])
def test_robots_stop_before_they_snap(sensors):
    plan, draws = towards_the_fold(), robots(10)
    opened = [open_loop(plan, Plant(ROBOT, draws[k : k + 1])) for k in range(10)]
    assert sum(run.first_snap_frame > 0 for run in opened) > 2
    for k in range(10):
        run = played(plan, draws[k : k + 1], k, sensors)
        assert not run.first_snap_frame
        assert not run.first_failed_frame
        if run.stopped:
            assert (run.q[-1] == run.q[-2]).all() or run.notes[-1].time >= plan.time[-2]


def test_a_stop_names_the_frame_and_the_reason():
    plan, draws = towards_the_fold(), robots(10)
    stopped = [run for k in range(10) if (run := played(plan, draws[k : k + 1], k)).stopped]
    assert stopped
    for run in stopped:
        note, frame = run.notes[-1], int(np.searchsorted(plan.time, run.notes[-1].time - 1e-9)) + 1
        assert note.why.startswith(
            f"frame {frame + 1} is not commanded, and the robot stays about frame {frame}: "
        )
        assert "snap" in note.why or "stability margin" in note.why
        assert (run.q[frame - 1 :] == run.q[frame - 1]).all()


def test_robots_with_margin_to_spare_are_not_stopped():
    plan, draws = made_plan(), robots(10, seed=5)
    for k in range(10):
        run = played(plan, draws[k : k + 1], k, TIP)
        assert run.notes == ()
        assert (run.stopped, run.first_failed_frame) == (False, 0)


@pytest.mark.parametrize("sensors", [SENSORS, TIP], ids=["points", "tip"])
@pytest.mark.parametrize("frame", [25, 29], ids=["later", "last"])
def test_a_snap_that_could_not_be_foreseen_is_told_at_once(sensors, frame):
    """Something turns the outer tube past the fold and back, of which commands say nothing."""
    plan = towards_the_fold(3.6, 30)
    plant = Plant(ROBOT, perturb_robot(ROBOT, np.zeros((1, 2, 5)), np.zeros((1, 2))))
    tracker, feed = Tracker(plan, sensors, Tolerances(0.01, 0.01, motor_zero=0.01)), Feed(plant, sensors, 1)
    q = plan.q[0]
    for k, time in enumerate(plan.time[: frame + 1].tolist()):
        plant.move_to(q, time)
        if k == frame:
            plant.move_to(q + np.array([1.5, 0, 0, 0, 0, 0]), time)
            plant.move_to(q, time)
            assert plant.has_snapped
        assert tracker.notes == []
        q = tracker.step(k, q, time, feed.take_readings(time))
    (note,) = tracker.notes
    assert note.state is TrackerState.STOPPED
    assert note.why.startswith(f"the robot has snapped about frame {frame + 1}: what is measured fits another")
    assert (q == plant.history[-1].q).all()


def test_what_speaks_against_a_motion_is_told_in_words():
    plan = towards_the_fold()
    tracker = Tracker(plan, SENSORS, Tolerances(0.001, 0.001, motor_zero=0.001))
    for q, time in zip(plan.q[:36], plan.time[:36], strict=True):
        tracker.observe(q, time, [])
    there = tracker.observer
    weaker = there.weaker_robot(there.predicted.of_margin, SNAP_SAFETY_DEVIATIONS)
    assert objection(there, weaker, plan.q[36], 0.05) == ""
    assert "would snap" in objection(there, weaker, plan.q[36] + [1.0, 0, 0, 0, 0, 0], 0.05)
    assert "would fall to" in objection(there, weaker, plan.q[36], 1.0)
    assert "standard deviations less stable would snap" in objection(there, None, plan.q[36], 0.05)


def test_where_it_is_estimated_is_what_matters_not_the_plan():
    """A tracker that knows of a zero that is off by 0.3 rad stops where the robot as described would not snap."""
    plan = towards_the_fold(4.1)
    parts = np.zeros((1, 2, 5))
    parts[0, 0, -1] = 0.3
    draw = perturb_robot(ROBOT, parts, np.zeros((1, 2)))
    assert open_loop(plan, Plant(ROBOT, draw)).first_snap_frame
    run = played(plan, draw, 0, SENSORS, Tolerances(0.02, 0.02, motor_zero=0.3))
    assert not run.first_snap_frame


def test_a_less_stable_robot_that_cannot_snap_is_not_taken_for_one_that_has():
    """Far from the fold, 2 deviations are 8 % of both curvatures: in one step its equilibrium is not found."""
    plan = towards_the_fold(4.2)
    tracker = Tracker(plan, SENSORS, OFF)
    for q, time in zip(plan.q[:29], plan.time[:29], strict=True):
        tracker.observe(q, time, [])
    there = tracker.observer
    weaker = there.weaker_robot(there.predicted.of_margin, 2.0)
    assert weaker is not None
    draw = there.differences.perturbed_robots(weaker.mean[None])
    assert not open_loop(plan, Plant(ROBOT, draw)).first_snap_frame
