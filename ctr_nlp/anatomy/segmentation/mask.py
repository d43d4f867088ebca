"""The path along the middle of a segmented lumen, a mask of voxels.

A path between two points is found by Dijkstra's algorithm on the graph of the lumen's voxels. An edge of length l
between voxels at distances d_1, d_2 from the wall costs l (d_1^-p + d_2^-p) / 2 with p = WALL_COST_POWER: the
trapezoidal rule for the integral of d^-p along the path (after Antiga and Steinman, IEEE TMI 23(6), 2004).
centring.py then moves the path to the middle of its cross-sections.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, find_objects
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ctr_nlp.anatomy.branch import (
    Branch,
    Branches,
    LumenMask,
    checked_point,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.formats.images import IMAGE_SPACE_TO_LPS, Image, read_image
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.anatomy.segmentation.centring import centre_route, lie_in_lumen
from ctr_nlp.anatomy.segmentation.lumen_voxels import select_lumen
from ctr_nlp.anatomy.segmentation.widths import check_widths
from ctr_nlp.exceptions import CurveError
from ctr_nlp.typing import Array, Flags

LEAST_VOXELS = 3.0
"""Least distance between entry and target, in diagonals of a voxel."""


def read_mask(
    path: str | Path, entry: npt.ArrayLike, target: npt.ArrayLike, options: ReadOptions = AS_THE_FILE_SAYS
) -> Branches:
    """Find the path from entry to target along the middle of a lumen, with its radius, in a mask.

    path: NIfTI-1 or NRRD, 0 outside the lumen and one other value within it; of several labels, of segments and of
    a probability map `options` say what is lumen. entry, target: (3,) mm in the file's
    own coordinates (RAS in NIfTI), in the lumen or at most a voxel's diagonal from it; the path begins and stops
    where it is nearest to them. Its points are about 1 mm apart; its radius is the distance to the wall in the
    cross-section, so that a lumen that ends or is cut open is not narrow there. The border of the image is no
    wall. options: what a person states about the file. Raises CurveError, and OptionError where nibabel or pynrrd
    is missing.

    The route is found by Dijkstra's algorithm at a cost that grows towards the wall, then centred in its
    cross-sections and smoothed.
    """
    lumen, selected_notes = read_lumen(path, options)
    to_lps = IMAGE_SPACE_TO_LPS[lumen.space]
    with name_source_in_errors(path):
        ends = np.array([find_lumen_index(lumen, "entry", entry), find_lumen_index(lumen, "target", target)])
        tube = _tube(lumen.voxels, lumen.spacing, ends)
        own = transform_points(tube[:, :3] / lumen.spacing, lumen.affine)
        width_notes = check_widths(own, tube[:, 3], options)
    branch = Branch(Path(path).name.partition(".")[0], transform_points(own, to_lps), tube[:, 3])
    facts = replace(lumen.facts, notes=(*lumen.facts.notes, *selected_notes, *width_notes))
    mask = LumenMask(lumen.voxels, to_lps @ lumen.affine)
    return Branches((branch,), lumen.space, to_lps, facts, mask)


def read_lumen(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> tuple[Image, tuple[str, ...]]:
    """Read the voxels of the lumen in a mask, cropped to them, and notes on how they were chosen.

    path, options: as `read_mask`. Raises CurveError, and OptionError where nibabel or pynrrd is missing.
    """
    image = read_image(path, options)
    with name_source_in_errors(path):
        selected, notes = select_lumen(image, options)
        return crop_to_lumen(replace(image, voxels=selected)), notes


def crop_to_lumen(image: Image) -> Image:
    """Return the part of an image of a lumen that contains it, with a voxel of wall around it where the image has
    one.
    """
    affine = image.affine.copy()
    (tight,) = find_objects(image.voxels.view(np.uint8))
    box = tuple(slice(max(0, part.start - 1), part.stop + 1) for part in tight)
    # Index 0 of the cropped image is index `start` of the whole one.
    affine[:3, 3] = transform_points([part.start for part in box], image.affine)
    return replace(image, voxels=np.ascontiguousarray(image.voxels[box]), affine=affine)


def find_lumen_index(mask: Image, name: str, given: npt.ArrayLike) -> Array:
    """Return the index (3,), not whole, of the lumen's point nearest to a given one; raise CurveError if that is
    far.
    """
    point = checked_point(name, given)
    to_index = np.asarray(np.linalg.inv(mask.affine), dtype=float)
    one = np.ones(3)
    index = transform_points(point, to_index)
    if lie_in_lumen(mask.voxels, one, index[None])[0]:
        return index
    voxels = np.argwhere(mask.voxels)
    # The nearest point of every voxel's box. At 0.5, its border, rounding might give the neighbour outside of the
    # lumen.
    there = np.clip(index, voxels - 0.49, voxels + 0.49)
    nearest = np.asarray(there[(((there - index) * mask.spacing) ** 2).sum(axis=1).argmin()])
    away = float(np.linalg.norm((nearest - index) * mask.spacing))
    allowed = float(np.linalg.norm(mask.spacing))
    if away <= allowed:
        return nearest
    # RAS and LPS differ by the signs of x and y: the commonest mistake, which the message offers as an
    # explanation.
    turned = transform_points(point * [-1, -1, 1], to_index)
    mixed = lie_in_lumen(mask.voxels, one, turned[None])[0]
    hint = "; with x and y negated it does: is it in LPS instead of RAS, or the other way round?" if mixed else ""
    near = ", ".join(f"{x:.1f}" for x in transform_points(nearest, mask.affine) + 0.0)
    raise CurveError(
        f"{name} {point.tolist()} is {away:.3g} mm outside the mask; it must lie in it or within {allowed:.2g} mm "
        f"of it, and the nearest point of the lumen is ({near}), in mm in the file's coordinates, "
        f"{mask.space}{hint}"
    )


def _tube(lumen: Flags, spacing: Array, ends: Array) -> Array:
    """Return points and radius (n, 4) in mm along the axes of a lumen (l, m, n), between indices `ends` (2, 3).

    spacing: sides of a voxel (3,), mm.
    """
    voxel = float(np.linalg.norm(spacing))
    apart = float(np.linalg.norm((ends[1] - ends[0]) * spacing))
    if apart < LEAST_VOXELS * voxel:
        least = f"they must be at least {LEAST_VOXELS * voxel:.3g} mm"
        raise CurveError(f"entry and target are {apart:.3g} mm apart; {least}")
    depth = depths(lumen, spacing)
    voxels = cheapest_route(depth, spacing, np.rint(ends).astype(int))
    if voxels is None:
        raise CurveError("entry and target lie in separate parts of the mask; there is no path between them")
    route = voxels * spacing
    room = depth[tuple(voxels.T)].astype(float)
    length = float(np.linalg.norm(np.diff(route, axis=0), axis=1).sum())
    width = 2 * (room.max() + voxel)
    if length < width:
        raise CurveError(
            f"the path from entry to target is {length:.3g} mm long; it must be longer than the lumen is wide, "
            f"about {width:.3g} mm"
        )
    tube = centre_route(lumen, spacing, route, room, ends * spacing)
    # A single point outside is what rounding to voxels may do on a smooth path; two in a row are outside of the
    # lumen.
    outside = ~lie_in_lumen(lumen, spacing, tube[:, :3])
    astray = np.flatnonzero(outside[1:] & outside[:-1])
    if astray.size:
        raise CurveError(
            f"a smooth path leaves the lumen {100 * astray[0] / len(tube):.0f} % along it from entry to target: "
            "the lumen is too narrow there for its voxels"
        )
    return tube


Index = npt.NDArray[np.integer[Any]]

WALL_COST_POWER = 3.0
"""A millimetre at distance d from the wall costs d^-WALL_COST_POWER: enough to keep to the middle in a bend."""
SPARSE_PART = 0.02
"""Part of its box that a lumen fills, below which the distance to the wall is searched for from its own voxels.
For airways, 1 % of a box, that takes a fifth of the time of a distance transform; for a wide tube, many times as
long."""
COARSE_NODE_STRIDE_VOXELS = 2
"""Distance of neighbouring nodes where the lumen is wide, in finest voxels."""
FINE_REGION_STRIDES = 4
"""Strides around start and stop where every voxel is a node."""
VOXEL_NEIGHBOUR_STEPS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)])
"""To half of a voxel's 26 neighbours: each pair of neighbours once."""


