"""Closed loops: nearer to the plan than open ones, within limits, and told of what is wrong with sensors."""

import numpy as np
import pytest
from loops_of import OFF, ROBOT, SENSORS, made_plan, robots
from near_fold import near_the_fold, plan_through

from ctr_nlp.identify.closed_loop.feed import (
    Feed,
    LateReadings,
    Outliers,
    ShiftedPoints,
    Silence,
    StuckReadings,
    SwappedAxes,
)
from ctr_nlp.identify.closed_loop.observer import Innovation
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.runs import closed_loop, open_loop
from ctr_nlp.identify.closed_loop.sensor_monitor import SensorMonitor
from ctr_nlp.identify.closed_loop.sensors import Reading, Sensors
from ctr_nlp.identify.closed_loop.sensors.points import TipPositionSensor
from ctr_nlp.identify.closed_loop.tracker import (
    MAX_CORRECTION_RAD_MM_RAD,
    PLAN_PULL_COST_MM2,
    TRACKER_STABILITY_MARGIN,
    Tracker,
    TrackerState,
)

BEGIN = 2.0
FAULTS = {
    "silence": Silence(BEGIN),
    "outliers": Outliers(BEGIN),
    "late": LateReadings(BEGIN, delay=0.6),
    "registration": ShiftedPoints(BEGIN, offset=(2.0, 0.0, 0.0)),
    "stuck": StuckReadings(BEGIN),
    "axes": SwappedAxes(BEGIN),
}


@pytest.fixture(scope="module")
def plan():
    return made_plan()


def away(run, plan):
    """Root mean square distance from the planned shapes, mm."""
    return float(np.sqrt(((run.shape - plan.shape) ** 2).sum(axis=-1).mean()))


def led(plan, draw, seed=0, faults=(), **feed):
    plant = Plant(ROBOT, draw)
    return closed_loop(plan, plant, Feed(plant, SENSORS, seed, faults=faults, **feed), Tracker(plan, SENSORS, OFF))


def check_limits(run, plan):
    dt = plan.time[1] - plan.time[0]
    assert (abs(np.diff(run.q, axis=0)) <= ROBOT.speed * dt + 1e-9).all()
    assert (run.q >= ROBOT.lower - 1e-9).all()
    assert (run.q <= ROBOT.upper + 1e-9).all()
    assert (np.diff(run.q[:, 2:4], axis=1) >= -1e-9).all()


def test_feedback_brings_robots_to_the_planned_shapes(plan):
    draws = robots(6)
    runs = [(open_loop(plan, Plant(ROBOT, draws[k : k + 1])), led(plan, draws[k : k + 1], k)) for k in range(6)]
    opened, closed = (np.array([away(run, plan) for run in some]) for some in zip(*runs, strict=True))
    assert closed.mean() < 0.5 * opened.mean()
    for _, run in runs:
        check_limits(run, plan)
        assert not run.first_failed_frame
        assert not run.stopped
        assert run.notes == ()


def test_the_same_seed_gives_the_same_run(plan):
    first, second = (led(plan, robots(1)) for _ in range(2))
    assert (first.q == second.q).all()
    assert (first.means == second.means).all()


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_sensors_are_told_in_half_a_second_and_do_no_harm(plan, name):
    draws = robots(3)
    for k in range(3):
        run = led(plan, draws[k : k + 1], k, (FAULTS[name],))
        opened = open_loop(plan, Plant(ROBOT, draws[k : k + 1]))
        check_limits(run, plan)
        assert opened.first_failed_frame or not run.first_failed_frame
        first = next(note for note in run.notes if note.time >= BEGIN)
        assert first.time <= BEGIN + 0.5 + 1e-9
        assert opened.first_snap_frame or not run.first_snap_frame


@pytest.mark.parametrize("name", ["silence", "registration", "axes"])
def test_where_sensing_fails_motors_go_back_to_the_plan(plan, name):
    run = led(plan, robots(3)[2:], 2, (FAULTS[name],))
    assert run.q[6] != pytest.approx(plan.q[6], abs=1e-6)
    assert run.q[-5:] == pytest.approx(plan.q[-5:], abs=1e-9)


def test_robots_are_corrected_where_tubes_do_not_act_on_each_other_yet(plan):
    """There the margin is 1, and the determinant that its slopes come from has none at 1 itself."""
    tracker = Tracker(plan, SENSORS, OFF)
    for frame in range(8):
        tracker.observe(plan.q[frame], plan.time[frame], [])
        assert tracker.observer.margin == pytest.approx(1.0, abs=1e-6)
        assert np.isfinite(tracker.observer.predicted.of_margin).all()


def test_tracking_goes_on_once_sensors_can_be_believed_again(plan):
    run = led(plan, robots(1), faults=(Silence(1.0, 2.5),))
    assert [note.state for note in run.notes] == [TrackerState.UNCORRECTED, TrackerState.TRACKING]
    assert run.notes[-1].time == pytest.approx(2.5, abs=0.51)


