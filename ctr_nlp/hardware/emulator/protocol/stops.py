"""All ways in which motion is stopped: feed hold, the end of a jog, reset, power failure and alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctr_nlp.hardware.emulator.mechanics.overrides import Overrides
from ctr_nlp.hardware.emulator.protocol.gcode import Modal
from ctr_nlp.hardware.emulator.protocol.reports import BANNER, UNLOCK, Status

if TYPE_CHECKING:
    from ctr_nlp.hardware.emulator.firmware import Firmware

ALARM_PAUSE_S = 0.1
HARD_LIMIT, SOFT_LIMIT, RESET, RESET_HOMING, ESTOP = 1, 2, 3, 6, 10


def hold(firmware: Firmware) -> None:
    """Feed hold; it does nothing to a jog, nor to homing, and an alarm has nothing left to hold."""
    if firmware.state in ("Idle", "Run"):
        firmware.state = "Hold"
        firmware.motion.hold()


def resume(firmware: Firmware) -> None:
    """Go on after a feed hold, once it has come to a standstill."""
    if firmware.state == "Hold" and firmware.motion.halted and firmware.when_stopped is None:
        firmware.say("[MSG:]")
        firmware.state = "Run"
        firmware.motion.resume()
        firmware.carry_on()


def stop(firmware: Firmware) -> None:
    """Come to a standstill at once and forget all that is planned or waits, an alarm too; not while homing."""

    def over() -> None:
        firmware.motion.flush()
        firmware.modal = Modal()
        firmware.state = "Idle"
        firmware.say("[MSG:Stop]")

    if firmware.state == "Home" or firmware.critical:
        return
    firmware.forget_lines()
    firmware.pending = None
    firmware.motion.brake()
    firmware.when_stopped = over


def cancel_jog(firmware: Firmware) -> None:
    """Come to a standstill and forget the rest of a jog."""

    def over() -> None:
        firmware.motion.flush()
        firmware.state = "Idle"

    firmware.when_stopped = over
    firmware.motion.brake()


def reset(firmware: Firmware) -> None:
    """Stop dead and start anew; in motion as `on_reset` of the firmware says."""
    homing, in_motion = firmware.state == "Home", firmware.moving
    if homing:
        firmware.say(f"ALARM:{RESET_HOMING}")
    elif in_motion and firmware.on_reset != "banner":
        firmware.say(f"ALARM:{RESET}")
    else:
        restart(firmware, locked=not in_motion and firmware.state == "Alarm")
        return
    firmware.state = "Alarm"
    firmware.homing.clear()
    firmware.forget_lines()
    firmware.pending = firmware.when_stopped = None
    if firmware.on_reset == "alarm" and not homing:
        firmware.motion.freeze()
    else:
        firmware.motion.flush()
        firmware.later(ALARM_PAUSE_S, lambda: restart(firmware, locked=True))


def restart(firmware: Firmware, locked: bool) -> None:
    """Begin as after power-on, with the banner; locked: in alarm. Position and settings stay."""
    firmware.forget_lines()
    firmware.pending = firmware.when_stopped = None
    firmware.timers.clear()
    firmware.homing.clear()
    firmware.motion.flush()
    firmware.override(Overrides())
    firmware.motion.read = None
    firmware.modal = Modal()
    firmware.critical = False
    firmware.state = "Alarm" if locked else "Idle"
    firmware.say(BANNER)
    if locked:
        firmware.say(UNLOCK)
    firmware.status = Status()
    firmware.report_due = False


def alarm(firmware: Firmware, number: int) -> None:
    """Stop dead with an alarm that only a reset ends."""
    firmware.motion.freeze()
    firmware.homing.clear()
    firmware.when_stopped = firmware.pending = None
    firmware.timers.clear()
    firmware.state = "Alarm"
    firmware.critical = True
    firmware.status.accessories = True
    firmware.say(f"ALARM:{number}")
    firmware.later(ALARM_PAUSE_S, lambda: firmware.say("[MSG:Reset to continue]"))


def soft_limit(firmware: Firmware) -> None:
    """Come to a standstill, then ALARM:2."""
    if firmware.motion.running:
        firmware.state = "Hold"
        firmware.motion.hold()
        firmware.when_stopped = lambda: alarm(firmware, SOFT_LIMIT)
    else:
        alarm(firmware, SOFT_LIMIT)
