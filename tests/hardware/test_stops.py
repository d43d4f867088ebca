"""Whatever becomes of the host or the link, motion ends in 0.5 s and 12 mm; in virtual time, on the emulator."""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench import Killed, World, plan_of
from emulator.faults import FAULTS
from emulator.wire import VirtualClock

from ctr_nlp.exceptions import CtrError
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.motion.lookahead import (
    MAX_MOTION_IN_HAND_S,
    MAX_SLIDE_TRAVEL_IN_HAND_MM,
    LinkTiming,
    Window,
    steady_speed,
    sustainable,
)
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.results import PlaybackOutcome
from ctr_nlp.plan.plan import Plan

pytestmark = pytest.mark.usefixtures("prepared_once")

SECONDS, MILLIMETRES = 0.5, 12.0
"""Within which motion must end after any cause."""

HEARD = 0.4
"""s within which motion must end after a stop was sent, over a link that works."""


def fast() -> Plan:
    """Slides at up to 41 mm/s and turns at up to 190 deg/s, out, back and out again."""
    t = np.linspace(0.0, 1.0, 61)[:, None]
    wave = 0.5 - 0.5 * np.cos(3 * np.pi * t)
    beta = np.hstack([5 + 30 * wave, 10 + 40 * wave, 15 + 52 * wave])
    alpha = np.hstack([2.0 * wave, -1.5 * wave, wave])
    return plan_of(np.hstack([alpha, beta, np.zeros((61, 2))]), 0.1)


class Tracked(VirtualClock):
    """A clock that keeps the controller's position in every millisecond since a cause."""

    def __init__(self) -> None:
        super().__init__()
        self.world: World | None = None
        self.path: list[tuple[float, np.ndarray]] = []
        self.cause: float | None = None

    def sleep(self, seconds: float) -> None:
        end = self.now() + seconds
        while self.now() < end - 1e-9:
            super().sleep(min(0.001, end - self.now()))
            if self.cause is not None and self.world is not None:
                self.path.append((self.now(), self.world.firmware.position.copy()))

    def struck(self) -> None:
        """The cause happens now."""
        self.cause = self.now()
        assert self.world is not None
        self.path = [(self.cause, self.world.firmware.position.copy())]

    def motion(self) -> tuple[float, float]:
        """s after the cause in which something moved last, and mm that a slide has travelled at most since."""
        assert self.cause is not None
        places = np.array([place for _, place in self.path])
        steps = abs(np.diff(places, axis=0))
        moved = np.flatnonzero(steps.max(axis=1) > 1e-9)
        last = self.path[moved[-1] + 1][0] - self.cause if moved.size else 0.0
        return last, float(steps[:, :3].sum(axis=0).max())


def tracked(folder: Path, plan: Plan) -> World:
    clock = Tracked()
    world = World(folder, plan, clock=clock)
    clock.world = world
    return world


def ended(world: World, cause: str, at: float) -> tuple[float, float, PlaybackOutcome | None]:
    """Strike so many s after the plan began: how long and how far motion went on, and the result, if any."""
    clock, after = world.clock, list[float]()
    assert isinstance(clock, Tracked)

    def strike(link: object = None) -> None:
        clock.struck()
        if cause == "kill":
            world.links[-1].dead = True
            raise Killed
        if cause == "suspend":
            clock.sleep(4.0)
            after.append(clock.motion()[0])
        elif cause == "reset":
            world.firmware.receive(b"\x18")
        else:
            fault = FAULTS[cause](at=0.0)
            fault.strike(world.links[-1].wire.line)

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and progress.time >= at and clock.cause is None:
            strike()

    outcome = None
    with suppress(Killed):
        outcome = world.begin(callback=seen).outcome
    clock.sleep(6.0)
    seconds, travel = clock.motion()
    return seconds, travel, outcome


