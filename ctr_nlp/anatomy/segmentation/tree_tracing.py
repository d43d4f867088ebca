"""The ends of a lumen and the routes to them, found on the graph of its voxels.

A tree of cheapest routes (Dijkstra) leads from the entry to every voxel. Its farthest voxel is an end, the route
to it the first one; from then on, the farthest voxel that no route explains is the next candidate, as in TEASAR
(Sato et al., Pacific Graphics 2000). A route explains the voxels in the balls around it, whose radius is that of
its cross-sections and not that of the inscribed ball: an uneven wall has lobes far outside of the latter. What
remains is an end only where it sticks out farther than a lobe of the wall does; see _is_branch and _find_stub.

Routes of one tree of shortest routes form no loop. Where two of them touch, far from where they part, the lumen
has one: cut_loops says where.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from ctr_nlp.anatomy.segmentation.centring import cast_rays
from ctr_nlp.anatomy.segmentation.mask import VOXEL_NEIGHBOUR_STEPS, WALL_COST_POWER, depths, link_voxels
from ctr_nlp.typing import Array, Flags, Index

COVER_VOXELS = 0.75
"""Voxels by which the ball around a point of a route is larger than the cross-section there."""
NEAR_SECTIONS = 2.5
"""A ball covers voxels alone that are nearly as far from the root as its centre, to so many radii: a branch that
only passes it is not covered."""
MIN_BRANCH_VOXELS, MIN_BRANCH_BASE_RADII, MIN_BRANCH_PARENT_RADII = 2.0, 2.0, 1.25
"""Least length of a branch beyond the balls: in voxels, in radii of its widest place, and in radii of its
parent."""
MIN_STUB_VOXELS, MIN_STUB_PARENT_RADII = 2.5, 1.0
"""Least height of a stub above the wall of its parent: in voxels, and in radii of the parent."""
MIN_STUB_WIDTH = 1.02
"""A stub is wider than a chain of single voxels by at least this factor."""
MIN_LUMEN_RADII = 3.0
"""Least length of a lumen, in radii of its widest place; a shorter one has no direction."""
SECTION_RAYS, SECTION_SAMPLES = 24, 32
"""Rays of a cross-section, and samples along each."""
MAX_RAY_RATIO, MAX_SHIFT = 1.35, 0.5
"""A ray counts as at most so many medians of its section; a centre is moved by at most so many radii."""
LOOP_RADII, LOOP_MM = 4.0, 5.0
"""Branches that touch form a loop where the way round from one to the other is longer than the sum of both."""
CONTACT_GAP_MM = 3.0
"""Contacts between two branches that are so far apart are two contacts."""
OPEN_CONTACT_PART, END_CONTACT_VOXELS = 0.5, 2.0
"""An end at a contact that is so wide, as a part of the branch's own depth, is no end: the lumen goes on. It is at
the contact where it is nearer than its radius and so many voxels."""


@dataclass(frozen=True)
class VoxelGraph:
    """The voxels of a lumen and the cost of the steps between neighbours.

    lumen: (l, m, n). spacing: (3,) mm. points: (k, 3) mm of each voxel, along the axes of the image. depth: (k,)
    mm from the wall. number: (l + 2, m + 2, n + 2), of each voxel, -1 outside. links: sparse (k, k), each pair
    once. part: (k,) number of the connected part that a voxel belongs to.
    """

    lumen: Flags
    spacing: Array
    points: Array
    depth: Array
    number: Index
    links: Any
    part: Index

    def find_nearest(self, point: Array) -> int:
        """Return the number of the voxel nearest to a point (3,) in mm."""
        return int(((self.points - point) ** 2).sum(axis=1).argmin())


@dataclass(frozen=True)
class Loop:
    """A place where two branches touch: its point (3,) mm, and the length of the way round, mm."""

    point: Array
    length: float


@dataclass(frozen=True)
class VoxelTree:
    """Routes from a root to the ends of a lumen.

    graph: its voxels. before: (k,) number of the voxel before each on its way from the root, negative at the root.
    along: (k,) mm from the root. routes: numbers of voxels, each from a voxel of an earlier route to an end.
    radius: (k,) mm of the cross-section at voxels of routes, 0 at others. beside: (k,) voxel of a route in whose
    ball a voxel lies, -1 where there is none.
    """

    graph: VoxelGraph
    root: int
    before: Index
    along: Array
    routes: list[Index]
    radius: Array
    beside: Index


def build_graph(lumen: Flags, spacing: Array) -> VoxelGraph:
    """Return the graph of the voxels of a lumen (l, m, n), 26 neighbours each; spacing: (3,) mm."""
    depth = np.pad(depths(lumen, spacing), 1)
    member = np.flatnonzero(depth)
    number: Index = np.full(depth.size, -1, np.int32)
    number[member] = np.arange(len(member), dtype=np.int32)
    room = depth.ravel()[member].astype(float)
    pitch = np.array(depth.strides) // depth.itemsize
    links = [
        link_voxels(
            depth > 0, number, room**-WALL_COST_POWER, int(step @ pitch), float(np.linalg.norm(step * spacing))
        )
        for step in VOXEL_NEIGHBOUR_STEPS
    ]
    tails, heads, costs = (np.concatenate(parts) for parts in zip(*links, strict=True))
    matrix = coo_array((costs, (tails, heads)), shape=(len(member), len(member))).tocsr()
    _, part = connected_components(matrix, directed=False)
    index = np.column_stack(np.unravel_index(member, depth.shape)) - 1
    return VoxelGraph(lumen, spacing, index * spacing, room, number.reshape(depth.shape), matrix, part)


def find_farthest(graph: VoxelGraph, root: int) -> int:
    """Return the voxel that the longest of the cheapest routes from a voxel leads to."""
    return int(_Search(graph, root).order_by_length[0])


def trace_tree(graph: VoxelGraph, root: int) -> VoxelTree:
    """Return the routes from a voxel to all ends of its part of a lumen; none where nothing sticks out of it."""
    search = _Search(graph, root)
    search.trace()
    return VoxelTree(graph, root, search.before, search.along, search.routes, search.radius, search.beside)


class _Search:
    """The search for ends from one root; places are the voxels in the order in which a tree is walked through."""

    def __init__(self, graph: VoxelGraph, root: int) -> None:
        self.graph = graph
        costs, before = dijkstra(graph.links, False, root, return_predecessors=True)
        reached = np.flatnonzero(np.isfinite(costs))
        # Steps cost something, so that a voxel comes after the one before it.
        order = reached[np.argsort(costs[reached], kind="stable")]
        self.before = before
        steps = np.zeros(len(before))
        steps[order[1:]] = np.linalg.norm(graph.points[order[1:]] - graph.points[before[order[1:]]], axis=1)
        along, size, place = _number_places(order.tolist(), before.tolist(), steps.tolist())
        self.along = np.array(along)
        self.size = np.array(size)
        self.place = np.array(place)
        self.at = np.zeros(len(order), int)
        self.at[self.place[order]] = order
        self.order_by_length = order[np.argsort(-self.along[order], kind="stable")]
        self.routes: list[Index] = []
        self.radius = np.zeros(len(before))
        self.beside = np.full(len(before), -1)
        self._on_route = np.zeros(len(before), bool)
        self._on_route[root] = True
        self._covered = np.zeros(len(before), bool)
        self._refused = np.zeros(len(order), bool)
        self._centres: list[Array] = []
        self._widths: list[Array] = []
        self._voxel = float(graph.spacing.max())

    def trace(self) -> None:
        """Add routes until no voxel is left that may be an end."""
        for voxel in self.order_by_length.tolist():
            if self._covered[voxel] or self._on_route[voxel] or self._refused[self.place[voxel]]:
                continue
            route = self._route(voxel)
            if not self.routes:
                if self.along[voxel] < MIN_LUMEN_RADII * self.graph.depth[route].max():
                    return
                self._add(route)
                continue
            outside = int((~self._covered[route]).argmax())
            if not self._is_branch(route, outside):
                stub = self._find_stub(route, outside)
                if stub is None:
                    first = self.place[route[outside]]
                    # The farthest voxel beyond this place is no end, so that no other one is.
                    self._refused[first : first + self.size[route[outside]]] = True
                    continue
                route = self._route(stub)
            self._add(route)

    def _route(self, voxel: int) -> Index:
        """Return the voxels from the nearest one on a route to this voxel."""
        route = [voxel]
        while not self._on_route[route[-1]]:
            route.append(int(self.before[route[-1]]))
        return np.array(route[::-1])

    def _is_branch(self, route: Index, outside: int) -> bool:
        """Return whether a route is long beyond the balls around the others; outside: its first voxel there."""
        length = self.along[route[-1]] - self.along[route[outside]]
        base = float(self.graph.depth[route[outside:]].max())
        parent = float(self.radius[route[0]])
        least = (MIN_BRANCH_VOXELS * self._voxel, MIN_BRANCH_BASE_RADII * base, MIN_BRANCH_PARENT_RADII * parent)
        return bool(length >= max(least))

    def _find_stub(self, route: Index, outside: int) -> int | None:
        """Return the voxel beyond the voxel `outside` of a route that is highest above the walls, if high enough.

        A stub that leaves its parent at an acute angle is short beyond the balls, but high above the parent's
        wall.
        """
        graph = self.graph
        if graph.depth[route[outside:]].max() < MIN_STUB_WIDTH * graph.spacing.min() / 2:
            return None
        first = self.place[route[outside]]
        beyond = self.at[first : first + self.size[route[outside]]]
        beyond = beyond[~self._covered[beyond]]
        centres = np.vstack(self._centres)
        widths = np.concatenate(self._widths)
        near = np.linalg.norm(centres - graph.points[route[-1]], axis=1) < 4 * widths + 6 * self._voxel
        if not near.any():
            return None
        above = np.linalg.norm(graph.points[beyond][:, None] - centres[near], axis=2) - widths[near]
        nearest = above.argmin(axis=1)
        height = above[np.arange(len(beyond)), nearest] + graph.spacing.min() / 2
        least = np.maximum(MIN_STUB_VOXELS * self._voxel, MIN_STUB_PARENT_RADII * widths[near][nearest])
        highest = int((height - least).argmax())
        return int(beyond[highest]) if height[highest] >= least[highest] else None

    def _add(self, route: Index) -> None:
        """Add a route, and cover the voxels in the balls around it."""
        graph = self.graph
        centres, widths = _measure_sections(graph, route)
        self.radius[route[1:]] = widths[1:]
        if not self.routes:
            self.radius[route[0]] = widths[0]
        self.routes.append(route)
        self._centres.append(centres)
        self._widths.append(widths)
        self._on_route[route] = True
        for voxel, centre, width in zip(route.tolist(), centres, widths, strict=True):
            ball = width + COVER_VOXELS * self._voxel
            inside = self._voxels_in_ball(centre, ball)
            apart = np.abs(self.along[inside] - self.along[voxel])
            inside = inside[apart <= NEAR_SECTIONS * ball]
            self._covered[inside] = True
            self.beside[inside] = voxel

    def _voxels_in_ball(self, centre: Array, radius: float) -> Index:
        """Return the voxels, not yet covered, in a ball around a centre (3,); all in mm."""
        graph = self.graph
        # `number` has a border of one voxel.
        low = np.maximum(np.floor((centre - radius) / graph.spacing).astype(int) + 1, 0)
        high = np.ceil((centre + radius) / graph.spacing).astype(int) + 2
        box = graph.number[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        found = box[box >= 0]
        found = found[~self._covered[found]]
        return found[((graph.points[found] - centre) ** 2).sum(axis=1) <= radius**2]


def _number_places(
    order: list[int], before: list[int], steps: list[float]
) -> tuple[list[float], list[int], list[int]]:
    """Return for each voxel its distance from the root, mm, the number of voxels beyond it with itself, and its
    place in a walk through the tree on which those beyond it come next.

    order: voxels, each after the one before it. before: of each voxel. steps: mm from the one before.
    """
    along = [0.0] * len(before)
    size = [1] * len(before)
    for voxel in order[1:]:
        along[voxel] = along[before[voxel]] + steps[voxel]
    for voxel in order[:0:-1]:
        size[before[voxel]] += size[voxel]
    place = [0] * len(before)
    free = [1] * len(before)
    for voxel in order[1:]:
        place[voxel] = free[before[voxel]]
        free[before[voxel]] += size[voxel]
        free[voxel] = place[voxel] + 1
    return along, size, place


def _mean_around(values: Array, reach: Index) -> Array:
    """Return the means of values (n, ...) over so many neighbours on either side, (n,), fewer at the ends."""
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    place = np.arange(len(values))
    first = np.maximum(place - reach, 0)
    stop = np.minimum(place + reach, len(values) - 1) + 1
    count = (stop - first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((total[stop] - total[first]) / count)


def _measure_sections(graph: VoxelGraph, route: Index) -> tuple[Array, Array]:
    """Return the middle (n, 3) and the radius (n,) of the cross-sections at the voxels of a route, mm.

    The radius is the median of rays to the wall: neither lobes nor side branches, which fewer rays see, change it.
    """
    room = graph.depth[route]
    count = len(route)
    place = np.arange(count)
    step = float(np.linalg.norm(graph.spacing)) / np.sqrt(3)
    reach = np.maximum(2, np.ceil(room / step)).astype(int)
    # Fewer neighbours near the ends, as many on either side, so that the ends stay.
    points = _mean_around(graph.points[route], np.minimum(reach, np.minimum(place, count - 1 - place)))
    tangent = points[np.minimum(place + reach, count - 1)] - points[np.maximum(place - reach, 0)]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    some = np.unique(np.append(np.arange(0, count, 2), count - 1))
    tube = np.column_stack([points[some], np.maximum(room[some], graph.spacing.max() / 2)])
    rays, angle, first, second = cast_rays(
        graph.lumen, graph.spacing, tube, tangent[some], rays=SECTION_RAYS, samples=SECTION_SAMPLES
    )
    rays = np.where(np.isfinite(rays), rays, room[some][:, None])
    median = np.median(rays, axis=1)
    rays = np.minimum(rays, MAX_RAY_RATIO * median[:, None])
    # The first harmonics of the rays are the vector to the middle; see centring.py.
    shift = 2 / SECTION_RAYS * ((rays @ np.cos(angle))[:, None] * first + (rays @ np.sin(angle))[:, None] * second)
    away = np.maximum(np.linalg.norm(shift, axis=1), 1e-9)
    moved = points[some] + shift * np.minimum(1, MAX_SHIFT * median / away)[:, None]
    centres = np.column_stack([np.interp(place, some, axis) for axis in moved.T])
    widths = np.maximum(np.interp(place, some, median), room)
    # A section at an end, in the cap, is narrower than the branch.
    around = np.maximum(4, np.ceil(2 * widths / step)).astype(int)
    return centres, np.maximum(widths, _mean_around(widths, around))


def cut_loops(tree: VoxelTree) -> tuple[VoxelTree, list[Loop]]:
    """Return a tree without the ends that are no ends, and the places where branches touch far from where they
    part.

    Where a contact is about as wide as a branch that ends there, the lumen goes on: this is no end.
    """
    graph = tree.graph
    route_of = np.full(len(graph.depth), -1)
    for number, route in enumerate(tree.routes):
        route_of[route[1:] if number else route] = number
    links = graph.links.tocoo()
    ends = np.column_stack([links.row, links.col])
    ends = ends[(tree.beside[ends] >= 0).all(axis=1)]
    beside = tree.beside[ends]
    numbers = route_of[beside]
    apart = numbers[:, 0] != numbers[:, 1]
    ends, beside, numbers = ends[apart], beside[apart], numbers[apart]
    loops = list[Loop]()
    dropped = set[int]()
    for pair in np.unique(np.sort(numbers, axis=1), axis=0):
        touching = (np.sort(numbers, axis=1) == pair).all(axis=1)
        voxels = ends[touching]
        places = np.sort(tree.along[beside[touching]], axis=1)
        parting = _find_parting(tree, route_of, int(pair[0]), int(pair[1]))
        ways = tree.along[beside[touching]].sum(axis=1) - 2 * np.minimum(places[:, 0], parting)
        order = places[:, 0].argsort(kind="stable")
        for group in np.split(order, np.flatnonzero(np.diff(places[order, 0]) > CONTACT_GAP_MM) + 1):
            nearest = int(group[ways[group].argmin()])
            widest = float(tree.radius[beside[touching][nearest]].max())
            if ways[nearest] <= LOOP_RADII * widest + LOOP_MM:
                continue
            contact = voxels[group]
            place = graph.points[contact].mean(axis=(0, 1))
            # Where three branches meet, each pair of them touches there.
            if all(np.linalg.norm(place - loop.point) > CONTACT_GAP_MM for loop in loops):
                loops.append(Loop(place, float(ways[nearest])))
            room = float(graph.depth[contact].max())
            for number in pair.tolist():
                route = tree.routes[number]
                tip = route[-1]
                radius = float(tree.radius[tip])
                width = float(np.median(graph.depth[route[len(route) // 2 :]]))
                near = np.linalg.norm(graph.points[contact].reshape(-1, 3) - graph.points[tip], axis=1).min()
                at_contact = near <= radius + END_CONTACT_VOXELS * graph.spacing.max()
                if at_contact and room >= OPEN_CONTACT_PART * width:
                    dropped.add(number)
    parents = {int(route_of[route[0]]) for route in tree.routes[1:]}
    # A route that others leave stays: its tail is short, and its beginning leads to them.
    routes = [route for number, route in enumerate(tree.routes) if number not in dropped - parents]
    return replace(tree, routes=routes), loops


def _find_parting(tree: VoxelTree, route_of: Index, one: int, other: int) -> float:
    """Return how far from the root, mm, the ways to two routes part; route_of: (k,) route of each voxel."""
    leaves = dict[int, float]()
    at, number = np.inf, one
    while number not in leaves:
        leaves[number] = at
        start = int(tree.routes[number][0])
        at, number = float(tree.along[start]), int(route_of[start])
    at, number = np.inf, other
    while number not in leaves:
        start = int(tree.routes[number][0])
        at, number = float(tree.along[start]), int(route_of[start])
    return float(min(at, leaves[number]))
