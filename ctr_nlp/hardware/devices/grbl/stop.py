"""Stopping the motion behind a Grbl controller, whatever the cause and the controller's state.

The stop is sent first; questions follow. Every wait ends, and a second stop during a stop changes nothing.
"""

from __future__ import annotations

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.clock import Clock
from ctr_nlp.hardware.devices.grbl.talk import ANSWER, GRBL_HOLD, GRBL_JOG_CANCEL, GRBL_RESET, Report, Talk

ASKING = 0.02
"""s between status questions while the axes come to rest."""

OVERHEARD = 0.06
"""s in which a controller must react to a hold; else it has missed it, as happens just after a resume."""

UNHEARD = 0.2
"""s after which a controller that still runs, or says nothing, is reset without having come to rest."""

RESTING = 1.0
"""s that a hold may take to come to rest; the slowest of ordinary drives need 0.4 s. So may a slow jog: steps that
are prepared are still made, one by one, after its feed has come to 0."""

RESTART = 3.0
"""s within which a controller must restart after a reset."""


def stop_controller(talk: Talk, clock: Clock, homing: bool = False) -> Report:
    """Stop motion, let the controller forget the rest of it, and return its report at rest.

    A feed hold, and for jogs, which know none, a cancellation are sent at once, and then, when the axes rest, a
    reset, which keeps the position. Where the hold is not obeyed in time, and in a homing cycle, which knows no
    hold, the reset is sent all the same. Raises DeviceFault where the position is not to be trusted afterwards.

    talk: with the controller. clock: of the player. homing: whether a homing cycle may be running.
    """
    talk.link.write(GRBL_HOLD + GRBL_JOG_CANCEL)
    rested = None if homing else _wait_for_rest(talk, clock)
    # Before our own reset, whose banner would look like a restart, too.
    restarted = talk.lost
    talk.link.write(GRBL_RESET)
    said = [reply.kind for reply in talk.replies_until("banner", RESTART) if reply.kind != "report"]
    if "banner" not in said:
        raise DeviceFault(f"the controller answers a reset with {said}: its position is not to be trusted")
    talk.take_restart_message()
    if restarted:
        raise DeviceFault(
            f"the controller said {restarted!r} before it was stopped: its position is not to be trusted"
        )
    if rested is None or "alarm" in said:
        raise DeviceFault("the controller was reset in motion: its position is not to be trusted")
    report = talk.report(ANSWER)
    # A reset in motion loses steps. Counted positions that still agree say that it came at rest.
    if (report.position != rested.position).any():
        raise DeviceFault("the axes have moved after they were stopped: their position is not to be trusted")
    return report


def _wait_for_rest(talk: Talk, clock: Clock) -> Report | None:
    """Return the second of two successive reports of axes at rest in one place, None where it comes too late.

    The controller has heard the hold where it reports another state, or, of a jog, a feed of 0.
    """
    begun = held = clock.now()
    before: Report | None = None
    heard = False
    while clock.now() - begun < (RESTING if heard else UNHEARD):
        report = talk.request_report(ASKING)
        if report is None:
            continue
        if report.state in ("Alarm", "Home"):
            return None
        heard = heard or report.state not in ("Run", "Jog") or (report.state == "Jog" and report.feed == 0)
        at_rest = report.stopped or report.state == "Idle"
        if at_rest and before is not None and (before.position == report.position).all():
            return report
        before = report if at_rest else None
        if not at_rest and clock.now() - held > OVERHEARD and report.state in ("Run", "Jog"):
            talk.link.write(GRBL_HOLD + GRBL_JOG_CANCEL)
            held = clock.now()
    return None
