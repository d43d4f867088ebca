"""Reading sensors while a plan is played, and correcting what the device has not been given yet."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import TrajectoryError
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.guiding.corrected_trajectory import FIRST_CORRECTED_KNOT, CorrectedTrajectory
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.sensing.source import Source
from ctr_nlp.identify.closed_loop.sensors import Reading
from ctr_nlp.identify.closed_loop.tracker import Note, TrackerState
from ctr_nlp.typing import Array

SHARE = 0.5
"""Part of the largest speeds and accelerations that a closed loop's plan uses; the rest is for corrections."""

SENSING_PERIOD_S = 0.1
"""s between two readings of sensors."""

SOON = 0.1
"""s before the device is given the stretch to a knot, at which this stretch is corrected: late, so that the newest
readings count."""


class RobotEstimate(NamedTuple):
    """Estimate of the robot's differences from the plan's robot.

    time: s of the clock. mean, deviation (k,): of the differences, in the order of the tracker's parameters.

    size: the mean square of the innovations of the last reading, in expected deviations, NaN where there was none.
    accepted: the share of its values that was used.
    """

    time: float
    mean: Array
    deviation: Array
    size: float
    accepted: float


class Guide:
    """Corrector of one trajectory; notify: called with what the operator must know, at once.

    wrong: why the motion must stop, "" where it need not. estimates: of the robot, in order.
    """

    def __init__(
        self, course: CorrectedTrajectory, source: Source, journal: Journal, notify: Callable[[Note], None]
    ) -> None:
        self._course = course
        self._source = source
        self._journal = journal
        self._told = notify
        self._looked = -np.inf
        self._knot = FIRST_CORRECTED_KNOT
        self._notes = len(course.tracker.notes)
        self.wrong = ""
        self.estimates = list[RobotEstimate]()

    def look(self, progress: MotionProgress, committed_time: float) -> Trajectory:
        """Return the trajectory as corrected by now.

        progress: of the device. committed_time: s of the motion that the device has been given.
        """
        if progress.stamp >= self._looked + SENSING_PERIOD_S:
            self._observe(progress)
        leeway = self._course.leeway
        while not self.wrong and self._knot < len(leeway.knots):
            begin = leeway.time[self._knot - 1]
            if begin > committed_time + SOON:
                break
            # A stretch that the device was given in part keeps its plan: a correction must not change it.
            if begin >= committed_time:
                self._correct(self._knot)
            self._knot += 1
        return self._course.trajectory

    def _observe(self, progress: MotionProgress) -> None:
        """Read the sensors; readings are in the journal before they count."""
        now = progress.stamp
        self._looked = progress.stamp
        q = self._course.joints(progress.time, progress.position)
        readings = self._source.take(q, now)
        told = [[reading.time, _to_json_values(reading.values)] for reading in readings]
        self._journal.record("sensed", time=progress.time, q=q.tolist(), now=now, readings=told)
        self._course.observe(progress.time, q, now, readings)
        self._note()
        self.estimates.append(self._current_estimate(now, len(readings)))

    def _current_estimate(self, now: float, count: int) -> RobotEstimate:
        tracker = self._course.tracker
        mean = tracker.observer.mean
        deviation = np.sqrt(tracker.observer.covariance.diagonal())
        if not count or not tracker.innovations:
            return RobotEstimate(now, mean, deviation, float("nan"), 0.0)
        last = tracker.innovations[-1]
        return RobotEstimate(now, mean, deviation, last.size, float(last.accepted.mean()))

    def _correct(self, knot: int) -> None:
        """Correct one knot, and record what is needed to resume after a crash."""
        observer = self._course.tracker.observer
        try:
            patch = self._course.correct(knot)
        except TrajectoryError as exception:
            self.wrong = f"the corrected path cannot be played: {exception}"
            return
        self._journal.record(
            "corrected",
            knot=knot,
            patch=patch.to_record(),
            mean=observer.mean.tolist(),
            covariance=observer.covariance.tolist(),
        )
        self._note()

    def _note(self) -> None:
        """Report new notes of the tracker, and stop where it does."""
        notes = self._course.tracker.notes
        for note in notes[self._notes :]:
            if note.state is TrackerState.UNCORRECTED and self._source.strange:
                note = note._replace(why=f"{note.why}; what came last is {self._source.strange}")
            self._journal.record("note", state=note.state.value, why=note.why)
            self._told(note)
            if note.state is TrackerState.STOPPED:
                self.wrong = note.why
        self._notes = len(notes)


def _to_json_values(values: Array) -> list[float | None]:
    """Return values as JSON has them, None for what is missing."""
    return [value if np.isfinite(value) else None for value in values.tolist()]


def readings_of(entries: list[list[object]]) -> list[Reading]:
    """Return the readings of a journal's record.

    entries: pairs of time, s, and values.
    """
    return [Reading(float(time), np.array(values, dtype=float)) for time, values in entries]  # type: ignore[arg-type]
