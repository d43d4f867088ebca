"""Interface of the devices that move the axes; one file for every kind of device. Knows no plan."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from ctr_nlp.hardware.motion.lookahead import Commands
from ctr_nlp.typing import Array


class Standing(NamedTuple):
    """Position of the axes of a device at rest.

    Attributes
    ----------
    position : ndarray
        Position (m,) of the axes, in their units.
    homed : bool
        Whether the device knows that the motors are there.
    """

    position: Array
    homed: bool


class Signs(NamedTuple):
    """Signs of trouble that a device shows beside its position; the supervision judges them.

    Attributes
    ----------
    anomaly : str
        A sentence on what it reported or did and no sound device does; empty for nothing.
    override : float, optional
        Factor on all speeds, in %; None where it is not reported.
    stalled : float
        Time, s, for which the device has done nothing although it was given something to do.
    cause : str
        Why it stalled; empty where that cannot be known.
    off_path_cause : str
        Why the axes are further from the path than such a device can be; empty where they are not.
    """

    anomaly: str = ""
    override: float | None = None
    stalled: float = 0.0
    cause: str = ""
    off_path_cause: str = ""


class MotionProgress(NamedTuple):
    """How far a device has come.

    Attributes
    ----------
    state : str
        ``"running"``, ``"holding"`` (slowing down), ``"held"`` or ``"done"``.
    time : float
        Time of the trajectory that has been played, s.
    position : ndarray
        Position (m,) of the axes, in their units.
    stamp : float
        When the position was measured, s of the clock.
    away : float
        Distance from the path, in parts of the axes' tolerances.
    signs : Signs
        Signs of trouble.
    """

    state: str
    time: float
    position: Array
    stamp: float
    away: float
    signs: Signs = Signs()


Asked = Callable[[], bool]
"""Function that returns whether a stop has been requested."""


class RunningMotion(Protocol):
    """Commands that a device has begun to play; all raise DeviceFault."""

    def update(self) -> MotionProgress:
        """Read what the device has reported and return the progress; sends no motion. Call it every few ms."""

    def feed(self) -> None:
        """Send the motion that the device may have now; call it after every update that shows no fault."""

    @property
    def committed_time(self) -> float:
        """Time of the motion, s, up to which commands were sent and cannot be changed."""

    def amend(self, commands: Commands) -> None:
        """Replace the commands that have not been sent.

        commands: have the same end time as those before, and are the same up to committed_time.
        """

    def hold(self) -> None:
        """Begin to stop on the path, so that the motion can be resumed."""

    def resume(self) -> None:
        """Continue after a hold."""


class Device(Protocol):
    """A player of commands; only home and abort wait for a motion, for a limited time. All raise DeviceFault."""

    def connect(self, stop: Asked) -> None:
        """Open the link and check what answers.

        stop: called meanwhile; where it returns True, DeviceFault is raised.
        """

    @property
    def identity(self) -> str:
        """Name that distinguishes a connected device from others at its address, "" where nothing does."""

    def standing(self) -> Standing:
        """Return where the axes stand; a device that moves is a fault."""

    @property
    def resolution(self) -> Array:
        """Smallest distances that the axes (m,) of a connected device can resolve, in their units."""

    def home(self, stop: Asked) -> None:
        """Let the device find its position, and wait for that.

        stop: called meanwhile; where it returns True the device is stopped at once, which is a fault.
        """

    def start(self, commands: Commands) -> RunningMotion:
        """Start to play commands from where the axes stand; feed is to be called from now on.

        Raises TrajectoryError where the link is too slow for them.
        """

    def abort(self) -> Standing:
        """Stop for good, in whatever state the device is, and forget what has not been played.

        The stop is sent before any question. Returns where the axes stand, once that is certain.
        """

    def close(self) -> None:
        """Close the link; nothing is sent."""
