"""The homing cycle: one axis after the other goes to its switch, off it, slowly back, and off it again."""

from __future__ import annotations

from ctr_nlp.hardware.emulator.controller.base import HomingMove
from ctr_nlp.hardware.emulator.controller.stops import Stopping


class Homing(Stopping):
    """A controller that finds its position."""

    def start_homing(self) -> None:
        """Begin the cycle; a report says so."""
        self.state = "Home"
        self.report()
        self.report_due = False
        seek, slow, pull = self.settings[25] / 60, self.settings[24] / 60, self.settings[27]
        pause = self.settings[26] / 1000
        for axis in self.settings.homing_axes():
            here = self.motion.position[axis]
            switch = -float(self.slip[axis])
            for place, seconds in (
                (switch, abs(switch - here) / seek),
                (switch - pull, pull / seek),
                (switch, pull / slow),
                (switch - pull, pull / seek),
            ):
                self.homing.append(HomingMove(axis, place, seconds + pause))

    def advance_homing(self, seconds: float) -> None:
        """Let time pass in the cycle; at its end the axes are homed and the report that was asked for is sent."""
        moves = self.homing
        while seconds > 0 and moves:
            axis, place, left = moves[0]
            share = min(1.0, seconds / left) if left > 0 else 1.0
            at = list(self.motion.position)
            at[axis] += share * (place - at[axis])
            self.motion.place(tuple(at))
            if share < 1.0:
                moves[0] = HomingMove(axis, place, left - seconds)
                return
            moves.popleft()
            seconds -= left
        if not moves:
            self.place_at_pull_off()
            if self.report_due:
                self.report()
            self.state = "Idle"
            self.say("[MSG:]")
            self.ok()

    def place_at_pull_off(self) -> None:
        """The axes that are homed stand at the pull-off and know it."""
        axes, pull_off = self.settings.homing_axes(), self.settings[27]
        at = self.motion.position
        self.motion.place(tuple(-pull_off if i in axes else p for i, p in enumerate(at)))
        self.slip[axes] = 0.0
        self.homed = set(axes)
        self.status.tell("homed")
