"""Sentences and tables on the robots within the tolerances that a plan was simulated on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.plan.measures import arrival, deepest_place, depth, e1, e3
from ctr_nlp.plan.record import Record
from ctr_nlp.plan.robustness import Cost, Robustness, spread
from ctr_nlp.plan.sample_outcomes import sample_outcomes
from ctr_nlp.support.runs import runs

BESIDE = 3
"""Losses fewer frames apart than this are reported together."""
NAMED = 3
"""Most tolerances that are named in a sentence; the table has them all."""


class Table(NamedTuple):
    """A title, the columns' names, and rows of which the first cell is a name; numbers are lengths in mm."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]


class Stretch(NamedTuple):
    """Frames, as text and from 1, in which `draws` robots are lost first, and how far the robot is out there."""

    frames: str
    draws: int
    out: str


def sentences(found: Robustness) -> list[str]:
    """Say where simulated robots are lost, and which tolerance is worth being met better."""
    told = []
    if found.losses:
        parts = [f"{each.frames} ({each.draws}; {each.out} mm out)" for each in stretches(found)]
        told.append(f"Samples are lost first in frames {', '.join(parts)}.")
    if found.costs and found.costs[0].growth > 0:
        most = found.costs[0]
        told.append(
            f"The {_named(most)} costs most: by itself it lets e3 grow by "
            f"{most.growth:.2g} mm, {most.share:.0%} of what all tolerances add one by one."
        )
    if fatal := [_named(cost) for cost in found.costs if cost.lost]:
        more = f" and {len(fatal) - NAMED} more" if len(fatal) > NAMED else ""
        told.append(f"Each of these loses a robot that differs in it alone: {', '.join(fatal[:NAMED])}{more}.")
    return told


def tables(plan: Record) -> list[Table]:
    """Tables of a plan's samples: arrival, contact and errors, where samples are lost, what each tolerance costs.

    Parameters
    ----------
    plan : Record
        A plan with samples.

    Returns
    -------
    list of Table
        Without the empty ones.
    """
    found = plan.drawn
    assert found is not None
    every = [
        Table("over the samples", ("", "nominal", "mean", "median", "95 %", "unit"), _spreads(plan, found)),
        Table("where samples are lost first", ("frames", "samples", "length out, mm"), list(stretches(found))),
        Table(
            "what each tolerance costs alone",
            ("tolerance", "e3 grows by, mm", "share", "lost of two"),
            _costs(found),
        ),
    ]
    return [table for table in every if table.rows]


def stretches(found: Robustness) -> list[Stretch]:
    """Find the stretches of frames in which simulated robots are lost first; near losses share one."""
    counts = np.zeros(found.e2.shape[1] + BESIDE, dtype=int)
    for loss in found.when:
        counts[loss.frame - 1] = loss.draws
    # Every loss marks BESIDE frames from its own on, so that losses near to one another form one run.
    near = np.convolve(counts > 0, np.ones(BESIDE))[: len(counts)] > 0
    rows = []
    for first, stop in runs(near):
        last = stop - BESIDE
        frames = f"{first + 1}" if last == first else f"{first + 1} to {last + 1}"
        out = " to ".join(dict.fromkeys(f"{found.length[j]:.0f}" for j in (first, last)))
        rows.append(Stretch(frames, int(counts[first:stop].sum()), out))
    return rows


def _spreads(plan: Record, found: Robustness) -> list[tuple[Any, ...]]:
    """Return the rows over samples: the nominal robot's value, then mean, median, and what 95 % of samples do not
    exceed (clearance: fall below).
    """
    outcomes, end, place = sample_outcomes(plan), arrival(plan), deepest_place(plan)
    errors, least = e1(plan), None if place is None else -place.depth
    known = np.isfinite(errors).any()
    depths = spread(outcomes.contact) if outcomes.walled else None
    summed = None if plan.clearance is None else float(np.nansum(depth(plan)))
    named = [
        ("tip error in the last frame", None if end is None else end.distance, spread(outcomes.tip_error)),
        ("deepest contact with the wall", None if least is None else max(-least, 0.0), depths),
        ("e3, RMS over frames of e2", e3(plan), found.errors),
        ("largest error, at equal arc length", float(np.nanmax(errors)) if known else None, found.largest_errors),
        ("least clearance from the lumen's wall", least, found.clearances),
        ("depths of contact summed over frames", summed, found.contacts),
    ]
    return [(name, nominal, *values, "mm") for name, nominal, values in named if values is not None]


def _costs(found: Robustness) -> list[tuple[Any, ...]]:
    """Return a row for each tolerance that is not 0, the most costly first."""
    return [(_named(cost), cost.growth, f"{cost.share:.0%}", cost.lost) for cost in found.costs]


def _named(cost: Cost) -> str:
    return f"{cost.tolerance.replace('_', ' ')} of tube {cost.tube}"
