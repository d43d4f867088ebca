"""Paths from a root to the tips, from lines through shared points as centreline files contain them.

Lines that share an end and leave it to the same side are whole: each is a path already, and that end the root.
VMTK writes centrelines so, and they need not meet on the trunk. Any other lines are pieces of trees, cut where
branches part or anywhere else, down to two points a piece. A piece with nothing beside it runs as it is given.
The root of a tree is the end whose first stretch, up to where branches part, is wider on average than any
other's by a tenth; failing that, the end from which all pieces lead away, or to which all of them lead; failing
that, the end nearest to where the caller enters. For a tree without branches the direction of its pieces counts
first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

Indices = npt.NDArray[np.intp]

SAME_MM = 1e-3
"""Points closer than this are one: files repeat a point where lines meet, rounded to single precision."""
LINE_HEADING_MM = 5.0
"""Lines that share an end are compared over this first length."""
MIN_ROOT_WIDTH_RATIO = 1.1
"""Factor by which a tree is at least wider at its root than at any other end."""


@dataclass(frozen=True)
class CentrelineNetwork:
    """Points (n, 3) in mm, the lumen's radius (n,) in mm or None, and the lines over them, lists of indices."""

    points: Array
    radius: Array | None
    lines: tuple[Indices, ...]

    def paths(self, entry: Array | None = None) -> list[Indices]:
        """Return the paths from each root to its tips, by the rules above; entry: (3,) mm. Raises CurveError."""
        joined = self._merge_repeated_points()
        if not joined.lines:
            raise CurveError("it holds no line of two or more points")
        if whole := joined._complete_paths():
            return whole
        edges: Indices = np.concatenate([np.column_stack([line[:-1], line[1:]]) for line in joined.lines])
        parts = import_extra("networkx").connected_components(_graph(edges))
        trees = [Tree(joined, edges[np.isin(edges[:, 0], list(part))]) for part in parts]
        return [path for tree in trees for path in tree.to_tips(entry)]

    def _merge_repeated_points(self) -> CentrelineNetwork:
        """Return the network with one index for points in the same place, and no line of a single point."""
        pairs = cKDTree(self.points).query_pairs(SAME_MM, output_type="ndarray")
        first = np.arange(len(self.points))
        for places in map(list, import_extra("networkx").connected_components(_graph(pairs))):
            first[places] = min(places)
        lines = [first[line] for line in self.lines]
        lines = [line[np.append(True, line[1:] != line[:-1])] for line in lines]
        return CentrelineNetwork(self.points, self.radius, tuple(line for line in lines if len(line) > 1))

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


class Tree:
    """Connected pieces: a network and those of its edges (m, 2), directed as their lines are."""

    def __init__(self, network: CentrelineNetwork, edges: Indices) -> None:
        self._network = network
        self._edges = edges
        self._graph = _graph(edges)
        if not import_extra("networkx").is_tree(self._graph):
            raise CurveError("its lines form a loop; they must form trees, with one path from a root to each tip")
        self._ends = np.array(sorted(node for node, degree in self._graph.degree if degree == 1))

    def to_tips(self, entry: Array | None) -> list[Indices]:
        """Return the paths from the root to the other ends, these in the order of their points.

        entry: (3,) mm, where the robot enters, or None; decides between ends where no rule finds the root.
        """
        root = self._root(entry)
        return [self._between(root, int(tip)) for tip in self._ends if tip != root]

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
        return int(self._ends[np.linalg.norm(self._network.points[self._ends] - entry, axis=1).argmin()])

    def _widest(self) -> int | None:
        """Return the end whose first stretch is clearly the widest; None where there is none or no radius."""
        radius = self._network.radius
        if radius is None:
            return None
        widths = np.array([radius[self._stretch(int(end))].mean() for end in self._ends])
        order = widths.argsort()
        return (
            int(self._ends[order[-1]]) if widths[order[-1]] >= MIN_ROOT_WIDTH_RATIO * widths[order[-2]] else None
        )

    def _source(self) -> int | None:
        """Return the end from which all lines lead away, or to which all of them lead, or None."""
        for edges in (self._edges, self._edges[:, ::-1]):
            starts = self._ends[np.isin(self._ends, edges[:, 0])]
            if len(starts) == 1:
                walked = import_extra("networkx").bfs_edges(self._graph, int(starts[0]))
                before = {there: here for here, there in walked}
                if all(before.get(there) == here for here, there in edges.tolist()):
                    return int(starts[0])
        return None

    def _between(self, root: int, tip: int) -> Indices:
        """Return the points from one end to another."""
        return np.array(import_extra("networkx").shortest_path(self._graph, root, tip))

    def _stretch(self, end: int) -> Indices:
        """Return the points from an end to the first bifurcation, or to the middle where there is none."""
        path = self._between(end, int(self._ends[self._ends != end][0]))
        parts = [k for k, point in enumerate(path.tolist()) if self._graph.degree[point] > 2]
        return path[: parts[0] if parts else len(path) // 2]


def _graph(edges: Indices) -> Any:
    """Return the graph of pairs of points (m, 2)."""
    graph = import_extra("networkx").Graph()
    graph.add_edges_from(edges.tolist())
    return graph
