"""Every violation that ends a motion: its type, its value in the message, and what is not one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import World, sweep

from ctr_nlp.hardware.devices import MotionProgress, Signs
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState
from ctr_nlp.hardware.playing.supervision import (
    HELD_UP,
    HOLDING,
    MAX_AHEAD_OF_SCHEDULE_S,
    MAX_DEVICE_SILENCE_S,
    MAX_STALL_TIME_S,
    MISPLACED,
    UNASKED,
    Supervisor,
)

pytestmark = pytest.mark.usefixtures("prepared_once")

LATE = 0.8


def supervisor() -> Supervisor:
    return Supervisor(LATE, np.array([0.01, 0.02]), np.array([0.5, 0.5]), lambda time: np.array([time, -time]))


def progress(time: float, stamp: float, state: str = "running", **changes: Any) -> MotionProgress:
    """A device that plays as it should, but for changes."""
    return MotionProgress(state, time, np.array([time, -time]), stamp, 0.1)._replace(**changes)


def watched(seen: list[tuple[float, MotionProgress]], by: Supervisor | None = None) -> list[str]:
    """What a supervisor says at moments."""
    by = by or supervisor()
    found = [by.violation(one, now) for now, one in seen]
    return ["" if violation is None else f"{violation.outcome.name}: {violation.message}" for violation in found]


def test_a_motion_in_time_is_left_alone() -> None:
    moments = np.arange(0.0, 5.0, 0.02)
    assert not any(watched([(now, progress(max(0.0, now - 0.1), now)) for now in moments]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"away": 1.01}, "PATH_TOLERANCE_VIOLATED: the axes are 1.01 tolerances from their path; 1 is allowed"),
        ({"signs": Signs("it said so")}, "DEVICE_FAULT: it said so"),
        ({"signs": Signs(override=110.0)}, "DEVICE_FAULT: the feed override is 110 %, and must be 100 %"),
        ({"signs": Signs(stalled=MAX_STALL_TIME_S + 0.1)}, "DEVICE_FAULT: nothing has moved for 1.1 s"),
        ({"stamp": -MAX_DEVICE_SILENCE_S - 0.1}, "DEVICE_FAULT: the device has reported no position for 0.6 s"),
    ],
)
def test_what_is_seen_at_once(changes: dict[str, Any], message: str) -> None:
    (said,) = watched([(0.0, progress(0.0, 0.0)._replace(**changes))])
    assert message in said


def test_nothing_is_said_at_the_tolerances_themselves() -> None:
    signs = Signs("", 100.0, MAX_STALL_TIME_S)
    assert not any(watched([(0.0, progress(0.0, -MAX_DEVICE_SILENCE_S, away=1.0, signs=signs))]))


def test_a_schedule_is_kept_both_ways() -> None:
    late = watched([(0.02 * n, progress(0.01 * n, 0.02 * n)) for n in range(100)])
    assert late.index(next(filter(None, late))) == int(LATE / 0.01) + 1
    assert f"s behind their schedule; {LATE:g} s are allowed" in late[-1]
    early = watched([(0.02 * n, progress(0.04 * n, 0.02 * n)) for n in range(100)])
    assert early.index(next(filter(None, early))) == int(MAX_AHEAD_OF_SCHEDULE_S / 0.02) + 1
    assert early[-1].startswith("PATH_TOLERANCE_VIOLATED: the axes are ")
    assert f"s ahead of their schedule; {MAX_AHEAD_OF_SCHEDULE_S:g} s are allowed" in early[-1]


def test_axes_cannot_be_ahead_of_their_commands() -> None:
    """Those that are reported there are not to be trusted; late ones are."""
    for rate, misplaced in ((0.01, False), (0.04, True)):
        by = supervisor()
        found = [by.violation(progress(rate * n, 0.02 * n), 0.02 * n) for n in range(100)]
        assert {ending.misplaced for ending in found if ending is not None} == {misplaced}


@pytest.mark.parametrize(("away", "misplaced"), [(0.9, None), (MISPLACED, None), (MISPLACED + 0.1, True)])
def test_axes_that_are_off_are_misplaced(away: float, misplaced: bool | None) -> None:
    ending = supervisor().violation(progress(0.0, 0.0, away=away), 0.0)
    assert (None if ending is None else ending.misplaced) is misplaced


def test_axes_within_tolerance_of_where_they_should_be_are_not_late() -> None:
    """Where a motion creeps, a small offset is long a time."""
    by = Supervisor(LATE, np.array([0.01, 0.02]), np.array([0.5, 0.5]), lambda time: np.array([0.1, -0.1]) * time)
    creeping = [(t, progress(0.0, t, position=np.zeros(2))) for t in np.arange(0.0, 6.0, 0.1)]
    said = watched(creeping, by)
    assert not any(said[:50])
    assert "s behind their schedule" in said[-1]


def test_a_stalled_device_is_not_called_late() -> None:
    stalled = [(t, progress(0.0, t, signs=Signs("", None, t, "an ok was lost"))) for t in np.arange(0.0, 2.0, 0.1)]
    assert set(watched(stalled)) - {""} >= {
        "DEVICE_FAULT: nothing has moved for 1.1 s, though the device was given more to do: an ok was lost"
    }
    assert not [said for said in watched(stalled) if "schedule" in said]


def held(at: float, since: float, until: float, **changes: Any) -> list[tuple[float, MotionProgress]]:
    """A device that rests at a time of its motion."""
    return [(now, progress(at, now, "held", **changes)) for now in np.arange(since, until, 0.1)]


def test_a_pause_lasts_as_long_as_its_user_wants_and_its_schedule_begins_anew() -> None:
    by = supervisor()
    by.note_pause()
    assert not any(watched([(0.0, progress(0.0, 0.0)), *held(0.5, 0.5, 300.0)], by))
    by.note_resume()
    assert not any(watched([(300.0 + 0.1 * n, progress(0.5 + 0.1 * n, 300.0 + 0.1 * n)) for n in range(20)], by))


def test_a_hold_by_somebody_else_ends() -> None:
    said = watched(held(0.5, 0.0, UNASKED + 1.0))
    assert not any(said[:-11])
    assert "somebody else has held the motion for 10 s" in said[-1]


@pytest.mark.parametrize("state", ["running", "holding", "done"])
def test_a_hold_that_somebody_else_ends_is_a_fault(state: str) -> None:
    by = supervisor()
    by.note_pause()
    assert not any(watched(held(0.5, 0.0, 1.0), by))
    (said,) = watched([(1.0, progress(0.5, 1.0, state))], by)
    assert "though the player did not resume" in said


def test_what_moves_in_a_hold_is_a_fault() -> None:
    by = supervisor()
    by.note_pause()
    assert not any(watched(held(0.5, 0.0, 1.0), by))
    (said,) = watched([(1.0, progress(0.5, 1.0, "held", position=np.array([0.5, -0.53])))], by)
    assert "an axis has moved by 0.03 in a hold" in said


@pytest.mark.hazard("late or missing stop")
def test_a_hold_must_come_to_rest() -> None:
    moments = np.arange(0.0, HOLDING + 0.5, 0.1)
    said = watched([(now, progress(0.5, now, "holding")) for now in moments])
    assert f"a hold has not come to rest in {HOLDING:g} s" in said[-1]
    assert said.index(next(filter(None, said))) > HOLDING / 0.1 - 1


def test_a_player_that_was_suspended_does_not_go_on() -> None:
    by = supervisor()
    assert not any(watched([(0.0, progress(0.0, 0.0)), (HELD_UP, progress(0.3, HELD_UP))], by))
    (said,) = watched([(2 * HELD_UP + 0.1, progress(0.6, 2 * HELD_UP + 0.1))], by)
    assert "the player itself was held up for 0.6 s" in said


# on the emulated controller


def on_the_way(world: World, at: float, action: Any) -> Any:
    """A callback that acts once in the plan's motion."""
    done: list[bool] = []

    def seen(trajectory: Any, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and progress.time > at and not done:
            done.append(True)
            action()

    return seen


def test_somebody_elses_resume_in_a_hold_stops_the_motion(tmp_path: Path) -> None:
    """It used to run on unseen, with the player waiting for ever."""
    world = World(tmp_path, sweep(40))
    resumed: list[float] = []

    def seen(trajectory: Any, progress: MotionProgress) -> None:
        pause(trajectory, progress)
        if world.latest.state is PlayerState.HOLD and not resumed:
            resumed.append(world.clock.now())
            world.firmware.receive(b"~")

    pause = on_the_way(world, 0.5, lambda: world.latest.pause())
    result = world.begin(callback=seen)
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert "though the player did not resume" in result.message
    assert world.clock.now() - resumed[0] < 0.6
    assert not world.firmware.moving
    assert result.trusted


def test_a_hold_by_a_pendant_that_nobody_ends_does_not_last_for_ever(tmp_path: Path) -> None:
    world = World(tmp_path, sweep(40))
    result = world.begin(callback=on_the_way(world, 0.5, lambda: world.firmware.receive(b"!")))
    assert "somebody else has held the motion for 10 s" in result.message
    assert result.trusted
    assert world.resume().outcome is PlaybackOutcome.SUCCESS


def test_a_pace_that_no_override_explains_is_seen(tmp_path: Path) -> None:
    """A controller that hides its overrides, and runs at half speed."""
    world = World(tmp_path, sweep(60))

    def hide(line: bytes) -> list[tuple[float, bytes]]:
        before, found, _ = line.partition(b"|Ov:")
        return [(0.0, before + b">\r\n" if found else line)]

    def slow() -> None:
        world.links[-1].wire.line.inward.append(hide)
        world.firmware.receive(b"\x92" * 5)

    result = world.begin(callback=on_the_way(world, 0.5, slow))
    assert result.outcome is PlaybackOutcome.PATH_TOLERANCE_VIOLATED
    assert "s behind their schedule; 1 s are allowed (" in result.message
