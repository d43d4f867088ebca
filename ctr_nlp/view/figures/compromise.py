"""Draw arrival against contact: the compromises of a robot that cannot both arrive and keep off the wall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import option
from ctr_nlp.planning.compromise import Compromise, pareto_front, planned_for
from ctr_nlp.view.figures.parts.page import STYLE, add_title, legend_of
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, GREEN, VERMILLION


@matplotlib.rc_context(STYLE)
def compromise(plan: Plan, found: Sequence[Compromise]) -> Figure:
    """Draw the tip's distance from the target's end over the deepest contact, a point a motion.

    Parameters
    ----------
    plan : Plan
        The plan, whose thresholds bound the green area: motions that arrive and keep off the wall.
    found : sequence of Compromise
        Motions found by :func:`ctr_nlp.planning.compromise.compromises`.

    Returns
    -------
    Figure
        One pair of axes, in mm. The line joins motions of which none is better in both.
    """
    figure = Figure(figsize=(5.6, 4.0), layout="constrained")
    axes = figure.subplots()
    tolerance = float(option(plan, "arrival_tolerance"))
    allowed = float(option(plan, "contact_allowed"))
    ordered = sorted(found, key=lambda one: one.contact)
    left = min(0.0, ordered[0].contact) - 0.5
    area = Rectangle((left, 0.0), allowed - left, tolerance, color=GREEN, alpha=0.2, lw=0, label="arrives, clear")
    axes.add_patch(area)
    front = pareto_front(found)
    axes.plot([one.contact for one in front], [one.tip for one in front], color=BLUE, lw=1.2)
    for one in ordered:
        own = one.arrival_weight is None
        colour = BLUE if one in front else "0.7"
        look: dict[str, Any] = {"marker": "o", "color": colour, "ms": 5}
        if own:
            look = {"marker": "D", "color": VERMILLION, "ms": 8}
        axes.plot(one.contact, one.tip, ls="", mec=BLACK, label=_label(plan, one, one in front), **look)
    axes.set_xlim(left=left)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("deepest contact (mm; negative: clear of the wall)")
    axes.set_ylabel("tip to the target's end (mm)")
    add_title(figure, f"Arrival against contact: {plan.meta['problem']['name']}")
    named = legend_of(axes)
    axes.legend(named.values(), named.keys(), loc="best")
    return figure


def _label(plan: Plan, one: Compromise, on_front: bool) -> str:
    """Return the name of a motion in the legend: whether it is the plan, and which robots it was planned for.

    on_front: whether no other motion is better in both arrival and contact.
    """
    if one.arrival_weight is None:
        return f"this plan, for {planned_for(plan, one)}"
    beaten = "" if on_front else ", another is better in both"
    return f"other motions, for {planned_for(plan, one)}{beaten}"