CAUSES = ("kill", "suspend", "cut", "half_open", "silent", "reset")


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.hazard("late or missing stop")
def test_motion_ends_at_once_whatever_becomes_of_host_or_link(cause: str, tmp_path: Path) -> None:
    """At moments drawn at random; fifty of each in the slow tests."""
    check_cause(cause, 5, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("cause", CAUSES)
def test_motion_ends_at_once_at_fifty_moments(cause: str, tmp_path: Path) -> None:
    check_cause(cause, 50, tmp_path)


def check_cause(cause: str, moments: int, folder: Path) -> None:
    draw, found = random.Random(cause), []
    for number in range(moments):
        (folder / str(number)).mkdir()
        world = tracked(folder / str(number), fast())
        seconds, travel, outcome = ended(world, cause, draw.uniform(0.1, 5.5))
        assert outcome is not PlaybackOutcome.SUCCESS
        assert outcome is not None or cause == "kill"
        found.append((seconds, travel))
    print(f"{cause}: s, mm (median) {np.median(found, axis=0)}, (worst) {np.max(found, axis=0)}")
    assert np.max(found, axis=0)[0] < SECONDS
    assert np.max(found, axis=0)[1] < MILLIMETRES


@pytest.mark.parametrize(
    ("fault", "options"),
    [
        ("false_alarm", {}),
        ("false_banner", {}),
        ("noise", {}),
        ("false_ok", {}),
        ("false_error", {}),
        ("third_party", {"data": b"\x91"}),
        ("third_party", {"data": b"G1 X-30 F10\n"}),
    ],
)
def test_over_a_link_that_works_a_stop_is_sent_and_obeyed_at_once(
    fault: str, options: dict[str, bytes], tmp_path: Path
) -> None:
    """Whatever is said or done by others: the first byte of a stop comes in 0.1 s, and rest 0.4 s after it."""
    for number, at in enumerate((0.9, 2.6, 4.4)):
        (tmp_path / str(number)).mkdir()
        world = tracked(tmp_path / str(number), fast())
        clock, sent = world.clock, list[float]()
        assert isinstance(clock, Tracked)

        def noted(data: bytes, clock: Tracked = clock, sent: list[float] = sent) -> bytes:
            if b"!" in data and clock.cause is not None:
                sent.append(clock.now())
            return data

        def seen(
            trajectory: Trajectory,
            progress: MotionProgress,
            world: World = world,
            at: float = at,
            noted: Callable[[bytes], bytes] = noted,
        ) -> None:
            clock = world.clock
            assert isinstance(clock, Tracked)
            if trajectory.frames[0] == 1 and progress.time >= at and clock.cause is None:
                clock.struck()
                line = world.links[-1].wire.line
                line.outward.append(noted)
                FAULTS[fault](at=0.0, **options).strike(line)

        result = world.begin(callback=seen)
        clock.sleep(4.0)
        assert result.outcome not in (PlaybackOutcome.SUCCESS, PlaybackOutcome.CANCELLED)
        assert clock.cause is not None
        assert sent[0] - clock.cause < 0.1
        assert clock.motion()[0] + clock.cause - sent[0] < HEARD


def test_an_override_is_named_with_its_value_and_when(tmp_path: Path) -> None:
    world = World(tmp_path, fast())

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if trajectory.frames[0] == 1 and progress.time > 2.0:
            world.firmware.receive(b"\x91" * 10)

    result = world.begin(callback=seen)
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert "the feed override is 200 %, and must be 100 %" in result.message
    assert "s after the start, frame 2" in result.message
    assert result.trusted


def test_an_override_from_before_stops_the_motion_too(tmp_path: Path) -> None:
    world = World(tmp_path, fast())
    world.firmware.receive(b"\x91" * 10)
    with pytest.raises(CtrError, match="feed override is 200 %"):
        world.begin()
    world.clock.sleep(3.0)
    assert world.firmware.executed_blocks == []


# how much may be in the controller's hands


@pytest.mark.hazard("late or missing stop")
def test_never_more_than_allowed_is_in_the_controllers_hands(tmp_path: Path) -> None:
    """By time and by the travel of every slide, from where the motors are; also where reports lie."""
    world, most = World(tmp_path, fast()), [0.0, 0.0]

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if not world.firmware.motion.blocks:
            return
        last = world.firmware.motion.blocks[-1].target
        travel = abs(np.array(last[:3]) - world.firmware.motion.position[:3]).max()
        numbers = [block.line for block in world.firmware.motion.blocks if block.line]
        commands = trajectory.commands()
        ahead = commands.time[max(numbers) - 1] - progress.time
        most[:] = max(most[0], ahead), max(most[1], travel)

    assert world.begin(callback=seen).outcome is PlaybackOutcome.SUCCESS
    assert 0.15 < most[0] <= MAX_MOTION_IN_HAND_S + 0.005
    assert 6.0 < most[1] <= MAX_SLIDE_TRAVEL_IN_HAND_MM + 0.01


def test_a_window_counts_travel_there_and_back() -> None:
    ends = np.arange(9) * 0.025
    points = np.array([[0.0, 0], [3, 90], [6, 180], [3, 90], [0, 0], [3, 0], [6, 0], [9, 0], [12, 0]])
    window = Window(ends, points, np.array([True, False]))
    assert window.open_to(0.0) == 3  # 9 mm; the fourth would make it 12
    assert window.open_to(0.025) == 4
    assert window.open_to(0.2) == 8
    turning = Window(np.arange(41) * 0.025, np.zeros((41, 2)), np.array([True, False]))
    assert turning.open_to(0.0) == 12
    assert turning.open_to(0.26) == 22


def test_a_long_piece_is_given_once_the_one_before_is_done() -> None:
    window = Window(np.array([0.0, 2.0, 4.0]), np.array([[0.0], [50.0], [100.0]]), np.array([True]))
    assert window.open_to(0.0) == 1
    assert window.open_to(1.9) == 1
    assert window.open_to(2.0) == 2


def test_an_axis_is_as_fast_as_it_can_brake_within_what_is_in_hand() -> None:
    link = LinkTiming(0.02)
    speed = steady_speed(200.0, True, link)
    assert speed**2 / 400.0 + speed * link.delay == pytest.approx(MAX_SLIDE_TRAVEL_IN_HAND_MM)
    turning = steady_speed(2000.0, False, link)
    assert turning / 4000.0 + link.delay == pytest.approx(MAX_MOTION_IN_HAND_S)
    assert steady_speed(2000.0, False, LinkTiming(0.2)) == 0.0


def test_what_a_link_sustains() -> None:
    slides = np.array([True, False])
    fast, limits = np.array([30.0, 100.0]), np.array([200.0, 2000.0])
    assert sustainable(fast, limits, slides, LinkTiming(0.01, 11520.0), 3000.0) == 1.0
    assert sustainable(fast, limits, slides, LinkTiming(0.01, 1200.0), 3000.0) == pytest.approx(0.4)
    assert sustainable(fast, limits, slides, LinkTiming(0.2, 11520.0), 3000.0) == 0.0
    slow = sustainable(2 * fast, limits, slides, LinkTiming(0.02), 3000.0)
    assert slow == pytest.approx(steady_speed(200.0, True, LinkTiming(0.02)) / 60.0)


def test_a_link_that_is_too_slow_is_told_before_anything_moves(tmp_path: Path) -> None:
    """A report takes 0.12 s at 9600 baud."""
    world = World(tmp_path, fast())
    world.hardware = replace(world.hardware, connection=replace(world.hardware.connection, baud=9600))
    result = world.begin()
    assert result.outcome is PlaybackOutcome.INVALID_PLAN
    assert "cannot keep this pace; play it at 0." in result.message
    world.clock.sleep(3.0)
    assert world.firmware.executed_blocks == []
