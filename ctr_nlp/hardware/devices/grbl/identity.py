"""Identity of a Grbl controller, and those of its settings that are not safe to play with.

Settings that let motors lose their position, change the meaning of lines or break limits are found, each with the
value to set. Numbers and meanings of settings: grblHAL, settings.c. Settings of single axes are numbered from a
base: $100 steps per unit, $110 largest rate per minute, $120 acceleration, $130 travel, $160 backlash.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.description import Hardware

Wrong = tuple[int | str, str, str]
"""Which setting is wrong, the value to set, and why."""

STATUS_MASK = 511
"""$10: machine positions, free blocks, line numbers, feed, pins, offsets, overrides and more in status reports."""

MIN_JUNCTION_DEVIATION = 0.1
MAX_JUNCTION_DEVIATION = 1.0
"""$11 must lie between them; mm, and for turning axes deg, which Grbl counts as mm.

At a corner between two lines Grbl goes at most at the speed v with v^2 = a $11 s / (1 - s), where s is the sine of
half the angle between the lines and a the acceleration across the corner (grblHAL, planner.c). It does not leave
the path: the velocity changes at once, by at most sqrt(8 a $11). So a larger $11 means faster corners.

The lower bound: a motion is sent in pieces of 0.025 s (MAX_PIECE_DURATION_S), so that a turn at 2000 deg/s^2
changes its speed by 50 deg/s from one piece to the next. With 0.01, as controllers are delivered, only
sqrt(8 2000 0.01) = 13 deg/s pass at once. Grbl then brakes at every piece of a quick turn, until the
supervision stops it for being late.
On the emulated controller, tubes turned back and forth at 2.9 Hz are 1 s late after 2 s with 0.01, and 0.32 s with
0.03; with 0.1 and more they are no later than the link alone makes them.

