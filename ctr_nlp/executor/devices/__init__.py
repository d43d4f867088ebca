"""What moves the axes: one small interface, and a file for every kind of device."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from ctr_nlp.executor.program import Commands

Array = npt.NDArray[np.float64]


class Standing(NamedTuple):
    """Where a device that does not move stands: position (m,) of its axes, in their units.

    homed: whether it knows that this is where the motors are.
    """

    position: Array
    homed: bool


class Progress(NamedTuple):
    """How far a device has come.

    state: "running", "holding" (slowing down), "held" or "done". time: s of the program that have been played.
    line: how many commands have been finished. position (m,): of the axes, in their units; stamp: when it was seen
    there, s of the clock. away: how far it was from the way it should be on, in parts of the axes' tolerances.
    """

    state: str
    time: float
    line: int
    position: Array
    stamp: float
    away: float


class Device(Protocol):
    """Plays commands. Nothing here waits for a motion but home and abort; all raise DeviceFault."""

    def connect(self) -> None:
        """Open the link and make sure of what answers."""
        ...

    def standing(self) -> Standing:
        """Where it stands; a device that moves is a fault."""
        ...

    @property
    def resolution(self) -> Array:
        """The least that its axes (m,) can tell apart, in their units, once it is connected."""
        ...

    def home(self, stop: Callable[[], bool]) -> None:
        """Find its position by itself, and wait for that; where stop says so, stop at once, which is a fault."""
        ...

    def start(self, commands: Commands) -> None:
        """Begin to play commands from where it stands; update goes on with it."""
        ...

    def update(self) -> Progress:
        """Do what can be done now and tell how far it is; call it every few ms."""
        ...

    def hold(self) -> None:
        """Begin to stop on the way, so that it can go on."""
        ...

    def resume(self) -> None:
        """Go on after a hold."""
        ...

    def abort(self) -> Standing:
        """Stop for good and forget what has not been played; returns where it stands once that is sure."""
        ...

    def close(self) -> None:
        """Let go of the link; nothing is sent."""
        ...
