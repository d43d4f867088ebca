"""Where on its path a device is: the straight pieces that it was given, and the place on them nearest to it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.hardware.motion.trajectory import Commands
from ctr_nlp.typing import Array

AT = 0.02
"""Parts of tolerances within which a device is at a place."""


class Place(NamedTuple):
    """A place on a path: the time (s) at which it is passed, how many pieces lie behind, and the distance to it.

    until: when it is left, where it is rested at. away: of the axis furthest off, in parts of its tolerance.
    """

    time: float
    until: float
    line: int
    away: float


class FollowedPath:
    """From a position (m,) along commands; tolerance (m,): of the axes."""

    def __init__(self, start: Array, commands: Commands, tolerance: Array) -> None:
        self.ends = np.append(0.0, commands.time)
        self.points = np.vstack([start, commands.positions])
        self._scale = 1.0 / tolerance

    def nearest(self, position: Array, first: int, last: int) -> Place:
        """The place on pieces first to last - 1, from 0, nearest to a position (m,); the earliest of equals."""
        last = max(last, first + 1)
        start, piece = self.points[first:last], np.diff(self.points[first : last + 1], axis=0) * self._scale
        gone = (position - start) * self._scale
        length = (piece**2).sum(axis=1)
        part = np.clip((piece * gone).sum(axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        away = abs(gone - part[:, None] * piece).max(axis=1)
        best = int((away > away.min() + 1e-9).argmin())
        k = first + best
        time = float(self.ends[k] + part[best] * (self.ends[k + 1] - self.ends[k]))
        apart = abs((self.points[k + 1 :] - position) * self._scale).max(axis=1) > AT
        resting = int(apart.argmax()) if apart.any() else len(apart)
        until = max(time, float(self.ends[k + resting]))
        return Place(time, until, k + bool(part[best] >= 1.0 - 1e-9), float(away[best]))
