"""The target of the moment: a part of the problem's path, displaced at a few handles."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.paths.target import SIGMA_GRID, Frame
from ctr_nlp.support.value_checks import floats, number, whole_number
from ctr_nlp.typing import Array

HANDLES = 4
"""Number of points at which the target can be pulled; the last one is its tip."""
HANDLE_SIGMA = (np.arange(HANDLES) + 1.0) / HANDLES
"""Their normalised arc lengths (HANDLES,) on the path."""


class Goal:
    """Target between two frames of a problem, plus a smooth displacement that is 0 at the insertion point.

    The displacement stays while the part of the path that is followed grows or shrinks.
    """

    def __init__(self, frames: Sequence[Frame], reach: float) -> None:
        """Begin at the first of `frames`, those of the problem's target; reach: of the robot, mm; a longer target
        is cut.
        """
        self._frames = frames
        self._reach = reach
        self._progress = 0.0
        self._pulled = np.zeros((HANDLES, 3))

    @property
    def progress(self) -> float:
        """Part of the frames that has passed, from 0 (the first) to 1 (the last)."""
        return self._progress

    def advance(self, progress: float) -> None:
        """Follow the path up to `progress`; raises OptionError unless that lies in [0, 1]."""
        self._progress = number(OptionError, "progress", progress, lambda x: 0 <= x <= 1, "lie in [0, 1]")
        self._forget()

    def pull(self, handle: int, point: Array) -> None:
        """Take a handle, from 0 to HANDLES - 1, to a point (3,) mm; raises OptionError."""
        if whole_number(OptionError, "handle", handle, 0) >= HANDLES:
            raise OptionError(f"handle is {handle}; it must be a whole number from 0 to {HANDLES - 1}")
        there = floats(OptionError, f"the point of handle {handle}", point, (3,))
        # Kept as a displacement from the path, so that it moves with the path.
        self._pulled[handle] += there - self.handles[handle]
        self._forget()

    def release(self) -> None:
        """Return to the path itself."""
        self._pulled[:] = 0.0
        self._forget()

    @property
    def displacement(self) -> Array:
        """Displacement of the handles from the path, (HANDLES, 3) mm; a copy."""
        return self._pulled.copy()

    def restore(self, progress: float, displacement: Array) -> None:
        """Return to an earlier progress, from 0 to 1, and displacement of the handles (HANDLES, 3) mm."""
        self._pulled = displacement.copy()
        self.advance(progress)

    @property
    def is_displaced(self) -> bool:
        """Whether the target differs from the path."""
        return bool(self._pulled.any())

    @cached_property
    def handles(self) -> Array:
        """Positions of the handles, (HANDLES, 3) mm."""
        return np.array([np.interp(HANDLE_SIGMA, SIGMA_GRID, axis) for axis in self._path.T]).T + self._pulled

    @cached_property
    def points(self) -> Array:
        """The target (101, 3) mm at uniform sigma of its own length."""
        path = self._path
        if not self.is_displaced:
            return path
        aside = CubicSpline(
            np.append(0.0, HANDLE_SIGMA), np.vstack([np.zeros(3), self._pulled]), bc_type="natural"
        )
        points = path + aside(SIGMA_GRID)
        along = cumulative_arc_length(points)
        if not (np.diff(along) > 0).all():  # two points in one place: not a curve by arc length
            return path
        # The displacement changes the length: sample again at uniform sigma of the new one.
        return np.asarray(CubicSpline(along, points)(SIGMA_GRID * min(along[-1], self._reach)))

    @cached_property
    def _path(self) -> Array:
        """Path (101, 3) mm, linear between two frames."""
        place = self._progress * (len(self._frames) - 1)
        before = min(int(place), max(len(self._frames) - 2, 0))
        after = min(before + 1, len(self._frames) - 1)
        part = place - before
        return np.asarray((1 - part) * self._frames[before].points + part * self._frames[after].points)

    def _forget(self) -> None:
        """Drop what was computed from progress and handles."""
        for name in ("handles", "points", "_path"):
            self.__dict__.pop(name, None)
