"""Planning again and again while a plan is led."""

from __future__ import annotations

from contextlib import suppress
from time import process_time
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import RobotError
from ctr_nlp.identify.closed_loop.replanning.reference_trajectory import ReferenceTrajectory, ReplanningStart
from ctr_nlp.identify.closed_loop.replanning.replanner import Replanner
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.typing import Array

REPLANNING_LEAD_S = 2.0
"""s between the moment whose knowledge a replanning uses and the frame that it begins with, which is what it may
take."""


class ReplanningOutcome(NamedTuple):
    """The outcome of one replanning.

    first: the frame, from 1, that it was to lead from. seconds: processor time that it took. adopted_plan: whether
    it leads from there, since it came to something better.
    """

    first: int
    seconds: float
    adopted_plan: bool


class Replanning:
    """Plans again and again what is left of a motion that a tracker leads: each time as soon as the last is over.

    outcomes: what came of each so far. It plans in place, as if it had been done beside: what is planned leads
    from REPLANNING_LEAD_S later on.
    """

    def __init__(self, replanner: Replanner, time: Array) -> None:
        """For a motion whose frames are at times (T,), s."""
        self._replanner = replanner
        self._time = time
        self._begun: _PendingReplanning | None = None
        self.outcomes = list[ReplanningOutcome]()

    def update_plan(self, tracker: Tracker, frame: int, ahead: Array) -> None:
        """Before motors are led to a frame, from 0: let what is planned lead from there on, and begin what is due.

        ahead (n, 2d + 2): where the motors will have gone by then.
        """
        begun = self._begun
        if begun is not None and frame >= begun.start.first:
            leads = begun.rest is not None
            self._begun = None
            self.outcomes.append(ReplanningOutcome(begun.start.first + 1, begun.seconds, leads))
            if begun.rest is not None:
                tracker.switch_reference(begun.start, begun.rest)
        if self._begun is None and tracker.is_tracking:
            with suppress(RobotError):  # of tubes as they are estimated now, none can be made
                self._begin(tracker, frame, ahead)

    def _begin(self, tracker: Tracker, frame: int, ahead: Array) -> None:
        """Plan what follows REPLANNING_LEAD_S after a frame, from 0; not before so much has been measured, nor a
        last frame.
        """
        now = self._time[min(frame, len(self._time) - 1)]
        first = int(np.searchsorted(self._time, now + REPLANNING_LEAD_S))
        if now < self._time[0] + REPLANNING_LEAD_S or first >= len(self._time) - 1:
            return
        outset = tracker.replanning_start(ahead, frame, first)
        begin = process_time()
        rest = self._replanner(outset)
        self._begun = _PendingReplanning(outset, rest, process_time() - begin)


class _PendingReplanning(NamedTuple):
    """A replanning that does not lead yet: what it was for, what came of it, and the seconds that it took."""

    start: ReplanningStart
    rest: ReferenceTrajectory | None
    seconds: float
