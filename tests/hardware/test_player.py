"""The player in virtual time: its states, stops at random moments, typed results, an arm in step, and resuming."""

from __future__ import annotations

import gc
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import World, plan_of, sweep
from emulator.faults import FAULTS
from emulator.firmware import Firmware
from emulator.wire import VirtualClock

from ctr_nlp.exceptions import DeviceFault, Stopped, TrajectoryError
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.devices import MotionProgress, Standing
from ctr_nlp.hardware.devices.arms import SimulatedArm
from ctr_nlp.hardware.devices.simulated import Simulated
from ctr_nlp.hardware.journal import Journal, read_journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState, Result
from ctr_nlp.hardware.playing.session import play_plan, prepare_trajectory
from ctr_nlp.plan.plan import Plan

pytestmark = pytest.mark.usefixtures("prepared_once")

HELD, ABORTED = 0.3, 0.5
"""s from a call within which a pause and an abort must have come to rest."""

SHORT = sweep(10)


class Rig:
    """A simulated device, an arm if the hardware has one, and a player, in virtual time."""

    def __init__(
        self, folder: Path, plan: Plan = SHORT, device: type[Simulated] = Simulated, lag: float | None = None
    ) -> None:
        self.clock, self.plan = VirtualClock(), plan
        self.hardware = (
            simulated_hardware(plan.robot)
            if lag is not None
            else replace(simulated_hardware(plan.robot), arm=None)
        )
        self.trajectory = prepare_trajectory(plan, self.hardware)[0]
        self.device = device(self.trajectory.positions(np.zeros(1))[0], self.clock)
        self.arm = None
        if self.hardware.arm is not None and lag is not None:
            self.arm = SimulatedArm(self.hardware.arm, plan.theta[0], lag=lag, clock=self.clock.now)
        self.path = folder / "journal.jsonl"
        self.player = Player(self.device, self.arm, Journal(self.path, self.clock), self.clock)

    def play(self, seen: Callable[[Trajectory, MotionProgress], None] | None = None) -> Result:
        """Play the trajectory from its start, after connecting where that is still to be done."""
        if self.player.state is PlayerState.DISCONNECTED:
            self.player.connect()
        return self.player.play(self.trajectory, seen)

    def states(self) -> list[str]:
        """As the journal has them."""
        return [record["state"] for record in read_journal(self.path) if record["kind"] == "state"]


class At:
    """A callback that acts once the trajectory has come to a time, and notes all progress."""

    def __init__(self, *actions: tuple[float, Callable[[], Any]]) -> None:
        self.actions, self.progress = list(actions), list[MotionProgress]()

    def __call__(self, trajectory: Trajectory, progress: MotionProgress) -> None:
        self.progress.append(progress)
        while self.actions and progress.time >= self.actions[0][0]:
            self.actions.pop(0)[1]()


