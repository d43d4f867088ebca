"""Ledger of the lines that a Grbl controller was sent and has acknowledged, to test its reports against.

Grbl's lines have no checksum. A digit that is lost on the way makes another position of a line, which is obeyed.
So every line of a motion is sent twice. Where both copies arrive as they were sent, the second finds nothing to
move and takes no block of the planner (grblHAL, planner.c: a block without steps is dropped); where one of them
was changed, it takes one. An `ok` for every line, the number of the first block in the planner (Ln) and the number
of blocks that are free (Bf) tell how many blocks there are, and how many there must be. Replies come in order, so
that this is exact at every report: a line that was changed is noticed once it is planned, and not when it is
played, some 0.25 s later.
"""

from __future__ import annotations

from typing import NamedTuple

from ctr_nlp.hardware.motion.lookahead import LinkTiming
from ctr_nlp.typing import Array

SURELY_STEPS = 1.5
"""Steps of an axis from one line to the next with which a line surely takes a block, however it is rounded."""

LATE_ANSWER_S = 0.2
"""Time within which a line is acknowledged that the controller can plan at once, beside what its bytes take."""

PASSED_S = 0.08
"""Time after which a question cannot overtake a line that was sent before it: a controller takes questions as they
arrive, and lines when it comes to them: milliseconds later, or more where a simulator is short of time."""

LASTING_S = 0.06
"""Time for which answers may come later than the motion can bear, as after a short delay of the link."""

STRANGE_S = 0.1
"""Time for which line numbers may be reported that cannot be: where the number of one line, or of one report, was
changed on the way, and all else agrees, the motion is as it should be."""

MAX_LINE_DURATION_RATIO = 6.0
"""How many times its own duration a line may be in preparation; corners and starts from rest need up to 2."""

LINGERING_S = 0.15
"""The least time for which a line may be in preparation."""

FOLLOWED_BY = 3
"""Blocks that must be in the planner for that: before the last ones it brakes, and so goes slower than asked."""


class SentLine(NamedTuple):
    """A line that was sent.

    number: its N, from 1. size: bytes. seconds: duration of the motion. last: whether no other copy of it follows.
    dwells: whether it waits (G4), and is acknowledged after that.
    """

    number: int
    size: int
    seconds: float
    last: bool
    dwells: bool


