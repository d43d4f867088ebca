"""Pieces of a tree that meet, joined to paths from its root to its tips.

3D Slicer's Extract Centerline writes one curve for each piece between bifurcations, each from the root's side to
the tip's. A piece belongs to the one whose end, or whose side, it begins at. Where pieces run in different
directions, only the rules of formats/network.py find the root.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ctr_nlp.anatomy.branch import Branch, check_points
from ctr_nlp.anatomy.formats.network import CentrelineNetwork
from ctr_nlp.anatomy.plausibility import tidy_branch, widens
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.typing import Array

MEETING_STEPS, MEETING_MM = 1.5, (0.5, 3.0)
"""Pieces meet that are at most so many steps between their points apart, within bounds in mm."""
SAME_ENTRY_MM = 10.0
"""Paths that begin so near to each other have one entry, and none begins on the side of the other."""
NEAR_MISS_MM = 10.0
"""A piece that begins so near to the end of another, but does not meet it, is noted."""
MAX_LISTED_PIECES = 6


UNDIRECTED_NOTE = (
    "{} pieces that meet in different directions were joined to {} branches, from the end that is the widest or "
    "the nearest to the entry"
)


@dataclass(frozen=True)
class Meeting:
    """Where a piece begins: at point `point` of piece `parent`, both counted from 0, `distance` mm away."""

    parent: int
    point: int
    distance: float


def join_pieces(
    pieces: Sequence[Branch], options: ReadOptions, entry: Array | None = None
) -> tuple[list[Branch], tuple[str, ...]]:
    """Return the paths from roots to tips of pieces that meet, and notes; other pieces stay as they are.

    pieces: as they stand in the file, in LPS. options: what a person states about the file. entry: (3,) mm in LPS,
    which settles where a tree starts whose pieces run in different directions. A joined path has the name of its
    last piece. Raises CurveError where points do not follow each other, or where pieces form a loop.
    """
    several = len(pieces) > 1
    notes = list[str]()
    tidy = list[Branch]()
    for piece in pieces:
        found, more = tidy_branch(piece, options)
        notes += [f"{piece.name}: {note}" if several else note for note in more]
        if several and len(found.points) < 2:
            notes.append(f"{piece.name}: left out, it has {len(found.points)} points")
        else:
            tidy.append(found)
    if len(tidy) < 2:
        return tidy or [tidy_branch(piece, options)[0] for piece in pieces], tuple(notes)
    for piece in tidy:
        check_points(piece.points)
    meetings = [find_meeting(tidy, k) for k in range(len(tidy))]
    if _directions_differ(tidy, meetings):
        branches = _join_undirected(tidy, entry)
        return branches, (*notes, UNDIRECTED_NOTE.format(len(tidy), len(branches)))
    routes = [_route(meetings, k) for k in range(len(tidy))]
    continued = {at.parent for at in meetings if at is not None and at.point >= len(tidy[at.parent].points) - 1}
    branches = [_join_route(tidy, meetings, route) for k, route in enumerate(routes) if k not in continued]
    if any(at is not None for at in meetings):
        if any(widens(branch) for branch in branches):
            # A path that widens seems to run towards the root, although its pieces follow each other.
            with suppress(CurveError):
                turned = _join_undirected(tidy, entry)
                return turned, (*notes, UNDIRECTED_NOTE.format(len(tidy), len(turned)))
        tips = [route for route in routes if len(route) > 1 and route[-1] not in continued]
        listed = "; ".join(" + ".join(tidy[k].name for k in route) for route in tips[:MAX_LISTED_PIECES])
        others = f" and {len(tips) - MAX_LISTED_PIECES} more" if len(tips) > MAX_LISTED_PIECES else ""
        notes.append(f"pieces that meet were joined: {listed}{others}")
    notes += _near_misses(tidy, meetings)
    return branches, tuple(notes)


def find_meeting(pieces: Sequence[Branch], number: int) -> Meeting | None:
    """Return where a piece begins on another one; None where it begins on none.

    pieces: all of them. number: of the piece, from 0. A piece that begins where another one begins, too, does not
    begin on it.
    """
    start = pieces[number].points[0]
    found: list[Meeting] = []
    for k, other in enumerate(pieces):
        if k == number:
            continue
        limit = meeting_distance(pieces[number], other)
        away = np.linalg.norm(other.points - start, axis=1)
        if away.min() > limit or away[0] <= min(limit, away[-1]):
            continue
        # An end counts before the points beside it, which are as near where points are dense.
        point = len(away) - 1 if away[-1] <= max(away.min(), MEETING_MM[0]) else int(away.argmin())
        if point == len(away) - 1 or away[0] > SAME_ENTRY_MM:
            found.append(Meeting(k, point, float(away[point])))
    return min(found, key=lambda at: at.distance, default=None)


def meeting_distance(one: Branch, other: Branch) -> float:
    """Return the largest distance in mm at which two pieces meet: `one` and `other`, of two or more points."""
    step = max(float(np.median(np.linalg.norm(np.diff(each.points, axis=0), axis=1))) for each in (one, other))
    return float(np.clip(MEETING_STEPS * step, *MEETING_MM))


def _directions_differ(pieces: Sequence[Branch], meetings: Sequence[Meeting | None]) -> bool:
    """Return whether some pieces run against the others: one ends where another ends or on its side, or three
    begin at one place and lead to different sides. Two that do so may be branches, but not if one of them widens.

    pieces: all of them. meetings: of each one, where it begins.
    """
    for k, one in enumerate(pieces):
        beside = [one]
        for j, other in enumerate(pieces):
            if j == k:
                continue
            limit = meeting_distance(one, other)
            to_end = np.linalg.norm(other.points - one.points[-1], axis=1)
            if to_end[-1] <= limit or (to_end.min() <= MEETING_MM[0] and to_end[0] > limit):
                return True
            if np.linalg.norm(one.points[0] - other.points[0]) <= limit:
                beside.append(other)
        if meetings[k] is None and (len(beside) > 2 or len({widens(each) for each in beside}) > 1):
            headings = np.array([each.points[min(len(each.points) - 1, 4)] - each.points[0] for each in beside])
            if (headings @ headings.T < 0).any():
                return True
    return False


def _join_undirected(pieces: Sequence[Branch], entry: Array | None) -> list[Branch]:
    """Return the paths from the root to the tips of pieces whose directions do not tell the root.

    pieces: all of them. entry: (3,) mm in LPS, or None. Raises CurveError where the root is not clear.
    """
    offsets = np.cumsum([0, *(len(piece.points) for piece in pieces)])
    points = np.concatenate([piece.points for piece in pieces])
    owner = np.repeat(np.arange(len(pieces)), [len(piece.points) for piece in pieces])
    lines = []
    moved = points.copy()
    for k, piece in enumerate(pieces):
        lines.append(np.arange(offsets[k], offsets[k + 1]))
        for end in (offsets[k], offsets[k + 1] - 1):
            for j in range(k):
                away = np.linalg.norm(points[offsets[j] : offsets[j + 1]] - points[end], axis=1)
                if away.min() <= meeting_distance(piece, pieces[j]):
                    # The network merges points in one place.
                    moved[end] = moved[offsets[j] + int(away.argmin())]
                    break
    known = all(piece.radius is not None for piece in pieces)
    radius = np.concatenate([piece.radius for piece in pieces if piece.radius is not None]) if known else None
    paths = CentrelineNetwork(moved, radius, tuple(lines)).paths(entry)
    return [
        Branch(pieces[owner[path[-1]]].name, moved[path], None if radius is None else radius[path])
        for path in paths
    ]


def _route(meetings: Sequence[Meeting | None], number: int) -> list[int]:
    """Return the pieces from a root to piece `number`; raise CurveError where they go round.

    meetings: of each piece, where it begins.
    """
    route = [number]
    while (at := meetings[route[0]]) is not None:
        if at.parent in route:
            raise CurveError("its curves form a loop: each begins where another one ends; remove one of them")
        route.insert(0, at.parent)
    return route


def _join_route(pieces: Sequence[Branch], meetings: Sequence[Meeting | None], route: Sequence[int]) -> Branch:
    """Return one path along the pieces of a route, with the name of the last one.

    pieces: all of them. meetings: where each begins. route: numbers of pieces, from the root's on.
    """
    branch = pieces[route[0]]
    shift = 0
    for number in route[1:]:
        piece = pieces[number]
        at = meetings[number]
        assert at is not None
        # The parent's point beside the first one of the piece is left out: the path would go back to it.
        stop = shift + at.point + (at.distance > MEETING_MM[0])
        points = np.vstack([branch.points[:stop], piece.points])
        radius = None
        if branch.radius is not None and piece.radius is not None:
            radius = np.concatenate([branch.radius[:stop], piece.radius])
        branch = Branch(piece.name, points, radius)
        shift = stop
    return branch


def _near_misses(pieces: Sequence[Branch], meetings: Sequence[Meeting | None]) -> list[str]:
    """Return notes on pieces that begin near the end of another one and were not joined to it.

    pieces: all of them. meetings: where each begins.
    """
    notes = []
    for k, piece in enumerate(pieces):
        if meetings[k] is not None:
            continue
        for other in pieces:
            gap = float(np.linalg.norm(piece.points[0] - other.points[-1]))
            if other is not piece and gap <= NEAR_MISS_MM:
                notes.append(
                    f"{piece.name!r} begins {gap:.1f} mm from the end of {other.name!r}, and is not joined to it"
                )
                break
    return notes
