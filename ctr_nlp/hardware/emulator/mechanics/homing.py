"""The homing cycle: one axis after the other goes to its switch, off it, slowly back, and off it again."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ctr_nlp.hardware.emulator.protocol.settings import Settings

if TYPE_CHECKING:
    from ctr_nlp.hardware.emulator.firmware import Firmware


class Move(NamedTuple):
    """One axis, by index, goes to a place (mm or deg); seconds: how long that still takes, pauses included."""

    axis: int
    place: float
    seconds: float


def homing_axes(settings: Settings) -> list[int]:
    """Axes, by index, in the order in which they are homed."""
    cycles = [int(settings[44 + i]) for i in range(3)]
    return [axis for cycle in cycles for axis in range(6) if cycle >> axis & 1]


def start(firmware: Firmware) -> None:
    """Begin the cycle; a report says so."""
    firmware.state = "Home"
    firmware.report()
    firmware.report_due = False
    settings = firmware.settings
    seek, slow, pull = settings[25] / 60, settings[24] / 60, settings[27]
    pause = settings[26] / 1000
    for axis in homing_axes(settings):
        here = firmware.motion.position[axis]
        switch = -float(firmware.slip[axis])
        for place, seconds in (
            (switch, abs(switch - here) / seek),
            (switch - pull, pull / seek),
            (switch, pull / slow),
            (switch - pull, pull / seek),
        ):
            firmware.homing.append(Move(axis, place, seconds + pause))


def advance(firmware: Firmware, seconds: float) -> None:
    """Let time pass in the cycle; at its end the axes are homed and the report that was asked for is sent."""
    moves = firmware.homing
    while seconds > 0 and moves:
        axis, place, left = moves[0]
        share = min(1.0, seconds / left) if left > 0 else 1.0
        at = list(firmware.motion.position)
        at[axis] += share * (place - at[axis])
        firmware.motion.place(tuple(at))
        if share < 1.0:
            moves[0] = Move(axis, place, left - seconds)
            return
        moves.popleft()
        seconds -= left
    if not moves:
        place_at_pull_off(firmware)
        if firmware.report_due:
            firmware.report()
        firmware.state = "Idle"
        firmware.say("[MSG:]")
        firmware.ok()


def place_at_pull_off(firmware: Firmware) -> None:
    """The axes that are homed stand at the pull-off and know it."""
    axes, pull_off = homing_axes(firmware.settings), firmware.settings[27]
    at = firmware.motion.position
    firmware.motion.place(tuple(-pull_off if i in axes else p for i, p in enumerate(at)))
    firmware.slip[axes] = 0.0
    firmware.homed = set(axes)
    firmware.status.homed = True
