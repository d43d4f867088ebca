"""Selection of the branch that a robot follows, and of the part of it between entry and target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

from ctr_nlp.anatomy.branch import (
    Branch,
    Branches,
    LumenMask,
    checked_point,
    format_point,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.files import is_markups, is_mask, list_files, read_branches
from ctr_nlp.anatomy.formats.slicer import find_pieces_beside
from ctr_nlp.anatomy.plausibility import WIDEST_AIRWAY_RADIUS_MM, note_radii, widens
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, GIVEN, NO_FACTS, FileFacts, ReadOptions
from ctr_nlp.anatomy.segmentation.widths import check_widths, find_leak
from ctr_nlp.exceptions import CurveError, OptionError, suggest_names
from ctr_nlp.paths.curve import Curve, curve_from_points
from ctr_nlp.paths.points import SHORTEST_MM
from ctr_nlp.typing import Array

UNKNOWN_LUMEN_MM = 5.0
"""How far from a branch without a radius a point may lie."""
SAME_TARGET_MM = 0.5
"""Branches lead to the same target that pass it as near as the nearest one, or so much farther."""
NEAREST_SEARCH_SPACING_MM = 0.25
"""Places along a curve among which the nearest one is looked for, before it is refined."""
MAX_LISTED_BRANCHES = 6
"""Largest number of branches that a message lists; `ctr-nlp branches` lists more of them in a table."""
MISTAKEN_COORDINATES: dict[str, tuple[float, float, float]] = {
    "With the signs of x and y exchanged it would: points and file seem to be one in RAS and one in LPS": (
        -1,
        -1,
        1,
    ),
    "With the sign of x exchanged it would: the file seems to be mirrored in x": (-1, 1, 1),
    "With the sign of y exchanged it would: the file seems to be mirrored in y": (1, -1, 1),
    "With the sign of z exchanged it would: the file seems to be mirrored in z": (1, 1, -1),
    "Ten times as large it would: points seem to be in cm": (10, 10, 10),
    "A thousand times as large it would: points seem to be in m": (1000, 1000, 1000),
}
"""Likely mistakes in the coordinates of points, and the factors on x, y and z that undo them."""
NOTED_END_GAP_MM = 0.5
"""A path is noted that ends farther before the target, or begins farther after the entry."""


@dataclass(frozen=True)
class BranchSegment:
    """A branch and the part of it that is followed.

    branch: the whole branch, in LPS. start, stop: arc lengths between which it is followed, mm. to_lps: transform
    (4, 4) from the file's coordinates to LPS. space: name of the file's coordinates, as in Branches. whole: the
    points and radii of the branch. facts: what its reader found out about the file. mask: the lumen's voxels,
    where the file is a mask.
    """

    branch: Curve
    start: float
    stop: float
    to_lps: Array
    space: str
    whole: Branch
    facts: FileFacts = NO_FACTS
    mask: LumenMask | None = None

    @property
    def followed_path(self) -> Curve:
        """The part that is followed."""
        return self.branch.part(self.start, self.stop)


def read_branch_segment(
    path: str | Path,
    branch: str | int | None = None,
    entry: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
    reverse: bool = False,
    options: ReadOptions = AS_THE_FILE_SAYS,
    pieces: Sequence[str | Path] = (),
) -> BranchSegment:
    """Read the part of a branch of a file from entry to target.

    path: the file. branch: name of the branch, or its number from 1. entry, target: (3,) mm in the file's own
    coordinates, by default the ends of the branch. reverse: whether the file's lines run from the tip to the root.
    options: what a person states about the file. pieces: further files with pieces of the same tree. Between entry
    and target a mask has one branch, without `branch`; otherwise its branches are those of its tree. Raises
    CurveError and OptionError.
    """
    between = False
    if is_mask(path):
        for option, value in (("reverse", reverse or None), ("pieces", pieces or None)):
            if value is not None:
                raise OptionError(
                    f"{option} does not go with a mask, as {path} is one: its paths lead from the entry to ends"
                )
        branches = read_branches(path, entry, target if branch is None else None, options)
        # Paths in a mask begin where the robot enters; that between two points ends at the target, too.
        between = branch is None and entry is not None and target is not None
        entry, target = None, None if between else target
    else:
        # In a file whose lines run towards the root, the target is where its trees start.
        branches = read_branches(path, target if reverse else entry, options=options, pieces=pieces)
        if entry is None and not reverse and is_markups(path):
            _refuse_lone_piece(path, branches)
    if reverse:
        branches = branches.reverse_direction()
    with name_source_in_errors(path):
        try:
            found = select_branch(branches, None if branch is None else str(branch), entry, target)
        except CurveError as error:
            hints = [note for note in branches.facts.notes if "--pieces" in note]
            raise CurveError("; ".join([str(error), *hints])) from error
        curve = curve_from_points(found.points, found.radius)
        start, stop = find_extent(curve, branches, entry, target)
        if stop - start < SHORTEST_MM:
            raise CurveError(
                f"from entry to target the path is {stop - start:.3g} mm long; it must be at least "
                f"{SHORTEST_MM:g} mm"
            )
    facts = replace(branches.facts, notes=(*branches.facts.notes, *_end_notes(curve, branches, entry, target)))
    if widens(found) and not reverse and (entry is None or target is None) and not is_mask(path):
        note = "the lumen widens along the path, as if it ran from a tip to the root; --reverse exchanges its ends"
        facts = replace(facts, notes=(*facts.notes, note))
    if is_mask(path) and found.radius is not None:
        facts = replace(facts, notes=(*facts.notes, *note_radii(found.radius, "the unit of the file (--units)")))
    if curve.radius is not None:
        s = np.linspace(start, stop, max(2, int(stop - start) + 1))
        points = transform_points(curve.point(s), branches.from_lps)
        if not is_mask(path):
            leak = find_leak(points, curve.radius(s))
            facts = replace(facts, notes=(*facts.notes, *([] if leak is None else [leak.partition(";")[0]])))
        elif not between:
            # That between two points is checked where it is found.
            with name_source_in_errors(path):
                facts = replace(facts, notes=(*facts.notes, *check_widths(points, curve.radius(s), options)))
    return BranchSegment(
        curve, start, stop, branches.to_lps, branches.space, found, facts=facts, mask=branches.mask
    )


def _end_notes(
    curve: Curve, branches: Branches, entry: npt.ArrayLike | None, target: npt.ArrayLike | None
) -> list[str]:
    """Return notes where a branch begins after the entry or ends before the target, as in a file cut short.

    curve: the branch, in LPS. branches: those of its file. entry, target: (3,) mm in the file's coordinates.
    """
    notes = []
    ends = (("entry", entry, 0.0, "begins {} mm after"), ("target", target, curve.length, "ends {} mm before"))
    for name, point, end, phrase in ends:
        if point is None:
            continue
        at = transform_points(checked_point(name, point), branches.to_lps)
        away = at - curve.point(np.array([end]))[0]
        tangent = curve.tangent(np.array([end]))[0]
        beyond = float(away @ tangent) * (1 if name == "target" else -1)
        if beyond > NOTED_END_GAP_MM:
            notes.append(f"the path {phrase.format(f'{beyond:.1f}')} the {name} that was given")
    return notes


def _refuse_lone_piece(path: str | Path, branches: Branches) -> None:
    """Raise CurveError where a file beside `path` ends where its only branch begins: a piece of a tree.

    branches: of the file at `path`.
    """
    if len(branches.branches) > 1:
        return
    before, _ = find_pieces_beside(path, branches)
    if before:
        start = format_point(transform_points(branches.branches[0].points[0], branches.from_lps).round(2))
        raise CurveError(
            f"{path} is a piece of a tree: it begins at {start}, on the curve of {list_files(before)}, so that "
            "the robot would enter in the middle of the tree. Give the other pieces too (--pieces FILE ...), or "
            "the point where the robot enters (--entry X Y Z) if it is this one"
        )


def select_branch(
    branches: Branches,
    branch: str | None = None,
    entry: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
) -> Branch:
    """Return the whole branch that is meant; `find_extent` locates entry and target along it.

    branches: those of the file. branch: its number from 1 or its name; without it, the branch nearest to target,
    or the only one. entry, target: points (3,) in mm, in the file's own coordinates. Raises CurveError where there
    is no such branch, none is named, or a point lies outside of the branch's lumen (5 mm where that is unknown).
    """
    points = {
        name: checked_point(name, at) for name, at in (("entry", entry), ("target", target)) if at is not None
    }
    lps = {name: transform_points(at, branches.to_lps) for name, at in points.items()}
    if branch is not None:
        found = _find_branch_named(branches, branch)
    elif len(branches.branches) == 1:
        found = branches.branches[0]
    elif target is not None:
        found = min(branches.branches, key=lambda each: _distance(each, lps["target"])[0])
        _check_one_way(branches, found, lps)
    else:
        raise CurveError(
            f"there are {len(branches.branches)} branches, {describe_branches(branches)}; choose one by number "
            "or name (--branch), or by a target point on it in the file's coordinates (--target)"
        )
    for name, at in lps.items():
        distance, lumen = _distance(found, at)
        if distance > lumen:
            raise CurveError(
                f"{name} {format_point(points[name])} is {distance:.1f} mm away from branch {found.name!r}; it "
                f"must lie in its lumen, within {lumen:.1f} mm, and be given in mm in the file's coordinates, "
                f"{branches.space}"
                + (
                    _doubt_units(branches, lumen)
                    or _suggest_coordinates(branches.branches if branch is None else (found,), branches, points)
                )
            )
    return found


def _check_one_way(branches: Branches, found: Branch, ends: dict[str, Array]) -> None:
    """Raise CurveError where another branch leads to the target, too, and by another way, as round a loop.

    branches: those of the file. found: the one nearest to the target. ends: "target" and perhaps "entry", (3,) mm
    in LPS.
    """
    away, _ = _distance(found, ends["target"])
    tree = cKDTree(found.points)
    for number, other in enumerate(branches.branches, start=1):
        if other is found or _distance(other, ends["target"])[0] > away + SAME_TARGET_MM:
            continue
        last = int(np.linalg.norm(other.points - ends["target"], axis=1).argmin())
        first = 0
        if "entry" in ends:
            first = int(np.linalg.norm(other.points - ends["entry"], axis=1).argmin())
        way = other.points[min(first, last) : last + 1]
        apart, nearest = tree.query(way)
        lumen = UNKNOWN_LUMEN_MM if found.radius is None else found.radius[nearest]
        if (apart > lumen).any():
            numbers = " and ".join(
                f"{k} {each.name!r} ({each.length:.1f} mm)"
                for k, each in enumerate(branches.branches, start=1)
                if each is found or k == number
            )
            raise CurveError(
                f"branches {numbers} both lead to the target, by ways up to {apart.max():.1f} mm apart: one of "
                "them takes a false connection; look at them (ctr-nlp branches FILE --out FILE.png) and choose "
                "with --branch"
            )


def find_extent(
    curve: Curve, branches: Branches, entry: npt.ArrayLike | None = None, target: npt.ArrayLike | None = None
) -> tuple[float, float]:
    """Return the arc lengths in mm of a branch at which it is nearest to entry and to target.

    curve: the branch, in LPS. branches: those of its file, for the transform. entry, target: (3,) mm in the file's
    own coordinates, by default the curve's ends. Raises CurveError where target does not come after entry.
    """
    start, stop = (
        end if point is None else _nearest(curve, transform_points(checked_point(name, point), branches.to_lps))
        for name, point, end in (("entry", entry, 0.0), ("target", target, curve.length))
    )
    if start >= stop:
        raise CurveError(
            f"the branch passes its target at {stop:.1f} mm and its entry at {start:.1f} mm; it must enter first: "
            "exchange the points, or reverse the branch"
        )
    return start, stop


def describe_branches(branches: Branches) -> str:
    """Return numbers, names and lengths of branches as text, of many the numbers alone."""
    count = len(branches.branches)
    if count > MAX_LISTED_BRANCHES:
        return f"1 to {count}, which `ctr-nlp branches` lists"
    entries = [f"{k} {each.name!r} ({each.length:.1f} mm)" for k, each in enumerate(branches.branches, start=1)]
    return ", ".join(entries)


def _find_branch_named(branches: Branches, branch: str) -> Branch:
    every = branches.branches
    if branch.strip().isdecimal() and 1 <= int(branch) <= len(every):
        return every[int(branch) - 1]
    same = [each for each in every if each.name == branch]
    if len(same) == 1:
        return same[0]
    problem = f"{len(same)} branches have that name" if same else "there is none of that name or number"
    meant = "" if same else suggest_names(branch, [each.name for each in every])
    raise CurveError(f"branch is {branch!r}; {problem}: {describe_branches(branches)}{meant}")


def _distance(branch: Branch, point: Array) -> tuple[float, float]:
    """Return the distance in mm of a point (3,) from the polyline through a branch's points, and the lumen's
    radius there.
    """
    start = branch.points[:-1]
    step = np.diff(branch.points, axis=0)
    # Foot of the perpendicular on every segment, as a part of its length, clipped to the segment.
    part = np.clip(((point - start) * step).sum(axis=1) / (step**2).sum(axis=1), 0, 1)
    distances = np.linalg.norm(start + part[:, None] * step - point, axis=1)
    k = int(distances.argmin())
    if branch.radius is None:
        return float(distances[k]), UNKNOWN_LUMEN_MM
    return float(distances[k]), float(branch.radius[k] + part[k] * (branch.radius[k + 1] - branch.radius[k]))


def _doubt_units(branches: Branches, lumen: float) -> str:
    """Return a sentence on the unit of a file where the lumen's radius, mm, is no airway's; else nothing."""
    if lumen <= WIDEST_AIRWAY_RADIUS_MM:
        return ""
    given = branches.facts.units_known == GIVEN
    seems = (
        f"the file does not seem to be in {branches.facts.units}, as --units says" if given else "check --units"
    )
    return f". No airway has a radius of more than {WIDEST_AIRWAY_RADIUS_MM:g} mm: {seems}"


def _suggest_coordinates(candidates: Sequence[Branch], branches: Branches, points: Mapping[str, Array]) -> str:
    """Return what to do to points so that all of them lie in the lumen of a branch, empty where nothing helps.

    candidates: the branch that was chosen, or all of them; the one nearest to mistaken points is any of them.
    branches: those of the file. points: entry and target (3,), as they were given.
    """
    for what, factors in MISTAKEN_COORDINATES.items():
        tried = [transform_points(point * np.array(factors), branches.to_lps) for point in points.values()]
        for candidate in candidates:
            if all(distance <= lumen for distance, lumen in (_distance(candidate, point) for point in tried)):
                return f". {what}"
    return ""


def _nearest(curve: Curve, point: Array) -> float:
    """Return the arc length in mm where a curve is nearest to a point (3,)."""

    def distance(s: npt.ArrayLike) -> Array:
        return np.asarray(np.linalg.norm(curve.point(np.atleast_1d(s)) - point, axis=1))

    places = np.linspace(0, curve.length, max(2, int(np.ceil(curve.length / NEAREST_SEARCH_SPACING_MM)) + 1))
    k = int(distance(places).argmin())
    # The distance has several minima along a bent path. The nearest sample is beside the right one, and the search
    # is confined to its two neighbours.
    bounds = places[max(k - 1, 0)], places[min(k + 1, len(places) - 1)]
    refined = minimize_scalar(lambda s: float(distance(s)[0]), bounds=bounds, method="bounded")
    return float(min((places[k], refined.x), key=lambda s: float(distance(s)[0])))
