"""Closed loops on the emulated controller in virtual time: led, stopped, resumed, and worked out again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bench import Killed
from guided import Loops, level_plan
from loops_of import SENSORS
from near_fold import plan_through

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState
from ctr_nlp.hardware.sensing.simulated import SimulatedRobot
from ctr_nlp.identify.closed_loop import tracker
from ctr_nlp.identify.closed_loop.feed import (
    Feed,
    LateReadings,
    Outliers,
    SensorFault,
    ShiftedPoints,
    Silence,
    StuckReadings,
    SwappedAxes,
)
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.identify.closed_loop.runs import closed_loop
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.robot.samples import sample_robots

pytestmark = pytest.mark.usefixtures("prepared_once")

PLAN = level_plan()
BEGIN = 4.0
FAULTS: dict[str, SensorFault] = {
    "silence": Silence(BEGIN),
    "outliers": Outliers(BEGIN),
    "late": LateReadings(BEGIN, delay=0.6),
    "registration": ShiftedPoints(BEGIN, offset=(2.0, 0.0, 0.0)),
    "stuck": StuckReadings(BEGIN),
    "axes": SwappedAxes(BEGIN),
}


def at(time: float, action: Callable[[], None]) -> Callable[[Trajectory, MotionProgress], None]:
    """Do something once in the plan's motion."""
    done = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if not done and len(trajectory.frames) > 2 and progress.time >= time:
            done.append(True)
            action()

    return seen


def open_loop(seed: int) -> SimulatedRobot:
    """The robot of a seed, moved through the plan as it is."""
    robot = SimulatedRobot(PLAN, SENSORS, seed)
    robot.apply_past_motion(PLAN.q)
    return robot


def ideal(seed: int) -> float:
    """How far a robot is from the planned shapes where nothing stands between it and its tracker, mm."""
    plant = Plant(PLAN.robot, sample_robots(PLAN.robot, 1, seed))
    run = closed_loop(PLAN, plant, Feed(plant, SENSORS, seed), Tracker(PLAN, SENSORS))
    return float(np.sqrt(((run.shape - PLAN.shape) ** 2).sum(axis=-1).mean()))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_robot_is_led_as_well_as_if_nothing_stood_between_it_and_its_tracker(tmp_path: Path, seed: int) -> None:
    """But for what a frame is: shapes are compared where the robot is about as long."""
    loops = Loops(tmp_path, PLAN, seed)
    result = loops.begin()
    assert (result.outcome, result.frame, result.trusted) == (PlaybackOutcome.SUCCESS, 40, True), result.message
    assert loops.notes == []
    assert loops.world.within_limits()
    assert loops.world.latest.device.stream.underruns == 0
    closed = loops.away()
    assert closed < ideal(seed) + 0.1
    loops.robot = open_loop(seed)
    assert closed < loops.away()


