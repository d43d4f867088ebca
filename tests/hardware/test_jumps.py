"""Positions that are reported far from where the axes should be are not trusted, whenever that is seen."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bench import World, sweep

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.playing.results import PlaybackOutcome

pytestmark = pytest.mark.usefixtures("prepared_once")

AXIS = 3
"""The axis whose reports jump: A, in degrees."""


@pytest.fixture
def world(tmp_path: Path) -> World:
    known = World(tmp_path, sweep(20), state=tmp_path / "state")
    known.meet()
    return known


def jump(world: World, by: float) -> None:
    """From now on all reports are off by so much, as a controller's are that has lost count."""

    def shifted(line: bytes) -> list[tuple[float, bytes]]:
        found = re.search(rb"MPos:([^|>]*)", line)
        if found is None:
            return [(0.0, line)]
        values = [float(value) for value in found[1].split(b",")]
        values[AXIS] += by
        told = ",".join(f"{value:.3f}" for value in values).encode()
        return [(0.0, line.replace(found[1], told))]

    world.links[-1].wire.line.inward.append(shifted)


def once(happens: Callable[[Any, MotionProgress], bool], action: Callable[[], None]) -> Any:
    """A callback that acts at the first progress of the plan's motion for which something holds."""
    done: list[bool] = []

    def seen(trajectory: Any, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and not done and happens(trajectory, progress):
            done.append(True)
            action()

    return seen


def distrusted(world: World) -> None:
    """The next session does not play."""
    world.latest.close()
    with pytest.raises(DeviceFault, match="not to be trusted"):
        world.begin()


@pytest.mark.hazard("position unknown")
def test_a_jump_on_the_way_is_not_trusted(world: World) -> None:
    result = world.begin(callback=once(lambda _, progress: progress.time > 0.8, lambda: jump(world, 5.0)))
    assert (result.outcome, result.trusted) == (PlaybackOutcome.PATH_TOLERANCE_VIOLATED, False)
    assert "tolerances from their path; 1 is allowed" in result.message
    distrusted(world)


def test_a_jump_while_it_stops_is_not_trusted(world: World) -> None:
    def stop() -> None:
        world.latest.abort()
        jump(world, 5.0)

    result = world.begin(callback=once(lambda _, progress: progress.time > 0.8, stop))
    assert not result.trusted
    distrusted(world)


def test_a_jump_in_a_pause_is_not_trusted(world: World) -> None:
    pause = once(lambda _, progress: progress.time > 0.8, lambda: world.latest.pause())
    rest = once(lambda _, progress: progress.state == "held", lambda: jump(world, 5.0))

    def seen(trajectory: Any, progress: MotionProgress) -> None:
        pause(trajectory, progress)
        rest(trajectory, progress)

    result = world.begin(callback=seen)
    assert not result.trusted
    distrusted(world)


def test_a_jump_before_the_motion_is_not_trusted(world: World) -> None:
    """Between the approach and the plan, while nothing moves."""
    arrived: list[bool] = []

    def seen(trajectory: Any, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 0 and progress.state == "done" and not arrived:
            arrived.append(True)
            jump(world, 5.0)

    result = world.begin(callback=seen)
    assert (result.outcome, result.trusted) == (PlaybackOutcome.INVALID_PLAN, False)
    distrusted(world)


@pytest.mark.parametrize("by", [0.3, 0.6, 1.4])
def test_an_offset_of_a_few_tolerances_is_not_trusted(by: float, world: World) -> None:
    result = world.begin(callback=once(lambda _, progress: progress.time > 0.8, lambda: jump(world, by)))
    assert (result.outcome, result.trusted) == (PlaybackOutcome.PATH_TOLERANCE_VIOLATED, False)


@pytest.mark.parametrize("by", [0.3, 5.0])
def test_a_jump_at_the_last_frame_is_not_trusted(by: float, world: World) -> None:
    last = once(lambda trajectory, progress: progress.time > trajectory.duration - 1e-3, lambda: jump(world, by))
    result = world.begin(callback=last)
    assert result.outcome is not PlaybackOutcome.SUCCESS
    assert not result.trusted, result.message