def test_states_from_connecting_to_closing(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    assert rig.player.state is PlayerState.DISCONNECTED
    rig.player.connect()
    assert rig.player.state is PlayerState.HOMED
    result = rig.play()
    assert (result.outcome, result.frame, result.trusted) == (PlaybackOutcome.SUCCESS, 10, True)
    rig.player.close()
    assert rig.states() == ["homed", "running", "homed", "disconnected"]


def test_garbage_collections_are_short_while_a_robot_moves(tmp_path: Path) -> None:
    """What existed before the motion is not searched in it; afterwards it is."""
    rig, moving = Rig(tmp_path), list[int]()
    rig.play(lambda trajectory, progress: moving.append(gc.get_freeze_count()))
    assert min(moving) > 10_000
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize(
    ("state", "calls"),
    [
        (PlayerState.DISCONNECTED, ("play", "trust")),
        (PlayerState.IDLE, ("connect", "play")),
        (PlayerState.HOMED, ("connect",)),
        (PlayerState.RUNNING, ("connect", "play", "trust")),
        (PlayerState.HOLD, ("connect", "play", "trust")),
        (PlayerState.FAULT, ("connect", "play", "trust")),
    ],
)
def test_calls_that_a_state_does_not_allow_say_so(
    state: PlayerState, calls: tuple[str, ...], tmp_path: Path
) -> None:
    rig = Rig(tmp_path)
    rig.player.state = state
    for call in calls:
        with pytest.raises(DeviceFault, match=f"the player is {state.value}; only one that is "):
            getattr(rig.player, call)(*([rig.trajectory] if call == "play" else []))
    assert rig.player.state is state


def test_a_device_that_is_not_homed_is_idle_until_it_is(tmp_path: Path) -> None:
    world = World(tmp_path, SHORT, firmware=Firmware({20: 1, 22: 1}))
    player = world.player()
    assert not player.connect().homed
    assert player.state is PlayerState.IDLE
    with pytest.raises(DeviceFault, match="only one that is homed plays"):
        player.play(world.trajectory())
    player = world.player()
    assert player.connect(home=True).homed
    assert player.state is PlayerState.HOMED


def test_homing_ends_an_alarm(tmp_path: Path) -> None:
    world = World(tmp_path, SHORT)
    world.firmware.hard_limit()
    player = world.player()
    assert player.connect(home=True).homed
    assert player.state is PlayerState.HOMED


def test_homing_can_be_stopped(tmp_path: Path) -> None:
    world = World(tmp_path, SHORT, firmware=Firmware({20: 1, 22: 1}))
    player, began = world.player(), world.clock.now()
    wait = world.clock.sleep

    def sleep(seconds: float) -> None:
        wait(seconds)
        if world.clock.now() > began + 2.0:
            player.abort()

    world.clock.sleep = sleep  # type: ignore[method-assign]
    with pytest.raises(Stopped, match=r"stopped on request.* its position is not to be trusted") as stop:
        player.connect(home=True)
    assert (stop.value.result.outcome, stop.value.result.trusted) == (PlaybackOutcome.CANCELLED, False)
    assert world.clock.now() < began + 2.0 + ABORTED
    assert player.state is PlayerState.FAULT
    wait(1.0)
    assert world.firmware.state == "Alarm"
    assert not world.firmware.moving


def test_a_hold_asked_for_at_the_controller_is_a_pause(tmp_path: Path) -> None:
    world, held = World(tmp_path, SHORT), [0]

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if len(trajectory.frames) > 2 and progress.time > 0.3 and not held[0]:
            held[0] = 1
            world.firmware.receive(b"!")
        if world.latest.state is PlayerState.HOLD:
            held[0] += 1
            if held[0] == 100:
                world.latest.resume()

    assert world.begin(callback=seen).outcome is PlaybackOutcome.SUCCESS
    assert held[0] >= 100
    assert world.frames_played() == list(range(1, 11))


# stopping


class Watch(VirtualClock):
    """A clock that notes when the controller moved last."""

    firmware: Firmware
    moved = 0.0

    def sleep(self, seconds: float) -> None:
        end = self.now() + seconds
        while self.now() < end - 1e-9:
            super().sleep(min(0.001, end - self.now()))
            if self.firmware.moving:
                self.moved = self.now()


def watched(folder: Path, plan: Plan = SHORT) -> World:
    world = World(folder, plan, clock=Watch())
    world.clock.firmware = world.firmware  # type: ignore[attr-defined]
    return world


def stops(world: World, pause_at: float, abort_at: float, idle: float = 0.3) -> tuple[float, float, float]:
    """Pause, wait, go on and abort: s until the axes rested, s until they did again, and until play returned."""
    clock, player = world.clock, world.player()
    assert isinstance(clock, Watch)
    called: dict[str, float] = {}
    rested = sent = 0.0

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        nonlocal rested, sent
        now = clock.now()
        if "pause" not in called and progress.time >= pause_at:
            called["pause"] = now
            player.pause()
        elif player.state is PlayerState.HOLD and "held" not in called:
            called["held"], rested, sent = now, clock.moved, world.sent_bytes()
            stood = world.firmware.position
            clock.sleep(idle)
            np.testing.assert_allclose(progress.position, stood, atol=2e-3)
            assert (world.firmware.position == stood).all()
            assert world.sent_bytes() == sent
        elif "held" in called and "resume" not in called:
            assert player.state is PlayerState.HOLD
            assert world.sent_bytes() <= sent + 1  # it is asked for its status, as in motion
            called["resume"] = now
            player.resume()
        elif "resume" in called and "abort" not in called and progress.time >= abort_at:
            called["abort"] = now
            player.abort()

    result = play_plan(player, world.plan, world.hardware, callback=seen)
    returned = clock.now()
    assert result.outcome is PlaybackOutcome.CANCELLED
    assert player.state is PlayerState.HOMED
    sent, stood = world.sent_bytes(), world.firmware.position
    clock.sleep(3.0)
    assert world.sent_bytes() == sent
    assert (world.firmware.position == stood).all()
    assert result.trusted
    assert result.position is not None
    np.testing.assert_allclose(result.position, stood, atol=2e-3)
    assert not world.firmware.slip.any()
    moved = min(clock.moved, returned)
    return rested - called["pause"], moved - called["abort"], returned - called["abort"]


def test_pauses_and_aborts_at_fifty_moments_come_to_rest_in_time(tmp_path: Path) -> None:
    draw, plan = random.Random(0), SHORT
    last = World(tmp_path, plan).trajectory().duration
    found = []
    for n in range(50):
        folder = tmp_path / str(n)
        folder.mkdir()
        first, second = sorted(draw.uniform(0.0, 0.85 * last) for _ in range(2))
        found.append(stops(watched(folder, plan), first, second))
    held, still, returned = np.array(found).T
    print(f"held, still, returned after (median, worst): {np.median(found, axis=0)}, {np.max(found, axis=0)}")
    assert 0 < held.max() < HELD
    assert 0 < still.max() < ABORTED
    assert returned.max() < ABORTED


@pytest.mark.parametrize("seed", range(8))
def test_a_simulated_device_stops_at_any_moment_and_keeps_its_place(seed: int, tmp_path: Path) -> None:
    """Held, it stays; after going on it comes through the same places as one that was never held."""
    draw, rig = random.Random(seed), Rig(tmp_path)
    rig.player.connect()
    held: list[MotionProgress] = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        moments(trajectory, progress)
        if rig.player.state is PlayerState.HOLD and not held:
            held.append(progress)
            rig.clock.sleep(1.0)
            assert (rig.device.update().position == progress.position).all()
            rig.player.resume()

    moments = At((draw.uniform(0.0, 0.85 * rig.trajectory.duration), rig.player.pause))
    assert rig.play(seen).outcome is PlaybackOutcome.SUCCESS
    assert rig.states() == ["homed", "running", "hold", "running", "homed"]
    commands = rig.trajectory.commands()
    for progress in moments.progress:
        ends = np.append(0.0, commands.time)
        path = np.vstack([rig.trajectory.positions(np.zeros(1)), commands.positions])
        there = [np.interp(progress.time, ends, column) for column in path.T]
        np.testing.assert_allclose(progress.position, there, atol=1e-9)
    frames = [record["frame"] for record in read_journal(rig.path) if record["kind"] == "frame"]
    assert frames == list(range(2, 11))


def test_every_frame_is_recorded_however_seldom_the_player_gets_to_look(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    assert rig.play(lambda *_: rig.clock.sleep(0.37)).outcome is PlaybackOutcome.SUCCESS
    frames = [record["frame"] for record in read_journal(rig.path) if record["kind"] == "frame"]
    assert frames == list(range(2, 11))


def test_nothing_goes_on_by_itself(tmp_path: Path) -> None:
    """Held for a minute with nobody asking, it is still held; twice paused, one call lets it go on."""
    world = watched(tmp_path)
    player, since = world.player(), [0.0, 0.0]

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        moments(trajectory, progress)
        if player.state is PlayerState.HOLD:
            since[0] = since[0] or world.clock.now()
            if world.clock.now() - since[0] > 60.0 and not since[1]:
                since[1] = world.clock.now()
                player.resume()

    moments = At((0.3, player.pause), (0.3, player.pause), (0.32, player.pause))
    result = play_plan(player, world.plan, world.hardware, callback=seen)
    assert result.outcome is PlaybackOutcome.SUCCESS
    assert since[1] - since[0] > 60.0
    assert world.frames_played() == list(range(1, 11))


@pytest.mark.parametrize("device", ["simulated", "controller"])
@pytest.mark.parametrize(
    ("words", "held"), [(("pause", "resume"), False), (("pause", "resume", "pause"), True), (("resume",), False)]
)
def test_the_last_word_before_it_rests_counts(
    device: str, words: tuple[str, ...], held: bool, tmp_path: Path
) -> None:
    """Resumed while it still slows down it goes on; paused after that, it does not."""
    world, rig = World(tmp_path, SHORT), Rig(tmp_path)
    player, clock = (rig.player, rig.clock) if device == "simulated" else (world.player(), world.clock)
    left, since = list(words), 0.0

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        nonlocal since
        if progress.time > 0.3 and left:
            getattr(player, left.pop(0))()
            since = clock.now()
        if player.state is PlayerState.HOLD and clock.now() > since + 1.0:
            player.abort()

    result = play_plan(player, SHORT, rig.hardware if device == "simulated" else world.hardware, callback=seen)
    assert result.outcome is (PlaybackOutcome.CANCELLED if held else PlaybackOutcome.SUCCESS)


def test_an_abort_is_final_and_reaches_a_held_device(tmp_path: Path) -> None:
    world = watched(tmp_path)
    player = world.player()

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        moments(trajectory, progress)
        if player.state is PlayerState.HOLD:
            player.abort()
            player.resume()
            player.pause()

    moments = At((0.4, player.pause))
    result = play_plan(player, world.plan, world.hardware, callback=seen)
    assert (result.outcome, result.trusted) == (PlaybackOutcome.CANCELLED, True)
    assert player.state is PlayerState.HOMED
    moved = world.clock.moved  # type: ignore[attr-defined]
    world.clock.sleep(2.0)
    assert world.clock.moved == moved  # type: ignore[attr-defined]


@pytest.mark.parametrize("before", [0.0, 0.01, 0.03, 0.06, 0.1])
def test_a_pause_at_the_very_end_changes_nothing(before: float, tmp_path: Path) -> None:
    """Paused on the last line or after it, it is done, or waits to be let go on."""
    world = World(tmp_path, SHORT)
    player = world.player()

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        moment(trajectory, progress)
        if player.state is PlayerState.HOLD:
            player.resume()

    moment = At((world.trajectory().duration - before, player.pause))
    result = play_plan(player, world.plan, world.hardware, callback=seen)
    assert result.outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == list(range(1, 11))


def test_an_abort_before_anything_plays_lets_nothing_begin(tmp_path: Path) -> None:
    world = World(tmp_path, SHORT)
    player = world.player()
    player.abort()
    result = play_plan(player, world.plan, world.hardware)
    assert (result.outcome, result.trusted) == (PlaybackOutcome.CANCELLED, True)
    world.clock.sleep(1.0)
    assert world.firmware.executed_blocks == []
    player.close()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError, TrajectoryError("not ours")])