def depths(lumen: Flags, spacing: Array) -> npt.NDArray[np.float32]:
    """Return the approximate distance in mm from the voxels (l, m, n) of a lumen to the wall; 0 outside of it.

    spacing: sides of a voxel (3,), mm. The distance to the nearest voxel outside, but for half a voxel. The border
    of the image is no wall.
    """
    if lumen.mean() > SPARSE_PART:
        # Padded with its own border: beyond that of the image the lumen goes on.
        to_wall = distance_transform_edt(np.pad(lumen, 1, mode="edge"), sampling=spacing)[1:-1, 1:-1, 1:-1][lumen]
    else:
        to_wall = _distances_to_wall(lumen, spacing)
    found = np.zeros(lumen.shape, np.float32)
    # The wall runs half a voxel before the centres of the voxels outside.
    found[lumen] = to_wall - spacing.min() / 2
    return found


def _distances_to_wall(lumen: Flags, spacing: Array) -> Array:
    """Return the distance in mm from each voxel of a lumen (l, m, n) to the nearest one outside; spacing: (3,)
    mm.
    """
    # The nearest voxels of the wall are neighbours of the lumen. Beyond the border of the image there are none.
    room = np.pad(lumen, 1)
    member = np.flatnonzero(room)
    pitch = np.array(room.strides)
    wall = np.zeros(room.size, bool)
    for step in VOXEL_NEIGHBOUR_STEPS @ pitch:
        wall[member + step] = True
        wall[member - step] = True
    wall &= ~room.ravel()
    around = np.argwhere(wall.reshape(room.shape)[1:-1, 1:-1, 1:-1]) * spacing
    tree = cKDTree(around, balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(np.argwhere(lumen) * spacing)[0])


