"""Sentences beside the numbers of the moment."""

from __future__ import annotations

import math

from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS, summarise_verdicts
from ctr_nlp.view.live.steered.session import HAND_METHOD, Session

HINT = "Drag a ball to pull the target, or a slider to move a joint. Drag the background to turn the view."


def status_message(session: Session, tip_error: float, snapped: bool, news: str) -> str:
    """Say how far a tip that is not there is from its goal, what is compiled, how wall and load count, and news.

    session: what is steered. tip_error: distance of the tip from the target's end, mm. snapped: whether the robot
    snapped a moment ago. news: sentences, "" for none.
    """
    found = [*_compilation_messages(session)]
    if not tip_error <= session.settings.arrival_tolerance:
        away = "" if math.isnan(tip_error) else f" by {tip_error:.1f} mm"
        found.insert(
            0, f"**The tip misses its goal{away}**; {session.settings.arrival_tolerance:g} mm is allowed."
        )
    if session.is_playing_back:
        found.append("The recording is played. Drag a ball or a slider to take over.")
    if session.problem.lumen is not None and session.method == HAND_METHOD:
        found.append("By hand, the sliders move the robot, also into the wall.")
    if session.active_load is not None:
        found.append(f"The load on the robot is {session.active_load}.")
    if snapped:
        found.append("**The robot snapped.** It continues from its new equilibrium.")
    return "\n\n".join([*found, news or HINT])


def verdict_list(plan: Plan) -> str:
    """Return the verdicts on a recorded plan as a list in Markdown, with a summary and a warning."""
    rows = [f"- {each.matter}: **{each.word}**{f', {each.value}' if each.value else ''}" for each in plan.verdicts]
    return "\n".join([f"{summarise_verdicts(summary(plan))} {NOT_FOR_PATIENTS}", "", *rows])


def _compilation_messages(session: Session) -> list[str]:
    """Say which programs are being compiled, are ready or cannot be made; nothing where none are awaited."""
    awaited = session.pending_drive
    if awaited is None:
        return []
    borne = f" under {session.load}" if session.load is not None else ""
    wanted = f"the {awaited.model.name} model{borne}{' within the wall' if awaited.within_lumen else ''}"
    if awaited.error is not None:
        return [f"The code for {wanted} cannot be compiled: {awaited.error}."]
    if awaited.drive is not None:
        return [f"The code for {wanted} is ready, and will be used when the recording ends."]
    return [
        f"Compiling the code for {wanted} in the background, once for all robots of this kind. This takes up to "
        f"some minutes. Until then steering uses the {session.model} model and ignores a wall or a load; it "
        "changes by itself."
    ]
