"""What became of a plan on draws of its robot, in sentences and tables."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.plan.robustness import Cost, Robustness
from ctr_nlp.support.runs import runs

BESIDE = 3
"""Losses that are fewer frames apart are told together."""
NAMED = 3
"""Tolerances that are named in a sentence, at most; the table has them all."""


class Table(NamedTuple):
    """A title, the columns' names, and rows of which the first cell is a name; numbers are lengths in mm."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]


class Stretch(NamedTuple):
    """Frames, as text and from 1, in which so many draws are lost first, and how far the robot is out there."""

    frames: str
    draws: int
    out: str


def sentences(found: Robustness) -> list[str]:
    """Where draws are lost, and which tolerance is worth being met better."""
    told = []
    if found.losses:
        parts = [f"{each.frames} ({each.draws}; {each.out} mm out)" for each in stretches(found)]
        told.append(f"Draws are lost first in frames {', '.join(parts)}.")
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


def tables(found: Robustness) -> list[Table]:
    """Errors and clearance over the draws, where draws are lost, and what each tolerance costs; none is empty."""
    every = [
        Table("over the draws", ("", "mean", "median", "95 %", "unit"), _spreads(found)),
        Table("where draws are lost first", ("frames", "draws", "length out, mm"), list(stretches(found))),
        Table(
            "what each tolerance costs alone",
            ("tolerance", "e3 grows by, mm", "share", "lost of two"),
            _costs(found),
        ),
    ]
    return [table for table in every if table.rows]


def stretches(found: Robustness) -> list[Stretch]:
    """Where draws are lost first, losses that are near to one another together."""
    counts = np.zeros(found.e2.shape[1] + BESIDE, dtype=int)
    for loss in found.when:
        counts[loss.frame - 1] = loss.draws
    near = np.convolve(counts > 0, np.ones(BESIDE))[: len(counts)] > 0
    rows = []
    for first, stop in runs(near):
        last = stop - BESIDE
        frames = f"{first + 1}" if last == first else f"{first + 1} to {last + 1}"
        out = " to ".join(dict.fromkeys(f"{found.length[j]:.0f}" for j in (first, last)))
        rows.append(Stretch(frames, int(counts[first:stop].sum()), out))
    return rows


def _spreads(found: Robustness) -> list[tuple[Any, ...]]:
    """Means, medians and what 95 % of draws do not exceed, or of clearances do not fall below."""
    named = {
        "e3, RMS over frames of e2": found.errors,
        "largest error, at equal arc length": found.largest_errors,
        "least clearance from the lumen's wall": found.clearances,
        "depths of contact summed over frames": found.contacts,
    }
    return [(name, *spread, "mm") for name, spread in named.items() if spread is not None]


def _costs(found: Robustness) -> list[tuple[Any, ...]]:
    """Of every tolerance that is not 0, the most costly first."""
    return [(_named(cost), cost.growth, f"{cost.share:.0%}", cost.lost) for cost in found.costs]


def _named(cost: Cost) -> str:
    return f"{cost.tolerance.replace('_', ' ')} of tube {cost.tube}"
