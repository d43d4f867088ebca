"""Planning again and again while the robot moves."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from contextlib import suppress
from time import process_time
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.loops.anew.replanner import Replanner
from ctr_nlp.loops.anew.way import Outset, Way
from ctr_nlp.loops.tracker import Tracker
from ctr_nlp.typing import Array

LEAD = 2.0
"""s between the moment whose knowledge a replanning uses and the frame that it begins with, which is what it may
take."""
Timed = tuple[Way | None, float]
"""What a replanner found, and the seconds of the processor that it took."""


class Planned(NamedTuple):
    """What came of one replanning: the frame, from 1, that it was to lead from; the seconds of the processor that
    it took; whether it does lead from there: it came in time, and to something better.
    """

    first: int
    seconds: float
    leads: bool


class Replanning:
    """Plans again and again what is left of a motion that a tracker leads: each time as soon as the last is over.

    planned: what came of each so far.
    """

    def __init__(self, replanner: Replanner, time: Array, executor: Executor | None = None) -> None:
        """For a motion whose frames are at times (T,), s; executor: in which to plan, None for in place."""
        self._replanner, self._time, self._executor = replanner, time, executor
        self._begun: _Begun | None = None
        self.planned = list[Planned]()

    def look(self, tracker: Tracker, frame: int, ahead: Array) -> int:
        """Before motors are led to a frame, from 0: let what is planned lead from there on, and begin what is due.

        ahead (n, 2d + 2): where the motors will have gone by then. The frame, from 0, from which on tubes are led
        along another way; 0 where nothing has changed.
        """
        changed = 0 if self._begun is None else self._over(self._begun, tracker, frame)
        if self._begun is None and tracker.tracks:
            self._begin(tracker, frame, ahead)
        return changed

    def _over(self, begun: _Begun, tracker: Tracker, frame: int) -> int:
        """Let what was begun lead where that is due; what is not known by then does not."""
        if frame < begun.first:
            return 0
        if not begun.future.done():
            self._begun = begun._replace(late=True)
            return 0
        rest, seconds = begun.future.result()
        leads = rest is not None and not begun.late
        self._begun = None
        self.planned.append(Planned(begun.first + 1, seconds, leads))
        if rest is None or begun.late:
            return 0
        tracker.go_on(begun.first, begun.start, rest)
        return begun.first

    def _begin(self, tracker: Tracker, frame: int, ahead: Array) -> None:
        """Plan what follows LEAD after a frame, from 0; not before so much has been measured, nor a last frame."""
        now = self._time[min(frame, len(self._time) - 1)]
        first = int(np.searchsorted(self._time, now + LEAD))
        if now < self._time[0] + LEAD or first >= len(self._time) - 1:
            return
        with suppress(RobotError):  # of tubes as they are estimated now, none can be made
            outset = tracker.outset(ahead, frame, first)
            self._begun = _Begun(first, outset.before[-1], self._submit(outset))

    def _submit(self, outset: Outset) -> Future[Timed]:
        if self._executor is not None:
            return self._executor.submit(_timed, self._replanner, outset)
        found: Future[Timed] = Future()
        found.set_result(_timed(self._replanner, outset))
        return found


class _Begun(NamedTuple):
    """A replanning under way: the frame, from 0, that it is to lead from, and where tubes are to be before it.

    late: whether that frame has passed already.
    """

    first: int
    start: Array
    future: Future[Timed]
    late: bool = False


def _timed(replanner: Replanner, outset: Outset) -> Timed:
    begin = process_time()
    return replanner(outset), process_time() - begin
