"""Paths from a root to the tips, from lines through shared points as centreline files contain them.

Lines that share an end and leave it to the same side are whole: each is a path already, and that end the root.
VMTK writes centrelines so, and they need not meet on the trunk. Any other lines are pieces of trees, cut where
branches part or anywhere else, down to two points a piece. A piece with nothing beside it runs as it is given.
The root of a tree is the end whose first stretch, up to where branches part, is wider on average than any
other's by a tenth; failing that, the end from which all pieces lead away, or to which all of them lead; failing
that, the end nearest to where the caller enters. For a tree without branches the direction of its pieces counts
first.

Where a false connection closes a loop, tips on one side of it have one path; to tips beyond it both ways round are
paths, and a note names the loop. Nothing here decides which of them is right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from ctr_nlp.anatomy.branch import format_point
from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

Indices = npt.NDArray[np.intp]

SAME_MM = 1e-3
"""Points closer than this are one: files repeat a point where lines meet, rounded to single precision."""
CELLS_PER_SAME_MM = 100
"""Points are first rounded to cells of this part of SAME_MM: trunks are shared by hundreds of lines, and pairs of
their points would be too many."""
LINE_HEADING_MM = 5.0
"""Lines that share an end are compared over this first length."""
MIN_ROOT_WIDTH_RATIO = 1.1
"""Factor by which a tree is at least wider at its root than at any other end."""
NARROW_LOOP_RADII, NARROW_LOOP_MM = 0.5, 0.5
"""Both ways round a loop are one path where they are at most so far apart: in radii of the lumen, or in mm where
these are unknown."""
MAX_WAYS = 8
"""Most paths to one tip; where loops leave more, there is none."""
MIN_FALSE_TURN_DEG, TURN_RATIO, SPACING_RATIO, STRAIGHT_POINTS, STRAIGHT_DEG = 25.0, 4.0, 1.5, 6, 1.0
"""A straight line that someone, or some program, drew from one branch to another: the path turns at one point by
more than the first number and so many times more than at most others, its points have another spacing from there
on, and lie on a straight line at first."""


@dataclass(frozen=True)
class NetworkPaths:
    """Paths through a network, lists of indices of its points, and notes on it: sentences, without a full stop."""

    paths: list[Indices]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class CentrelineNetwork:
    """Points (n, 3) in mm, the lumen's radius (n,) in mm or None, and the lines over them, lists of indices.

    Radii that are 0 or NaN are not known.
    """

    points: Array
    radius: Array | None
    lines: tuple[Indices, ...]

    def paths(self, entry: Array | None = None) -> list[Indices]:
        """Return the paths from each root to its tips, by the rules above; entry: (3,) mm. Raises CurveError."""
        return self.find_paths(entry).paths

    def find_paths(self, entry: Array | None = None) -> NetworkPaths:
        """Return the paths from each root to its tips, by the rules above, and notes on what was left out.

        entry: (3,) mm, where the robot enters, or None. Raises CurveError.
        """
        joined = self._merge_repeated_points()
        if not joined.lines:
            raise CurveError("it holds no line of two or more points")
        notes = list[str]()
        single = sum(len(set(line.tolist())) == 1 for line in self.lines)
        if single:
            notes.append(f"left out {'a line' if single == 1 else f'{single} lines'} of a single point")
        paths = list[Indices]()
        for lines in joined._connected_lines():
            network = replace(joined, lines=lines)
            whole = network._complete_paths()
            if whole:
                distinct = list({line.tobytes(): line for line in whole}.values())
                if len(distinct) < len(whole):
                    notes.append(f"left out {len(whole) - len(distinct)} lines that repeat another one")
                paths += distinct
            else:
                found = Tree(network).to_tips(entry)
                paths += found.paths
                notes += found.notes
        notes += self._note_false_connections(paths)
        return NetworkPaths(paths, tuple(notes))

    def _merge_repeated_points(self) -> CentrelineNetwork:
        """Return the network with one index for points in the same place, and no line of a single point."""
        _, some, cell = np.unique(
            np.rint(self.points * (CELLS_PER_SAME_MM / SAME_MM)), axis=0, return_index=True, return_inverse=True
        )
        pairs = cKDTree(self.points[some]).query_pairs(SAME_MM, output_type="ndarray")
        _, place = connected_components(_adjacency(pairs, len(some)), directed=False)
        place = place[cell.ravel()]
        # A place is called by the first of its points.
        first = np.full(place.max(initial=-1) + 1, len(self.points))
        np.minimum.at(first, place, np.arange(len(place)))
        merged = first[place]
        lines = [merged[line] for line in self.lines]
        lines = [line[np.append(True, line[1:] != line[:-1])] for line in lines]
        return replace(self, lines=tuple(line for line in lines if len(line) > 1))

    def _connected_lines(self) -> list[tuple[Indices, ...]]:
        """Return the lines in groups that share points, in the order of the file."""
        _, part = connected_components(_adjacency(_edges(self.lines), len(self.points)), directed=False)
        groups: dict[int, list[Indices]] = {}
        for line in self.lines:
            groups.setdefault(int(part[line[0]]), []).append(line)
        return [tuple(lines) for lines in groups.values()]

    def _complete_paths(self) -> list[Indices]:
        """Return the lines, directed away from their common end; an empty list where they are pieces of trees."""
        if any(line[0] == line[-1] for line in self.lines):
            return []
        if len(self.lines) == 1:
            return list(self.lines)
        shared = set.intersection(*({int(line[0]), int(line[-1])} for line in self.lines))
        for root in sorted(shared, key=lambda end: -sum(line[0] == end for line in self.lines)):
            away = [line if line[0] == root else line[::-1] for line in self.lines]
            headings = np.array([self._heading(line) for line in away])
            # Within 90 degrees of each other: the lines run down the same trunk, side by side. Pieces that meet at
            # a bifurcation point to different sides.
            if (headings @ headings.T > 0).all():
                return away
        return []

    def _heading(self, line: Indices) -> Array:
        """Return the unit vector (3,) of a line over its first LINE_HEADING_MM."""
        offsets = self.points[line] - self.points[line[0]]
        far = np.flatnonzero(np.linalg.norm(offsets, axis=1) >= LINE_HEADING_MM)
        offset = offsets[far[0] if far.size else -1]
        return np.asarray(offset / max(np.linalg.norm(offset), SAME_MM))

    def _note_false_connections(self, paths: list[Indices]) -> list[str]:
        """Return notes on straight lines that seem to have been drawn from one branch to another."""
        found: dict[int, str] = {}
        for number, path in enumerate(paths, start=1):
            turn = _find_false_turn(self.points[path])
            if turn is not None and int(path[turn[0]]) not in found:
                k, degrees = turn
                place = format_point(self.points[path[k]].round(2))
                found[int(path[k])] = (
                    f"branch {number} turns by {degrees:.0f} degrees at {place}, and the points beside it lie on "
                    "a straight line at another distance: this may be a false connection between two branches"
                )
        return list(found.values())


class Tree:
    """Connected pieces of a network, directed as its lines are; where loops are closed, no tree in truth."""

    def __init__(self, network: CentrelineNetwork) -> None:
        self._network = network
        # Points are counted anew, from 0 on, so that no array is longer than this tree.
        self._points, numbers = np.unique(_edges(network.lines), return_inverse=True)
        directed = numbers.reshape(-1, 2)
        self._edges = directed[directed[:, 0] != directed[:, 1]]
        self._graph = _adjacency(self._edges, len(self._points))
        self._degree = np.diff(self._graph.indptr)
        self._ends = np.flatnonzero(self._degree == 1)
        if not self._ends.size:
            raise CurveError("its lines form a loop without an end; they must lead from a root to tips")
        if len(self._ends) == 1:
            raise CurveError("its lines form a loop with one end; they must lead from a root to tips")

    def to_tips(self, entry: Array | None) -> NetworkPaths:
        """Return the paths from the root to the other ends, these in the order of their points.

        entry: (3,) mm, where the robot enters, or None; decides between ends where no rule finds the root.
        """
        root = self._root(entry)
        _, before = breadth_first_order(self._graph, root, directed=False)
        tips = [int(tip) for tip in self._ends if tip != root]
        routes = {tip: _walk_back(before, tip) for tip in tips}
        if self._graph.nnz == 2 * (len(self._points) - 1):
            return NetworkPaths([self._points[route] for route in routes.values()])
        paths = list[Indices]()
        notes: dict[str, None] = {}
        left_out = 0
        for route in routes.values():
            ways, found = self._ways(route)
            paths += [self._points[way] for way in ways]
            notes.update(dict.fromkeys(found))
            left_out += not ways
        if left_out:
            what = "a tip that has" if left_out == 1 else f"{left_out} tips that have"
            notes[f"left out {what} no clear path: several loops lie before it"] = None
        if not paths:
            raise CurveError(
                "its lines form a loop before every tip, so that no path is clear: "
                f"{'; '.join(notes)}; remove the false connections"
            )
        return NetworkPaths(paths, tuple(notes))

    @cached_property
    def _loops(self) -> list[Any]:
        """Parts of the graph, sets of points, within which more than one way leads from point to point."""
        networkx = import_extra("networkx")
        graph = networkx.Graph(self._edges.tolist())
        return [graph.subgraph(part).copy() for part in networkx.biconnected_components(graph) if len(part) > 2]

    def _ways(self, route: Indices) -> tuple[list[Indices], list[str]]:
        """Return all paths that lead where a route leads, none where loops make them too many; and notes.

        route: points of this tree.
        """
        stretches: list[list[Indices]] = []
        notes = []
        done = 0
        inside = {}
        for number, loop in enumerate(self._loops):
            places = [k for k, point in enumerate(route.tolist()) if point in loop]
            if len(places) > 1:
                inside[places[0]] = (places[-1], number)
        for first, (last, number) in sorted(inside.items()):
            ways = self._arcs(number, int(route[first]), int(route[last]))
            stretches.append([route[done:first]])
            ends = " and ".join(self._place(int(route[k])) for k in (first, last))
            if not ways:
                notes.append(f"the lines form several loops between {ends}")
                return [], notes
            if len(ways) == 1:
                notes.append(f"the lines form a narrow loop between {ends}; the shorter way is taken")
            else:
                lengths = " and ".join(f"{self._length(way):.1f}" for way in ways)
                notes.append(
                    f"the lines form a loop between {ends}, {lengths} mm long: one side of it is a false "
                    "connection; both ways lead to tips beyond it"
                )
            stretches.append([way[:-1] for way in ways])
            done = last
        stretches.append([route[done:]])
        if np.prod([len(each) for each in stretches]) > MAX_WAYS:
            return [], notes
        return [np.concatenate(parts) for parts in product(*stretches)], notes

    @cached_property
    def _found_arcs(self) -> dict[tuple[int, int, int], list[Indices]]:
        """Ways that were found, by number of the loop, start and stop: many routes pass the same loop."""
        return {}

    def _arcs(self, number: int, start: int, stop: int) -> list[Indices]:
        """Return the ways from one point of a loop to another, the shorter one first; one where they hardly
        differ, none where the loop is no simple one.

        number: of the loop. start, stop: points of it.
        """
        asked = number, start, stop
        if asked not in self._found_arcs:
            self._found_arcs[asked] = self._find_arcs(*asked)
        return self._found_arcs[asked]

    def _find_arcs(self, number: int, start: int, stop: int) -> list[Indices]:
        """Find what `_arcs` returns; number: of the loop. start, stop: points of it."""
        loop = self._loops[number]
        if loop.number_of_edges() != loop.number_of_nodes():
            return []
        networkx = import_extra("networkx")
        ways = []
        for first in list(loop[start]):
            other = loop.copy()
            other.remove_edges_from([(start, each) for each in loop[start] if each != first])
            ways.append(np.array(networkx.shortest_path(other, start, stop)))
        ways.sort(key=self._length)
        one, two = (self._network.points[self._points[way]] for way in ways)
        apart = max(cKDTree(a).query(b)[0].max() for a, b in ((one, two), (two, one)))
        radius = self._network.radius
        narrow = NARROW_LOOP_MM
        if radius is not None:
            known = radius[self._points[ways[0]]]
            known = known[known > 0]
            narrow = NARROW_LOOP_RADII * float(known.min()) if known.size else narrow
        return ways[:1] if apart <= narrow else ways

    def _length(self, way: Indices) -> float:
        steps = np.diff(self._network.points[self._points[way]], axis=0)
        return float(np.linalg.norm(steps, axis=1).sum())

    def _place(self, point: int) -> str:
        return format_point(self._network.points[self._points[point]].round(2))

    def _root(self, entry: Array | None) -> int:
        rules: list[Callable[[], int | None]] = [self._widest, self._source]
        # A tree without branches has two ends, whose widths differ little: there the direction of its lines counts
        # first.
        for rule in rules if len(self._ends) > 2 else reversed(rules):
            root = rule()
            if root is not None:
                return root
        if entry is None:
            raise CurveError(
                f"where its lines start is not clear: none of their {len(self._ends)} ends is the widest by a "
                "tenth, nor do all of them lead away from one end; give the point where the robot enters"
            )
        ends = self._network.points[self._points[self._ends]]
        return int(self._ends[np.linalg.norm(ends - entry, axis=1).argmin()])

    def _widest(self) -> int | None:
        """Return the end whose first stretch is clearly the widest; None where there is none or no radius."""
        radius = self._network.radius
        if radius is None:
            return None
        known = np.where(radius > 0, radius, np.nan)[self._points]
        stretches = [known[self._stretch(int(end))] for end in self._ends]
        widths = np.array([np.nanmean(each) if np.isfinite(each).any() else 0.0 for each in stretches])
        order = widths.argsort()
        return (
            int(self._ends[order[-1]]) if widths[order[-1]] >= MIN_ROOT_WIDTH_RATIO * widths[order[-2]] else None
        )

    def _source(self) -> int | None:
        """Return the end from which all lines lead away, or to which all of them lead, or None."""
        for edges in (self._edges, self._edges[:, ::-1]):
            starts = self._ends[np.isin(self._ends, edges[:, 0])]
            if len(starts) == 1:
                _, before = breadth_first_order(self._graph, int(starts[0]), directed=False)
                if (before[edges[:, 1]] == edges[:, 0]).all():
                    return int(starts[0])
        return None

    def _stretch(self, end: int) -> Indices:
        """Return the points from an end to the first bifurcation, or to the middle where there is none."""
        path = [end]
        before = -1
        while len(path) == 1 or self._degree[path[-1]] == 2:
            beside = self._graph.indices[self._graph.indptr[path[-1]] : self._graph.indptr[path[-1] + 1]]
            ahead = [int(point) for point in beside if point != before]
            if not ahead:
                break
            before = path[-1]
            path.append(ahead[0])
        branches_part = self._degree[path[-1]] > 2
        return np.array(path[:-1] if branches_part else path[: len(path) // 2])


def _edges(lines: tuple[Indices, ...]) -> Indices:
    """Return the pairs of neighbouring points (m, 2) of lines, in their directions."""
    return np.concatenate([np.column_stack([line[:-1], line[1:]]) for line in lines])


def _adjacency(pairs: Indices, count: int) -> Any:
    """Return the symmetric matrix (count, count) of points that are beside each other, by pairs (m, 2)."""
    both = np.concatenate([pairs, pairs[:, ::-1]])
    matrix = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    matrix.sum_duplicates()
    return matrix


def _walk_back(before: Indices, tip: int) -> Indices:
    """Return the points from the root to a tip; before: of each point, the one before it, negative at the root."""
    path = [tip]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


def _find_false_turn(points: Array) -> tuple[int, float] | None:
    """Return the index and the angle in degrees at which a path leaves a branch in a straight line that was drawn.

    points: (n, 3) mm, none repeated. None where there is no such point.
    """
    moves = np.diff(points, axis=0)
    steps = np.linalg.norm(moves, axis=1)
    if len(steps) < 2 * STRAIGHT_POINTS or not (steps > 0).all():
        return None
    cosines = (moves[:-1] * moves[1:]).sum(axis=1) / (steps[:-1] * steps[1:])
    turns = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    if turns.max() <= MIN_FALSE_TURN_DEG:
        return None
    usual = TURN_RATIO * np.percentile(turns, 90)
    for k in np.flatnonzero(turns > max(MIN_FALSE_TURN_DEG, usual)):
        # Turn k is at point k + 1, between steps k and k + 1.
        ahead, behind = turns[k + 1 : k + STRAIGHT_POINTS], turns[max(k - STRAIGHT_POINTS + 1, 0) : k]
        ratio = np.median(steps[k + 1 : k + STRAIGHT_POINTS]) / np.median(
            steps[max(k - STRAIGHT_POINTS, 0) : k + 1]
        )
        for side, other in ((ahead, ratio), (behind, 1 / ratio)):
            if len(side) == STRAIGHT_POINTS - 1 and side.max() < STRAIGHT_DEG and other > SPACING_RATIO:
                return int(k) + 1, float(turns[k])
    return None
