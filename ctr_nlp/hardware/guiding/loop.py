"""A closed loop around a player: a tracker, a source of sensor readings, and a callback for notes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ctr_nlp.hardware.guiding.corrected_trajectory import CorrectedTrajectory
from ctr_nlp.hardware.guiding.guide import Guide, RobotEstimate
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.sensing.source import Source
from ctr_nlp.identify.closed_loop.tracker import Note, Tracker
from ctr_nlp.typing import Array


class ClosedLoop:
    """A closed loop for one motion.

    tracker: of its plan. source: of readings. notify: called with what the operator must know, at once.
    """

    def __init__(self, tracker: Tracker, source: Source, notify: Callable[[Note], None]) -> None:
        self.tracker = tracker
        self._source = source
        self._told = notify
        self.estimates: list[RobotEstimate] = []
        """Estimates during the motion, in order."""

    def open(self) -> None:
        """Start to listen, before anything moves; raises DeviceFault, OptionError, HardwareError."""
        self._source.open()

    def guide(self, trajectory: Trajectory, before: Array, journal: Journal) -> Guide:
        """Return the corrector of a trajectory.

        trajectory: with a share below 1. before (n, 2d + 2): configurations that the robot has passed. journal: of
        the session.
        """
        observer = self.tracker.observer
        journal.record("estimate", mean=observer.mean.tolist(), covariance=observer.covariance.tolist())
        self._source.apply_past_motion(before)
        guide = Guide(CorrectedTrajectory(trajectory, self.tracker, before), self._source, journal, self._told)
        self.estimates = guide.estimates
        return guide

    def close(self) -> None:
        """Stop listening."""
        self._source.close()


def final_estimate(records: list[dict[str, Any]]) -> tuple[Array, Array] | None:
    """Return mean (k,) and covariance (k, k) of the robot's differences at a session's end, None without any.

    records: of the session's journal.
    """
    return next((_read_estimate(record) for record in records[::-1] if "covariance" in record), None)


def initial_estimate(records: list[dict[str, Any]]) -> tuple[Array, Array] | None:
    """Return mean (k,) and covariance (k, k) of the robot's differences at a session's start, None without any.

    records: of the session's journal.
    """
    return next((_read_estimate(record) for record in records if "covariance" in record), None)


def _read_estimate(record: dict[str, Any]) -> tuple[Array, Array]:
    """Return mean and covariance of a record."""
    return np.array(record["mean"]), np.array(record["covariance"])
