"""Sentences and tables on the Monte Carlo samples of a plan."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.plan.measures import arrival, contact_depths, e1, e3, find_deepest_point
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.plan.robustness import Robustness, ToleranceCost, spread
from ctr_nlp.plan.sample_outcomes import sample_outcomes
from ctr_nlp.support.flag_runs import find_flag_runs

LOSS_INTERVAL_MAX_GAP_FRAMES = 3
"""Failures fewer frames apart than this are reported together."""
MAX_NAMED_TOLERANCES = 3
"""Largest number of tolerances named in a sentence; the table has them all."""


class RobustnessTable(NamedTuple):
    """A title, the columns' names, and rows of which the first cell is a name; numbers are lengths in mm."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]


class LossInterval(NamedTuple):
    """Frames, as text and from 1, in which `draws` samples first fail, and the length that is out there, mm."""

    frames: str
    draws: int
    out: str


def robustness_sentences(found: Robustness) -> list[str]:
    """Return sentences on where samples fail and which tolerance costs most; found: results on the samples."""
    told = []
    if found.lost_count:
        parts = [
            f"{each.frames} ({each.draws} of them, {each.out} mm extended)" for each in find_loss_intervals(found)
        ]
        told.append(f"Samples first fail in frames {', '.join(parts)}.")
    if found.costs and found.costs[0].growth > 0:
        most = found.costs[0]
        told.append(
            f"The {_tolerance_name(most)} costs most: alone it adds {most.growth:.2g} mm to e3, "
            f"{most.share:.0%} of the sum over all tolerances."
        )
    if fatal := [_tolerance_name(cost) for cost in found.costs if cost.lost]:
        more = f" and {len(fatal) - MAX_NAMED_TOLERANCES} more" if len(fatal) > MAX_NAMED_TOLERANCES else ""
        told.append(
            f"A deviation in any one of these alone makes a robot fail: "
            f"{', '.join(fatal[:MAX_NAMED_TOLERANCES])}{more}."
        )
    return told


def tables(plan: PlanData) -> list[RobustnessTable]:
    """Build the tables of a plan's samples: arrival, contact and errors; where samples fail; cost of tolerances.

    Parameters
    ----------
    plan : PlanData
        A plan with samples.

    Returns
    -------
    list of RobustnessTable
        Without the empty ones.
    """
    found = plan.drawn
    assert found is not None
    every = [
        RobustnessTable("samples", ("", "nominal", "mean", "median", "95 %", "unit"), _spreads(plan, found)),
        RobustnessTable(
            "frames in which samples first fail",
            ("frames", "samples", "extended length, mm"),
            list(find_loss_intervals(found)),
        ),
        RobustnessTable(
            "cost of each tolerance alone",
            ("tolerance", "added e3, mm", "share", "failed of two"),
            _costs(found),
        ),
    ]
    return [table for table in every if table.rows]


def find_loss_intervals(found: Robustness) -> list[LossInterval]:
    """Return the intervals of frames in which samples first fail; failures close in time share one.

    found: results on the samples.
    """
    counts = np.zeros(found.e2.shape[1] + LOSS_INTERVAL_MAX_GAP_FRAMES, dtype=int)
    for loss in found.losses_by_frame:
        counts[loss.frame - 1] = loss.draws
    # Every loss marks LOSS_INTERVAL_MAX_GAP_FRAMES frames from its own on, so that losses near to one another form
    # one run.
    near = np.convolve(counts > 0, np.ones(LOSS_INTERVAL_MAX_GAP_FRAMES))[: len(counts)] > 0
    rows = []
    for first, stop in find_flag_runs(near):
        last = stop - LOSS_INTERVAL_MAX_GAP_FRAMES
        frames = f"{first + 1}" if last == first else f"{first + 1} to {last + 1}"
        out = " to ".join(dict.fromkeys(f"{found.length[j]:.0f}" for j in (first, last)))
        rows.append(LossInterval(frames, int(counts[first:stop].sum()), out))
    return rows


def _spreads(plan: PlanData, found: Robustness) -> list[tuple[Any, ...]]:
    """Return rows of the nominal robot's value, then mean, median and 95 % quantile over samples.

    Of clearance it is the 5 % quantile.
    """
    outcomes = sample_outcomes(plan)
    end = arrival(plan)
    place = find_deepest_point(plan)
    errors = e1(plan)
    least = None if place is None else -place.depth
    known = np.isfinite(errors).any()
    depths = spread(outcomes.contact) if outcomes.wall_known else None
    summed = None if plan.clearance is None else float(np.nansum(contact_depths(plan)))
    named = [
        ("tip error in the last frame", None if end is None else end.distance, spread(outcomes.tip_error)),
        ("deepest contact with the wall", None if least is None else max(-least, 0.0), depths),
        ("e3, RMS over frames of e2", e3(plan), found.errors),
        ("largest error, at equal arc length", float(np.nanmax(errors)) if known else None, found.largest_errors),
        ("least clearance from the wall, at or between frames", least, found.clearances),
        ("depths of contact summed over frames", summed, found.contacts),
    ]
    return [(name, nominal, *values, "mm") for name, nominal, values in named if values is not None]


def _costs(found: Robustness) -> list[tuple[Any, ...]]:
    """Return a row for each tolerance that is not 0, the most costly first."""
    return [(_tolerance_name(cost), cost.growth, f"{cost.share:.0%}", cost.lost) for cost in found.costs]


def _tolerance_name(cost: ToleranceCost) -> str:
    return f"{cost.tolerance.replace('_', ' ')} of tube {cost.tube}"
