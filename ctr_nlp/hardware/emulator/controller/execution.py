"""What lines of G-code do: moves go to the planner as it has room, dwells and the program's end wait for motion.

An `ok` means planned, not done.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.hardware.emulator.controller.homing import Homing
from ctr_nlp.hardware.emulator.mechanics.planner import Vector
from ctr_nlp.hardware.emulator.protocol.gcode import Line, Modal, Refused, read

LOCKED = 9


class Execution(Homing):
    """A controller that obeys G-code."""

    def execute(self, text: str) -> None:
        """Obey a line of G-code, now or as soon as there is room; raises Refused."""
        if self.state in ("Alarm", "Jog"):
            raise Refused(LOCKED)
        if self.error is not None:
            raise Refused(self.error)
        line = read(text, self.modal)
        target = self.target_of(line)
        if self.state == "Check":
            self._accept(line.modal)
        elif self.outside(target):
            self.soft_limit()
        elif line.dwell or line.ends:
            self.pending = lambda: self._waited(line)
        else:
            self.pending = lambda: self.planned(line, target)

    def target_of(self, line: Line) -> Vector:
        """Where a line leads from what is planned, (6,) mm and deg."""
        at = list(self.motion.target)
        for i, value in line.axes.items():
            at[i] = value if line.modal.absolute else at[i] + value
        return tuple(at)

    def outside(self, target: Vector) -> bool:
        """Whether soft limits, where they are on, forbid a target (6,)."""
        if not self.settings[20]:
            return False
        return any(not -self.settings[130 + i] <= target[i] <= 0 for i in self.homed)

    def planned(self, line: Line, target: Vector, jog: bool = False) -> bool:
        """Put a line into the planner; False where there is no room yet."""
        if line.axes and not self.motion.free:
            return False
        self.motion.begin_line(line.number)
        if line.axes:
            speed = line.modal.feed / 60
            if line.modal.motion == 0:
                speed = float("inf")
            elif line.modal.inverse_time:
                speed *= float(np.linalg.norm(np.subtract(target, self.motion.target)))
            self.motion.plan(target, speed, line.number or None, jog)
        self._accept(self.modal if jog else line.modal)
        return True

    def _accept(self, modal: Modal) -> None:
        self.modal = modal
        self.ok()

    def _waited(self, line: Line) -> bool:
        """A dwell or the program's end waits for all motion; True once it is over."""
        if self.motion.running or self.motion.blocks:
            if not self.motion.running:
                self.state = "Run"
                self.motion.start()
            return False
        if line.ends:
            self.say("[MSG:Pgm End]")
            self._accept(Modal(inches=line.modal.inches))
            return True
        until = self.time + line.dwell

        def over() -> bool:
            if self.time < until - 1e-12:
                return False
            self._accept(line.modal)
            return True

        self.pending = over
        return False
