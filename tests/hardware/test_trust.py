"""What is remembered of a device between sessions: distrust lasts, and a device has one player."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Killed, World, sweep

from ctr_nlp.exceptions import DeviceFault, HardwareError, Stopped
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState
from ctr_nlp.hardware.playing.trust import Memory, Remembered, doubt, state_folder

pytestmark = pytest.mark.usefixtures("prepared_once")

AT = np.array([1.0, 2.0])
STEP = np.array([0.01, 0.01])


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path, sweep(12), state=tmp_path / "state")


def killed(world: World, frame: int = 6) -> None:
    """Play until the player dies after a frame."""

    def die(trajectory: Any, progress: Any) -> None:
        if trajectory.frames[0] == 1 and progress.time > trajectory.frame_time[frame - 1]:
            world.links[-1].dead = True
            raise Killed

    with pytest.raises(Killed):
        world.begin(callback=die, verified=True)
    world.clock.sleep(3.0)
    world.latest.close()


@pytest.mark.hazard("position unknown")
def test_distrust_lasts_until_a_person_has_looked(world: World) -> None:
    """A reset in motion loses the position; the next session, in another process, does not play on."""

    def reset(trajectory: Any, progress: Any) -> None:
        if trajectory.frames[0] == 1 and progress.time > 0.5:
            world.firmware.receive(b"\x18")

    assert not world.begin(callback=reset, verified=True).trusted
    world.latest.close()
    world.firmware.receive(b"$X\n")
    for _ in range(2):
        with pytest.raises(DeviceFault, match=r"not to be trusted, since .*position-verified"):
            world.begin()
        assert world.latest.state is PlayerState.IDLE
        world.latest.close()
    assert world.begin(verified=True).outcome is PlaybackOutcome.SUCCESS
    world.latest.close()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS


def test_a_stop_while_it_connects_changes_nothing_of_what_is_remembered(world: World) -> None:
    killed(world)
    player = world.player()
    player.abort()
    with pytest.raises(Stopped) as stop:
        player.connect()
    assert (stop.value.result.outcome, stop.value.result.trusted) == (PlaybackOutcome.CANCELLED, False)
    player.close()
    with pytest.raises(DeviceFault, match="a motion had begun, and its end was never recorded"):
        world.begin()
    world.latest.close()
    assert world.begin(verified=True).outcome is PlaybackOutcome.SUCCESS
    world.latest.close()
    player = world.player()
    player.abort()
    with pytest.raises(Stopped) as stop:
        player.connect()
    assert stop.value.result.trusted
    player.close()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS


def test_homing_by_hand_cannot_be_asked_of_a_controller(world: World) -> None:
    world.hardware = replace(world.hardware, connection=replace(world.hardware.connection, homing="manual"))
    with pytest.raises(HardwareError, match="this hardware homes by hand"):
        world.begin(home=True)
    assert b"!" not in world.path.read_bytes()


def test_homing_ends_distrust(world: World) -> None:
    killed(world)
    with pytest.raises(DeviceFault, match="a motion had begun, and its end was never recorded"):
        world.begin()
    world.latest.close()
    assert world.begin(home=True).outcome is PlaybackOutcome.SUCCESS


def test_a_crash_is_gone_on_from_only_with_its_own_journal(world: World) -> None:
    """The journal tells where on its path the robot must be, which is looked for; nothing else does."""
    killed(world)
    with pytest.raises(DeviceFault, match="not to be trusted"):
        world.begin()
    world.latest.close()
    assert world.resume().outcome is PlaybackOutcome.SUCCESS
    world.latest.close()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS


@pytest.mark.hazard("position unknown")
def test_a_power_cycle_is_seen_by_the_controllers_own_count(world: World) -> None:
    assert world.begin(verified=True).outcome is PlaybackOutcome.SUCCESS
    world.latest.close()
    before = world.firmware.position.copy()
    world.firmware.reboot(loses_position=True)
    world.firmware.homed.update({0, 1, 2})  # as with switches at zero: it says that it is homed
    world.firmware.take()
    with pytest.raises(
        DeviceFault, match=r"the device reports the position .* but was left at .*: it was switched off"
    ):
        world.begin()
    assert (before != world.firmware.position).any()


def test_nothing_is_played_where_nothing_can_be_remembered(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where a folder should be")
    world = World(tmp_path, sweep(12), state=tmp_path / "state")
    with pytest.raises(DeviceFault, match=r"cannot be saved in .*set CTR_NLP_STATE to a folder"):
        world.begin()
    assert world.firmware.executed_blocks == []


@pytest.mark.parametrize("homes", [True, False])
def test_a_device_never_met_is_asked_about_once(homes: bool, world: World) -> None:
    with pytest.raises(DeviceFault, match=r"there is no record of this device.*--position-verified"):
        world.begin()
    assert world.firmware.executed_blocks == []
    world.latest.close()
    assert world.begin(**({"home": True} if homes else {"verified": True})).outcome is PlaybackOutcome.SUCCESS
    world.latest.close()
    assert world.begin().outcome is PlaybackOutcome.SUCCESS


def test_another_user_who_never_met_the_device_is_asked(world: World) -> None:
    killed(world)
    world.state = world.folder / "state of another user"
    with pytest.raises(DeviceFault, match="there is no record of this device"):
        world.begin()
    world.latest.close()
    assert world.begin(verified=True).outcome is PlaybackOutcome.SUCCESS


def test_players_of_all_users_share_one_lock(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    first, second = (Memory(tmp_path / user, "tcp there:1", "host", shared) for user in ("one", "two"))
    before = os.umask(0o077)
    try:
        first.claim()
    finally:
        os.umask(before)
    with pytest.raises(DeviceFault, match="another player is connected to host: only one may be"):
        second.claim()
    first.release()
    second.claim()
    second.release()
    if os.name == "posix":  # whoever may read it can lock it
        assert [path.stat().st_mode & 0o777 for path in shared.iterdir()] == [0o444]


def test_a_lock_that_cannot_be_taken_is_said(tmp_path: Path) -> None:
    memory = Memory(tmp_path, "tcp there:1", "host", tmp_path / "missing")
    with pytest.raises(DeviceFault, match=r"host cannot be locked against other users .*missing.*nothing is"):
        memory.claim()


@pytest.mark.hazard("two programs move one device")
def test_a_device_has_one_player(world: World) -> None:
    first = world.player()
    first.connect()
    second = world.player()
    with pytest.raises(DeviceFault, match="another player is connected to wire:"):
        second.connect()
    second.close()
    first.close()
    assert world.begin(verified=True).outcome is PlaybackOutcome.SUCCESS


def test_what_cannot_be_read_is_no_reason_for_trust(tmp_path: Path) -> None:
    memory = Memory(tmp_path, "wire:")
    assert memory.read("controller") is None
    memory.write("controller", Remembered(True, "", (1.0, 2.0)))
    assert memory.read("controller").position == [1.0, 2.0]  # type: ignore[union-attr]
    assert memory.read("another") is None
    file = next(tmp_path.glob("*.json"))
    for text in ("", "[]", "{}", '{"trusted": true, "more": 1}', json.dumps("trusted")):
        file.write_text(text)
        left = memory.read("controller")
        assert left is not None
        assert not left.trusted
        assert str(file) in left.why


@pytest.mark.parametrize(
    ("left", "reason"),
    [
        (None, "there is no record of this device"),
        (Remembered(True, "", (1.0, 2.005)), ""),
        (Remembered(True, "", None), ""),
        (Remembered(True, "", (1.0, 2.02)), "it was switched off, or moved by other means"),
        (Remembered(True, "", (1.0, 2.0, 3.0)), "it was switched off"),
        (Remembered(False, "it fell", (1.0, 2.0)), "since it fell: home the device, or check"),
        (Remembered(False, "it fell", None, "this"), ""),
        (Remembered(False, "it fell", None, "other"), "since it fell"),
    ],
)
def test_what_speaks_against_a_position(left: Remembered | None, reason: str) -> None:
    found = doubt(left, AT, STEP, "this")
    assert reason in found
    assert bool(found) is bool(reason)


def test_where_devices_are_remembered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CTR_NLP_STATE", str(tmp_path))
    assert state_folder() == tmp_path
    monkeypatch.delenv("CTR_NLP_STATE")
    assert state_folder().name == "ctr_nlp"
