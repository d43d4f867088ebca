"""Checks of whether the points and radii of a file can be what they are taken for, shared by all its readers.

What can be repaired without guessing is repaired, with a note: points given twice, and a radius that is missing at
an end. Order and units cannot be read off the points with certainty; where they are unlikely the file is refused,
and a person states what is right (`ReadOptions`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.anatomy.branch import Branch, check_points, format_point
from ctr_nlp.anatomy.reading import ASSUMED, GIVEN, MM_PER_UNIT, STATED, FileFacts, ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.points import LEAST_POINTS, check_coordinates
from ctr_nlp.typing import Array, Flags, Index

REPEATED_POINT_MM = 1e-3
"""Neighbouring points closer than this are one point that was saved twice."""
STEP_NEIGHBOURS = 3
"""Steps on either side with which a step is compared, by their median."""
MAX_STEP_RATIO, MIN_LONG_STEP_MM = 10.0, 4.0
"""A step is refused from this many times its neighbours on, unless it is shorter than the second number."""
MAX_RING_STEPS, MIN_RING_STEP_RATIO = 2.5, 2.5
"""Points are in a ring whose last one is so many usual steps from the first; such a ring is cut at a step that is
so many times as long as those beside it."""
NOTED_OFFSET_MM, NOTED_OFFSET_STEPS, NOTED_OFFSET_RATIO = 0.4, 0.3, 6.0
"""A point is noted that lies farther beside its neighbours than this, in mm, in steps between them, and in
medians of all points: noise is everywhere, a wrong point alone."""
NOTED_STEP_RATIO, NOTED_EVEN_STEP_RATIO, NOTED_STEP_EXCESS_MM = 2.5, 1.5, 1.0
"""Ratios from which a note says that a step is long, the second where points are evenly spaced, and by how much it
must be longer at least."""
EVEN_STEPS = 1.1
"""Points are evenly spaced where the 90th percentile of their steps is at most so many times the 10th."""
MAX_TURN_DEG, MIN_REVERSED_MM = 120.0, 0.5
"""A path that turns by more between two steps runs back, unless one of them is shorter than the second number:
the noise of points that are close together."""
PLAUSIBLE_SPAN_MM = (20.0, 600.0)
"""Extents of centrelines in the body, from a short vessel to a tree of airways or arteries."""
LIKELY_SPAN_MM = (30.0, 400.0)
"""Extents from which the unit of an implausible file is inferred."""
MIN_REACH_PART, NOTED_REACH_PART, MAX_REACHES = 0.1, 0.35, 4.0
"""Parts of a robot's reach below which a path is more likely in another unit, and may be, which is noted; the
last bounds its length in that unit."""
MAX_RADIUS_GAP_PART = 0.05
"""Part of a path at an end over which a missing radius is the neighbour's; one point is always allowed."""
END_PART = 0.1
"""Length of the first and the last part of a branch, whose mean radii are compared, as a part of it."""
WIDENS = 1.2
"""Ratio of mean radii at end and start from which on a branch seems to run from tip to root: a lumen narrows."""
MAX_LUMEN_RADIUS_MM, MIN_LUMEN_RADIUS_MM = 40.0, 0.2
"""Radii of lumens outside of these are noted."""
WIDEST_AIRWAY_RADIUS_MM = 15.0
"""Radius that no airway exceeds: where a point misses a lumen that is wider, the unit of the file is doubted."""


@dataclass(frozen=True)
class FoundUnits:
    """The unit of a file's lengths.

    units: one of MM_PER_UNIT. known: STATED, GIVEN or ASSUMED. notes: sentences on how it was settled.
    """

    units: str
    known: str
    notes: tuple[str, ...] = ()

    @property
    def mm_per_unit(self) -> float:
        """Factor from the file's lengths to mm."""
        return MM_PER_UNIT[self.units]


