"""Whether the width of a lumen along a path is that of a path from entry to target.

A lumen narrows from where a robot enters to the tips. Where it is clearly wider at the target than at the entry,
the points seem exchanged; where it is wide again beyond a narrow part, the path may run through a leak of the
segmentation, beyond the wall.
"""

from __future__ import annotations

import numpy as np

from ctr_nlp.anatomy.branch import format_point
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.typing import Array

MASK_END_PART = 0.15
"""Length of the first and the last part of a path, whose median radii are compared, as a part of it."""
MAX_WIDENING, NOTED_WIDENING = 1.35, 1.1
"""Ratio of these from target to entry from which on the points seem exchanged, and that which is noted."""
MIN_NARROWING = 1.25
"""Factor by which a lumen that narrows is wider at the entry than at its narrowest place."""
MAX_LEAK_RATIO, MIN_LEAK_MM = 1.8, 2.0
"""Factor, and difference in mm, by which a lumen is wider than at its narrowest place before in a leak."""
SUDDEN_MM = 10.0
"""Length over which a lumen widens at once: this, or its diameter where that is longer."""
SMOOTHED_MM = 3.0
"""Length over which radii are averaged: single cross-sections are wide at bifurcations."""


def check_widths(points: Array, radius: Array, options: ReadOptions) -> tuple[str, ...]:
    """Return notes on the width of a lumen along a path; raise CurveError for findings that nobody has accepted.

    points: (n, 3) mm in the file's coordinates, from entry to target. radius: (n,) mm. options: of their `accept`
    "ends" and "leak" count.
    """
    notes = []
    for finding, message in (("leak", find_leak(points, radius)), ("ends", _find_exchange(points, radius))):
        if message is None:
            continue
        if finding not in options.accept:
            raise CurveError(f"{message}, or --accept {finding} if it is right")
        notes.append(f"{message.partition(';')[0]}; accepted")
    widening = _widening(points, radius)
    if not notes and widening >= NOTED_WIDENING:
        notes.append(
            f"the lumen is {widening:.2f} times as wide at the target as at the entry: check that they are not "
            "exchanged"
        )
    return tuple(notes)


def _widening(points: Array, radius: Array) -> float:
    """Return the ratio of the median radii of the last and the first part of a path.

    points: (n, 3) mm. radius: (n,) mm.
    """
    along = cumulative_arc_length(points)
    first = np.median(radius[along <= MASK_END_PART * along[-1]])
    return float(np.median(radius[along >= (1 - MASK_END_PART) * along[-1]]) / first)


def _find_exchange(points: Array, radius: Array) -> str | None:
    """Return the message on entry and target that seem exchanged, None where they do not.

    points: (n, 3) mm. radius: (n,) mm.
    """
    if _widening(points, radius) < MAX_WIDENING:
        return None
    return (
        f"the lumen's radius is {radius[0]:.1f} mm at the entry and {radius[-1]:.1f} mm at the target, and it "
        "widens from one to the other: they seem exchanged, "
        "a robot enters where a lumen is wide; exchange --entry and --target"
    )


def find_leak(points: Array, radius: Array) -> str | None:
    """Return the message on a path through a leak, None where there is none.

    points: (n, 3) mm. radius: (n,) mm.
    """
    along = cumulative_arc_length(points)
    near = np.abs(along[:, None] - along) <= SMOOTHED_MM / 2
    mean = near @ radius / near.sum(axis=1)
    narrowest = np.minimum.accumulate(mean)
    # A path from a tip to the root widens all the way, and there it is the ends that are wrong: what counts is a
    # lumen that narrows first, or widens at once.
    narrowed = mean[0] > MIN_NARROWING * narrowest
    behind = (along <= along[:, None]) & (along >= along[:, None] - np.maximum(SUDDEN_MM, 2 * mean)[:, None])
    sudden = np.where(behind, mean, np.inf).min(axis=1)
    lowest = np.where(narrowed, narrowest, sudden)
    wide = (mean > MAX_LEAK_RATIO * lowest) & (mean > lowest + MIN_LEAK_MM)
    if not wide.any():
        return None
    k = int(np.where(wide, mean, 0).argmax())
    i = int(np.flatnonzero(mean[: k + 1] <= lowest[k])[-1])
    places = [format_point(points[at].round(1)) for at in (i, k)]
    return (
        f"the lumen's radius grows from {mean[i]:.1f} mm at {places[0]} to {mean[k]:.1f} mm at "
        f"{places[1]}, {along[k] - along[i]:.0f} mm further on: the path seems to run through a leak of the "
        f"segmentation there{'' if narrowed[k] else ' (or entry and target are exchanged)'}; mend the mask"
    )