class Ledger:
    """Lines in the order in which they were sent, and how many of them were acknowledged.

    start (m,): where the motion starts; resolution (m,): what the axes can resolve, both in their units. blocks:
    of the planner when nothing moves. link: as measured. patience: s by which answers may come later than measured
    without stopping the supply of motion.
    """

    def __init__(
        self, start: Array, resolution: Array, blocks: int, link: LinkTiming, patience: float = LATE_ANSWER_S
    ) -> None:
        self._there = start
        self._resolution = resolution
        self._blocks = blocks
        self._link = link
        self._patience = patience
        self._written: list[SentLine] = []
        self._due: list[float] = []
        # Lines are numbered from 1: _first_of[n] is the index of line n's first copy, entry 0 stands for none.
        self._first_of = [0, 0]
        # Running sums: the copies with indices a to b - 1 take between _least[b] - _least[a] and
        # _most[b] - _most[a] blocks of the planner. The bounds differ where a line may be too short for a step.
        self._least = [0]
        self._most = [0]
        self.acknowledged = 0
        """Lines for which an ok has come."""
        self.planned = 0
        """Number of the last line of which all copies were acknowledged."""
        self.in_flight = 0
        """Bytes of lines that have not been acknowledged."""
        self._lingers: tuple[int, float] | None = None
        self._late_since: float | None = None
        self._strange_since: float | None = None
        self._playing = 1
        """Number of the first block in the planner, as last reported."""

    @property
    def missing(self) -> int:
        """Number of lines that have not been acknowledged."""
        return len(self._written) - self.acknowledged

    def write(self, texts: list[bytes], position: Array | None, seconds: float, now: float) -> None:
        """Note that the next line is sent.

        Parameters
        ----------
        texts : list of bytes
            Its copies.
        position : (m,) array or None
            Where it leads, in the axes' units; None where it waits.
        seconds : float
            How long that takes.
        now : float
            Time on the clock, s.
        """
        number = len(self._first_of) - 1
        least = most = 0
        if position is not None:
            gone = abs(position - self._there)
            most = int(gone.max() > 0.0)
            least = int((gone / self._resolution).max() >= SURELY_STEPS)
            self._there = position
        for i, text in enumerate(texts):
            line = SentLine(number, len(text), seconds, i == len(texts) - 1, position is None)
            self._written.append(line)
            self.in_flight += line.size
            # After in_flight has grown: a line is answered once its own bytes have arrived, too.
            self._due.append(self._time_due(now))
            # Only the first copy moves anything, and so takes a block of the planner.
            self._least.append(self._least[-1] + least * (i == 0))
            self._most.append(self._most[-1] + most * (i == 0))
        self._first_of.append(len(self._written))

    def acknowledge(self, now: float) -> str:
        """Note an ok.

        Parameters
        ----------
        now : float
            Time on the clock, s.

        Returns
        -------
        str
            A sentence on what is wrong with it, "" for nothing.
        """
        if not self.missing:
            return (
                "the controller acknowledges more lines than it was sent: a line or its `ok` came twice, or "
                "another client sent one"
            )
        line = self._written[self.acknowledged]
        due = self._due[self.acknowledged]
        self.acknowledged += 1
        self.in_flight -= line.size
        if line.last:
            self.planned = line.number
        if line.dwells:  # what came behind it had to wait, too
            self.note_resume(now)
            return ""
        return self._overdue(line, due, now) or self._lasting(line, now - due, now)

    def _lasting(self, line: SentLine, late: float, now: float) -> str:
        """Return why answers must not stay so late, "" where they may; late: s of this one, now: s."""
        if late <= self._patience:
            self._late_since = None
            return ""
        # Late since due + patience, not since it was noticed: answers may come in bunches.
        self._late_since = now - late + self._patience if self._late_since is None else self._late_since
        if now - self._late_since <= LASTING_S:
            return ""
        return (
            f"the answer to line {line.number} came late, by {late:.2g} s, and so did those before, for "
            f"{LASTING_S:g} s; at this pace {self._patience:.2g} s are allowed"
        )

    def _overdue(self, line: SentLine, due: float, now: float) -> str:
        """Return why a line should have been answered by now, "" where it need not; due: s of the clock."""
        if now - due <= LATE_ANSWER_S:
            return ""
        return (
            f"line {line.number} was not answered in time, by {now - due:.2g} s; {LATE_ANSWER_S:g} s are allowed: "
            "answers came late, lines or `ok` were lost on the way, or another client keeps the controller waiting"
        )

    def _time_due(self, now: float) -> float:
        """Return when all lines under way are answered, s of the clock, if the last was sent now."""
        return now + self.in_flight / self._link.rate + self._link.round_trip

    def note_hold(self) -> None:
        """Note a hold: the controller reads no lines, and no line counts as late or lasting too long."""
        self._due[self.acknowledged :] = [float("inf")] * self.missing
        self._lingers = None

    def note_resume(self, now: float) -> None:
        """Note that the controller may read what is under way from now on, s of the clock."""
        self._late_since = None
        self._due[self.acknowledged :] = [self._time_due(now)] * self.missing

    def contradiction(self, line: int, free: int | None, running: bool, now: float, asked: float = 0.0) -> str:
        """Find out whether a report can follow from what the controller was sent.

        Parameters
        ----------
        line : int
            Number of the first block in its planner, 0 for none.
        free : int or None
            Blocks for which it has room; None where that is not reported.
        running : bool
            Whether it is in that state.
        now : float
            Time on the clock, s.
        asked : float
            When it was asked for, or earlier, s. What was to be answered before that has been lost, since answers
            come in order, however late they come.

        Returns
        -------
        str
            A sentence on why it cannot, and what may have happened; "" where it can.
        """
        waiting = self._written[self.acknowledged :]
        overdue = bool(waiting) and not any(each.dwells for each in waiting)
        late = self._overdue(waiting[0], self._due[self.acknowledged], now) if overdue else ""
        if overdue and not late and self._due[self.acknowledged] + PASSED_S < asked:
            late = (
                f"line {waiting[0].number} was not answered: a line or its `ok` was lost on the way, or another "
                "client has stopped the controller or keeps it waiting"
            )
        if late or free is None or not line:
            return late
        blocks = self._blocks - free
        if not blocks:  # the number is then that of the line that is being read, before it is planned or answered
            return ""
        if not self._playing <= line < len(self._first_of) - 1:
            return self._strange(line, now)
        self._strange_since = None
        self._playing = line
        done = self.acknowledged
        last = self._written[self.acknowledged - 1] if self.acknowledged else None
        newest = 0 if last is None else last.number
        has = f"the controller plays line {line} and has {blocks} in hand"
        if line > newest:
            return (
                f"{has}, though it has acknowledged none beyond line {newest}: lines or their `ok` were lost on "
                "the way, or a line or this report was changed on the way"
            )
        # In the planner are the blocks from the line that is being played to the last acknowledged one.
        before = self._first_of[line]
        least = self._least[done] - self._least[before]
        most = self._most[done] - self._most[before]
        if blocks > most:
            has = f"{has}, and should have {most}"
            changed = "a line or this report was changed on the way, or another client sent a line"
            if blocks == most + 1 and last is not None and last.last:
                return f"{has}: a line or its `ok` was lost on the way, {changed}"
            return f"{has}: lines came in another order, {changed}"
        if blocks < max(least, 1):
            return (
                f"{has}, and should have {least}: a line or its `ok` came twice, a line's number or this report "
                "was changed on the way, or another client made it forget lines"
            )
        return self._lingering(line, blocks, now) if running else ""

    def _strange(self, line: int, now: float) -> str:
        """Return why an impossible line number is reported for too long, "" while it may be a corrupted report."""
        self._strange_since = now if self._strange_since is None else self._strange_since
        if now - self._strange_since <= STRANGE_S:
            return ""
        return (
            f"the controller plays line {line} after line {self._playing}, of {len(self._first_of) - 2} that it "
            "was sent: line numbers or reports are changed on the way, or another client sends lines"
        )

    def _lingering(self, line: int, blocks: int, now: float) -> str:
        """Return why a line is in preparation for longer than it may, "" where it is not; now: s."""
        if self._lingers is None or self._lingers[0] != line or blocks < FOLLOWED_BY:
            self._lingers = line, now
            return ""
        seconds = self._written[self._first_of[line]].seconds
        lasted = now - self._lingers[1]
        if lasted <= max(LINGERING_S, MAX_LINE_DURATION_RATIO * seconds):
            return ""
        return (
            f"line {line} has lasted for {lasted:.2g} s, and should take {seconds:.2g} s: its feed was changed on "
            "the way, or something slows the controller down"
        )
