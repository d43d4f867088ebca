"""Figure of the distributions, over airways, of errors and shares of failed samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ctr_nlp.studies.survival.cases import Airway
from ctr_nlp.view.figures.parts.page import STYLE, add_title, plain_ticks
from ctr_nlp.view.figures.parts.palette import BLUE, ORANGE, VERMILLION


@matplotlib.rc_context(STYLE)
def distributions(airways: Sequence[Airway]) -> Figure:
    """Draw cumulative distributions over the airways of the mean e3 over samples, and of the share that fails."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    looks: dict[str, Any] = {
        "plain": {"color": VERMILLION, "ls": "-"},
        "best margin": {"color": ORANGE, "ls": "--"},
        "robust": {"color": BLUE, "ls": "-"},
    }
    named = {"plain": "plain", "best margin": "best", "robust": "robust"}
    for label, name in named.items():
        plans = [getattr(airway, name) for airway in airways]
        left.ecdf([plan.mean for plan in plans if plan.mean is not None], label=label, lw=1.8, **looks[label])
        right.ecdf([plan.share for plan in plans], label=label, lw=1.8, clip_on=False, **looks[label])
    left.set_xscale("log")
    plain_ticks(left.xaxis)
    left.set_xlabel("mean e3 over draws (mm)")
    left.set_ylabel("airways with no more")
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.set_xlabel("draws lost")
    right.set_xlim(left=-0.01)
    right.xaxis.set_major_formatter(PercentFormatter(1.0))
    right.legend(loc="lower right")
    draws = airways[0].plain.draws
    add_title(figure, f"{len(airways)} airways, {draws} draws of the tolerances each")
    return figure
