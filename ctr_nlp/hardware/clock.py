"""Clocks of a player: the machine's, or that of an emulated controller in tests."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock in s."""

    def now(self) -> float:
        """Return the time, s."""

    def sleep(self, seconds: float) -> None:
        """Let so many seconds pass."""


class RealClock:
    """The machine's monotonic clock, which does not jump when the time of day is set."""

    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)
