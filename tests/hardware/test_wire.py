"""Bytes that are lost or changed between player and controller are noticed before they move an axis far."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import wire_faults
from bench import World, sweep
from wire_faults import KINDS, Injector, chunk, known, table

from ctr_nlp.hardware.devices.grbl.ledger import (
    LATE_ANSWER_S,
    LINGERING_S,
    STRANGE_S,
    Ledger,
)
from ctr_nlp.hardware.motion.lookahead import LinkTiming
from ctr_nlp.hardware.playing.results import PlaybackOutcome, Result

SECONDS = 0.025
"""Of a line."""


@pytest.fixture(scope="module", autouse=True)
def prepared_once() -> Iterator[None]:
    """A trajectory is made and checked once."""
    with wire_faults.prepared_once():
        yield


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.hazard("corrupted commands")
def test_a_fault_of_each_kind_is_bounded_and_named(kind: str, tmp_path: Path) -> None:
    run = wire_faults.run(2000 + list(KINDS).index(kind), tmp_path, kind)
    assert run.note != "never struck"
    assert run.faults == [], run


@pytest.mark.slow
def test_five_hundred_faults_are_bounded_and_named() -> None:
    runs = chunk(list(range(500)), "")
    print(table(runs))
    assert [run for run in runs if run.faults] == []
    assert sum(run.note == "never struck" for run in runs) == 0


def struck(folder: Path, change: Callable[[bytes], bytes | None]) -> tuple[World, Result, Injector]:
    """Play with one line changed, from 0.8 s on."""
    world, injectors = World(folder, sweep(20)), list[Injector]()

    def seen(trajectory: object, progress: object) -> None:
        if not injectors and trajectory.frames[0] == 1 and progress.time > 0.8:  # type: ignore[attr-defined]
            injectors.append(Injector(world.links[-1].wire.line, random.Random(0)))
            injectors[0].on_lines(change)

    return world, world.begin(callback=seen), injectors[0]


@pytest.mark.parametrize(
    ("word", "changed"),
    [(b"Z-", b"Z-1"), (b"Z-2", b"Z-"), (b"A2", b"A"), (b"G90", b"G91"), (b"G21", b"G20"), (b"A", b"A-")],
)
@pytest.mark.hazard("corrupted commands")
def test_a_changed_line_is_noticed_before_it_is_played(word: bytes, changed: bytes, tmp_path: Path) -> None:
    """However far it leads: no axis leaves the path, and the position is trusted."""
    world, result, injector = struck(
        tmp_path, lambda piece: piece.replace(word, changed, 1) if word in piece and b" " in piece else None
    )
    assert (result.outcome, result.trusted) == (PlaybackOutcome.DEVICE_FAULT, "soft limits" not in result.message)
    assert "changed on the way" in result.message
    assert injector.struck_at is not None
    path = np.array([world.trajectory().positions(t) for t in np.linspace(0, world.trajectory().duration, 500)])
    assert abs(path - world.firmware.position).max(axis=1).min() < 0.2


def test_a_copy_takes_the_place_of_a_lost_line_and_the_loss_is_noticed(tmp_path: Path) -> None:
    _, result, _ = struck(tmp_path, lambda piece: b"" if b" " in piece else None)
    assert (result.outcome, result.trusted) == (PlaybackOutcome.DEVICE_FAULT, True)
    assert "a line or its `ok` was lost on the way" in result.message
    assert result.frame <= 11  # at 1.1 s; before, it was noticed at the end


def test_a_feed_that_slows_a_line_down_is_noticed(tmp_path: Path) -> None:
    _, result, _ = struck(
        tmp_path, lambda piece: re.sub(rb" F(\d\d)\d\d", rb" F\1", piece) if b" F" in piece else None
    )
    assert (result.outcome, result.trusted) == (PlaybackOutcome.DEVICE_FAULT, True)
    assert "its feed was changed on the way" in result.message


def test_a_changed_number_of_one_line_does_no_harm(tmp_path: Path) -> None:
    _, result, injector = struck(tmp_path, lambda piece: piece.replace(b"N", b"N99", 1) if b" " in piece else None)
    assert "N99" in injector.note
    assert result.outcome is PlaybackOutcome.SUCCESS


# the ledger alone


class Session:
    """A ledger and a controller of 100 blocks that plans at once all that it is sent."""

    def __init__(self) -> None:
        self.ledger = Ledger(np.zeros(2), np.array([0.003, 0.01]), 100, LinkTiming(0.01, 11520.0))
        self.sent = 0

    def send(self, moves: float | None = 1.0) -> None:
        """A line and its copy, by so many mm, or a line that waits."""
        self.sent += 1
        texts = [b"x" * 90, b"x" * 60] if moves is not None else [b"x" * 20]
        position = None if moves is None else np.array([self.sent * moves, 0.0])
        self.ledger.write(texts, position, SECONDS, 0.0)

    def acknowledge(self, count: int, now: float = 0.0) -> str:
        """So many ok; what was wrong with the last."""
        return [self.ledger.acknowledge(now) for _ in range(count)][-1]

    def report(self, line: int, blocks: int, now: float = 0.0) -> str:
        """What is wrong with a report."""
        return self.ledger.contradiction(line, 100 - blocks, True, now)


@pytest.fixture
def session() -> Session:
    made = Session()
    for _ in range(10):
        made.send()
    return made


def test_reports_of_what_was_sent_are_right(session: Session) -> None:
    session.acknowledge(10)
    assert session.report(1, 5) == session.report(3, 3) == ""
    session.acknowledge(1)
    assert session.report(3, 4) == ""
    session.acknowledge(9)
    assert session.report(4, 7) == session.report(11, 0) == session.report(10, 1) == session.report(10, 0) == ""
    assert (session.ledger.planned, session.ledger.missing, session.ledger.in_flight) == (10, 0, 0)


@pytest.mark.parametrize(
    ("acknowledged", "blocks", "words"),
    [
        (10, 6, "a line or its `ok` was lost on the way"),
        (11, 7, "lines came in another order, a line or this report was changed on the way"),
        (10, 7, "lines came in another order"),
        (10, 4, "a line or its `ok` came twice"),
    ],
)
def test_blocks_that_were_not_sent_are_noticed(
    session: Session, acknowledged: int, blocks: int, words: str
) -> None:
    session.acknowledge(acknowledged)
    assert words in session.report(1, blocks)


def test_a_line_that_was_not_acknowledged_cannot_be_played(session: Session) -> None:
    session.acknowledge(4)
    assert "acknowledged none beyond line 2" in session.report(4, 1)


def test_numbers_that_were_never_sent_are_borne_for_a_moment(session: Session) -> None:
    session.acknowledge(20)
    assert session.report(4, 7, 1.0) == session.report(77, 6, 1.02) == session.report(1, 6, 1.04) == ""
    assert session.report(6, 5, 1.05) == ""
    assert session.report(77, 4, 1.06) == ""
    assert "after line 6" in session.report(78, 4, 1.06 + STRANGE_S + 0.01)


def test_more_answers_than_lines_are_noticed(session: Session) -> None:
    assert session.acknowledge(20) == ""
    assert "acknowledges more lines than it was sent" in session.acknowledge(1)


def test_lines_too_short_for_a_step_may_take_a_block_or_none() -> None:
    session = Session()
    for _ in range(3):
        session.send(0.002)
    session.acknowledge(6)
    assert session.report(1, 3) == session.report(1, 1) == ""
    assert session.report(1, 4) != ""


def test_late_answers_are_noticed_also_where_none_comes(session: Session) -> None:
    """A line that waits, or a hold, is no reason."""
    assert session.acknowledge(1, 0.1) == ""
    assert "was not answered in time" in session.report(1, 1, 0.6 + LATE_ANSWER_S)
    session.ledger.note_hold()
    assert session.report(1, 1, 60.0) == session.acknowledge(1, 61.0) == ""
    session.ledger.note_resume(61.0)
    assert session.acknowledge(17, 61.1) == ""
    session.send(None)
    session.send()
    assert session.acknowledge(1, 61.2) == session.report(10, 1, 65.0) == session.acknowledge(1, 65.0) == ""
    assert session.acknowledge(1, 65.05) == ""


def test_a_line_that_lasts_too_long_is_noticed(session: Session) -> None:
    session.acknowledge(20)
    assert session.report(3, 8, 1.0) == session.report(3, 8, 1.0 + LINGERING_S) == ""
    assert "its feed was changed" in session.report(3, 8, 1.01 + LINGERING_S)
    assert session.report(9, 2, 2.0) == session.report(9, 2, 9.0) == ""  # before the end it brakes


def test_the_injector_strikes_what_it_says() -> None:
    """Plans of both paces are fast enough that a slide goes further than allowed within a second."""
    for name, least in (("slow", 10.0), ("fast", 35.0)):
        assert np.abs(np.diff(known(name).beta, axis=0)).max() / 0.1 > least
