"""The device of a Grbl controller: connect, home, start a motion and stop it."""

from __future__ import annotations

from collections.abc import Callable

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Asked, Standing
from ctr_nlp.hardware.devices.grbl.identity import Identity, check_settings
from ctr_nlp.hardware.devices.grbl.stop import stop_controller
from ctr_nlp.hardware.devices.grbl.stream import Stream
from ctr_nlp.hardware.devices.grbl.talk import GRBL_RESET, GREETING, Talk, never
from ctr_nlp.hardware.link import ByteLink
from ctr_nlp.hardware.motion.lookahead import Commands
from ctr_nlp.typing import Array

HOMING_CYCLE_TIMEOUT_S = 180.0
"""s for a homing cycle."""


class Grbl:
    """A grblHAL controller at the end of the link that open_link opens; stream.py plays a motion on it."""

    def __init__(self, hardware: Hardware, open_link: Callable[[], ByteLink], clock: Clock) -> None:
        self._hardware = hardware
        self._opened = open_link
        self._clock = clock
        self._link: ByteLink | None = None
        self._known: Identity | None = None
        self.stream: Stream | None = None
        """The motion that was played last."""
        self._homing = False
        self._restarted = ""

    def connect(self, stop: Asked = never) -> None:
        """Open the link and identify the controller; unless it is idle, only its status is asked for.

        stop: called meanwhile; where it returns True, DeviceFault is raised.
        """
        self._link = self._opened()
        self._talk = Talk(self._link, self._clock)
        report, self._restarted = self._talk.greet(stop)
        # Status questions are real-time bytes, which a moving controller answers at once. Lines would wait behind
        # the motion.
        if report.state == "Idle":
            self._identify(stop)

    def _identify(self, stop: Asked = never) -> None:
        self._known = self._talk.identify(stop)
        check_settings(self._known, self._hardware)

    @property
    def identity(self) -> str:
        """Version, options and driver of the controller."""
        return self._require_identity().description

    def _require_identity(self) -> Identity:
        if self._known is None:
            raise DeviceFault("the controller has not been asked who it is: it was not idle when it was connected")
        return self._known

    @property
    def resolution(self) -> Array:
        """Resolution of the axes (m,), in their units: a step, and the last digit of reports."""
        return self._require_identity().resolution(self._hardware)

    def standing(self) -> Standing:
        """Return where the axes stand; raises DeviceFault unless the controller is idle and set correctly."""
        report = self._talk.report()
        if report.state != "Idle":
            raise DeviceFault(f"the controller is {report.state}; it must be Idle before anything is played")
        if self._known is None:
            self._identify()
        offsets = self._talk.offsets()
        for name in ("G54", "G92", "TLO"):
            if any(offsets.get(name, ())):
                raise DeviceFault(
                    f"the controller's {name} is {offsets[name]}; G-code must mean machine positions"
                )
        override = self._talk.override()
        if override != 100:
            raise DeviceFault(f"the feed override is {override:g} %; set it to 100 % at the controller")
        homed = self._hardware.connection.homing == "manual" or self._all_homed(offsets)
        return Standing(report.position[self._require_identity().columns(self._hardware)], homed)

    def _all_homed(self, offsets: dict[str, tuple[float, ...]]) -> bool:
        """Whether all slides have been homed; turning axes have no end to find."""
        *_, mask = offsets.get("HOME", (0.0,))
        columns = zip(self._hardware.axes, self._require_identity().columns(self._hardware), strict=True)
        return all(int(mask) >> column & 1 for axis, column in columns if axis.unit == "mm")

    def home(self, stop: Asked) -> None:
        """Run the controller's homing cycle, which also ends an alarm.

        stop: called meanwhile; where it returns True, DeviceFault is raised.
        """
        if self._hardware.connection.homing != "cycle":
            raise HardwareError("this hardware homes by hand: connection.homing is not cycle")
        if self._talk.report().state == "Alarm":
            # After a limit alarm Grbl waits for a reset before it takes anything else, $H included.
            self._talk.link.write(GRBL_RESET)
            self._talk.replies_until("banner", GREETING)
            self._talk.quiet()
            self._talk.take_restart_message()
        if self._known is None:
            self._identify(stop)
        # Stays set where homing fails, so that abort knows that a feed hold is not obeyed.
        self._homing = True
        self.stream = None
        self._talk.ask("$H", HOMING_CYCLE_TIMEOUT_S, stop)
        self._homing = False
        self._talk.quiet()

    def start(self, commands: Commands) -> Stream:
        """Prepare to play commands from where the axes stand; raises TrajectoryError for a slow link."""
        self._restarted = ""
        self.stream = Stream(self._talk, self._require_identity(), self._hardware, self._clock, commands)
        return self.stream

    def abort(self) -> Standing:
        """Stop in whatever state the controller is; raises DeviceFault where the position is not to be trusted."""
        if self._link is None:
            raise DeviceFault("the link was never opened: nothing could be sent")
        homing = self._homing
        self._homing = False
        stop_controller(self._talk, self._clock, homing)
        # Opening a port restarts many boards (DTR). One that was moving has lost steps, though it reports a
        # position afterwards.
        if self._restarted:
            raise DeviceFault("the controller restarted when it was connected: its position is not to be trusted")
        standing = self.standing()
        off = "" if self.stream is None else self.stream.off_lines(standing.position)
        if off:
            raise DeviceFault(f"{off}: its position is not to be trusted")
        return standing

    def close(self) -> None:
        """Close the link; nothing is sent."""
        if self._link is not None:
            self._link.close()