def cheapest_route(depth: npt.NDArray[np.float32], spacing: Array, ends: Index) -> Index | None:
    """Return the indices (n, 3) of voxels on the cheapest route between `ends` (2, 3); None where there is none.

    depth: (l, m, n) mm, as `depths` gives it. spacing: sides of a voxel (3,), mm. The cost is a function of the
    distance to the wall (see above). Nodes are coarse where balls of that distance cover the edges between them;
    narrow places, where every voxel is a node, are added if they are needed.
    """
    strides = np.maximum(1, np.round(COARSE_NODE_STRIDE_VOXELS * spacing.min() / spacing)).astype(int)
    diagonal = float(np.linalg.norm(strides * spacing))
    # A border of wall as wide as a stride: a step in the flattened image then cannot wrap around to the other
    # side.
    room = np.pad(depth, [(s, s) for s in strides])
    every = tuple(slice(s, -s, s) for s in strides)
    coarse = np.zeros(room.shape, bool)
    fine = np.zeros(room.shape, bool)
    # Balls around both ends of an edge, each larger than half of its length, cover it: the edge stays in the
    # lumen.
    coarse[every] = room[every] > diagonal / 2 + spacing.min()
    for end in ends + strides:
        near = tuple(
            slice(max(0, i - FINE_REGION_STRIDES * s), i + FINE_REGION_STRIDES * s + 1)
            for i, s in zip(end, strides, strict=True)
        )
        fine[near] = room[near] > 0
    route = _dijkstra(room, spacing, ((coarse, strides), (fine, np.ones(3, int))), ends + strides)
    if route is None:
        fine |= (room > 0) & (room < 1.5 * diagonal + 2 * spacing.min())
        route = _dijkstra(room, spacing, ((coarse, strides), (fine, np.ones(3, int))), ends + strides)
    return None if route is None else route - strides


def _dijkstra(
    depth: npt.NDArray[np.float32], spacing: Array, levels: tuple[tuple[Flags, Index], ...], ends: Index
) -> Index | None:
    """Return the indices (n, 3) of the cheapest route between `ends` (2, 3); None where there is none.

    depth: (l, m, n) mm. levels: nodes (l, m, n), each with the stride (3,) in voxels at which they are linked to
    their neighbours.
    """
    member = np.flatnonzero(np.any([nodes for nodes, _ in levels], axis=0))
    number = np.full(depth.size, -1, np.int32)
    number[member] = np.arange(len(member), dtype=np.int32)
    cost = depth.ravel()[member].astype(float) ** -WALL_COST_POWER
    # Distance of neighbours along each axis in the flattened image, in entries.
    pitch = np.array(depth.strides) // depth.itemsize
    links = [
        link_voxels(nodes, number, cost, step @ pitch, float(np.linalg.norm(step * spacing)))
        for nodes, stride in levels
        for step in VOXEL_NEIGHBOUR_STEPS * stride
    ]
    tails, heads, costs = (np.concatenate(parts) for parts in zip(*links, strict=True))
    graph = coo_array((costs, (tails, heads)), shape=(len(member), len(member))).tocsr()
    start, at = (int(number[np.ravel_multi_index(tuple(end), depth.shape)]) for end in ends)
    # Undirected: VOXEL_NEIGHBOUR_STEPS lists each pair of neighbours once.
    reached, before = dijkstra(graph, False, start, return_predecessors=True)
    if not np.isfinite(reached[at]):
        return None
    walked = [at]
    while before[at] >= 0:
        at = int(before[at])
        walked.append(at)
    return np.column_stack(np.unravel_index(member[walked[::-1]], depth.shape))


def link_voxels(nodes: Flags, number: Index, cost: Array, step: int, length: float) -> tuple[Index, Index, Array]:
    """Return the pairs of nodes that are `step` entries apart in the flattened image, and the cost of each pair.

    nodes: (l, m, n). number: of each voxel's node. cost: per mm at every node. length: of the step, mm.
    """
    here = np.flatnonzero(nodes)
    here = here[nodes.ravel()[here + step]]
    tails = number[here]
    heads = number[here + step]
    return tails, heads, length * (cost[tails] + cost[heads]) / 2
