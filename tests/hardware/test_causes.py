"""Messages name the cause that was there: each fault of the link alone, on the emulated controller."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bench import World, sweep
from test_jumps import jump, once

from ctr_nlp.hardware.playing.results import PlaybackOutcome

pytestmark = pytest.mark.usefixtures("prepared_once")


def wire(world: World) -> Any:
    return world.links[-1].wire.line


def lose_an_ok(world: World) -> None:
    """The next ok does not come through."""
    lost: list[bytes] = []

    def without(line: bytes) -> list[tuple[float, bytes]]:
        if line.strip() == b"ok" and not lost:
            lost.append(line)
            return []
        return [(0.0, line)]

    wire(world).inward.append(without)


@pytest.mark.parametrize("flow", ["count", "wait"])
def test_a_lost_ok_is_named(flow: str, tmp_path: Path) -> None:
    world = World(tmp_path, sweep(20))
    world.hardware = replace(world.hardware, connection=replace(world.hardware.connection, flow=flow))
    result = world.begin(callback=once(lambda _, progress: progress.time > 0.8, lambda: lose_an_ok(world)))
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert "a line or its `ok` was lost on the way" in result.message
    assert result.trusted


def test_an_offset_within_tolerance_is_named_at_once(tmp_path: Path) -> None:
    world = World(tmp_path, sweep(20))
    result = world.begin(callback=once(lambda _, progress: progress.time > 0.8, lambda: jump(world, -0.3)))
    assert (result.outcome, result.trusted) == (PlaybackOutcome.PATH_TOLERANCE_VIOLATED, False)
    assert "from the lines that were sent" in result.message
    assert result.frame in (8, 9)


def test_lines_that_do_not_arrive_are_named(tmp_path: Path) -> None:
    world = World(tmp_path, sweep(20))

    def mute() -> None:
        wire(world).outward.append(lambda data: bytes(byte for byte in data if byte in b"?!~\x18\x85"))

    result = world.begin(callback=once(lambda _, progress: progress.time > 0.8, mute))
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert "a line or its `ok` was lost on the way" in result.message
