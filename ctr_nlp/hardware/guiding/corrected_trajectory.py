"""A trajectory and its corrections by a tracker; the same inputs give the same corrections, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ctr_nlp.hardware.guiding.leeway import Leeway
from ctr_nlp.hardware.motion.trajectory import Patch, Trajectory
from ctr_nlp.hardware.playing.checks import check_trajectory
from ctr_nlp.identify.closed_loop.sensors import Reading
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.typing import Array

FIRST_CORRECTED_KNOT = 2
"""The first knot that may be corrected: what comes before is sent when the motion begins."""


class CorrectedTrajectory:
    """A trajectory with a share below 1, corrected knot by knot as a tracker asks.

    trajectory: as corrected. Beyond the last corrected knot it returns to the plan, so that all of it can be
    played, whether or not anything is corrected later.
    """

    def __init__(self, trajectory: Trajectory, tracker: Tracker, before: Array) -> None:
        """Start; before (n, 2d + 2): configurations that the robot has passed until the trajectory's start."""
        self.trajectory = trajectory
        self.tracker = tracker
        self.leeway = Leeway(trajectory)
        path = trajectory.motion.path
        self._at = np.clip(path.x, self.leeway.knots[0], self.leeway.knots[-1])
        self._path = path(path.x)
        self._slopes = path(path.x, 1)
        self._planned = path(self.leeway.knots)
        self._offsets = np.zeros_like(self._planned)
        self._time = 0.0
        tracker.apply_past_motion(before)

    def joints(self, time: float, position: Array) -> Array:
        """Return q (2d + 2,) of axes measured at a position (m,) at a time of the trajectory, s."""
        return self.trajectory.joints(np.array([time]), position[None])[0]

    def observe(self, time: float, q: Array, now: float, readings: Sequence[Reading]) -> None:
        """Give the tracker what sensors have measured.

        time: of the trajectory, s, at which the motors are at q (2d + 2,). now: that moment on the clock, s.
        readings: since the last call.
        """
        self._time = time
        self.tracker.observe(q, now, readings)

    def correct(self, knot: int) -> Patch:
        """Correct the path at a knot of the leeway as the tracker asks; return what has changed.

        Raises TrajectoryError where that is beyond the reach of the arm.
        """
        s = self.trajectory.knots
        knots = self.leeway.knots
        before = self._offsets[knot - 1]
        here = float(self.trajectory.motion.parameter(self._time))
        # The robot depends on where it came from: the tracker needs the configurations from here to the knot
        # before, which are fixed already.
        ahead = self.trajectory.motion.path(np.append(s[(s > here) & (s < knots[knot - 1])], knots[knot - 1]))
        low, high = self.leeway.box(knot, before)
        planned = self._planned[knot]
        frame, last = (int(self.leeway.frames[k]) - 1 for k in (knot, knot - 1))
        wanted = self.tracker.compute_command(frame, last, ahead, planned + low, planned + high)
        offset = self.leeway.nearest_allowed_offset(knot, before, wanted - planned)
        self._offsets[knot:] = self.leeway.offsets_back_to_plan(knot, offset)
        patch = self._patch()
        self.trajectory = self.trajectory.apply_patch(patch)
        first, last = np.searchsorted(s, knots[knot - 1 : knot + 1])
        check_trajectory(self.trajectory, stretch=slice(int(first), int(last) + 1))
        return patch

    def _patch(self) -> Patch:
        """Return what differs from the trajectory as it was before the last correction."""
        path = self.trajectory.motion.path
        added = CubicHermiteSpline(self.leeway.knots, self._offsets, np.zeros_like(self._offsets))
        q = self._path + added(self._at)
        slopes = self._slopes + added(self._at, 1)
        other = np.flatnonzero(((q != path(path.x)) | (slopes != path(path.x, 1))).any(axis=1))
        rows = slice(int(other[0]), int(other[-1]) + 1) if len(other) else slice(0, 0)
        return Patch(rows.start, q[rows], slopes[rows])
