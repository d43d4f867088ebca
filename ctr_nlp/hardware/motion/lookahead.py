"""Look-ahead: how many straight pieces a controller may have been given, and where on them it is.

A controller plays what it was given to the end, whatever becomes of the host: nothing can call it back once the
link or the player is gone. So what it was given and has not done, counted from the position that it last
confirmed, is bounded in time and in the travel of every slide. Too little of it would slow the motion down: a
controller runs no faster than it can come to rest within what it was given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.typing import Array, Flags

MAX_MOTION_IN_HAND_S = 0.3
"""s of motion that a controller may have in hand; coming to rest within it takes up to a half longer."""

MAX_SLIDE_TRAVEL_IN_HAND_MM = 11.5
"""mm that a slide may travel in that time."""

MAX_PIECE_DURATION_S = 0.025
"""s: the longest straight piece of a motion; a piece is given whole or not at all."""

MAX_PREPARED_PULSES_S = 0.09
"""s of step pulses that grblHAL works out beyond the position that it reports, at most (ten segments of 10 ms)."""

POSITION_POLL_PERIOD_S = 0.02
"""s between two status questions while axes move."""

ROUND_TRIP = 0.025
"""s from such a question to its answer on an ordinary link: 9 ms are a report of 100 bytes at 115200 baud."""

SAME_PLACE_TOLERANCE_RATIO = 0.02
"""Parts of tolerances within which a device is at a place."""


@dataclass(frozen=True)
class Commands:
    """Straight pieces of a motion, one after the other, from where it starts.

    time (N,) s: when each ends, from the start; frame (N,): the next frame on the path, from 1; positions (N, m)
    of the axes, in their units, at its end.
    """

    time: Array
    frame: npt.NDArray[np.int64]
    positions: Array


class LinkTiming(NamedTuple):
    """Delay and rate of a link. round_trip: s from a question to its answer; rate: bytes/s."""

    round_trip: float = ROUND_TRIP
    rate: float = math.inf

    @property
    def delay(self) -> float:
        """Motion in hand, s, that is of no use for braking: done but not reported, or still under way."""
        return MAX_PREPARED_PULSES_S + MAX_PIECE_DURATION_S + POSITION_POLL_PERIOD_S + 1.5 * self.round_trip


def steady_speed(acceleration: float, slides: bool, link: LinkTiming | None = None) -> float:
    """Return the largest speed, in unit/s, that an axis can keep with so little motion in hand.

    acceleration: of the axis, in unit/s^2. slides: whether its travel (mm) is bounded, too. link: None for an
    ordinary one; where it is too slow the speed is 0. The motion in hand less what is late must suffice for
    braking: v / (2 a) + delay = MAX_MOTION_IN_HAND_S, v^2 / (2 a) + v delay = MAX_SLIDE_TRAVEL_IN_HAND_MM.
    """
    delay = (link or LinkTiming()).delay
    # Braking from v takes v / a, in which the axis covers v^2 / (2 a): v / (2 a) s of the motion at full speed.
    # Both conditions of the docstring solved for v; the second by its positive root.
    by_time = max(0.0, 2.0 * acceleration * (MAX_MOTION_IN_HAND_S - delay))
    by_travel = acceleration * (math.sqrt(delay**2 + 2.0 * MAX_SLIDE_TRAVEL_IN_HAND_MM / acceleration) - delay)
    return min(by_time, by_travel) if slides else by_time


class Window:
    """Limits on how many pieces of a motion a controller may have been given.

    ends (N + 1,) s and points (N + 1, m): when and where pieces begin and end; slides (m,): which axes count in
    mm.
    """

    def __init__(self, ends: Array, points: Array, slides: Flags) -> None:
        self._ends = ends
        gone = abs(np.diff(points[:, slides], axis=0, prepend=points[:1, slides]))
        self._travel = np.cumsum(gone, axis=0)

    def open_to(self, done: float) -> int:
        """Return how many pieces may have been given to a controller that has confirmed so many s, done."""
        in_time = int(np.searchsorted(self._ends, done + MAX_MOTION_IN_HAND_S + 1e-9, "right")) - 1
        allowed = [
            int(
                np.searchsorted(travel, np.interp(done, self._ends, travel) + MAX_SLIDE_TRAVEL_IN_HAND_MM, "right")
            )
            - 1
            for travel in self._travel.T
        ]
        begun = int(np.searchsorted(self._ends, done + 1e-9, "right"))  # at rest, the next piece is always given
        return min(len(self._ends) - 1, max(begun, min([in_time, *allowed])))


def sustainable(speed: Array, acceleration: Array, slides: Flags, link: LinkTiming, rate: float) -> float:
    """Return the part of its pace, at most 1, at which a link can supply a motion; 0 for none.

    speed (m,): largest of the axes in the motion. acceleration (m,): of the controller. slides (m,): which axes
    count in mm. link: as measured. rate: bytes/s of the motion.
    """
    parts = [1.0, link.rate / rate if rate > 0 else 1.0]
    for fastest, change, slide in zip(speed, acceleration, slides, strict=True):
        if fastest > 0:
            parts.append(steady_speed(float(change), bool(slide), link) / float(fastest))
    return float(min(parts))


class PathPlace(NamedTuple):
    """A place on a path.

    time: s at which it is passed. until: s at which it is left, where the path rests there. line: number of pieces
    behind it. away: distance to it of the axis furthest off, in parts of its tolerance.
    """

    time: float
    until: float
    line: int
    away: float


class FollowedPath:
    """Straight pieces from a start position (m,) along commands; tolerance (m,): of the axes."""

    def __init__(self, start: Array, commands: Commands, tolerance: Array) -> None:
        self.ends = np.append(0.0, commands.time)
        self.points = np.vstack([start, commands.positions])
        self._scale = 1.0 / tolerance

    def at(self, time: float) -> Array:
        """Return the position (m,) at a time, s."""
        return np.array([np.interp(time, self.ends, column) for column in self.points.T])

    def nearest(self, position: Array, first: int, last: int) -> PathPlace:
        """Return the place nearest to a position (m,) on pieces first to last - 1, from 0.

        Of equally near places it is the earliest.
        """
        last = max(last, first + 1)
        start = self.points[first:last]
        piece = np.diff(self.points[first : last + 1], axis=0) * self._scale
        gone = (position - start) * self._scale
        length = (piece**2).sum(axis=1)
        # Projection on each piece, all axes in parts of their tolerances, since mm and degrees have no common
        # distance. A piece without length counts as its start.
        part = np.clip((piece * gone).sum(axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        away = abs(gone - part[:, None] * piece).max(axis=1)
        # argmin of booleans is the first False: rounding must not prefer a later place.
        best = int((away > away.min() + 1e-9).argmin())
        k = first + best
        time = float(self.ends[k] + part[best] * (self.ends[k + 1] - self.ends[k]))
        apart = abs((self.points[k + 1 :] - position) * self._scale).max(axis=1) > SAME_PLACE_TOLERANCE_RATIO
        resting = int(apart.argmax()) if apart.any() else len(apart)
        until = max(time, float(self.ends[k + resting]))
        return PathPlace(time, until, k + bool(part[best] >= 1.0 - 1e-9), float(away[best]))
