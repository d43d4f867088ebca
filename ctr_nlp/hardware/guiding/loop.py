"""A closed loop around a player: whose tracker, which sensors, and who is told."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

import numpy as np

from ctr_nlp.hardware.guiding.course import Course
from ctr_nlp.hardware.guiding.guide import Estimated, Guide, told_of, way_of
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.sensing.source import Source
from ctr_nlp.loops.anew.replanner import Replanner
from ctr_nlp.loops.anew.replanning import Replanning
from ctr_nlp.loops.tracker import Note, Tracker
from ctr_nlp.typing import Array


class ClosedLoop:
    """For one motion. tracker: of its plan; told: called with what the operator must know, at once.

    estimates: what was known in the motion, in order. replanning: what was planned anew in it, None for nothing.
    """

    def __init__(
        self,
        tracker: Tracker,
        source: Source,
        told: Callable[[Note], None],
        replanner: Replanner | None = None,
        executor: Executor | None = None,
    ) -> None:
        """replanner: plans the rest of the motion anew while it is made, in an executor, None for in place."""
        self.tracker, self._source, self._told = tracker, source, told
        self._replanner, self._executor = replanner, executor
        self.estimates: list[Estimated] = []
        self.replanning: Replanning | None = None

    def open(self) -> None:
        """Begin to listen, before anything moves; raises DeviceFault, OptionError, HardwareError."""
        self._source.open()

    def guide(self, trajectory: Trajectory, before: Array, journal: Journal) -> Guide:
        """Who corrects a trajectory; before (n, 2d + 2): where the robot has come through."""
        observer = self.tracker.observer
        journal.record("estimate", mean=observer.mean.tolist(), covariance=observer.covariance.tolist())
        if self.tracker.replanned:
            journal.record("replanned", **told_of(self.tracker.way, 1))
        self._source.led(before)
        if self._replanner is not None:
            self.replanning = Replanning(self._replanner, self._due(trajectory), self._executor)
        guide = Guide(Course(trajectory, self.tracker, before), self._source, journal, self._told, self.replanning)
        self.estimates = guide.estimates
        return guide

    def _due(self, trajectory: Trajectory) -> Array:
        """When frames (T,) are reached, s; those that are passed already, at the trajectory's beginning."""
        found = np.full(len(self.tracker.way.q), trajectory.frame_time[0])
        ahead = trajectory.frames > 0
        found[trajectory.frames[ahead] - 1] = trajectory.frame_time[ahead]
        return found

    def close(self) -> None:
        """Stop to listen."""
        self._source.close()


def known_of(records: list[dict[str, Any]]) -> tuple[Array, Array] | None:
    """Mean (k,) and covariance (k, k) of the robot's differences at a session's end; None where nobody knew."""
    return next((_known(record) for record in records[::-1] if "covariance" in record), None)


def went_on(tracker: Tracker, records: list[dict[str, Any]]) -> None:
    """Lead a tracker along what was planned anew in a session."""
    for record in records:
        if record["kind"] == "replanned":
            tracker.go_on(*way_of(record))


def begun_with(records: list[dict[str, Any]]) -> tuple[Array, Array] | None:
    """The same when a session began."""
    return next((_known(record) for record in records if "covariance" in record), None)


def _known(record: dict[str, Any]) -> tuple[Array, Array]:
    return np.array(record["mean"]), np.array(record["covariance"])
