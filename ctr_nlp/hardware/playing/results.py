"""Requests to a player while it works, its states, and how playing ends.

Outcomes are those of the ROS 2 trajectory controllers.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from queue import Empty, SimpleQueue
from typing import NamedTuple

from ctr_nlp.hardware.devices import Standing
from ctr_nlp.hardware.journal import Journal
from ctr_nlp.typing import Array


class Wishes:
    """Requests from anywhere, also other threads and signal handlers; the last counts, but an abort is final.

    latest: "" for none, "pause", "resume" or "abort", as of the last look. Each is recorded once it is seen.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        # put of a SimpleQueue is reentrant: a signal handler may interrupt another put, or a get. A lock would
        # deadlock there.
        self._queue = SimpleQueue[str]()
        self.latest = ""

    def ask(self, wish: str) -> None:
        """Request something.

        wish: "pause", "resume" or "abort".
        """
        self._queue.put(wish)

    def is_abort_requested(self) -> bool:
        """Read and record new requests; return whether one of them was an abort."""
        while True:
            try:
                wish = self._queue.get_nowait()
            except Empty:
                return self.latest == "abort"
            self._journal.record("wish", wish=wish)
            if self.latest != "abort":
                self.latest = wish

    def clear_wish(self) -> None:
        """Forget the latest request, since it has been carried out."""
        self.latest = ""

    def clear_abort(self) -> None:
        """Forget an abort that has been carried out; other requests hold for what is played next."""
        if self.latest == "abort":
            self.clear_wish()


class PlayerState(Enum):
    """State of the player; the value is what a person reads."""

    DISCONNECTED = "disconnected"
    IDLE = "idle"
    HOMED = "homed"
    RUNNING = "running"
    HOLD = "hold"
    FAULT = "fault"


class PlaybackOutcome(Enum):
    """Outcome of playing; the value is for people.

    Named as the error codes of control_msgs/action/FollowJointTrajectory, where these have one.
    """

    SUCCESS = "success"
    INVALID_PLAN = "invalid plan"
    PATH_TOLERANCE_VIOLATED = "path tolerance violated"
    GOAL_TOLERANCE_VIOLATED = "goal tolerance violated"
    CANCELLED = "cancelled"
    DEVICE_FAULT = "device fault"


class Ending(NamedTuple):
    """Outcome of a motion, and a sentence why.

    standing: where the axes rest, None where the device still has to be stopped. misplaced: whether the axes were
    reported so far from where they should be that their position is not to be trusted.
    """

    outcome: PlaybackOutcome
    message: str
    standing: Standing | None = None
    misplaced: bool = False


@dataclass(frozen=True)
class Result:
    """Outcome of playing, and why.

    frame: the last that was passed for certain, 0 for none. position: where the axes stand (m,) in their units,
    None where that is not known. trusted: whether that is where the motors are. memory_error: why trust could not
    be remembered, so that the next session asks for it again; "" where it was.
    """

    outcome: PlaybackOutcome
    message: str
    frame: int
    position: Array | None
    trusted: bool
    memory_error: str = ""