def test_a_robot_whose_margin_is_not_safe_stops_where_nothing_is_measured(plan):
    draw = robots(1)
    plant, tracker = Plant(ROBOT, draw), Tracker(plan, SENSORS, OFF)
    q = plan.q[0]
    for frame, time in enumerate(plan.time[:5].tolist()):
        plant.move_to(q, time)
        q = tracker.step(frame, q, time, [])
    assert tracker.notes[0].state is TrackerState.UNCORRECTED
    assert "no measurement" in tracker.notes[0].why
    assert tracker.observer.mean == pytest.approx(tracker.observer.differences.mean)


@pytest.mark.parametrize("name", ["registration", "axes"])
def test_sensors_that_have_contradicted_are_not_believed_again(plan, name):
    run = led(plan, robots(3)[2:], 2, (FAULTS[name],))
    held = next(note.time for note in run.notes if note.state is TrackerState.UNCORRECTED)
    after = run.means[plan.time >= held]
    assert (after == after[0]).all()


def tip(rejected, time, excess=4.0):
    """What doubts look at of one tip that was measured, and taken or not; excess: by so many deviations."""
    off = np.array([excess, 0.0, 0.0]) * rejected
    innovation = Innovation(time, off, np.ones(3), np.full(3, not rejected), 1.0, 1, int(rejected))
    return time, Reading(time, np.array([time, 0.0, 0.0])), innovation, np.zeros(3)


def test_one_tip_that_is_far_off_is_chance_and_two_of_nine_are_told():
    """At 20 readings a second nine are in the window: of a thousand right ones, one is rejected."""
    doubts = SensorMonitor()
    told = [doubts.check_reading(*tip(k == 4, 0.05 * k))[1] for k in range(40)]
    assert told == [""] * 40
    doubts = SensorMonitor()
    told = [doubts.check_reading(*tip(k in (4, 7), 0.05 * k))[1] for k in range(8)]
    assert told[:7] == [""] * 7
    assert told[7] == "25% of what is measured is far from what is expected, and is not used"


def test_one_tip_that_no_chance_explains_is_told_at_once():
    doubts = SensorMonitor()
    told = [doubts.check_reading(*tip(k == 4, 0.05 * k, excess=7.0))[1] for k in range(5)]
    assert told == ["", "", "", "", "20% of what is measured is far from what is expected, and is not used"]


def test_a_tip_of_which_a_value_is_missing_is_not_far_off():
    tracker = Tracker(made_plan(), Sensors(TipPositionSensor()), OFF)
    tracker.observe(tracker.plan.q[0], 0.0, [])
    seen = tracker.observer.compute_innovation(Reading(0.0, np.array([0.0, np.nan, 60.0])))
    assert (seen.groups, seen.rejected) == (0, 0)
    assert not seen.accepted.any()


@pytest.fixture(scope="module")
def thin():
    """A plan whose stability margin falls to 0.1, below what a tracker keeps elsewhere."""
    q = near_the_fold(4.24, 40)
    q[:, 2:4] = np.linspace((20.0, 30.0), (62.0, 85.0), 40)
    plan = plan_through(q, ROBOT)
    assert 0 < plan.stability[-1] < 0.5 * TRACKER_STABILITY_MARGIN
    return plan


def test_no_more_margin_is_asked_for_than_was_planned_and_the_pull_grows_where_it_is_thin(thin):
    asked = []
    for k in range(6):
        tracker, own = Tracker(thin, SENSORS, OFF), []
        correct = tracker._correction

        def recorded(at, wanted, planned, low, high, margin, pull, correct=correct, own=own):
            asked.append((at.margin, margin, pull))
            own.append(margin)
            return correct(at, wanted, planned, low, high, margin, pull)

        tracker._correction, plant = recorded, Plant(ROBOT, robots(6)[k : k + 1])
        closed_loop(thin, plant, Feed(plant, SENSORS, k), tracker)
        assert len(own) > 30  # a robot that has to stop is not asked further
        assert (own <= thin.stability[1 : len(own) + 1] + 1e-12).all()
    margins, _, pulls = np.array(asked).T
    thin_ones = margins < TRACKER_STABILITY_MARGIN
    assert thin_ones.any()
    assert pulls[thin_ones].min() > 10 * PLAN_PULL_COST_MM2
    assert pulls[margins > 0.9].max() < 10 * PLAN_PULL_COST_MM2


def test_corrections_stay_near_the_plan(thin):
    draws = robots(3)
    for k in range(3):
        run = led(thin, draws[k : k + 1], k)
        near = np.repeat(MAX_CORRECTION_RAD_MM_RAD, 2) + np.append(
            np.full(2, 0.06), np.zeros(4)
        )  # motors' zeros are off by 0.05 rad
        assert (abs(run.q - thin.q) <= near + 1e-9).all()