def test_whatever_the_callback_raises_stops_everything_first(error: Any, tmp_path: Path) -> None:
    world = watched(tmp_path)
    player, moved = world.player(), 0.0

    def fail() -> None:
        raise error

    kind = error if isinstance(error, type) else type(error)
    with pytest.raises(kind):
        play_plan(player, world.plan, world.hardware, callback=At((0.4, fail)))
    assert player.state is PlayerState.HOMED
    records = read_journal(world.path)
    assert [r["outcome"] for r in records if r["kind"] == "result"][-1] == "CANCELLED"
    moved = world.clock.moved  # type: ignore[attr-defined]
    world.clock.sleep(2.0)
    assert world.clock.moved == moved  # type: ignore[attr-defined]
    player.close()
    assert world.resume().outcome is PlaybackOutcome.SUCCESS
    assert world.frames_played() == list(range(1, 11))


# results


class Elsewhere(Simulated):
    """Axes that stand off what they are told."""

    off = 0.0
    away = 0.0

    def update(self) -> MotionProgress:
        progress = super().update()
        return progress._replace(position=progress.position + self.off, away=self.away)

    def standing(self) -> Standing:
        return Standing(self._position + self.off, True)


def test_results_say_what_was_violated(tmp_path: Path) -> None:
    rig = Rig(tmp_path, device=Elsewhere)
    rig.device.off = 0.51  # type: ignore[attr-defined]
    result = rig.play()
    assert result.outcome is PlaybackOutcome.INVALID_PLAN
    assert "axis X (beta_1) stands at 2.51 mm, and frame 1 is at 2" in result.message
    assert rig.states() == ["homed", "fault"]  # nobody knows why they stand there

    (tmp_path / "off").mkdir()
    rig = Rig(tmp_path / "off", device=Elsewhere)
    rig.device.off = 0.49  # type: ignore[attr-defined]
    result = rig.play()
    assert (result.outcome, result.frame) == (PlaybackOutcome.GOAL_TOLERANCE_VIOLATED, 10)
    assert rig.player.state is PlayerState.FAULT

    (tmp_path / "away").mkdir()
    rig = Rig(tmp_path / "away", device=Elsewhere)
    rig.player.connect()
    result = rig.play(At((0.5, lambda: setattr(rig.device, "away", 1.5))))
    assert (result.outcome, result.frame) == (PlaybackOutcome.PATH_TOLERANCE_VIOLATED, 5)
    assert "1.5 tolerances" in result.message
    assert rig.player.state is PlayerState.FAULT