def find_units(points: Array, options: ReadOptions, stated: str | None = None) -> FoundUnits:
    """Return the unit of a file's lengths; raise CurveError where it is implausible and nobody has confirmed it.

    points: all points (n, 3) of the file, in its own unit. options: what a person states; their unit counts before
    the file's. stated: unit that the file states, one of MM_PER_UNIT, or None, which is taken as mm. A stated unit
    is checked like an assumed one: tools write mm whatever the data were in.
    """
    check_coordinates(points)
    if options.units is not None:
        differs = stated not in (None, options.units)
        note = f"units are {options.units}, as given; the file says {stated}"
        return FoundUnits(options.units, GIVEN, (note,) if differs else ())
    units = stated or "mm"
    known = ASSUMED if stated is None else STATED
    span = _extent(points)
    if span == 0 and len(points) >= LEAST_POINTS:
        raise CurveError(f"its {len(points)} points are all the same, {format_point(points[0])}")
    if len(points) < LEAST_POINTS or PLAUSIBLE_SPAN_MM[0] <= span * MM_PER_UNIT[units] <= PLAUSIBLE_SPAN_MM[1]:
        return FoundUnits(units, known)
    fit = _fitting_unit(span, LIKELY_SPAN_MM, units)
    if span * MM_PER_UNIT[units] > PLAUSIBLE_SPAN_MM[1] and fit is None:
        check_points(points * MM_PER_UNIT[units])
        note = (
            f"points span {span * MM_PER_UNIT[units]:.0f} mm, which is long for a lumen; check the unit (--units)"
        )
        return FoundUnits(units, known, (note,))
    raise CurveError(_unit_message("its points span", span, units, fit, known))


def check_reach(branch: Branch, reach: float, thinnest: float, facts: FileFacts) -> list[str]:
    """Check the size of a whole branch against the robot; return notes.

    branch: in mm. reach: of the robot, mm. thinnest: outer radius of its thinnest tube, mm. facts: of the file;
    nothing is doubted where a person gave its unit. Raises CurveError where another unit is far likelier: the path
    is tiny beside the robot, or the thinnest tube fits nowhere, and in the other unit neither is so.
    """
    if facts.units_known == GIVEN:
        return []
    own = branch.length / MM_PER_UNIT[facts.units]
    fit = _fitting_unit(own, (2 * MIN_REACH_PART * reach, MAX_REACHES * reach), facts.units)
    if fit is None or branch.length >= NOTED_REACH_PART * reach:
        return []
    too_thin = False
    if branch.radius is not None:
        widest = float(branch.radius.max())
        too_thin = widest < thinnest <= widest * MM_PER_UNIT[fit] / MM_PER_UNIT[facts.units]
    if branch.length < MIN_REACH_PART * reach or too_thin:
        thin = (
            f", whose thinnest tube has a radius of {thinnest:.3g} mm and the lumen {widest:.3g}"
            if too_thin
            else ""
        )
        subject = f"the robot reaches {reach:.0f} mm{thin}, but the length of the path is"
        raise CurveError(_unit_message(subject, own, facts.units, fit, facts.units_known))
    return [
        f"the path is {branch.length:.1f} mm long, and the robot reaches {reach:.0f} mm; if the file is in {fit}, "
        f"the path is {own * MM_PER_UNIT[fit]:.0f} mm long: say so with --units {fit}"
    ]


@dataclass(frozen=True)
class DistinctPoints:
    """Points of a path of which none repeats the one before it.

    points: (n, 3) mm. radius: (n,) mm or None. numbers: (n,) of the points in the file, from 1. notes: sentences.
    """

    points: Array
    radius: Array | None
    numbers: Index
    notes: tuple[str, ...] = ()


