"""Lengths and bends of the branches of a tree, each part of it measured once.

Branches of a tree share their first points with others. What was measured along them is taken from the earlier
branch, so that the work grows with the points of the tree and not with its tips times its depth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from ctr_nlp.anatomy.branch import Branch
from ctr_nlp.paths.lumen_fit import FIT_CHECK_SPACING_MM
from ctr_nlp.paths.points import checked_points, cumulative_arc_length
from ctr_nlp.paths.smoothing_spline import smooth_values
from ctr_nlp.typing import Array

OVERLAP_POINTS = 24
"""Shared points with which the rest of a branch is measured: a spline needs some before those of its own."""
MARGIN_POINTS = 6
"""The last of these, along which the measures of the rest count and not those of the earlier branch."""

MIN_SMOOTHED_POINTS = 5
"""Points that a smoothing spline needs."""


@dataclass(frozen=True)
class BranchMeasures:
    """Length of a branch along its spline, mm, and its largest curvatures, 1/mm.

    curvature: of a smoothing spline, which hides the noise of points. sharpest: of the spline through the points.
    """

    length: float
    curvature: float
    sharpest: float


@dataclass(frozen=True)
class _Profile:
    """A branch and its measures from point to point: points (n, 3) mm, lengths (n - 1,) mm, and the largest
    curvatures there, (n - 1,) 1/mm.
    """

    points: Array
    length: Array
    curvature: Array
    sharpest: Array


def measure_branches(branches: Sequence[Branch]) -> Iterator[BranchMeasures]:
    """Yield the measures of each branch; raise CurveError where the points of one are no curve."""
    profiles = list[_Profile]()
    # Number of the last branch that had a point at a place along it.
    seen: dict[tuple[int, bytes], int] = {}
    for number, branch in enumerate(branches):
        points = checked_points(branch.points)
        keys = [(k, point.tobytes()) for k, point in enumerate(points)]
        shared, earlier = _find_shared(points, [seen.get(key, -1) for key in keys], profiles)
        first = shared - OVERLAP_POINTS
        if first > 0:
            profile = _continue(profiles[earlier], points, shared - MARGIN_POINTS, first)
        else:
            profile = _measure(points)
        profiles.append(profile)
        seen.update(dict.fromkeys(keys, number))
        yield BranchMeasures(
            float(profile.length.sum()), float(profile.curvature.max()), float(profile.sharpest.max())
        )


def count_bifurcations(branches: Sequence[Branch]) -> list[int | None]:
    """Return how many bifurcations each branch passes, its generation; None where branches share no points.

    branches: of one tree. A bifurcation is a point from which branches lead to different points.
    """
    if len(branches) == 1:
        return [0]
    keys = [[point.tobytes() for point in branch.points] for branch in branches]
    ahead: dict[bytes, set[bytes]] = {}
    for places in keys:
        for place, after in pairwise(places):
            ahead.setdefault(place, set()).add(after)
    parts = [[k for k, place in enumerate(places[:-1]) if len(ahead[place]) > 1] for places in keys]
    # Whole centrelines, as VMTK writes them, part at their first point alone: what they share is not known.
    return [len(found) if max(found, default=0) else None for found in parts]


def _find_shared(points: Array, owners: list[int], profiles: list[_Profile]) -> tuple[int, int]:
    """Return how many of the first points (n, 3) mm of a branch an earlier one has too, and its number.

    owners: of each point, the number of a branch that has it in the same place, or -1. profiles: of all branches.
    """
    unshared = next((k for k, owner in enumerate(owners) if owner < 0), len(owners))
    if unshared == 0:
        return 0, -1
    earlier = owners[unshared - 1]
    # Owners may change on the way, where branches part and meet again.
    others = profiles[earlier].points
    common = min(len(points), len(others))
    differ = np.flatnonzero((points[:common] != others[:common]).any(axis=1))
    return int(differ[0]) if differ.size else common, earlier


def _continue(before: _Profile, points: Array, cut: int, first: int) -> _Profile:
    """Return the profile of a branch that is known up to its point `cut`.

    before: of an earlier branch with the same points up to there. points: (n, 3) mm of this one. first: point from
    which on the rest is measured.
    """
    rest = _measure(points[first:])
    return _Profile(
        points,
        np.append(before.length[:cut], rest.length[cut - first :]),
        np.append(before.curvature[:cut], rest.curvature[cut - first :]),
        np.append(before.sharpest[:cut], rest.sharpest[cut - first :]),
    )


def _measure(points: Array) -> _Profile:
    """Measure a branch along its C2 spline by chord length; points: (n, 3) mm."""
    chord = cumulative_arc_length(points)
    spline = CubicSpline(chord, points)
    smooth = CubicSpline(chord, smooth_values(chord, points)) if len(points) >= MIN_SMOOTHED_POINTS else spline
    # Places from point to point, at most FIT_CHECK_SPACING_MM apart; the points themselves are among them.
    counts = np.maximum(1, np.ceil(np.diff(chord) / FIT_CHECK_SPACING_MM)).astype(int)
    starts = np.concatenate([[0], np.cumsum(counts)])
    u = np.interp(np.arange(starts[-1] + 1), starts, chord)
    tangent = spline(u, 1)
    speed = np.linalg.norm(tangent, axis=1)
    # Simpson's rule within each cell; for close points the chord between unit tangents is the angle between them.
    middle = np.linalg.norm(spline((u[:-1] + u[1:]) / 2, 1), axis=1)
    lengths = np.diff(u) * (speed[:-1] + 4 * middle + speed[1:]) / 6
    turns = np.linalg.norm(np.diff(tangent / speed[:, None], axis=0), axis=1) / lengths
    first = smooth(u, 1)
    second = smooth(u, 2)
    curvature = np.linalg.norm(np.cross(first, second), axis=1) / np.linalg.norm(first, axis=1) ** 3
    cells = np.maximum(curvature[:-1], curvature[1:])
    return _Profile(
        points,
        np.add.reduceat(lengths, starts[:-1]),
        np.maximum.reduceat(cells, starts[:-1]),
        np.maximum.reduceat(turns, starts[:-1]),
    )
