"""How playing ends, typed as the ROS 2 trajectory controllers type it, and the states that lead there."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from ctr_nlp.hardware.devices import Standing
from ctr_nlp.typing import Array


class State(Enum):
    """Of the player; the value is what a person reads."""

    DISCONNECTED = "disconnected"
    IDLE = "idle"
    HOMED = "homed"
    RUNNING = "running"
    HOLD = "hold"
    FAULT = "fault"


class Outcome(Enum):
    """As error codes of control_msgs/action/FollowJointTrajectory, where it has one; the value is for people."""

    SUCCESS = "success"
    INVALID_PLAN = "invalid plan"
    PATH_TOLERANCE_VIOLATED = "path tolerance violated"
    GOAL_TOLERANCE_VIOLATED = "goal tolerance violated"
    CANCELLED = "cancelled"
    DEVICE_FAULT = "device fault"


class Ending(NamedTuple):
    """How a motion ends, and a sentence why; standing: None where the device still has to be stopped."""

    outcome: Outcome
    message: str
    standing: Standing | None = None


@dataclass(frozen=True)
class Result:
    """How it ended and why.

    frame: the last that was passed for certain, 0 for none. position: where the axes stand (m,) in their units,
    None where nothing is known. trusted: whether that is where the motors are.
    """

    outcome: Outcome
    message: str
    frame: int
    position: Array | None
    trusted: bool
