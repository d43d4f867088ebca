"""Figure of the robustness trade-off; in a file of its own, since the numbers need no matplotlib."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.studies.robustness_trade_off import RobustnessPoint, choose_plan
from ctr_nlp.view.figures.parts.page import STYLE, add_title
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE, VERMILLION

MARGIN_MARKERS = "x+sd^v"
"""Markers of nominal plans, one for each margin."""
ROBUSTNESS_TICK_DIGITS = "1235"
"""Leading digits of the ticks that are labelled."""


@rc_context(STYLE)
def draw_robustness_trade_off(
    points: Sequence[RobustnessPoint], problem: str, most_lost: float = MOST_LOST
) -> Figure:
    """Draw e3 as planned and as the mean over samples, and below it the share of failures.

    points: the judged plans. problem: its name, for the title. most_lost: accepted share of failures; a ring marks
    the plan that is chosen with it.
    """
    figure = Figure(figsize=(7.0, 5.2), layout="constrained")
    above, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    usual = Settings().stability_margin
    robust = sorted((p for p in points if p.amount or p.margin == usual), key=lambda p: p.amount)
    known = [p for p in robust if p.mean is not None]
    amounts = [p.amount for p in robust]
    above.plot(amounts, [p.planned or float("nan") for p in robust], "o--", color=BLUE, label="as planned")
    means = [p.amount for p in known], [p.mean or 0.0 for p in known]
    above.plot(*means, "o-", color=VERMILLION, label="mean over samples")
    below.plot(amounts, [p.share for p in robust], "o-", color=VERMILLION, clip_on=False)
    others = [p for p in points if p not in robust and p.mean is not None]
    for p, marker in zip(others, itertools.cycle(MARGIN_MARKERS)):
        look: dict[str, Any] = {"marker": marker, "ls": "", "color": BLACK, "mfc": "none", "clip_on": False}
        above.plot(0, p.mean or 0.0, label=f"margin {p.margin:g}, mean over samples", **look)
        below.plot(0, p.share, **look)
    if (best := choose_plan(points, most_lost)) is not None and best.mean is not None:
        above.plot(best.amount, best.mean, "o", ms=13, mfc="none", color=BLACK, label="chosen")
    below.axhline(most_lost, color=BLACK, lw=0.8, ls=":", label=f"allowed, {most_lost:.1%}")
    below.legend()
    above.set_yscale("log")  # errors of failed robots are ten times larger than others
    for ticks in (above.yaxis.set_major_formatter, above.yaxis.set_minor_formatter):
        ticks(lambda e3, _: f"{e3:g}" if f"{e3:.0e}"[0] in ROBUSTNESS_TICK_DIGITS else "")
    above.grid(which="minor", lw=0.3)
    above.set_ylabel("e3 (mm)")
    below.set_ylim(bottom=0, top=max(1.1 * max(p.share for p in points), 2 * most_lost))
    below.set_ylabel("samples that fail")
    below.yaxis.set_major_formatter(PercentFormatter(1.0))
    below.set_xlabel("tolerances planned for, as part of the robot's")
    above.legend()
    add_title(figure, f"What robustness costs and brings: {problem}")
    return figure