The upper bound: $11 keeps lines of other origin, such as jogs, from asking the motors for a leap in speed.
Steppers that are asked for too large a leap lose steps, which nobody notices without encoders. With 1 a slide of
200 mm/s^2 may leap by 40 mm/s, nearly its full speed; beyond that $11 bounds nothing.
"""

NEEDED = {0: "machine positions", 1: "the planner's free blocks", 2: "line numbers", 6: "overrides"}
"""Bits of $10 without which a motion cannot be supervised."""


@dataclass(frozen=True)
class Identity:
    """Description of a connected controller, from its answers to $I, $$ and $N.

    letters: of its axes. receive: size of its receive buffer, bytes. blocks: size of its planner. settings: values
    by name, as reported ("110"; startup lines are "N0", "N1"). description: version, options and driver, which
    distinguish it from other controllers.
    """

    letters: str
    receive: int
    blocks: int
    settings: dict[str, str]
    description: str

    def setting(self, number: int) -> float:
        """Return the setting of a number; raises DeviceFault where it is not reported or no number."""
        try:
            return float(self.settings[str(number)])
        except (KeyError, ValueError) as exception:
            raise DeviceFault(f"the controller does not report its setting ${number}") from exception

    def columns(self, hardware: Hardware) -> list[int]:
        """Return which of the controller's axes the hardware's axes are; raises DeviceFault."""
        missing = [axis.letter for axis in hardware.axes if axis.letter not in self.letters]
        if missing:
            raise DeviceFault(f"the controller has axes {self.letters}; the hardware wants {missing[0]}")
        return [self.letters.index(axis.letter) for axis in hardware.axes]

    def resolution(self, hardware: Hardware) -> npt.NDArray[np.float64]:
        """Return the smallest distances that the hardware's axes (m,) can resolve, in their units.

        hardware: names the axes.
        """
        return 1.0 / np.array([self.setting(100 + column) for column in self.columns(hardware)]) + 1e-3

    def acceleration(self, hardware: Hardware) -> npt.NDArray[np.float64]:
        """Return the controller's acceleration of the hardware's axes (m,), in unit/s^2."""
        return np.array([self.setting(120 + column) for column in self.columns(hardware)])


class SettingFinding(NamedTuple):
    """A setting that is wrong: its name, its value, the value to set, and why."""

    name: str
    value: str
    wanted: str
    why: str

    def __str__(self) -> str:
        return f"the controller's ${self.name} is {self.value}, and {self.why}: set ${self.name}={self.wanted}"


def check_settings(identity: Identity, hardware: Hardware) -> None:
    """Raise DeviceFault with the first unsafe setting and the number of others.

    identity: of the controller, with its settings. hardware: what the settings must suit.
    """
    wrong = [*find_wrong_settings(identity, hardware), *find_changed_settings(identity, hardware)]
    if wrong:
        more = f" ({len(wrong) - 1} more: `ctr-nlp commission` lists all)" if len(wrong) > 1 else ""
        raise DeviceFault(f"{wrong[0]}{more}")


def find_wrong_settings(identity: Identity, hardware: Hardware) -> list[SettingFinding]:
    """Return every setting that is unsafe to play with; raises DeviceFault where one is not reported.

    identity: of the controller, with its settings. hardware: what the settings must suit.
    """
    wrong = (
        *_reports(identity),
        *_positions(identity, hardware),
        *_corners(identity),
        *_limits(identity, hardware),
    )
    return [SettingFinding(str(name), identity.settings[str(name)], wanted, why) for name, wanted, why in wrong]


def find_loose_settings(
    settings: Mapping[str, str], columns: Sequence[int], hardware: Hardware
) -> list[SettingFinding]:
    """Return the settings with which a corrupted line can move an axis faster or further than any plan may.

    Parameters
    ----------
    settings : mapping of str to str
        The controller's settings by name.
    columns : sequence of int
        Which of the controller's axes the hardware's are.
    hardware : Hardware
        Its ``speed`` and, where it homes by a cycle, its ``range`` are what plans may use.

    Returns
    -------
    list of SettingFinding
        With the values to set. Without homing Grbl has no soft limits, and only the largest rates count.
    """
    found = []
    for axis, column in zip(hardware.axes, columns, strict=True):
        bounds = [(110 + column, 60.0 * axis.speed, "faster than its speed")]
        # After homing Grbl counts from 0 at the switch down to -$130, the soft limit.
        if hardware.connection.homing == "cycle" and axis.unit == "mm" and axis.range[0] < 0:
            bounds.append((130 + column, -axis.range[0], "beyond its range"))
        for number, most, what in bounds:
            name = str(number)
            if float(settings.get(name, "0")) > most * (1 + 1e-6):
                why = f"lets a corrupted line move {axis.letter} {what} in the hardware file"
                found.append(SettingFinding(name, settings[name], f"{most:g}", why))
    return found


def find_changed_settings(identity: Identity, hardware: Hardware) -> list[SettingFinding]:
    """Return every setting that differs from the rig's commissioning; none without commissioning.

    identity: of the controller, with its settings. hardware: holds the commissioned settings.
    """
    before = hardware.commissioned or {}
    return [
        SettingFinding(
            name, identity.settings.get(name, "not reported"), value, f"was {value} when the rig was commissioned"
        )
        for name, value in sorted(before.items())
        if identity.settings.get(name) != value and not _wrong_before(name, value, identity, hardware)
    ]


def _wrong_before(name: str, value: str, identity: Identity, hardware: Hardware) -> bool:
    """Return whether the commissioned value of a setting is unsafe, as in a record of a version with other rules.

    Then nobody is asked to restore it: else one message would ask for a value that another one forbids. name,
    value: of the setting.
    """
    try:
        then = find_wrong_settings(replace(identity, settings=identity.settings | {name: value}), hardware)
    except DeviceFault:
        return False
    return name in [finding.name for finding in then]


def _reports(identity: Identity) -> Iterator[Wrong]:
    """Yield settings without which status reports do not suffice for supervision."""
    mask = int(identity.setting(10))
    missing = [name for bit, name in NEEDED.items() if not mask >> bit & 1]
    if missing:
        yield 10, str(STATUS_MASK), f"status reports lack {', '.join(missing)}"
    if identity.setting(13):
        yield 13, "0", "it reports in inches"
    if identity.settings.get("39", "1") == "0":
        yield 39, "1", "a hold is not obeyed while a line with $ or a comment is being read"


def _positions(identity: Identity, hardware: Hardware) -> Iterator[Wrong]:
    """Yield settings with which motors lose their position, or an axis counts as something else."""
    axes = [(axis.letter, column) for axis, column in zip(hardware.axes, identity.columns(hardware), strict=True)]
    held = int(float(identity.settings.get("37", "0")))
    limp = [letter for letter, column in axes if not held >> column & 1]
    if identity.setting(1) != 255 and limp:
        why = f"motors {' '.join(limp)} go limp after {identity.setting(1):g} ms at rest, and lose their position"
        yield 1, "255", why
    harmful = {
        32: "it works as a laser cutter or a lathe, whose axes mean something else",
        41: "it moves an axis by itself when its door is opened",
        62: "it goes to sleep by itself, and its motors go limp",
    }
    for letter, column in axes:
        harmful[160 + column] = f"it compensates backlash of {letter}, which must be left to the hardware file"
    for number, why in harmful.items():
        if float(identity.settings.get(str(number), "0")):
            yield number, "0", why
    for name in ("N0", "N1"):
        if identity.settings.get(name):
            yield name, "", "it is obeyed whenever the controller starts"


def _corners(identity: Identity) -> Iterator[Wrong]:
    """Yield the junction deviation, where corners would be late or their speed would not be bounded."""
    deviation = identity.setting(11)
    if deviation < MIN_JUNCTION_DEVIATION:
        yield (
            11,
            f"{MIN_JUNCTION_DEVIATION:g}",
            "is so small that quick rotations would be late: it counts degrees as mm",
        )
    elif deviation > MAX_JUNCTION_DEVIATION:
        why = "is so large that motors may be asked for leaps in speed, in which steppers lose steps"
        yield 11, f"{MAX_JUNCTION_DEVIATION:g}", why


def _limits(identity: Identity, hardware: Hardware) -> Iterator[Wrong]:
    """Yield rates and accelerations below the hardware file's, and homing or soft limits that are off."""
    for axis, column in zip(hardware.axes, identity.columns(hardware), strict=True):
        for base, name, wanted in ((110, "speed", 60 * axis.speed), (120, "acceleration", axis.acceleration)):
            number = base + column
            if identity.setting(number) < wanted * (1 - 1e-9):
                why = f"is less than the {name} of {axis.letter} in the hardware file, so that it would be late"
                yield number, f"{wanted:g}", why
    if hardware.connection.homing == "cycle":
        if not int(identity.setting(22)) % 2:
            yield 22, "1", "homing is off, though the hardware file says that it is a cycle"
        if not identity.setting(20):
            yield 20, "1", "soft limits are off, though the hardware homes by a cycle"
