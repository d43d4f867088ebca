"""Beginning and going on: whatever ended a session, the next plays what is left, once, or refuses to."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Killed, World, homing_hardware, plan_of, sweep
from emulator.firmware import Firmware

from ctr_nlp.exceptions import DeviceFault, TrajectoryError
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState, Result
from ctr_nlp.hardware.playing.session import play_plan, prepare_trajectory, resume
from ctr_nlp.plan.plan import Plan

pytestmark = pytest.mark.usefixtures("prepared_once")

SHORT = sweep(12)
ALL = list(range(1, 13))
HOMED = Firmware({20: 1}, homed=True).position


def rig(folder: Path, plan: Plan = SHORT, **hardware: Any) -> World:
    return World(folder, plan, homing_hardware(**hardware))


def until(world: World, seconds: float, action: Callable[[], Any]) -> Callable[[Trajectory, MotionProgress], None]:
    """A callback that acts once, so many s after now."""
    end, left = world.clock.now() + seconds, [action]

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if left and world.clock.now() >= end:
            left.pop()()

    return seen


def killed(world: World, seconds: float, play: Callable[..., Result] | None = None) -> None:
    """Play until the player dies, so many s from now."""

    def die() -> None:
        world.links[-1].dead = True
        raise Killed

    with pytest.raises(Killed):
        (play or world.begin)(callback=until(world, seconds, die))


def motion_start(world: World) -> float:
    """s from begin to the first frame, by trying."""
    found: list[float] = []
    trial = World(world.folder / "trial", world.plan, world.hardware)
    trial.path.parent.mkdir()
    start = trial.clock.now()

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and not found:
            found.append(trial.clock.now() - start)

    assert trial.begin(callback=seen).outcome is PlaybackOutcome.SUCCESS
    return found[0]


def finish(world: World) -> None:
    """Go on to the end; every frame has been played once, at the latest then."""
    if world.frames_played() == ALL:
        refused(world, "nothing is left")
        return
    result = world.resume()
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    assert world.frames_played() == ALL
    assert world.within_limits()


# beginning


@pytest.mark.parametrize("part", [0.1, 0.5])
def test_the_first_frame_is_gone_to_slowly_and_straight(part: float, tmp_path: Path) -> None:
    world = rig(tmp_path, approach=part)
    trajectory, approach = world.trajectory(), list[Trajectory]()
    start = world.firmware.position
    places = []

    def seen(played: Trajectory, progress: MotionProgress) -> None:
        if played.frames[0] == 0:
            approach.append(played)
            places.append(progress.position)

    assert world.begin(callback=seen).outcome is PlaybackOutcome.SUCCESS
    motion = approach[0]
    fastest = abs(motion.at(np.linspace(0, motion.duration, 500))[1]).max(axis=0)
    limits = world.hardware.apply_limits(world.plan.robot).speed * part
    assert (fastest <= limits * (1 + 1e-6)).all()
    assert (fastest / limits).max() > 0.5
    end = trajectory.positions(np.zeros(1))[0]
    order = ["XYZABC".index(letter) for letter in world.hardware.letters]
    gone = (np.array(places) - start[order])[:, :3] / (end - start[order])[:3]
    np.testing.assert_allclose(gone, np.broadcast_to(gone[:, :1], gone.shape), atol=0.02)


def test_nothing_is_gone_to_where_the_robot_is_there_already(tmp_path: Path) -> None:
    q = np.zeros((5, 8))
    q[:, 3:6] = np.linspace(0.0, 4.0, 5)[:, None]
    homed = homing_hardware()
    axes = [replace(axis, zero=HOMED[i]) if i < 3 else axis for i, axis in enumerate(homed.axes)]
    world = rig(tmp_path, plan_of(q, 0.2), axes=tuple(axes))
    played = set()
    np.testing.assert_allclose(world.trajectory().positions(np.zeros(1))[0][:3], HOMED[:3], atol=1e-3)
    assert (
        world.begin(callback=lambda trajectory, _: played.add(int(trajectory.frames[0]))).outcome
        is PlaybackOutcome.SUCCESS
    )
    assert played == {1}


def test_a_device_that_does_not_know_where_it_stands_is_homed_or_refused(tmp_path: Path) -> None:
    world = World(tmp_path, SHORT, firmware=Firmware({20: 1, 22: 1}))
    with pytest.raises(DeviceFault, match="home it first"):
        world.begin()
    assert world.firmware.executed_blocks == []
    assert world.latest.state is PlayerState.IDLE
    player = world.player()
    assert play_plan(player, world.plan, world.hardware, home=True).outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == ALL


# going on


@pytest.mark.parametrize("seed", [*range(6), 153])  # 153 stops on a frame, to the step
def test_an_aborted_session_goes_on_where_it_stopped(seed: int, tmp_path: Path) -> None:
    world = rig(tmp_path)
    moment = motion_start(world) + random.Random(seed).uniform(0.1, 0.9)
    assert (
        world.begin(callback=until(world, moment, lambda: world.latest.abort())).outcome
        is PlaybackOutcome.CANCELLED
    )
    finish(world)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("wait", [0.0, 0.2, 5.0])
def test_a_killed_session_goes_on_where_the_controller_came_to(seed: int, wait: float, tmp_path: Path) -> None:
    """wait: s until it is resumed; until its buffer is empty, the controller plays on and is stopped first."""
    world = rig(tmp_path)
    killed(world, motion_start(world) + random.Random(seed).uniform(0.1, 0.7))
    world.clock.sleep(wait)
    finish(world)


@pytest.mark.parametrize("seed", range(3))
def test_twice_in_a_row(seed: int, tmp_path: Path) -> None:
    draw, world = random.Random(seed), rig(tmp_path)
    killed(world, motion_start(world) + draw.uniform(0.1, 0.2))
    result = world.resume(callback=until(world, 1.0 + draw.uniform(0.0, 0.2), lambda: world.latest.abort()))
    if result.outcome is PlaybackOutcome.CANCELLED:
        finish(world)
    assert world.frames_played() == ALL


def test_killed_while_it_is_held(tmp_path: Path) -> None:
    world = rig(tmp_path)
    moment = motion_start(world) + 0.4
    start = world.clock.now()
    paused = until(world, moment, lambda: world.latest.pause())

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        paused(trajectory, progress)
        if world.latest.state is PlayerState.HOLD and world.clock.now() > start + moment + 1.0:
            world.links[-1].dead = True
            raise Killed

    with pytest.raises(Killed):
        world.begin(callback=seen)
    world.clock.sleep(10.0)
    finish(world)


def test_killed_on_the_way_to_the_first_frame(tmp_path: Path) -> None:
    world = rig(tmp_path, approach=0.1)
    killed(world, motion_start(world) - 0.3)
    world.clock.sleep(5.0)
    with pytest.raises(TrajectoryError, match="ended before its first frame: play the plan from its start"):
        world.resume()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == ALL


def stopped(folder: Path, **hardware: Any) -> World:
    """A session that was aborted in the middle."""
    world = rig(folder, **hardware)
    moment = motion_start(world) + 0.5
    assert (
        world.begin(callback=until(world, moment, lambda: world.latest.abort())).outcome
        is PlaybackOutcome.CANCELLED
    )
    return world


def refused(world: World, message: str, **options: Any) -> None:
    """Resuming is refused, moves nothing, and leaves the session as it was."""
    before, stood = len(world.firmware.executed_blocks), world.firmware.position
    with pytest.raises(TrajectoryError, match=message):
        world.resume(**options)
    world.latest.close()
    world.clock.sleep(2.0)
    assert len(world.firmware.executed_blocks) == before
    assert (world.firmware.position == stood).all()


def test_a_robot_that_was_moved_by_hand_is_not_played_until_it_is_back(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    jog(world, "Y-1.5")
    refused(world, "tolerances off the path after frame")
    jog(world, "Y1.5")
    finish(world)


def jog(world: World, word: str) -> None:
    """Move the axes from the controller's own panel."""
    world.firmware.receive(f"$J=G91 G21 {word} F1000\n".encode())
    world.clock.sleep(2.0)


