"""How motion is stopped: feed hold, the end of a jog, reset, power failure and alarms; and the homing cycle."""

from __future__ import annotations

import numpy as np

from emulator.controller.base import Controller, HomingMove
from emulator.gcode import Modal
from emulator.planner import Overrides
from emulator.reports import BANNER, UNLOCK, Status

ALARM_PAUSE_S = 0.1
ALARM_HARD_LIMIT, ALARM_SOFT_LIMIT, ALARM_RESET_IN_MOTION, ALARM_RESET_WHILE_HOMING, ALARM_ESTOP = 1, 2, 3, 6, 10


class Stopping(Controller):
    """A controller that can be stopped, and that finds its position."""

    def hold(self) -> None:
        """Feed hold; it does nothing to a jog, nor to homing, and an alarm has nothing left to hold."""
        if self.state in ("Idle", "Run"):
            self.state = "Hold"
            self.motion.hold()

    def resume(self) -> None:
        """Go on after a feed hold, once it has come to a standstill."""
        if self.state == "Hold" and self.motion.is_halted and self.when_stopped is None:
            self.say("[MSG:]")
            self.state = "Run"
            self.motion.resume()
            self.settle()

    def settle(self) -> None:
        """Change state where motion has come to its end."""
        if self.motion.running:
            return
        if self.when_stopped is not None:
            action, self.when_stopped = self.when_stopped, None
            action()
        elif self.state in ("Run", "Jog") and not self.motion.blocks:
            self.state = "Idle"

    def stop(self) -> None:
        """Come to a standstill at once and forget all that is planned or waits, an alarm too; not while homing."""

        def over() -> None:
            self._rest_idle()
            self.modal = Modal()
            self.say("[MSG:Stop]")

        if self.state == "Home" or self.critical:
            return
        self.forget_lines()
        self.pending = None
        self.motion.brake()
        self.when_stopped = over

    def cancel_jog(self) -> None:
        """Forget what was received, come to a standstill and forget the rest of a jog."""
        self.forget_lines()
        if self.state == "Jog":
            self.when_stopped = self._rest_idle
            self.motion.brake()

    def _rest_idle(self) -> None:
        self.motion.flush()
        self.state = "Idle"

    def reset(self) -> None:
        """Stop dead and start anew; in motion as on_reset says."""
        homing = self.state == "Home"
        if not homing and not (self.moving and self.on_reset != "banner"):
            self.restart(locked=not self.moving and self.state == "Alarm")
            return
        self.say(f"ALARM:{ALARM_RESET_WHILE_HOMING if homing else ALARM_RESET_IN_MOTION}")
        self.state = "Alarm"
        self.forget_lines()
        self._drop_plans()
        if self.on_reset == "alarm" and not homing:
            self.motion.freeze()
        else:
            self.motion.flush()
            self.later(ALARM_PAUSE_S, lambda: self.restart(locked=True))

    def _drop_plans(self) -> None:
        self.homing.clear()
        self.pending = self.when_stopped = None

    def restart(self, locked: bool) -> None:
        """Begin as after power-on, with the banner; locked: in alarm. Position and settings stay."""
        self.forget_lines()
        self._drop_plans()
        self.timers.clear()
        self.motion.flush()
        self.override(Overrides())
        self.motion.begin_line(None)
        self.modal = Modal()
        self.critical = False
        self.state = "Alarm" if locked else "Idle"
        self.say(BANNER)
        if locked:
            self.say(UNLOCK)
        self.status = Status()
        self.report_due = False

    def reboot(self, loses_position: bool = False) -> None:
        """Power fails for a moment: motion stops at once, buffers are empty, the banner is sent."""
        if loses_position:
            self.slip = self.slip + np.array(self.motion.position)
            self.motion.place((0.0,) * 6)
            self.homed.clear()
        self.restart(locked=False)

    def alarm(self, number: int) -> None:
        """Stop dead with an alarm that only a reset ends."""
        self.motion.freeze()
        self._drop_plans()
        self.timers.clear()
        self.state = "Alarm"
        self.critical = True
        self.status.tell("accessories")
        self.say(f"ALARM:{number}")
        self.later(ALARM_PAUSE_S, lambda: self.say("[MSG:Reset to continue]"))

    def hard_limit(self) -> None:
        """A limit switch is met in motion: everything stops where it is."""
        self.alarm(ALARM_HARD_LIMIT)

    def soft_limit(self) -> None:
        """Come to a standstill, then raise the alarm."""
        if self.motion.running:
            self.state = "Hold"
            self.motion.hold()
            self.when_stopped = lambda: self.alarm(ALARM_SOFT_LIMIT)
        else:
            self.alarm(ALARM_SOFT_LIMIT)

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
