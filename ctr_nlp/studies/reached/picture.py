"""Figure of the outcomes of plans: ends reached, distances of tips from their ends, and depths of contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.verdicts import REACHED_VERDICT_NAMES
from ctr_nlp.studies.reached.cases import REACHED, MethodOutcomes
from ctr_nlp.view.figures.parts.page import STYLE
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

OUTCOME_COLOURS = dict(
    zip((REACHED, *REACHED_VERDICT_NAMES), (GREEN, BLACK, VERMILLION, PURPLE, ORANGE, SKY, "0.75"), strict=True)
)
"""Colours of reached ends, and of plans by their first failed check."""
OUTCOME_MARKERS = "osD^v"
"""Markers of the methods in the right panel; they repeat after five."""


@matplotlib.rc_context(STYLE)
def draw_outcomes(ways: Sequence[MethodOutcomes], fails: Mapping[str, str]) -> Figure:
    """Draw the outcomes of plans.

    Parameters
    ----------
    ways : sequence of MethodOutcomes
        At least one.
    fails : mapping
        Label in words for each of REACHED_VERDICT_NAMES that a plan may fail.

    Returns
    -------
    Figure
        Left, a bar for each method, divided by the first check that fails. Right, a mark for each plan: the tip's
        distance from the target's end over the deepest contact, both in mm, with the area in which both are
        allowed.
    """
    figure = Figure(figsize=(8.4, 2.6 + 0.4 * len(ways)), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    begin = np.zeros(len(ways))
    for check, colour in OUTCOME_COLOURS.items():
        counts = np.array([sum(outcome.failed == check for outcome in way.outcomes) for way in ways])
        if counts.any():
            bars = left.barh(range(len(ways)), counts, left=begin, color=colour, label=fails.get(check, check))
            left.bar_label(bars, [str(count) if count else "" for count in counts], label_type="center")
        begin += counts
    left.set_yticks(range(len(ways)), [way.name.replace(", ", ",\n") for way in ways])
    left.invert_yaxis()
    left.set_xlabel("ends")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3, frameon=False)
    thresholds = Settings()
    allowed = thresholds.contact_allowed
    tolerance = thresholds.arrival_tolerance
    for k, way in enumerate(ways):
        contact = [outcome.contact for outcome in way.outcomes]
        tip = [outcome.tip for outcome in way.outcomes]
        look = {"marker": OUTCOME_MARKERS[k % len(OUTCOME_MARKERS)], "color": (BLUE, VERMILLION, BLACK)[k % 3]}
        right.scatter(contact, tip, s=14, alpha=0.6, lw=0, label=way.name, **look)
    right.add_patch(Rectangle((0.0, 0.0), allowed, tolerance, color=GREEN, alpha=0.25, lw=0, label="allowed"))
    right.set_xlabel("deepest contact (mm)")
    right.set_ylabel("tip to the target's end (mm)")
    right.set_xlim(left=-0.1)
    right.set_ylim(bottom=0.0)
    right.legend(loc="best")
    return figure
