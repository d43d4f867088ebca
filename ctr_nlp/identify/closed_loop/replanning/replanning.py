"""Receding re-planning while a plan is tracked."""

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
"""Time, s, between the estimate that a re-planning uses and its first frame: its time budget."""


class ReplanningOutcome(NamedTuple):
    """The outcome of one re-planning.

    first: its first frame, from 1. seconds: processor time that it took. adopted_plan: whether the re-planned
    trajectory is better and is tracked from there.
    """

    first: int
    seconds: float
    adopted_plan: bool


class Replanning:
    """Re-plans the rest of a tracked motion, each time as soon as the last re-planning is adopted or dropped.

    outcomes: of each so far. It plans in this process, and the result is used REPLANNING_LEAD_S later, as if it
    had been computed in parallel.
    """

    def __init__(self, replanner: Replanner, time: Array) -> None:
        """Start for a motion; replanner: plans its rest. time: (T,), times of its frames, s."""
        self._replanner = replanner
        self._time = time
        self._begun: _PendingReplanning | None = None
        self.outcomes = list[ReplanningOutcome]()

    def update_plan(self, tracker: Tracker, frame: int, ahead: Array) -> None:
        """Switch to a re-planned trajectory that is due at a frame, from 0, and start the next re-planning.

        tracker: of the motion. ahead: (n, 2d + 2), configurations that the motors pass until that frame.
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
        """Re-plan the motion from REPLANNING_LEAD_S after a frame, from 0, except near its start and end."""
        now = self._time[min(frame, len(self._time) - 1)]
        first = int(np.searchsorted(self._time, now + REPLANNING_LEAD_S))
        if now < self._time[0] + REPLANNING_LEAD_S or first >= len(self._time) - 1:
            return
        outset = tracker.replanning_start(ahead, frame, first)
        begin = process_time()
        rest = self._replanner(outset)
        self._begun = _PendingReplanning(outset, rest, process_time() - begin)


class _PendingReplanning(NamedTuple):
    """A re-planning that is not tracked yet: its start, its result, and the seconds that it took."""

    start: ReplanningStart
    rest: ReferenceTrajectory | None
    seconds: float