def test_the_controller_never_goes_faster_than_its_axes_may(tmp_path: Path) -> None:
    """Whatever is wanted: the estimate is told to be a robot that is far off."""
    loops = Loops(tmp_path, PLAN)
    path = []
    loops.begin(callback=lambda trajectory, progress: path.append(trajectory))
    led = path[-1]
    assert led.continues(path[-2])
    q, speed, acceleration = led.at(np.linspace(0.0, led.duration, 5000))
    assert (abs(speed) <= led.robot.speed).all()
    assert (abs(acceleration) <= led.robot.acceleration).all()
    assert abs(q - path[-len(path) // 2].at(np.linspace(0.0, led.duration, 5000))[0]).max() > 1e-3


def test_the_journal_gives_the_same_commands_bit_for_bit(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)
    loops.begin()
    again = loops.replayed()
    assert again.differs == ""
    assert again.corrections > 30
    sent = [r["data"] for r in read_journal(loops.world.path) if r["kind"] == "sent" and " G93 " in r["data"]]
    assert 300 < again.commands <= len(sent)


@pytest.mark.parametrize("what", ["measured", "commanded"])
def test_a_journal_in_which_something_was_changed_is_found_out(tmp_path: Path, what: str) -> None:
    loops = Loops(tmp_path, PLAN)
    loops.begin(callback=at(3.0, lambda: loops.world.latest.abort()))
    records = read_journal(loops.world.path)
    if what == "measured":
        next(r for r in records if r["kind"] == "sensed" and r["time"] > 1.0)["readings"][0][1][0] += 0.1
    else:
        line = next(r for r in records[-100::-1] if r["kind"] == "sent" and "G1 X-" in r["data"])
        line["data"] = line["data"].replace("X-", "X-1")
    loops.world.path.write_text("".join(json.dumps(record) + "\n" for record in records))
    assert ("correction" if what == "measured" else "line") in loops.replayed().differs


def test_it_stops_where_it_is_told_to_and_goes_on_with_what_was_known(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)
    result = loops.begin(callback=at(3.0, lambda: loops.world.latest.abort()))
    assert (result.outcome, result.trusted) == (PlaybackOutcome.CANCELLED, True)
    for time in (2.0, 1.5, np.inf):
        loops.world.latest.close()
        mean = next(r for r in read_journal(loops.world.path)[::-1] if r["kind"] == "corrected")["mean"]
        result = loops.resume(callback=at(time, lambda: loops.world.latest.abort()))
        assert loops.latest.tracker.observer.differences.mean.tolist() == mean
        assert loops.replayed().differs == ""
    assert (result.outcome, result.frame) == (PlaybackOutcome.SUCCESS, 40), result.message
    passed = [r["frame"] for r in read_journal(loops.world.path) if r["kind"] == "frame"]
    assert passed == sorted(set(passed))
    assert loops.world.within_limits()
    moved = loops.robot.plant.history
    assert not loops.robot.plant.has_snapped
    assert np.abs(np.diff([each.q for each in moved], axis=0)).max() < 10.0


def test_it_goes_on_after_its_player_has_died(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)

    def die() -> None:
        loops.world.links[-1].dead = True

    with pytest.raises(Killed):
        loops.begin(callback=at(3.0, die))
    loops.world.clock.sleep(2.0)
    result = loops.resume()
    assert (result.outcome, result.frame) == (PlaybackOutcome.SUCCESS, 40), result.message


def test_in_a_pause_it_stands_and_goes_on_looking(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)
    held = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        pause(trajectory, progress)
        if progress.state == "held":
            held.append((progress.stamp, progress.position))
            if progress.stamp > held[0][0] + 2.0:
                loops.world.latest.resume()

    pause = at(3.0, lambda: loops.world.latest.pause())
    assert loops.begin(callback=seen).outcome is PlaybackOutcome.SUCCESS
    assert (np.ptp([position for _, position in held], axis=0) == 0).all()
    looked = [r["now"] for r in read_journal(loops.world.path) if r["kind"] == "sensed"]
    assert sum(held[0][0] < now < held[-1][0] for now in looked) > 10
    assert loops.notes == []
    assert loops.replayed().differs == ""


def test_tubes_are_pulled_back_along_the_corrected_path(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)
    before = loops.world.firmware.position.copy()
    loops.begin(callback=at(6.0, lambda: loops.world.latest.abort()))
    loops.world.latest.close()
    assert loops.world.retract().outcome is PlaybackOutcome.SUCCESS
    assert loops.world.firmware.position == pytest.approx(before, abs=0.01)


def test_a_closed_loop_is_not_gone_on_with_as_an_open_one(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)
    loops.begin(callback=at(3.0, lambda: loops.world.latest.abort()))
    loops.world.latest.close()
    with pytest.raises(TrajectoryError, match="was played with --closed-loop: resume it with"):
        loops.world.resume()


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_sensors_are_told_in_half_a_second_and_do_no_harm(tmp_path: Path, name: str) -> None:
    for seed in (1, 2):
        (tmp_path / str(seed)).mkdir()
        loops = Loops(tmp_path / str(seed), PLAN, seed, [FAULTS[name]])
        result = loops.begin()
        first = next(note for note in loops.notes if note.time >= BEGIN)
        assert first.time <= BEGIN + 0.5
        told = [record for record in read_journal(loops.world.path) if record["kind"] == "note"]
        assert told[0]["t"] <= BEGIN + 0.5
        assert loops.world.within_limits()
        assert not loops.robot.plant.has_snapped
        assert result.trusted
        assert loops.replayed().differs == ""
        assert result.outcome is PlaybackOutcome.SUCCESS


def test_where_doubt_exceeds_the_margin_it_stops_and_can_be_trusted(tmp_path: Path) -> None:
    """Tubes are turned against each other until shortly before they snap, and nothing is measured."""
    q = np.zeros((40, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0.0, 4.2, 40), (60.0, 80.0)
    loops = Loops(tmp_path, plan_through(q, PLAN.robot), faults=[Silence()])
    result = loops.begin()
    assert result.outcome is PlaybackOutcome.PATH_TOLERANCE_VIOLATED
    assert "standard deviations less stable would snap" in result.message
    assert result.trusted
    assert [note.state for note in loops.notes] == [tracker.TrackerState.UNCORRECTED, tracker.TrackerState.STOPPED]
    assert loops.world.latest.state is PlayerState.FAULT
    stood = loops.world.firmware.position.copy()
    assert abs(stood[3]) < np.degrees(4.0)
    loops.world.clock.sleep(1.0)
    assert (loops.world.firmware.position == stood).all()


def test_what_is_learnt_is_told_over_time(tmp_path: Path) -> None:
    loops = Loops(tmp_path, PLAN)
    loops.begin()
    known = loops.latest.estimates
    assert len(known) > 70
    assert (known[-1].deviation < known[0].deviation).all()
    assert 0.5 < np.sqrt(np.mean([each.size for each in known])) < 1.5
    assert all(each.accepted == 1.0 for each in known)
