"""Figures of a study's groups: distribution of a number in each, and the trade-off between two numbers."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ctr_nlp.studies.grid.groups import STUDY_RANKING_COLUMN, Group, Groups
from ctr_nlp.typing import Array, Flags
from ctr_nlp.view.figures.parts.page import STYLE, add_title, printable
from ctr_nlp.view.figures.parts.palette import BLUE, VERMILLION

MAX_LABELLED_GROUPS = 30
"""Largest number of groups that are all labelled."""
GROUP_QUANTILES = 0.05, 0.25, 0.5, 0.75, 0.95
"""Quantiles of a group that its bars show."""
COLUMN_AXIS_LABELS = {
    STUDY_RANKING_COLUMN: "e3 (mm)",
    "robustness_e3_mean": "mean e3 over samples (mm)",
    "robustness_lost_share": "share of samples that fail",
}
"""Labels of columns on axes; other columns have their names."""


@matplotlib.rc_context(STYLE)
def draw_groups(found: Groups, column: str, against: str | None = None) -> Figure:
    """Draw quantiles of a column in every group, and its medians over those of another column.

    Parameters
    ----------
    found : Groups
        The groups.
    column : str
        Column that is drawn.
    against : str, optional
        Column of the second panel's abscissa, in which a line joins the Pareto-optimal groups: those to which no
        other is smaller in both. Without it there is no second panel.

    Returns
    -------
    Figure
        Without groups in which the column has no values.
    """
    groups = [group for group in found.groups if len(group.column_values(column))]
    size = min(7.5, 1.4 + 0.22 * len(groups))
    figure = Figure(
        figsize=(7.0, max(2.6, size)) if against is None else (9.0, max(3.6, size)), layout="constrained"
    )
    left, *right = figure.subplots(1, 1 if against is None else 2, squeeze=False)[0].tolist()
    _draw_quantiles(left, groups, column, found.column)
    if against is not None:
        _draw_trade_off(right[0], groups, column, against)
    count = sum(group.plans for group in groups)
    add_title(figure, f"{count} plans by {found.column}")
    return figure


def _draw_quantiles(axes: Axes, groups: Sequence[Group], column: str, by: str) -> None:
    """Draw the quantiles of a column in every group, one line each; by: column by which rows are grouped."""
    for place, group in enumerate(groups):
        least, low, middle, high, most = (group.quantile(column, share) for share in GROUP_QUANTILES)
        axes.plot([least, most], [place, place], color=BLUE, lw=1.0, solid_capstyle="butt")
        axes.plot([low, high], [place, place], color=BLUE, lw=4.0, solid_capstyle="butt")
        axes.plot(middle, place, color=VERMILLION, marker="|", ms=8, mew=2.0, ls="")
    names = [printable(group.name) for group in groups]
    shown = (
        range(len(groups))
        if len(groups) <= MAX_LABELLED_GROUPS
        else range(0, len(groups), -(-len(groups) // MAX_LABELLED_GROUPS))
    )
    axes.set_yticks(list(shown), [names[place] for place in shown], parse_math=False, fontsize=8)
    axes.set_ylim(len(groups) - 0.5, -0.5)
    axes.set_ylabel(printable(by), parse_math=False)
    axes.set_xlabel(_axis_label(column), parse_math=False)
    axes.set_title("median, middle half and 5 to 95 % of plans", fontsize=8)


def _draw_trade_off(axes: Axes, groups: Sequence[Group], column: str, against: str) -> None:
    """Draw medians of `column` over medians of `against`, and the line through the Pareto-optimal groups."""
    medians = np.array([[group.quantile(name, 0.5) for name in (against, column)] for group in groups])
    axes.plot(*medians.T, color=BLUE, marker="o", ms=4, ls="")
    front = medians[pareto_optimal(medians)]
    axes.plot(*front[np.argsort(front[:, 0])].T, color=VERMILLION, lw=1.4, drawstyle="steps-post")
    if len(groups) <= MAX_LABELLED_GROUPS:
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
    axes.set_xlabel(_axis_label(against), parse_math=False)
    axes.set_ylabel(_axis_label(column), parse_math=False)
    axes.set_title("medians of groups; no other is smaller in both than those on the line", fontsize=8)


def pareto_optimal(medians: Array) -> Flags:
    """Find the Pareto-optimal rows of medians.

    Parameters
    ----------
    medians : (n, 2) array
        Two numbers a row, of which less is better.

    Returns
    -------
    (n,) array of bool
        Rows to which no other one is at most as large in both columns and smaller in one; never rows with NaN.
    """
    # Entry [i, j] is row j minus row i. NaN makes every comparison false, so that it dominates nothing.
    differences = medians[None] - medians[:, None]
    below = np.all(differences <= 0, axis=2) & np.any(differences < 0, axis=2)
    kept: Flags = np.isfinite(medians).all(axis=1) & ~np.any(below, axis=1)
    return kept


def _axis_label(column: str) -> str:
    """Return the label of a column on axes, with its unit where that is known."""
    return COLUMN_AXIS_LABELS.get(column, printable(column))