def test_a_device_that_fails_before_it_starts_is_a_result_too(tmp_path: Path) -> None:
    class Mute(Simulated):
        def standing(self) -> Standing:
            raise DeviceFault("no answer")

    rig = Rig(tmp_path, device=Mute)
    rig.player.state = PlayerState.HOMED
    result = rig.play()
    assert (result.outcome, result.position, result.trusted) == (PlaybackOutcome.DEVICE_FAULT, None, False)
    assert rig.player.state is PlayerState.FAULT


@pytest.mark.parametrize("name", ["hard_limit", "cut", "silent", "banner"])
def test_a_controller_that_fails_is_a_device_fault(name: str, tmp_path: Path) -> None:
    world = World(tmp_path, SHORT)
    result = world.begin((FAULTS[name](at=world.firmware.time + 1.2),))
    assert (result.outcome, result.trusted) == (PlaybackOutcome.DEVICE_FAULT, False)
    assert world.latest.state is PlayerState.FAULT


# the arm


def tilting(frames: int = 10) -> Plan:
    """Tubes come out while the robot tilts to and fro."""
    t = np.linspace(0.0, 1.0, frames)[:, None]
    beta = np.hstack([2 + 5 * t, 4 + 8 * t, 8 + 12 * t])
    theta = np.hstack([0.15 * np.sin(3 * t), -0.1 * t])
    return plan_of(np.hstack([0.5 * t, 0 * t, -0.5 * t, beta, theta]), 0.2)


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_the_arm_keeps_in_step_with_the_steppers(lag: float, tmp_path: Path) -> None:
    rig = Rig(tmp_path, tilting(), lag=lag)
    rig.player.connect()
    assert rig.arm is not None
    off = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        late = np.array([max(progress.time - lag, 0.0)])
        off.append(np.linalg.norm(rig.player.tilt() - trajectory.at(late)[0][0, -2:]))

    assert rig.play(seen).outcome is PlaybackOutcome.SUCCESS
    assert max(off[:-1]) < 4e-3  # 0.3 rad/s for some 10 ms
    np.testing.assert_allclose(rig.arm.tilt(), rig.plan.theta[-1], atol=1e-3)
    stood = rig.arm.tilt()
    rig.clock.sleep(1.0)
    np.testing.assert_array_equal(rig.arm.tilt(), stood)


