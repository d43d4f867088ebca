"""Sources of measurements, and how their messages become readings on our clock in the robot's base frame."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.identify.closed_loop.sensors import Reading
from ctr_nlp.typing import Array

DRIFT = 1e-3
"""Largest relative difference in speed between the sender's clock and ours."""

OLDEST = 0.9
"""s: older measurements are left out, as if they had never come."""

MAX_READINGS_PER_LOOK = 4
"""Readings that one call returns at most, the newest."""


class Message(NamedTuple):
    """A message of a sender.

    values (m,): as sent, NaN for missing ones. stamp: when it was sent, s of the sender's clock, or None. waited:
    s since it reached this machine, 0 where that is not known.
    """

    values: Array
    stamp: float | None = None
    waited: float = 0.0


class Source(ABC):
    """One source of measurements. strange: the last input that was no measurement, "" for none."""

    strange = ""

    @abstractmethod
    def open(self) -> None:
        """Start to listen; raises DeviceFault."""

    @abstractmethod
    def apply_past_motion(self, configurations: Array) -> None:
        """Note that the robot has passed configurations without being measured.

        configurations: q (n, 2d + 2).
        """

    @abstractmethod
    def take(self, q: Array, now: float) -> list[Reading]:
        """Return the readings that have come, oldest first, without waiting.

        q: (2d + 2,) of the motors. now: s of the clock.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop listening."""


class Remote(Source):
    """A source beyond a link; a kind of link implements how messages come. sensing: describes it."""

    def __init__(self, sensing: Sensing) -> None:
        self._sensing = sensing
        self._lag = math.inf
        self._last = -math.inf

    @abstractmethod
    def _receive_messages(self) -> list[Message]:
        """Return the messages that have come, oldest first."""

    def apply_past_motion(self, configurations: Array) -> None:
        """Ignore past configurations: a real robot has passed them itself."""

    def take(self, q: Array, now: float) -> list[Reading]:
        """Return the newest readings that have come, oldest first, without waiting.

        q: not used, since a real robot is measured. now: s of the clock.
        """
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
        """Return when a message was measured, s of our clock; the quickest message counts as having taken no time.

        stamp: s of the sender's clock, or None. came: s of our clock at which it reached this machine.
        """
        if stamp is None:
            return came - self._sensing.delay
        # The two clocks have an unknown offset. The least of came - stamp is this offset and the quickest delay;
        # it may grow as fast as the clocks drift apart.
        if math.isfinite(self._last):
            self._lag += DRIFT * (came - self._last)
        self._lag = min(self._lag, came - stamp)
        self._last = came
        return stamp + self._lag - self._sensing.delay
