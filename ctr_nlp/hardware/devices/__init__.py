"""What moves the axes: one small interface, and a file for every kind of device. Knows no plan."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from ctr_nlp.hardware.motion.lookahead import Commands
from ctr_nlp.typing import Array


class Standing(NamedTuple):
    """Where a device that does not move stands: position (m,) of its axes, in their units.

    homed: whether it knows that this is where the motors are.
    """

    position: Array
    homed: bool


class Signs(NamedTuple):
    """What a device shows beside its position; whether that is as it should be is decided by the supervision.

    anomaly: a sentence on what it said or did that no device does that plays as it should, "" for nothing.
    override: what it scales all speeds by, in %, None where it does not tell. stalled: s in which it has done
    nothing although it was given something to do. cause: why that is so, as far as can be told, "" where nothing
    can. off_path_cause: why its axes are further from the path than those of such a device can be, "" where they
    are not.
    """

    anomaly: str = ""
    override: float | None = None
    stalled: float = 0.0
    cause: str = ""
    off_path_cause: str = ""


class MotionProgress(NamedTuple):
    """How far a device has come.

    state: "running", "holding" (slowing down), "held" or "done". time: s of the trajectory that have been played.
    position (m,): of the axes, in their units; stamp: when it was seen there, s of the clock. away: how far it was
    from the path it should be on, in parts of the axes' tolerances. signs: what else it shows.
    """

    state: str
    time: float
    position: Array
    stamp: float
    away: float
    signs: Signs = Signs()


Asked = Callable[[], bool]
"""Whether a stop has been asked for."""


class RunningMotion(Protocol):
    """Commands that a device has begun to play; all raise DeviceFault."""

    def update(self) -> MotionProgress:
        """Take the news and tell how far it is; gives the device nothing to do. Call it every few ms."""

    def feed(self) -> None:
        """Give the device what it may have now: called after every update in which nothing was wrong."""

    @property
    def committed_time(self) -> float:
        """How far it has been given its commands for good, s of the motion."""

    def amend(self, commands: Commands) -> None:
        """Play other commands, which end when those before did and are the same as far as they were given."""

    def hold(self) -> None:
        """Begin to stop on the path, so that it can go on."""

    def resume(self) -> None:
        """Go on after a hold."""


class Device(Protocol):
    """Plays commands. Only home and abort wait for a motion, and their waits end; all raise DeviceFault."""

    def connect(self, stop: Asked) -> None:
        """Open the link and make sure of what answers; where a stop is asked for meanwhile, that is a fault."""

    @property
    def identity(self) -> str:
        """What tells this device, once it is connected, from others at its address; "" where nothing does."""

    def standing(self) -> Standing:
        """Where it stands; a device that moves is a fault."""

    @property
    def resolution(self) -> Array:
        """The least that its axes (m,) can tell apart, in their units, once it is connected."""

    def home(self, stop: Asked) -> None:
        """Find its position by itself, and wait for that; where stop says so, stop at once, which is a fault."""

    def start(self, commands: Commands) -> RunningMotion:
        """Get ready to play commands from where it stands; feeding begins with it.

        Raises TrajectoryError where the link is too slow for them.
        """

    def abort(self) -> Standing:
        """Stop for good, in whatever state it is, and forget what has not been played.

        The stop is sent before anything is asked. Returns where it stands once that is sure.
        """

    def close(self) -> None:
        """Let go of the link; nothing is sent."""
