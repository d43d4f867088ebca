"""What lines of G-code do: moves go to the planner as it has room, dwells and the program's end wait for motion.

An `ok` means planned, not done.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctr_nlp.hardware.emulator.mechanics.planner import Vector
from ctr_nlp.hardware.emulator.protocol.gcode import Line, Modal, Refused, read
from ctr_nlp.hardware.emulator.protocol.stops import soft_limit

if TYPE_CHECKING:
    from ctr_nlp.hardware.emulator.firmware import Firmware

LOCKED = 9


def execute(firmware: Firmware, text: str) -> None:
    """Obey a line of G-code, now or as soon as there is room; raises Refused."""
    if firmware.state in ("Alarm", "Jog"):
        raise Refused(LOCKED)
    if firmware.error is not None:
        raise Refused(firmware.error)
    line = read(text, firmware.modal)
    target = target_of(firmware, line)
    if firmware.state == "Check":
        firmware.modal = line.modal
        firmware.ok()
    elif outside(firmware, target):
        soft_limit(firmware)
    elif line.dwell or line.ends:
        firmware.pending = lambda: _waited(firmware, line)
    else:
        firmware.pending = lambda: planned(firmware, line, target)


def target_of(firmware: Firmware, line: Line) -> Vector:
    """Where a line leads from what is planned, (6,) mm and deg."""
    start = firmware.motion.target
    at = list(start)
    for i, value in line.axes.items():
        at[i] = value if line.modal.absolute else start[i] + value
    return tuple(at)


def outside(firmware: Firmware, target: Vector) -> bool:
    """Whether soft limits, where they are on, forbid a target (6,)."""
    if not firmware.settings[20]:
        return False
    return any(not -firmware.settings[130 + i] <= target[i] <= 0 for i in firmware.homed)


def planned(firmware: Firmware, line: Line, target: Vector, jog: bool = False) -> bool:
    """Put a line into the planner; False where there is no room yet."""
    if line.axes and not firmware.motion.free:
        return False
    feed = line.modal.feed
    firmware.motion.read = line.number or None
    if line.axes:
        if line.modal.motion == 0:
            speed = float("inf")
        elif line.modal.inverse_time:
            start = firmware.motion.target
            speed = feed / 60 * float(np.linalg.norm(np.subtract(target, start)))
        else:
            speed = feed / 60
        firmware.motion.plan(target, speed, line.number or None, jog)
    if not jog:
        firmware.modal = line.modal
    firmware.ok()
    return True


def _waited(firmware: Firmware, line: Line) -> bool:
    """A dwell or the program's end waits for all motion; True once it is over."""
    if firmware.motion.running or firmware.motion.blocks:
        if not firmware.motion.running:
            firmware.state = "Run"
            firmware.motion.start()
        return False
    if line.ends:
        firmware.modal = Modal(inches=line.modal.inches)
        firmware.say("[MSG:Pgm End]")
        firmware.ok()
        return True
    until = firmware.time + line.dwell

    def over() -> bool:
        if firmware.time < until - 1e-12:
            return False
        firmware.modal = line.modal
        firmware.ok()
        return True

    firmware.pending = over
    return False
