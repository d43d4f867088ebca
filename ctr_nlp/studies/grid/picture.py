"""Pictures of a study's plans by a column: how a number is distributed in each group, and two of them weighed."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.figures.parts.page import STYLE, printable
from ctr_nlp.figures.parts.palette import BLUE, VERMILLION
from ctr_nlp.studies.grid.groups import ERROR, Group, Groups
from ctr_nlp.typing import Array, Flags

NAMED = 30
"""Groups that have room for their names."""
SHARES = 0.05, 0.25, 0.5, 0.75, 0.95
"""Of the plans of a group, between whose values bars are drawn."""
UNITS = {
    ERROR: "e3 (mm)",
    "robustness_e3_mean": "mean e3 over draws (mm)",
    "robustness_lost_share": "share of draws lost",
}
"""How columns are called on axes; others by their names."""


@matplotlib.rc_context(STYLE)
def by_group(found: Groups, column: str, against: str | None = None) -> Figure:
    """Quantiles of a column in every group, and over medians of another column those of the first.

    A line goes through the groups of which no other one is smaller in both.
    """
    groups = [group for group in found.groups if len(group.of(column))]
    size = min(7.5, 1.4 + 0.22 * len(groups))
    figure = Figure(
        figsize=(7.0, max(2.6, size)) if against is None else (9.0, max(3.6, size)), layout="constrained"
    )
    left, *right = figure.subplots(1, 1 if against is None else 2, squeeze=False)[0].tolist()
    _quantiles(left, groups, column, found.column)
    if against is not None:
        _weighed(right[0], groups, column, against)
    count = sum(group.plans for group in groups)
    figure.suptitle(printable(f"{count} plans by {found.column}"), fontsize=10, parse_math=False)
    return figure


def _quantiles(axes: Axes, groups: Sequence[Group], column: str, by: str) -> None:
    for place, group in enumerate(groups):
        least, low, middle, high, most = (group.quantile(column, share) for share in SHARES)
        axes.plot([least, most], [place, place], color=BLUE, lw=1.0, solid_capstyle="butt")
        axes.plot([low, high], [place, place], color=BLUE, lw=4.0, solid_capstyle="butt")
        axes.plot(middle, place, color=VERMILLION, marker="|", ms=8, mew=2.0, ls="")
    names = [printable(group.name) for group in groups]
    shown = range(len(groups)) if len(groups) <= NAMED else range(0, len(groups), -(-len(groups) // NAMED))
    axes.set_yticks(list(shown), [names[place] for place in shown], parse_math=False, fontsize=8)
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.set_ylabel(printable(by), parse_math=False)
    axes.set_xlabel(_called(column), parse_math=False)
    axes.set_title("median, middle half and 5 to 95 % of plans", fontsize=8)


def _weighed(axes: Axes, groups: Sequence[Group], column: str, against: str) -> None:
    medians = np.array([[group.quantile(name, 0.5) for name in (against, column)] for group in groups])
    axes.plot(*medians.T, color=BLUE, marker="o", ms=4, ls="")
    front = medians[best(medians)]
    axes.plot(*front[np.argsort(front[:, 0])].T, color=VERMILLION, lw=1.4, drawstyle="steps-post")
    if len(groups) <= NAMED:
        for group, place in zip(groups, medians.tolist(), strict=True):
            axes.annotate(
                printable(group.name),
                place,
                xytext=(4, 3),
                textcoords="offset points",
                fontsize=7,
                parse_math=False,
            )
    axes.margins(0.12)
    axes.set_xlabel(_called(against), parse_math=False)
    axes.set_ylabel(_called(column), parse_math=False)
    axes.set_title("medians of groups; no other is smaller in both than those on the line", fontsize=8)


def best(medians: Array) -> Flags:
    """Which of rows (n, 2) no other row is below in both columns, (n,) of truth values; NaN is never best."""
    differences = medians[None] - medians[:, None]
    below = np.all(differences <= 0, axis=2) & np.any(differences < 0, axis=2)
    kept: Flags = np.isfinite(medians).all(axis=1) & ~np.any(below, axis=1)
    return kept


def _called(column: str) -> str:
    return UNITS.get(column, printable(column))
