"""How much motion a controller may have in hand: nothing can call it back once the link or the player is gone.

A controller plays what it was given to the end, whatever becomes of the host. So what it was given and has not
done, counted from the position that it last confirmed, is bounded in time and in the travel of every slide. Too
little of it would slow the motion down: a controller runs no faster than it can come to rest within what it was
given.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ctr_nlp.typing import Array, Flags

AHEAD = 0.3
"""s of motion that a controller may have in hand; coming to rest within it takes up to a half longer."""

TRAVEL = 11.5
"""mm that a slide may travel in that time."""

LONGEST = 0.025
"""s: the longest straight piece of a motion; a piece is given whole or not at all."""

PREPARED = 0.09
"""s of step pulses that grblHAL works out beyond the position that it reports, at most (ten segments of 10 ms)."""

POLL = 0.02
"""s between two questions for the position while axes move."""

ROUND_TRIP = 0.025
"""s from such a question to its answer on an ordinary link: 9 ms are a report of 100 bytes at 115200 baud."""


class LinkTiming(NamedTuple):
    """What a link can do. round_trip: s from a question to its answer; rate: bytes/s that it takes."""

    round_trip: float = ROUND_TRIP
    rate: float = math.inf

    @property
    def delay(self) -> float:
        """Seconds of motion in hand that are of no use for braking: done but not told, or still under way."""
        return PREPARED + LONGEST + POLL + 1.5 * self.round_trip


def steady_speed(acceleration: float, slides: bool, link: LinkTiming | None = None) -> float:
    """The largest speed that an axis keeps up with so little motion in hand; 0 where the link is too slow.

    acceleration: of the axis, in unit/s^2. slides: whether its travel (mm) is bounded too. The room that is left
    when everything late is taken off must do for braking: v / (2 a) + delay = AHEAD, v^2 / (2 a) + v delay =
    TRAVEL.
    """
    delay = (link or LinkTiming()).delay
    by_time = max(0.0, 2.0 * acceleration * (AHEAD - delay))
    by_travel = acceleration * (math.sqrt(delay**2 + 2.0 * TRAVEL / acceleration) - delay)
    return min(by_time, by_travel) if slides else by_time


class Window:
    """Which of the pieces of a motion a controller may have been given.

    ends (N + 1,) s and points (N + 1, m): when and where pieces begin and end; slides (m,): which axes count in
    mm.
    """

    def __init__(self, ends: Array, points: Array, slides: Flags) -> None:
        self._ends = ends
        gone = abs(np.diff(points[:, slides], axis=0, prepend=points[:1, slides]))
        self._travel = np.cumsum(gone, axis=0)

    def open_to(self, done: float) -> int:
        """How many pieces may have been given when a controller is known to have done so many s of the motion."""
        in_time = int(np.searchsorted(self._ends, done + AHEAD + 1e-9, "right")) - 1
        allowed = [
            int(np.searchsorted(travel, np.interp(done, self._ends, travel) + TRAVEL, "right")) - 1
            for travel in self._travel.T
        ]
        begun = int(np.searchsorted(self._ends, done + 1e-9, "right"))  # at rest, the next piece is always given
        return min(len(self._ends) - 1, max(begun, min([in_time, *allowed])))


def sustainable(speed: Array, acceleration: Array, slides: Flags, link: LinkTiming, rate: float) -> float:
    """The part of its pace, at most 1, at which a motion can be kept supplied over a link; 0 for none.

    speed (m,): largest of the axes in the motion; acceleration (m,): of the controller; rate: bytes/s of the
    motion.
    """
    parts = [1.0, link.rate / rate if rate > 0 else 1.0]
    for fastest, change, slide in zip(speed, acceleration, slides, strict=True):
        if fastest > 0:
            parts.append(steady_speed(float(change), bool(slide), link) / float(fastest))
    return float(min(parts))