def test_a_little_off_is_made_up_for_slowly(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    jog(world, "Y-0.3")
    finish(world)


def test_another_plan_other_hardware_or_another_journal_are_refused(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    plan, hardware = world.plan, world.hardware
    beta = plan.beta.copy()
    beta[-1, 0] += 1e-6
    world.plan = replace(plan, beta=beta)
    refused(world, r"another plan: its digest .* that of this plan \(bench\)")
    world.plan = replace(plan, shape=plan.shape + 0.02)
    refused(world, "another plan")
    world.plan = plan
    axis = replace(hardware.axes[0], zero=hardware.axes[0].zero - 1e-3)
    for other in (replace(hardware, axes=(axis, *hardware.axes[1:])), replace(hardware, approach=0.9)):
        world.hardware = other
        refused(world, "another hardware: .* that of this hardware file")
    world.hardware = hardware
    finish(world)


def test_what_is_over_or_never_began_is_not_resumed(tmp_path: Path) -> None:
    world = rig(tmp_path)
    world.player().connect()
    refused(world, "played no trajectory")
    assert world.begin().outcome is PlaybackOutcome.SUCCESS
    refused(world, "reached frame 12, the last one: nothing is left")


def test_an_untrusted_position_is_refused_unless_somebody_looked(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    record = {"t": 0.0, "kind": "result", "outcome": "DEVICE_FAULT", "frame": 6, "trusted": False}
    with world.path.open("a") as file:
        file.write(json.dumps(record) + "\n")
    refused(world, "was not to be trusted")
    assert world.resume(verified=True).outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == ALL


def test_a_failed_attempt_to_resume_does_not_hide_the_session(tmp_path: Path) -> None:
    world = stopped(tmp_path)
    for _ in range(2):
        with pytest.raises(DeviceFault):
            world.resume((unanswered(),))
        world.latest.close()
        world.clock.sleep(1.0)
    records = read_journal(world.path)
    assert sum(record["kind"] == "session" for record in records) == 3
    assert world.resume(verified=True).outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == ALL


def unanswered() -> Any:
    from emulator.faults import FAULTS

    return FAULTS["half_open"](at=0.0)


def test_the_rest_is_played_at_the_tempo_of_the_beginning(tmp_path: Path) -> None:
    world = rig(tmp_path)
    player, slow = world.player(), 0.5
    whole = prepare_trajectory(world.plan, world.hardware, slow)[0]
    moment = motion_start(world) + 1.0
    play_plan(player, world.plan, world.hardware, slow, callback=until(world, moment, player.abort))
    player.close()
    rest: list[Trajectory] = []
    again = world.player()
    result = resume(
        again,
        world.plan,
        world.hardware,
        read_journal(world.path),
        callback=lambda trajectory, _: rest.append(trajectory),
    )
    assert result.outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == ALL
    last = np.diff(rest[-1].frame_time[-4:-1])
    np.testing.assert_allclose(last, np.diff(whole.frame_time[-4:-1]), rtol=0.1)
    assert last.min() > 0.19


@pytest.mark.parametrize("seed", range(6))
def test_a_plan_that_comes_by_the_same_places_again_goes_on_in_the_right_round(seed: int, tmp_path: Path) -> None:
    """Three times the same circle, each longer than what the controller's buffer holds."""
    turn = np.linspace(0.0, 6 * np.pi, 37)
    q = np.zeros((37, 8))
    q[:, 0], q[:, 1] = 0.3 * np.sin(turn), -0.3 * np.sin(turn)
    q[:, 3:6] = np.array([6.0, 12.0, 18.0]) + 3 * (1 - np.cos(turn))[:, None]
    world = rig(tmp_path, plan_of(q, 0.6))
    killed(world, motion_start(world) + random.Random(seed).uniform(0.5, 14.0))
    world.clock.sleep(8.0)
    known = {r["frame"] for r in read_journal(world.path) if r["kind"] == "frame"}
    assert world.resume().outcome is PlaybackOutcome.SUCCESS
    again = [r["frame"] for r in read_journal(world.path) if r["kind"] == "frame"]
    assert max(known) < again[0] <= max(known) + 11  # 100 blocks and some lines of 0.05 s are buffered
    assert again[-1] == 37
