"""Planning again and again while the robot moves."""

from __future__ import annotations

import math
from concurrent.futures import Executor, Future
from time import thread_time
from typing import NamedTuple

from ctr_nlp.loops.anew.replanner import Replanner
from ctr_nlp.loops.anew.way import Outset, Way
from ctr_nlp.loops.tracker import Tracker

LEAD = 2.0
"""s between the moment whose knowledge a replanning uses and the frame that it begins with, which is what it may
take."""


class Planned(NamedTuple):
    """What came of one replanning: the frame, from 1, that it was to lead from; the seconds of the thread that it
    took; whether it does lead from there.
    """

    first: int
    seconds: float
    leads: bool


class Replanning:
    """Plans again and again what is left of a motion that a tracker leads: each time as soon as the last is over.

    planned: what came of each so far.
    """

    def __init__(self, replanner: Replanner, frames: int, dt: float, executor: Executor | None = None) -> None:
        """For a motion of so many frames, dt s apart; executor: in which to plan, None for at once, in place."""
        self._replanner, self._frames, self._executor = replanner, frames, executor
        self._lead = math.ceil(LEAD / dt)
        self._begun: tuple[int, Future[tuple[Way | None, float]]] | None = None
        self.planned = list[Planned]()

    def look(self, frame: int, tracker: Tracker) -> int:
        """Before motors are led to a frame, from 0: let what is planned lead from there on, and begin what is due.

        The frame, from 0, from which tubes are led along another way; 0 where nothing has changed.
        """
        changed = 0
        if self._begun is not None and frame >= self._begun[0]:
            first, future = self._begun
            rest, seconds = future.result() if future.done() and frame == first else (None, math.nan)
            self.planned.append(Planned(first + 1, seconds, rest is not None))
            self._begun = None
            if rest is not None:
                tracker.go_on(first, rest)
                changed = first
        first = frame + self._lead
        if self._begun is None and frame >= self._lead and first < self._frames - 1 and tracker.tracks:
            self._begun = first, self._submit(tracker.outset(frame - 1, first))
        return changed

    def _submit(self, outset: Outset) -> Future[tuple[Way | None, float]]:
        if self._executor is not None:
            return self._executor.submit(self._timed, outset)
        found: Future[tuple[Way | None, float]] = Future()
        found.set_result(self._timed(outset))
        return found

    def _timed(self, outset: Outset) -> tuple[Way | None, float]:
        begin = thread_time()
        return self._replanner(outset), thread_time() - begin