def drop_repeated_points(points: Array, radius: Array | None = None) -> DistinctPoints:
    """Leave out points that repeat the one before them.

    points: (n, 3) mm. radius: (n,) mm or None.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    keep = np.append(True, ~(steps < REPEATED_POINT_MM))[: len(points)]
    numbers = np.flatnonzero(keep) + 1
    dropped = np.flatnonzero(~keep) + 1
    notes: tuple[str, ...] = ()
    if dropped.size:
        what = "a point that repeats" if dropped.size == 1 else f"{dropped.size} points that repeat"
        notes = (f"left out {what} the one before it ({list_numbers(dropped)})",)
    return DistinctPoints(points[keep], None if radius is None else radius[keep], numbers, notes)


def check_steps(points: Array, options: ReadOptions, numbers: Index | None = None) -> tuple[str, ...]:
    """Check that points follow each other along a path; return notes, raise CurveError where they do not.

    points: (n, 3) mm, none repeated. options: nothing is refused where they accept "steps". numbers: (n,) of the
    points in the file, by default from 1. Refused are steps much longer than those beside them, wherever they
    stand, and points at which the path runs back.
    """
    if len(points) < LEAST_POINTS:
        return ()
    numbers = np.arange(1, len(points) + 1) if numbers is None else numbers
    moves = np.diff(points, axis=0)
    steps = np.linalg.norm(moves, axis=1)
    beside = _neighbouring_steps(steps)
    disorder = _describe_disorder(points, numbers, moves, steps, beside)
    if disorder is None:
        return tuple(_note_steps(points, numbers, steps, beside))
    if "steps" in options.accept:
        return (f"{disorder}; accepted",)
    raise CurveError(
        f"{disorder}. Points must follow each other from the entry to the tip: check their order, or accept it "
        "with --accept steps"
    )


def repair_radii(radius: Array | None, numbers: Index | None = None) -> tuple[Array | None, tuple[str, ...]]:
    """Return radii fit for use, None where they are unknown, and notes on what was repaired.

    radius: (n,) mm along one path, or None. numbers: (n,) of its points in the file, by default from 1. Zeros or
    NaN alone mean that it is unknown; at an end they take the neighbour's value. Raises CurveError for others.
    """
    if radius is None:
        return None, ()
    numbers = np.arange(1, len(radius) + 1) if numbers is None else numbers
    missing = np.isnan(radius) | (radius == 0)
    if missing.all():
        what = "zero" if not np.isnan(radius).any() else "missing"
        return None, (f"the lumen's radius is {what} at all points: it is taken as unknown",)
    known = np.flatnonzero(~missing)
    before, after = int(known[0]), len(radius) - 1 - int(known[-1])
    allowed = max(1, int(MAX_RADIUS_GAP_PART * len(radius)))
    bad: Flags = missing | ~np.isfinite(radius) | (radius < 0)
    notes = list[str]()
    repaired = radius.copy()
    for count, filled, source in (
        (before, slice(0, before), known[0]),
        (after, slice(known[-1] + 1, None), known[-1]),
    ):
        if 0 < count <= allowed:
            bad[filled] = False
            repaired[filled] = radius[source]
            where = list_numbers(numbers[filled])
            notes.append(
                f"the lumen's radius is missing at an end (point {where}): that of point {numbers[source]} is "
                "taken"
            )
    if bad.any():
        k = int(bad.argmax())
        raise CurveError(
            f"the lumen radius at point {numbers[k]} is {radius[k]:g}; radii must be positive finite numbers in mm"
        )
    return repaired, (*notes, *note_radii(repaired, "its unit, which must be that of the points"))


def note_radii(radius: Array, doubted: str) -> tuple[str, ...]:
    """Return a note where no radius (n,), mm, is one of a lumen that a robot enters, and nothing otherwise.

    doubted: what the note asks to check.
    """
    if MIN_LUMEN_RADIUS_MM <= radius.max() <= MAX_LUMEN_RADIUS_MM:
        return ()
    return (f"the lumen's radius is {radius.min():.3g} to {radius.max():.3g} mm; check {doubted}",)


def tidy_branch(branch: Branch, options: ReadOptions) -> tuple[Branch, tuple[str, ...]]:
    """Return a branch without repeated points and with repaired radii, and notes; raise CurveError for bad steps.

    branch: as it stands in the file, in mm. options: what a person states about the file.
    """
    check_coordinates(branch.points)
    distinct = drop_repeated_points(branch.points, branch.radius)
    steps = check_steps(distinct.points, options, distinct.numbers)
    radius, repaired = repair_radii(distinct.radius, distinct.numbers)
    notes = (*distinct.notes, *steps, *repaired)
    return replace(branch, points=distinct.points, radius=radius), notes


def widens(branch: Branch) -> bool:
    """Return whether the lumen of a branch is clearly wider at its end than at its beginning."""
    if branch.radius is None:
        return False
    count = max(1, round(END_PART * len(branch.radius)))
    return bool(branch.radius[-count:].mean() > WIDENS * branch.radius[:count].mean())


def list_numbers(numbers: Index) -> str:
    """Return numbers as text, at most five of them."""
    listed = ", ".join(str(number) for number in numbers[:5].tolist())
    return listed + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")


def _extent(points: Array) -> float:
    """Return the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0


