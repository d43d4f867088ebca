"""The way through a lumen that keeps off its wall, voxel by voxel."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ctr_nlp.typing import Array, Flags

Flags = Flags
Index = npt.NDArray[np.integer[Any]]

POWER = 3.0
"""A millimetre at distance d from the wall costs d^-POWER: enough to keep to the middle in a bend."""
STRIDE = 2
"""Of the finest voxels, between neighbouring nodes where the lumen is wide."""
MARGIN = 4
"""Strides around start and stop where every voxel is a node."""
STEPS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)])
"""To half of a voxel's 26 neighbours: each pair of neighbours once."""


def depths(lumen: Flags, spacing: Array) -> npt.NDArray[np.float32]:
    """Distance in mm from the voxels (l, m, n) of a lumen to the wall, about; 0 outside of it.

    The Euclidean distance transform to the voxels that touch the wall. The border of the image is no wall.
    """
    edge = lumen & ~binary_erosion(lumen, np.ones((3, 3, 3)), border_value=1)
    to_edge = distance_transform_edt(~edge, sampling=spacing)
    return np.where(lumen, to_edge + spacing.min() / 2, 0.0).astype(np.float32)


def cheapest_route(depth: npt.NDArray[np.float32], spacing: Array, ends: Index) -> Index | None:
    """Indices (n, 3) of voxels from one end to the other, ends (2, 3); None where the lumen does not join them.

    depth: (l, m, n) mm, as `depths` gives it. Dijkstra's algorithm with the cost of Antiga and Steinman, IEEE TMI
    23(6), 2004, a function of the distance to the wall. Its nodes are coarse where balls of that distance cover
    the edges between them; narrow places, where every voxel is a node, are added if they are needed.
    """
    strides = np.maximum(1, np.round(STRIDE * spacing.min() / spacing)).astype(int)
    diagonal = float(np.linalg.norm(strides * spacing))
    room = np.pad(depth, [(s, s) for s in strides])
    every = tuple(slice(s, -s, s) for s in strides)
    coarse, fine = np.zeros(room.shape, bool), np.zeros(room.shape, bool)
    coarse[every] = room[every] > diagonal / 2 + spacing.min()
    for end in ends + strides:
        near = tuple(slice(max(0, i - MARGIN * s), i + MARGIN * s + 1) for i, s in zip(end, strides, strict=True))
        fine[near] = room[near] > 0
    route = _dijkstra(room, spacing, ((coarse, strides), (fine, np.ones(3, int))), ends + strides)
    if route is None:
        fine |= (room > 0) & (room < 1.5 * diagonal + 2 * spacing.min())
        route = _dijkstra(room, spacing, ((coarse, strides), (fine, np.ones(3, int))), ends + strides)
    return None if route is None else route - strides


def _dijkstra(
    depth: npt.NDArray[np.float32], spacing: Array, levels: tuple[tuple[Flags, Index], ...], ends: Index
) -> Index | None:
    """The cheapest route over nodes (l, m, n) that are linked to their neighbours at a stride (3,)."""
    member = np.flatnonzero(np.any([nodes for nodes, _ in levels], axis=0))
    number = np.full(depth.size, -1, np.int32)
    number[member] = np.arange(len(member), dtype=np.int32)
    cost = depth.ravel()[member].astype(float) ** -POWER
    pitch = np.array(depth.strides) // depth.itemsize
    links = [
        _links(nodes, number, cost, step @ pitch, float(np.linalg.norm(step * spacing)))
        for nodes, stride in levels
        for step in STEPS * stride
    ]
    tails, heads, costs = (np.concatenate(parts) for parts in zip(*links, strict=True))
    graph = coo_array((costs, (tails, heads)), shape=(len(member), len(member))).tocsr()
    start, at = (int(number[np.ravel_multi_index(tuple(end), depth.shape)]) for end in ends)
    reached, before = dijkstra(graph, False, start, return_predecessors=True)
    if not np.isfinite(reached[at]):
        return None
    walked = [at]
    while before[at] >= 0:
        at = int(before[at])
        walked.append(at)
    return np.column_stack(np.unravel_index(member[walked[::-1]], depth.shape))


def _links(nodes: Flags, number: Index, cost: Array, step: int, length: float) -> tuple[Index, Index, Array]:
    """Pairs of nodes that are a step apart in the flattened image, and the cost of going between them."""
    here = np.flatnonzero(nodes)
    here = here[nodes.ravel()[here + step]]
    tails, heads = number[here], number[here + step]
    return tails, heads, length * (cost[tails] + cost[heads]) / 2