def still_afterwards(rig: Rig) -> bool:
    """Whether neither the axes nor the arm move any more."""
    assert rig.arm is not None
    before = (rig.device.standing().position.copy(), rig.arm.tilt())
    rig.clock.sleep(1.0)
    return bool((rig.device.standing().position == before[0]).all() and (rig.arm.tilt() == before[1]).all())


def test_an_arm_that_falls_behind_stops_both(tmp_path: Path) -> None:
    rig = Rig(tmp_path, tilting(), lag=0.4)
    result = rig.play()
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert "the arm is not in step" in result.message
    assert 0 < result.frame < 10
    assert still_afterwards(rig)
    assert rig.player.state is PlayerState.FAULT


class Unheard(Simulated):
    """Axes of which nothing is heard for a while, as over a link that is late."""

    until = -1.0
    told: MotionProgress

    def update(self) -> MotionProgress:
        progress = super().update()
        if self._clock.now() >= self.until or progress.state == "holding":
            self.told = progress
        return self.told


@pytest.mark.parametrize(("silence", "late"), [(0.45, True), (0.05, False)])
def test_late_reports_are_not_called_a_fault_of_the_arm(silence: float, late: bool, tmp_path: Path) -> None:
    rig = Rig(tmp_path, tilting(), device=Unheard, lag=0.0)
    result = rig.play(At((0.5, lambda: setattr(rig.device, "until", rig.clock.now() + silence))))
    assert result.outcome is (PlaybackOutcome.DEVICE_FAULT if late else PlaybackOutcome.SUCCESS), result.message
    assert result.message.startswith("the device reported no position for 0.4") is late, result.message
    assert ("its reports are late, and the arm" in result.message) is late


