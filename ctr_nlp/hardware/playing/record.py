"""Record of a motion: measured positions beside commanded ones, at the times of frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.typing import Array


class Tracking(NamedTuple):
    """Measured and commanded positions at frames.

    frame (T,): numbers. time (T,) s: when each was due, without pauses. commanded, measured (T, m): positions
    then, in the axes' units. late (T,) s: how much later than due it was passed.
    """

    frame: npt.NDArray[np.int64]
    time: Array
    commanded: Array
    measured: Array
    late: Array

    @property
    def error(self) -> Array:
        """Measured minus commanded positions, (T, m)."""
        return self.measured - self.commanded


class Recorder:
    """Recorder of the progress of the latest trajectory; call it with every progress."""

    def __init__(self) -> None:
        self._trajectory: Trajectory | None = None

    def __call__(self, trajectory: Trajectory, progress: MotionProgress) -> None:
        """Add a new progress, unless it is of a pause."""
        before = self._trajectory
        self._trajectory = trajectory
        if not trajectory.continues(before):
            self._paused = 0.0
            self._rows: list[tuple[float, float, Array]] = []
            self._held: MotionProgress | None = None
        if progress.state in ("holding", "held"):
            self._held = self._held or progress
            return
        if self._held is not None:
            # The time of a pause less the motion that was still made while slowing down.
            self._paused += progress.stamp - self._held.stamp - (progress.time - self._held.time)
            self._held = None
        time = progress.stamp - self._paused
        if not self._rows or time > self._rows[-1][0]:
            self._rows.append((time, progress.time, progress.position))

    def tracking(self) -> Tracking | None:
        """Return positions at the times of frames, linear between reports; None where too few came.

        Times count from when the axes began to move, by the first report in which they had.
        """
        if self._trajectory is None or len(self._rows) < 2:
            return None
        stamp, played, position = (np.array(column) for column in zip(*self._rows, strict=True))
        began = int((played > 0).argmax())
        stamp -= stamp[began] - played[began]
        reached = self._trajectory.frame_time <= played[-1] + 1e-9
        due = self._trajectory.frame_time[reached]
        measured = np.stack([np.interp(due, stamp, column) for column in position.T], axis=1)
        passed = np.interp(due, np.maximum.accumulate(played) + 1e-12 * np.arange(len(played)), stamp)
        commanded = self._trajectory.positions(due)
        return Tracking(self._trajectory.frames[reached], due, commanded, measured, passed - due)