def _fitting_unit(length: float, likely: tuple[float, float], doubted: str) -> str | None:
    """Return the unit other than `doubted` in which a length lies within bounds in mm, None where there is none.

    length: in the unit to be found. likely: the bounds.
    """
    others = ((unit, factor) for unit, factor in MM_PER_UNIT.items() if unit != doubted)
    fits = [unit for unit, factor in others if likely[0] <= length * factor <= likely[1]]
    return fits[0] if fits else None


def _unit_message(subject: str, length: float, units: str, fit: str | None, known: str) -> str:
    """Return the message on an implausible unit.

    subject: what was measured. length: in the file's unit. units: taken so far. fit: unit that fits better, or
    None. known: how `units` is known.
    """
    source = "the unit that the file states" if known == STATED else "assumed, since the file states no unit"
    message = f"{subject} {length:.3g} {units} ({source})"
    if fit is None:
        choices = "|".join(MM_PER_UNIT)
        return f"{message}, which is no size of a path in the body; state the unit with --units {choices}"
    return (
        f"{message}; in {fit} that would be {length * MM_PER_UNIT[fit]:.3g} mm, which fits better. State the unit "
        f"with --units {fit}, or --units {units} where that is right"
    )


def _neighbouring_steps(steps: Array) -> Array:
    """Return for each of `steps` (n,) the larger of the medians of those just before and just after it."""
    # Row k has the steps just before step k, row k + STEP_NEIGHBOURS + 1 those just after it; NaN beyond an end.
    padded = np.pad(steps, STEP_NEIGHBOURS, constant_values=np.nan)
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(padded, STEP_NEIGHBOURS), axis=1)
    count = np.maximum(np.isfinite(windows).sum(axis=1, keepdims=True), 1)
    # NaN is sorted to the end: the median is in the middle of the `count` values before it.
    middle = np.concatenate([(count - 1) // 2, count // 2], axis=1)
    medians = np.take_along_axis(windows, middle, axis=1).mean(axis=1)
    return np.asarray(np.fmax(medians[: len(steps)], medians[STEP_NEIGHBOURS + 1 :]))


def _offsets(points: Array) -> Array:
    """Return how far each of points (n, 3), n >= 4, is from the cubic through two points on either side, (n,) mm.

    Beyond an end there are none: the first and last two points have 0, but for a parabola through the next three.
    """
    count = len(points)
    found = np.zeros(count)
    if count >= 5:
        k = np.arange(2, count - 2)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        # Places along the path with the point itself left out, whose detour would lengthen it.
        across = np.linalg.norm(points[k + 1] - points[k - 1], axis=1)
        here = across * steps[k - 1] / (steps[k - 1] + steps[k])
        places = np.column_stack([-steps[k - 2], 0 * across, across, across + steps[k + 1]])
        found[k] = np.linalg.norm(
            _interpolate(places, points[k[:, None] + [-2, -1, 1, 2]], here) - points[k], axis=1
        )
    for order in (slice(None), slice(None, None, -1)):
        ends = points[order]
        gaps = np.linalg.norm(np.diff(ends[1:4], axis=0), axis=1)
        here = np.array([-np.linalg.norm(ends[1] - ends[0])])
        guess = _interpolate(np.array([[0.0, gaps[0], gaps.sum()]]), ends[None, 1:4], here)[0]
        # An extrapolated place is less certain than one between neighbours.
        found[order][0] = float(np.linalg.norm(guess - ends[0])) / 2
    return found


def _interpolate(places: Array, values: Array, at: Array) -> Array:
    """Return Lagrange's polynomials through values (n, m, 3) at places (n, m), evaluated at `at` (n,): (n, 3)."""
    total = np.zeros((len(values), 3))
    for i in range(places.shape[1]):
        weight = np.ones(len(values))
        for j in range(places.shape[1]):
            if j != i:
                weight = (
                    weight
                    * (at - places[:, j])
                    / np.where(places[:, i] == places[:, j], 1, places[:, i] - places[:, j])
                )
        total += weight[:, None] * values[:, i]
    return total


def _find_reversal(moves: Array, steps: Array) -> tuple[int, float] | None:
    """Return the index of the point at which a path runs back and its turn in degrees, None where there is none.

    moves: (n, 3) from point to point, mm. steps: their lengths (n,), mm.
    """
    cosines = (moves[:-1] * moves[1:]).sum(axis=1) / (steps[:-1] * steps[1:])
    back = (cosines < np.cos(np.radians(MAX_TURN_DEG))) & (np.minimum(steps[:-1], steps[1:]) > MIN_REVERSED_MM)
    if not back.any():
        return None
    k = int(np.where(back, cosines, 1.0).argmin())
    return k + 1, float(np.degrees(np.arccos(np.clip(cosines[k], -1.0, 1.0))))


def _describe_disorder(points: Array, numbers: Index, moves: Array, steps: Array, beside: Array) -> str | None:
    """Return what shows that points do not follow each other, None where nothing does.

    points: (n, 3) mm. numbers: (n,) in the file. moves: (n - 1, 3) from point to point. steps: their lengths.
    beside: lengths of the steps beside each.
    """
    usual = float(np.median(steps))
    # Where the last point is beside the first one, the points are in a ring, which is cut at its longest step.
    ring = float(np.linalg.norm(points[-1] - points[0])) <= MAX_RING_STEPS * usual
    # A step that is short in itself does no harm beside shorter ones, which files have where lines were joined.
    ratios = np.where(steps >= MIN_LONG_STEP_MM, steps / np.maximum(beside, REPEATED_POINT_MM), 0.0)
    k = int(ratios.argmax())
    if ratios[k] >= (MIN_RING_STEP_RATIO if ring else MAX_STEP_RATIO):
        ends = [f"{numbers[i]} {format_point(points[i].round(3))}" for i in (k, k + 1)]
        found = (
            f"points {ends[0]} and {ends[1]} are {steps[k]:.1f} mm apart, but their neighbours {beside[k]:.2g} mm"
        )
        if not ring:
            return f"{found}: points are missing or in another order, or several lines stand one after another"
        if k == len(steps) - 1:
            cause = "the last point lies before the first one: SlicerVMTK before 2024 saved the first point last"
        elif k == 0:
            cause = "the first point lies behind the last one, as if the last point had been saved first"
        else:
            cause = "the first point lies behind the last one: the points seem to begin in the middle of the path"
        return f"{found}: {cause}"
    back = _find_reversal(moves, steps)
    if back is None:
        return None
    at = f"point {numbers[back[0]]} {format_point(points[back[0]].round(3))}"
    return f"the path turns by {back[1]:.0f} degrees at {at}, so that it runs back along itself"


def _note_steps(points: Array, numbers: Index, steps: Array, beside: Array) -> list[str]:
    """Return notes on a step that is somewhat long, and on a point that lies beside the others.

    points: (n, 3) mm. numbers: (n,) in the file. steps: (n - 1,) from point to point, mm. beside: lengths of the
    steps beside each.
    """
    notes = list[str]()
    shortest, longest = np.percentile(steps, [10, 90])
    noted = NOTED_EVEN_STEP_RATIO if longest <= EVEN_STEPS * shortest else NOTED_STEP_RATIO
    ratios = np.where(steps >= beside + NOTED_STEP_EXCESS_MM, steps / np.maximum(beside, REPEATED_POINT_MM), 0.0)
    k = int(ratios.argmax())
    if ratios[k] >= noted:
        notes.append(
            f"points {numbers[k]} and {numbers[k + 1]} are {steps[k]:.1f} mm apart, their neighbours "
            f"{beside[k]:.2g}; the path between them is interpolated"
        )
    offsets = _offsets(points)
    i = int(offsets.argmax())
    around = NOTED_OFFSET_STEPS * float(np.median(steps)), NOTED_OFFSET_RATIO * float(np.median(offsets))
    if offsets[i] > max(NOTED_OFFSET_MM, *around):
        place = f"point {numbers[i]} {format_point(points[i].round(3))}"
        notes.append(f"{place} lies {offsets[i]:.1f} mm beside its neighbours, the others much less; check it")
    return notes
