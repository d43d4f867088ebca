"""What goes wrong while a plan is played, at random moments: nothing may move, be sent or be trusted after it."""

from __future__ import annotations

import json
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Killed, World
from emulator.faults import FAULTS

from ctr_nlp.exceptions import DeviceFault, TrajectoryError
from ctr_nlp.hardware import journal as journal_module
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState, Result

pytestmark = pytest.mark.usefixtures("prepared_once")

HOST_FAULTS = ("killed", "ctrl_c", "full_disk")
KINDS = (*FAULTS, *HOST_FAULTS)
AFTERWARDS = 8.0
"""s in which all that is buffered has run out."""


class Moment:
    """Something that happens to the host once the clock has come to a time."""

    def __init__(self, world: World, at: float, action: Any) -> None:
        self._world, self._at, self._action, self.done = world, at, action, False

    def __call__(self, *_: Any) -> None:
        """See whether it is time."""
        if not self.done and self._world.clock.now() >= self._at:
            self.done = True
            self._action()


def struck(world: World, kind: str, at: float, seed: int, monkeypatch: pytest.MonkeyPatch) -> Result | None:
    """Play with a fault; None where the process died."""
    if kind in FAULTS:
        return world.begin((FAULTS[kind](at=at, seed=seed),))

    def kill() -> None:
        world.links[-1].dead = True
        raise Killed

    def fill() -> None:
        def full(*_: Any) -> int:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(journal_module.os, "write", full)

    moment = Moment(world, at, {"killed": kill, "ctrl_c": lambda: world.latest.abort(), "full_disk": fill}[kind])
    try:
        return world.begin(callback=moment)
    except Killed:
        return None
    finally:
        monkeypatch.undo()


def check_stop(world: World, result: Result | None, kind: str) -> None:
    """What holds after any stop."""
    sent = world.sent_bytes()
    journal = [json.loads(line) for line in world.path.read_bytes().splitlines()]
    world.clock.sleep(AFTERWARDS)
    assert world.sent_bytes() == sent
    assert world.within_limits()
    if result is None:
        return
    assert result.outcome in PlaybackOutcome
    if kind != "full_disk":
        last = [record for record in journal if record["kind"] in ("result", "state")]
        assert last[-1]["state"] == world.latest.state.value
        assert last[-2]["outcome"] == result.outcome.name
        assert [record["kind"] for record in journal[-2:]] == ["result", "state"]
    assert world.latest.state in (PlayerState.HOMED, PlayerState.FAULT)
    if result.trusted:
        assert result.position is not None
        assert not world.firmware.moving
        np.testing.assert_allclose(result.position, world.firmware.position, atol=2e-3)
        np.testing.assert_allclose(world.firmware.slip, 0.0)
    if result.outcome is PlaybackOutcome.SUCCESS:
        assert world.frames_played() == list(range(1, len(world.plan.time) + 1))


def check_resume(world: World, kind: str) -> str:
    """Resuming is refused, or plays every frame that is left exactly once."""
    before, frames = world.frames_played(), list(range(1, len(world.plan.time) + 1))
    try:
        result = world.resume()
    except (TrajectoryError, DeviceFault) as error:
        assert world.frames_played() == before
        return f"refused: {error}"
    assert result.outcome is PlaybackOutcome.SUCCESS, result
    after = world.frames_played()[len(before) :]
    assert after == frames[-len(after) :]
    if kind == "third_party" and after[:1] == before[-1:]:  # others had moved it away, and it was brought back
        after = after[1:]
    if kind == "bytes_lost":  # digits that are lost move a frame, by no more than the tolerances
        assert set(world.frames_played(within=0.5)) == set(frames)
    else:
        assert before + after == frames
    assert world.within_limits()
    return "resumed"


def run(seed: int, folder: Path, monkeypatch: pytest.MonkeyPatch, kind: str = "") -> tuple[str, str, str]:
    """One fault at a random moment, what it ended in, and whether it could be resumed."""
    draw = random.Random(seed)
    kind = kind or draw.choice(KINDS)
    world = World(folder, state=folder / "state")
    world.meet()
    start = world.clock.now()
    try:
        result = struck(world, kind, start + draw.uniform(0.0, 3.3), seed, monkeypatch)
    except (DeviceFault, TrajectoryError) as error:
        check_stop_before_motion(world)
        return kind, f"not begun: {error}", ""
    check_stop(world, result, kind)
    world.latest.close()
    if result is None or not result.trusted:
        check_distrust(world)
    ended = "killed" if result is None else f"{result.outcome.value}, {'' if result.trusted else 'not '}trusted"
    return kind, ended, check_resume(world, kind)


def check_distrust(world: World) -> None:
    """A later session does not play: the controller is in no state for it, or remembered as not to be trusted."""
    finished = len(world.firmware.executed_blocks)
    with pytest.raises((DeviceFault, TrajectoryError)):
        world.begin()
    world.latest.close()
    assert len(world.firmware.executed_blocks) == finished


def check_stop_before_motion(world: World) -> None:
    """A session that could not be begun has sent no motion."""
    world.clock.sleep(AFTERWARDS)
    assert [
        number for number, _ in world.firmware.executed_blocks if number is not None
    ] == []  # others may have jogged
    assert world.within_limits()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(2))
def test_a_fault_at_a_random_moment_ends_cleanly(
    kind: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(1000 + seed, tmp_path, monkeypatch, kind)


@pytest.mark.slow
def test_a_thousand_faults_end_cleanly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ends: Counter[tuple[str, str]] = Counter()
    wrong = []
    for seed in range(1000):
        folder = tmp_path / str(seed)
        folder.mkdir()
        try:
            kind, end, _ = run(seed, folder, monkeypatch)
        except AssertionError as error:
            wrong.append((seed, str(error)[:300]))
        else:
            ends[kind, end.partition(":")[0]] += 1
    print(*(f"{count:4d} {kind}: {end}" for (kind, end), count in sorted(ends.items())), sep="\n")
    assert not wrong
