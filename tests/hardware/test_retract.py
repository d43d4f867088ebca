"""Pulling the tubes back: on the path that they came, or innermost first; checked, slow, and stopped on
request."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Killed, World, homing_hardware, plan_of, sweep

from ctr_nlp.exceptions import DeviceFault, TrajectoryError
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.motion.lookahead import FollowedPath
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.results import PlaybackOutcome
from ctr_nlp.hardware.playing.retract import innermost_first

pytestmark = pytest.mark.usefixtures("prepared_once")


def stopped(folder: Path, at: float = 1.0, **hardware: Any) -> World:
    """A rig whose motion was aborted so many s after it began."""
    world = World(folder, sweep(20), homing_hardware(approach=0.5, **hardware))

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and progress.time > at:
            world.latest.abort()

    assert world.begin(callback=seen).trusted
    return world


@pytest.mark.parametrize("at", [0.05, 0.6, 1.4])
@pytest.mark.hazard("robot cannot be withdrawn")
def test_the_way_back_is_the_way_there(at: float, tmp_path: Path) -> None:
    world = stopped(tmp_path, at)
    trajectory, start = world.trajectory(), World(tmp_path).firmware.position
    path, places = (
        FollowedPath(trajectory.positions(np.zeros(1))[0], trajectory.commands(), world.hardware.tolerance),
        [],
    )
    speeds = []

    def seen(played: Trajectory, progress: MotionProgress) -> None:
        speeds.append(abs(played.at(np.linspace(0, played.duration, 50))[1]) / played.robot.speed)
        if len(played.frames) > 2:
            places.append(path.nearest(progress.position, 0, len(trajectory.commands().time)).away)

    result = world.retract(callback=seen)
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    np.testing.assert_allclose(world.firmware.position, start, atol=5e-3)
    assert max(places) < 0.1
    assert np.max(speeds) <= 1 + 1e-6
    assert (speeds[0] * 0.5 <= 0.5 + 1e-6).all()


def test_what_was_retracted_is_not_resumed(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    assert world.retract().outcome is PlaybackOutcome.SUCCESS
    with pytest.raises(TrajectoryError, match="were retracted after that session: play the plan from its start"):
        world.resume()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS


def test_a_retraction_that_was_stopped_is_gone_on_with(tmp_path: Path) -> None:
    world = stopped(tmp_path, 1.4)
    start = World(tmp_path).firmware.position

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if progress.time > 0.5 * trajectory.duration:
            world.latest.abort()

    for _ in range(3):
        assert world.retract(callback=seen).outcome is PlaybackOutcome.CANCELLED
    assert world.retract().outcome is PlaybackOutcome.SUCCESS
    np.testing.assert_allclose(world.firmware.position, start, atol=5e-3)


def test_tubes_that_do_not_stand_on_their_way_are_not_pulled(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    world.firmware.receive(b"$J=G91 Y-4 F600\n")
    world.clock.sleep(2.0)
    before = world.firmware.position.copy()
    with pytest.raises(TrajectoryError, match="tolerances off the path"):
        world.retract()
    assert (world.firmware.position == before).all()


def test_a_controller_that_a_dead_player_left_in_motion_is_stopped_first(tmp_path: Path) -> None:
    world = World(tmp_path, sweep(20), state=tmp_path / "state")

    def die(trajectory: Trajectory, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and progress.time > 0.8:
            world.links[-1].dead = True
            raise Killed

    with pytest.raises(Killed):
        world.begin(callback=die, verified=True)
    world.latest.close()
    assert world.retract().outcome is PlaybackOutcome.SUCCESS
    assert (world.firmware.position[:3] > -1.1).all()


def test_a_position_that_is_not_to_be_trusted_needs_a_person(tmp_path: Path) -> None:
    world = World(tmp_path, sweep(20), state=tmp_path / "state")

    def reset(trajectory: Trajectory, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and progress.time > 0.8:
            world.firmware.receive(b"\x18")

    assert not world.begin(callback=reset, verified=True).trusted
    world.latest.close()
    world.firmware.receive(b"$X\n")
    with pytest.raises(TrajectoryError, match="not to be trusted"):
        world.retract()
    with pytest.raises(DeviceFault, match="not to be trusted"):
        world.retract(known=False)
    world.latest.close()
    assert world.retract(verified=True).outcome is PlaybackOutcome.SUCCESS


@pytest.mark.hazard("robot cannot be withdrawn")
def test_without_a_journal_the_innermost_tube_comes_first(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    places = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        places.append(-progress.position[:3])

    before = world.firmware.position.copy()
    result = world.retract(known=False, callback=seen)
    assert result.outcome is PlaybackOutcome.SUCCESS
    beta = np.array(places)
    assert (np.diff(beta, axis=0) < 2e-3).all()
    assert (np.diff(beta, axis=1) > -5e-3).all()
    moving = [np.flatnonzero(column < column[0] - 0.05)[0] for column in beta.T]
    assert moving[2] < moving[1] < moving[0]
    np.testing.assert_allclose(world.firmware.position[:3], 0.0, atol=5e-3)
    np.testing.assert_allclose(world.firmware.position[3:], before[3:], atol=2e-2)


def test_tubes_that_are_in_have_nowhere_to_go() -> None:
    plan, hardware = plan_of(np.zeros((3, 8)), 0.1), homing_hardware()
    with pytest.raises(TrajectoryError, match="all tubes are retracted already"):
        innermost_first(plan, hardware, hardware.positions(plan.robot, np.zeros(8)), np.zeros(2))


def test_another_plan_is_refused_by_name(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    world.plan = replace(world.plan, shape=world.plan.shape + 0.02)
    with pytest.raises(TrajectoryError, match="the journal is of another plan"):
        world.retract()
