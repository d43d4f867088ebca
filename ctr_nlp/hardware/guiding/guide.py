"""Looking at sensors while a plan is played, and correcting what the device has not been given yet."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.devices import Progress
from ctr_nlp.hardware.guiding.course import FIRST, Course
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.sensing.source import Source
from ctr_nlp.loops.sensors import Reading
from ctr_nlp.loops.tracker import Note, State
from ctr_nlp.typing import Array

SHARE = 0.5
"""Of the largest speeds and accelerations that a plan has in a closed loop; the rest is for corrections."""

CYCLE = 0.1
"""s between two looks at sensors."""

SOON = 0.1
"""s before the device is given what leads to a knot at which that is corrected."""


class Estimated(NamedTuple):
    """What was known at a time, s of the clock: mean (k,) and deviations (k,) of the robot's differences.

    size: the mean square of the innovations of the last reading, in expected deviations, NaN where there was none.
    accepted: the share of its values that was taken.
    """

    time: float
    mean: Array
    deviation: Array
    size: float
    accepted: float


class Guide:
    """Leads one trajectory; told: called with what the operator must know, at once.

    wrong: why the motion must stop, "" where nothing speaks against it. estimates: what was known, in order.
    """

    def __init__(self, course: Course, source: Source, journal: Journal, told: Callable[[Note], None]) -> None:
        self._course, self._source, self._journal, self._told = course, source, journal, told
        self._looked, self._knot, self._notes = -np.inf, FIRST, len(course.tracker.notes)
        self.wrong, self.estimates = "", list[Estimated]()

    def look(self, progress: Progress, given: float) -> Trajectory:
        """The trajectory as corrected by now; given: how far the device has been given it, s."""
        if progress.stamp >= self._looked + CYCLE:
            self._observe(progress)
        leeway = self._course.leeway
        while not self.wrong and self._knot < len(leeway.knots):
            begin = leeway.time[self._knot - 1]
            if begin > given + SOON:
                break
            if begin >= given:
                self._correct(self._knot)
            self._knot += 1
        return self._course.trajectory

    def _observe(self, progress: Progress) -> None:
        """Take what sensors have told; everything is in the journal before it counts."""
        now, self._looked = progress.stamp, progress.stamp
        q = self._course.joints(progress.time, progress.position)
        readings = self._source.take(q, now)
        told = [[reading.time, _listed(reading.values)] for reading in readings]
        self._journal.record("sensed", time=progress.time, q=q.tolist(), now=now, readings=told)
        self._course.observe(progress.time, q, now, readings)
        self._note()
        self.estimates.append(self._estimated(now, len(readings)))

    def _estimated(self, now: float, count: int) -> Estimated:
        tracker = self._course.tracker
        mean, deviation = tracker.observer.mean, np.sqrt(tracker.observer.covariance.diagonal())
        if not count or not tracker.innovations:
            return Estimated(now, mean, deviation, float("nan"), 0.0)
        last = tracker.innovations[-1]
        return Estimated(now, mean, deviation, last.size, float(last.accepted.mean()))

    def _correct(self, knot: int) -> None:
        """Correct one knot, and record what is needed to go on after a crash."""
        observer = self._course.tracker.observer
        try:
            patch = self._course.correct(knot)
        except TrajectoryError as exception:
            self.wrong = f"the corrected path cannot be played: {exception}"
            return
        self._journal.record(
            "corrected",
            knot=knot,
            patch=patch.told(),
            mean=observer.mean.tolist(),
            covariance=observer.covariance.tolist(),
        )
        self._note()

    def _note(self) -> None:
        """Tell what is new, and stop where the tracker does."""
        notes = self._course.tracker.notes
        for note in notes[self._notes :]:
            if note.state is State.HELD and self._source.strange:
                note = note._replace(why=f"{note.why}; what came last is {self._source.strange}")
            self._journal.record("note", state=note.state.value, why=note.why)
            self._told(note)
            if note.state is State.STOPPED:
                self.wrong = note.why
        self._notes = len(notes)


def _listed(values: Array) -> list[float | None]:
    """As JSON has them, None for what is missing."""
    return [value if np.isfinite(value) else None for value in values.tolist()]


def readings_of(told: list[list[object]]) -> list[Reading]:
    """The readings of a journal's record."""
    return [Reading(float(time), np.array(values, dtype=float)) for time, values in told]  # type: ignore[arg-type]
