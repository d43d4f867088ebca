"""What clearance costs and brings in many airways, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import SymmetricalLogLocator

from ctr_nlp.figures.parts.page import STYLE
from ctr_nlp.figures.parts.palette import BLACK, BLUE, ORANGE, VERMILLION
from ctr_nlp.studies.clearance.cases import WITH, Airway

LINEAR = 1.0
"""mm of contact up to which the scale is linear, so that none can be shown; logarithmic beyond."""


@matplotlib.rc_context(STYLE)
def cost_of_clearance(cases: Sequence[Airway]) -> Figure:
    """Contact without and with clearance, mm summed over frames, and growth of e3 in %; sorted by the first."""
    figure = Figure(figsize=(7.0, 5.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    ranked = sorted(cases, key=lambda case: (case.contact_without, case.contact_with, case.growth))
    _contact(upper, ranked)
    _growth(lower, ranked)
    lower.set_xlim(0.0, len(ranked) + 1.0)
    lower.set_xlabel("airway, by its contact without clearance")
    real = sum(not case.synthetic for case in ranked)
    counts = f"{real} real airways, {len(ranked) - real} synthetic"
    figure.suptitle(f"What clearance brings and costs: {counts}", fontsize=10)
    return figure


def _contact(axes: Axes, ranked: Sequence[Airway]) -> None:
    place = np.arange(1, len(ranked) + 1)
    without, kept, alone = np.array([(each.contact_without, each.contact_with, each.alone) for each in ranked]).T
    left = kept > 0
    axes.vlines(place, kept, without, color="0.75", lw=0.9)
    look: dict[str, Any] = {"ls": "", "clip_on": False, "zorder": 3}
    axes.plot(place, without, color=ORANGE, marker="o", ms=3.5, label="without clearance", **look)
    axes.plot(place, kept, color=BLUE, marker="s", ms=3.2, label="with clearance", **look)
    look |= {"color": BLACK, "marker": "_", "ms": 7, "mew": 1.2}
    axes.plot(place[left], alone[left], label="clearance alone, at full length", **look)
    axes.set_yscale("symlog", linthresh=LINEAR, linscale=0.6)
    axes.yaxis.set_major_locator(SymmetricalLogLocator(base=10, linthresh=LINEAR, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("contact, sum over frames (mm)")
    axes.legend(loc="upper left", handletextpad=0.2)


def _growth(axes: Axes, ranked: Sequence[Airway]) -> None:
    place, growth = np.arange(1, len(ranked) + 1), np.array([case.growth for case in ranked])
    real = np.array([not case.synthetic for case in ranked])
    for chosen, colour, label in ((~real, BLUE, "synthetic airway"), (real, ORANGE, "real airway")):
        axes.bar(place[chosen], growth[chosen], width=0.8, color=colour, lw=0, label=label)
    most = 100 * WITH.affordable()
    axes.axhline(most, color=VERMILLION, lw=1.2, label=f"limit, {most:g} %")
    axes.set_ylabel("growth of e3 (%)")
    axes.legend(loc="upper left", ncols=3)
    axes.set_ylim(top=1.35 * most)