def test_a_hold_holds_both_and_both_go_on(tmp_path: Path) -> None:
    rig = Rig(tmp_path, tilting(), lag=0.02)
    rig.player.connect()
    held = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        moments(trajectory, progress)
        if rig.player.state is PlayerState.HOLD and not held:
            held.append(progress.time)
            assert still_afterwards(rig)
            wanted = trajectory.at(np.array([progress.time]))[0][0, -2:]
            np.testing.assert_allclose(rig.player.tilt(), wanted, atol=0.3 * 0.1)
            rig.player.resume()

    moments = At((0.8, rig.player.pause))
    result = rig.play(seen)
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    assert len(held) == 1
    np.testing.assert_allclose(rig.player.tilt(), rig.plan.theta[-1], atol=1e-3)


class Broken(SimulatedArm):
    """Fails when it is told to go somewhere."""

    broken = stuck = False

    def follow(self, theta: Any) -> None:
        if self.broken:
            raise DeviceFault("protective stop")
        super().follow(theta)

    def stop(self) -> None:
        super().stop()
        if self.stuck:
            raise DeviceFault("could not be told to stop")


@pytest.mark.parametrize("stuck", [False, True])
def test_an_arm_that_fails_stops_the_steppers(stuck: bool, tmp_path: Path) -> None:
    rig = Rig(tmp_path, tilting(), lag=0.0)
    assert rig.hardware.arm is not None
    arm = Broken(rig.hardware.arm, rig.plan.theta[0], clock=rig.clock.now)
    arm.stuck = stuck
    rig.arm = rig.player._arm = arm
    rig.player.connect()
    result = rig.play(At((0.8, lambda: setattr(arm, "broken", True))))
    assert (result.outcome, result.trusted) == (PlaybackOutcome.DEVICE_FAULT, True)
    assert "protective stop" in result.message
    assert ("could not be told" in result.message) == stuck
    assert still_afterwards(rig)


def test_an_aborted_program_with_an_arm_can_be_resumed_in_the_same_session(tmp_path: Path) -> None:
    rig = Rig(tmp_path, tilting(), lag=0.0)
    rig.player.connect()
    result = rig.play(At((0.8, rig.player.abort)))
    assert result.outcome is PlaybackOutcome.CANCELLED
    assert still_afterwards(rig)
    assert rig.player.state is PlayerState.HOMED
    rig.player.close()
    again = play_plan(rig.player, rig.plan, rig.hardware)
    assert again.outcome is PlaybackOutcome.SUCCESS, again.message
