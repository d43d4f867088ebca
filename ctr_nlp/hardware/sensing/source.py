"""What sends measurements, and how its messages become readings of our clock in the robot's frame."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.identify.closed_loop.sensors import Reading
from ctr_nlp.typing import Array

DRIFT = 1e-3
"""By which part the sender's clock may run faster or slower than ours."""

OLDEST = 0.9
"""s: what was measured earlier is left out, as if it had never come."""

MAX_READINGS_PER_LOOK = 4
"""Readings that are taken between two looks: the newest."""


class Message(NamedTuple):
    """Values (m,) as sent, NaN for missing ones; stamp: when that was, s of the sender's clock, or None.

    waited: for how many s it has been at this machine, 0 where nobody knows.
    """

    values: Array
    stamp: float | None = None
    waited: float = 0.0


class Source(ABC):
    """One sender of measurements. strange: the last that came and is no measurement, "" for nothing."""

    strange = ""

    @abstractmethod
    def open(self) -> None:
        """Begin to listen; raises DeviceFault."""

    @abstractmethod
    def apply_past_motion(self, configurations: Array) -> None:
        """The robot has come through q (n, 2d + 2), where nothing was measured."""

    @abstractmethod
    def take(self, q: Array, now: float) -> list[Reading]:
        """What has come by now, s of the clock, with the motors at q (2d + 2,), oldest first; never waits."""

    @abstractmethod
    def close(self) -> None:
        """Stop to listen."""


class Remote(Source):
    """A sender beyond a link, described by sensing; a kind of link says what has come."""

    def __init__(self, sensing: Sensing) -> None:
        self._sensing = sensing
        self._lag = math.inf
        self._last = -math.inf

    @abstractmethod
    def _receive_messages(self) -> list[Message]:
        """The messages that have come, oldest first."""

    def apply_past_motion(self, configurations: Array) -> None:
        """A robot that is there knows."""

    def take(self, q: Array, now: float) -> list[Reading]:
        """As Source; of these the newest."""
        size = len(self._sensing.sensors)
        found = list[Reading]()
        for message in self._receive_messages():
            if message.values.shape != (size,):
                self.strange = f"{message.values.size} numbers, where {size} are measured"
                continue
            time = self._time(message.stamp, now - message.waited)
            if np.isfinite(message.values).any() and time >= now - OLDEST:
                found.append(Reading(time, self._sensing.to_base_frame(message.values)))
        return found[-MAX_READINGS_PER_LOOK:]

    def _time(self, stamp: float | None, came: float) -> float:
        """When a message that came at a time was measured, s of our clock; the quickest one took no time."""
        if stamp is None:
            return came - self._sensing.delay
        if math.isfinite(self._last):
            self._lag += DRIFT * (came - self._last)
        self._lag = min(self._lag, came - stamp)
        self._last = came
        return stamp + self._lag - self._sensing.delay
