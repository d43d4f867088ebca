"""What is asked of a player while it works, its states, and how playing ends.

Outcomes are typed as the ROS 2 trajectory controllers type them.
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
    """Wishes from anywhere, also from other threads and signal handlers; the last counts, but an abort is final.

    latest: "" for none, "pause", "resume" or "abort", as of the last look. Each is in the journal once it is seen.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._queue = SimpleQueue[str]()
        self.latest = ""

    def ask(self, wish: str) -> None:
        """Ask for something."""
        self._queue.put(wish)

    def is_abort_requested(self) -> bool:
        """Look at what has been asked for; whether an abort has."""
        while True:
            try:
                wish = self._queue.get_nowait()
            except Empty:
                return self.latest == "abort"
            self._journal.record("wish", wish=wish)
            if self.latest != "abort":
                self.latest = wish

    def clear_wish(self) -> None:
        """What was wished for has been done."""
        self.latest = ""

    def clear_abort(self) -> None:
        """An abort has been carried out; other wishes hold for what is played next."""
        if self.latest == "abort":
            self.clear_wish()


class PlayerState(Enum):
    """Of the player; the value is what a person reads."""

    DISCONNECTED = "disconnected"
    IDLE = "idle"
    HOMED = "homed"
    RUNNING = "running"
    HOLD = "hold"
    FAULT = "fault"


class PlaybackOutcome(Enum):
    """As error codes of control_msgs/action/FollowJointTrajectory, where it has one; the value is for people."""

    SUCCESS = "success"
    INVALID_PLAN = "invalid plan"
    PATH_TOLERANCE_VIOLATED = "path tolerance violated"
    GOAL_TOLERANCE_VIOLATED = "goal tolerance violated"
    CANCELLED = "cancelled"
    DEVICE_FAULT = "device fault"


class Ending(NamedTuple):
    """How a motion ends, and a sentence why; standing: None where the device still has to be stopped.

    misplaced: whether the axes were reported so far from where they should be that they are not to be trusted.
    """

    outcome: PlaybackOutcome
    message: str
    standing: Standing | None = None
    misplaced: bool = False


@dataclass(frozen=True)
class Result:
    """How it ended and why.

    frame: the last that was passed for certain, 0 for none. position: where the axes stand (m,) in their units,
    None where nothing is known. trusted: whether that is where the motors are. memory_error: why that could not be
    remembered, so that the next session asks for it again; "" where it was.
    """

    outcome: PlaybackOutcome
    message: str
    frame: int
    position: Array | None
    trusted: bool
    memory_error: str = ""
