"""Commissioning a Grbl controller: what it is set to, one axis moved by a small step, and the record of both."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.devices import Asked
from ctr_nlp.hardware.devices.grbl.identity import (
    Identity,
    SettingFinding,
    find_changed_settings,
    find_loose_settings,
    find_wrong_settings,
)
from ctr_nlp.hardware.devices.grbl.stop import stop_controller
from ctr_nlp.hardware.devices.grbl.talk import Talk
from ctr_nlp.hardware.link import ByteLink
from ctr_nlp.typing import Array

TRIAL_STEP_LENGTH = 1.0
"""mm or degrees of a trial step."""

TRIAL_STEP_SPEED = 2.0
"""mm/s or degrees/s of a trial step."""

TRIAL_STEP_POLL_S = 0.1
"""s between two status reports during a trial step; it may take three times as long as planned."""


STEP_DIRECTION_SIGNS = {"+": 1, "-": -1}
"""Signs that name the directions of a trial step."""


class ControllerReadout(NamedTuple):
    """Settings, position and delay of a controller, as read for commissioning.

    wrong: settings that go against safe playing. changed: those that differ from the last commissioning. loose:
    those that let a corrupted line move an axis faster or further than any plan. position: (m,) of the axes in
    their units. round_trip: s from a status question to its answer.
    """

    identity: Identity
    wrong: list[SettingFinding]
    changed: list[SettingFinding]
    loose: list[SettingFinding]
    position: Array
    round_trip: float


class Commissioning:
    """A connected Grbl controller that plays nothing; every wait ends. Raises DeviceFault, HardwareError."""

    def __init__(self, hardware: Hardware, open_link: Callable[[], ByteLink], clock: Clock) -> None:
        if hardware.connection.device != "grbl":
            raise HardwareError(
                f"device of the connection is {hardware.connection.device!r}; only a Grbl controller is "
                'commissioned. Write device = "grbl", and its url, into the hardware file; without one, '
                'step 4 of "Commissioning" in docs/hardware.md starts an emulated one'
            )
        self._hardware = hardware
        self._link = open_link()
        self._clock = clock
        self._talk = Talk(self._link, clock)
        self._arrived = set[tuple[str, int]]()
        self._skipped = set[str]()

    def read(self) -> ControllerReadout:
        """Read settings, position and delay of an idle controller, and judge the settings."""
        report, _ = self._talk.greet()
        if report.state != "Idle":
            raise DeviceFault(f"the controller is {report.state}; it must be Idle to be commissioned")
        identity = self._talk.identify()
        self._columns = identity.columns(self._hardware)
        self._acceleration = identity.acceleration(self._hardware)
        wrong = find_wrong_settings(identity, self._hardware)
        changed = find_changed_settings(identity, self._hardware)
        position = self._talk.report().position[self._columns]
        loosely = find_loose_settings(identity.settings, self._columns, self._hardware)
        self.controller = ControllerReadout(identity, wrong, changed, loosely, position, self._talk.round_trip())
        return self.controller

    def tighten(self) -> list[SettingFinding]:
        """Set the loose settings to what plans may use and read everything again.

        Returns what was set. Raises DeviceFault.
        """
        found = self.controller.loose
        for one in found:
            self._talk.ask(f"${one.name}={one.wanted}")
        self.read()
        return found

    def step(self, letter: str, direction: int, stop: Asked) -> tuple[float, float]:
        """Move one axis by a small step and return its positions before and after, in its unit.

        letter: of the axis. direction: 1 for up, -1 for down. stop: called while the axis moves; True stops it.
        The axis stays in its range. It is stopped, too, where it does not arrive in time, which is a DeviceFault.
        A step that arrives counts as tried.
        """
        index = self._hardware.letters.index(letter)
        axis = self._hardware.axes[index]
        before = float(self._talk.report().position[self._columns][index])
        goal = before + direction * TRIAL_STEP_LENGTH
        if not axis.range[0] - 1e-3 <= goal <= axis.range[1] + 1e-3:
            raise HardwareError(
                f"axis {letter} ({axis.joint}) stands at {before:.4g} {axis.unit} and would go to {goal:.4g}; it "
                f"must stay in [{axis.range[0]:g}, {axis.range[1]:g}]"
            )
        # A jog can be cancelled and leaves the parser's modes alone. Its F is per minute, whatever G93 or G94 is
        # active.
        self._talk.ask(f"$J=G90 G21 {letter}{goal:.4f} F{60 * TRIAL_STEP_SPEED:g}")
        end = (
            self._clock.now()
            + 3.0 * TRIAL_STEP_LENGTH / TRIAL_STEP_SPEED
            + 2.0 * TRIAL_STEP_SPEED / self._acceleration[index]
        )
        while self._clock.now() < end and not stop():
            report = self._talk.request_report(TRIAL_STEP_POLL_S)
            after = before if report is None else float(report.position[self._columns][index])
            # Idle alone is no proof of arrival: the first report may come before the jog begins.
            if report is not None and report.state == "Idle" and abs(after - goal) < 0.5 * TRIAL_STEP_LENGTH:
                self._arrived.add((letter, direction))
                return before, after
        stop_controller(self._talk, self._clock)
        raise DeviceFault(
            f"axis {letter} was stopped before it had made its step of {TRIAL_STEP_LENGTH:g} {axis.unit}"
        )

    def skip(self, letter: str) -> None:
        """Leave the axis with this letter untested, because a person says so."""
        self._skipped.add(letter)

    @property
    def remaining(self) -> tuple[str, ...]:
        """Steps that have not arrived yet, as "X+", "X-", of axes that are not skipped, in order."""
        return tuple(
            f"{letter}{sign}"
            for letter in self._hardware.letters
            for sign, direction in STEP_DIRECTION_SIGNS.items()
            if letter not in self._skipped and (letter, direction) not in self._arrived
        )

    @property
    def untested_axes(self) -> tuple[str, ...]:
        """Letters of the axes that have not arrived in both directions, skipped ones among them."""
        return tuple(
            letter
            for letter in self._hardware.letters
            if any((letter, direction) not in self._arrived for direction in STEP_DIRECTION_SIGNS.values())
        )

    def close(self) -> None:
        """Let go of the link; nothing is sent."""
        self._link.close()
