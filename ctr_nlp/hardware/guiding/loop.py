"""A closed loop around a player: whose tracker, which sensors, and who is told."""

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
    """For one motion. tracker: of its plan; notify: called with what the operator must know, at once."""

    def __init__(self, tracker: Tracker, source: Source, notify: Callable[[Note], None]) -> None:
        self.tracker = tracker
        self._source = source
        self._told = notify
        self.estimates: list[RobotEstimate] = []
        """What was known in the motion, in order."""

    def open(self) -> None:
        """Begin to listen, before anything moves; raises DeviceFault, OptionError, HardwareError."""
        self._source.open()

    def guide(self, trajectory: Trajectory, before: Array, journal: Journal) -> Guide:
        """Who corrects a trajectory; before (n, 2d + 2): where the robot has come through."""
        observer = self.tracker.observer
        journal.record("estimate", mean=observer.mean.tolist(), covariance=observer.covariance.tolist())
        self._source.apply_past_motion(before)
        guide = Guide(CorrectedTrajectory(trajectory, self.tracker, before), self._source, journal, self._told)
        self.estimates = guide.estimates
        return guide

    def close(self) -> None:
        """Stop to listen."""
        self._source.close()


def final_estimate(records: list[dict[str, Any]]) -> tuple[Array, Array] | None:
    """Mean (k,) and covariance (k, k) of the robot's differences at a session's end; None where nobody knew."""
    return next((_read_estimate(record) for record in records[::-1] if "covariance" in record), None)


def initial_estimate(records: list[dict[str, Any]]) -> tuple[Array, Array] | None:
    """The same when a session began."""
    return next((_read_estimate(record) for record in records if "covariance" in record), None)


def _read_estimate(record: dict[str, Any]) -> tuple[Array, Array]:
    return np.array(record["mean"]), np.array(record["covariance"])
