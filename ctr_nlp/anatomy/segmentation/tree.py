"""The tree of a segmented lumen: paths from an entry to all ends of a mask, as a centreline file has them.

The routes through the voxels (tree_tracing.py) are cut into pieces where branches part, sampled about every
millimetre, and moved to the middle of the cross-sections together, so that branches share the points up to where
they part (centring.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ctr_nlp.anatomy.branch import (
    Branch,
    Branches,
    LumenMask,
    format_point,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.formats.images import IMAGE_SPACE_TO_LPS, Image
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.anatomy.segmentation.centring import STEP_MM, centre_tree
from ctr_nlp.anatomy.segmentation.mask import find_lumen_index, read_lumen
from ctr_nlp.anatomy.segmentation.tree_tracing import (
    Loop,
    VoxelGraph,
    VoxelTree,
    build_graph,
    cut_loops,
    find_farthest,
    trace_tree,
)
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.points import LEAST_POINTS, cumulative_arc_length
from ctr_nlp.typing import Array, Flags, Index

ENTRY_WIDTH_PART = 0.75
"""Ends at least so wide, as a part of the widest one, may be the entry."""
MAX_CUT_AREA = 2.5
"""Largest area of a lumen that the border of the image cuts across, in areas of the inscribed circle."""
END_CLEARANCE_RADII = 0.5
"""A path stops so many radii before the cap of the lumen, and at the border of the image at no distance."""
MIN_PIECE_MM = 0.5
"""Branches that part nearer to each other than this part at one point."""
MAX_LISTED_LOOPS = 5


@dataclass(frozen=True)
class _Nodes:
    """Points of a tree about a millimetre apart.

    tube: (n, 4) points and radii, mm. before: (n,) number of the point before each, negative at the root. tips:
    numbers of the ends, in the order of the routes.
    """

    tube: Array
    before: Index
    tips: list[int]


def read_mask_tree(
    path: str | Path, entry: npt.ArrayLike | None = None, options: ReadOptions = AS_THE_FILE_SAYS
) -> Branches:
    """Find the paths from the entry to all ends of the lumen in a mask, with its radius along them.

    path: NIfTI-1 or NRRD, as for `read_mask`. entry: (3,) mm in the file's own coordinates, in the lumen or at
    most a voxel's diagonal from it; by default the uppermost of the wide places where the border of the image
    cuts the lumen, or else of its wide ends. options: what a person states about the file. Branches share the
    points up to where they part. What is not connected with the entry, and cavities within the lumen, are noted.
    Raises CurveError, and OptionError where nibabel or pynrrd is missing.
    """
    lumen, notes = read_lumen(path, options)
    to_lps = IMAGE_SPACE_TO_LPS[lumen.space]
    with name_source_in_errors(path):
        filled = _fill_cavities(lumen.voxels)
        cavities = int(filled.sum() - lumen.voxels.sum())
        if cavities:
            notes = (*notes, f"{cavities} voxels within the lumen are not of it: they are taken as lumen")
        lumen = replace(lumen, voxels=filled)
        graph = build_graph(lumen.voxels, lumen.spacing)
        if entry is None:
            root, found = _guess_entry(graph, lumen)
            notes = (*notes, found)
        else:
            root = graph.find_nearest(find_lumen_index(lumen, "entry", entry) * lumen.spacing)
        tree = trace_tree(graph, root)
        if not tree.routes:
            raise CurveError("its lumen has no end away from the entry: no part of it is longer than it is wide")
        tree, loops = cut_loops(tree)
        notes = (*notes, *_note_loops(loops, lumen), *_note_separate_parts(graph, root, lumen.spacing))
        nodes = _sample_routes(tree)
        tube = centre_tree(lumen.voxels, lumen.spacing, nodes.tube, nodes.before)
        notes = (*notes, _note_offsets(tree, tube))
        lps = transform_points(transform_points(tube[:, :3] / lumen.spacing, lumen.affine), to_lps)
    branches = list[Branch]()
    for way in _walk_to_tips(nodes):
        if len(way) >= LEAST_POINTS:
            branches.append(Branch(f"branch {len(branches) + 1}", lps[way], tube[way, 3]))
    if not branches:
        raise CurveError(f"{path}: its lumen is shorter than {LEAST_POINTS} mm from the entry to its only end")
    facts = replace(lumen.facts, notes=(*lumen.facts.notes, *notes))
    mask = LumenMask(lumen.voxels, to_lps @ lumen.affine)
    return Branches(tuple(branches), lumen.space, to_lps, facts, mask)


def _fill_cavities(lumen: Flags) -> Flags:
    """Return a lumen (l, m, n) with its cavities, which do not touch the border of the image, filled."""
    parts, _ = label(np.pad(~lumen, 1, constant_values=True))
    return np.asarray(parts[1:-1, 1:-1, 1:-1] != parts[0, 0, 0])


def _guess_entry(graph: VoxelGraph, lumen: Image) -> tuple[int, str]:
    """Return the voxel at the end of a lumen where a robot seems to enter, and a note; see read_mask_tree."""
    sizes = np.bincount(graph.part)
    largest = graph.part == sizes.argmax()
    inner = int(np.where(largest, graph.depth, 0.0).argmax())
    first = find_farthest(graph, inner)
    tree = trace_tree(graph, first)
    if not tree.routes:
        raise CurveError("its lumen has no end: no part of it is longer than it is wide; give --entry X Y Z")
    ends = [(first, _width_before(tree, 0, at_root=True))]
    ends += [(int(route[-1]), _width_before(tree, number)) for number, route in enumerate(tree.routes)]
    cuts = _find_cut_ends(graph, largest)
    least = ENTRY_WIDTH_PART * max(width for _, width in (*ends, *cuts))
    wide_cuts = [end for end in cuts if end[1] >= least]
    likely = wide_cuts or [end for end in ends if end[1] >= least]
    height = transform_points(graph.points / graph.spacing, lumen.affine)[:, 2]
    entry, width = max(likely, key=lambda end: float(height[end[0]]))
    where = "where the image cuts the lumen" if wide_cuts else "an end"
    choice = "the widest" if len(likely) == 1 else f"the uppermost of {len(likely)} wide ones"
    place = format_point(_round_place(graph.points[entry], lumen))
    return entry, (
        f"the entry is guessed: {place}, {where}, {choice}, radius {width:.1f} mm; --entry X Y Z says where it is"
    )


def _find_cut_ends(graph: VoxelGraph, member: Flags) -> list[tuple[int, float]]:
    """Return the middle voxel and the radius, mm, of each place where the border of the image cuts a lumen across.

    member: (k,) voxels among which they are looked for. A lumen along the border is not cut across.
    """
    index = np.rint(graph.points / graph.spacing).astype(int)
    at_border = ((index == 0) | (index == np.array(graph.lumen.shape) - 1)).any(axis=1)
    border = np.flatnonzero(at_border & member)
    count, patch = connected_components(graph.links[border][:, border], directed=False)
    face = float(np.prod(graph.spacing)) ** (2 / 3)
    found = list[tuple[int, float]]()
    for number in range(count):
        voxels = border[patch == number]
        middle = int(voxels[graph.depth[voxels].argmax()])
        radius = float(graph.depth[middle])
        if len(voxels) * face <= MAX_CUT_AREA * np.pi * (radius + graph.spacing.max()) ** 2:
            found.append((middle, radius))
    return found


def _width_before(tree: VoxelTree, number: int, at_root: bool = False) -> float:
    """Return the median radius, mm, of a tree between the end of route `number`, or the root, and where it
    parts.
    """
    route = tree.routes[number]
    starts = {int(other[0]) for other in tree.routes[1:]}
    parts = [k for k, voxel in enumerate(route.tolist()) if voxel in starts and k > 0]
    if at_root:
        stretch = route[: parts[0]] if parts else route[: len(route) // 2]
    else:
        stretch = route[parts[-1] :] if parts else route[len(route) // 2 if number == 0 else 1 :]
    return float(np.median(tree.radius[stretch])) if len(stretch) else 0.0


def _round_place(point: Array, lumen: Image) -> Array:
    """Return a point (3,) in mm along the axes of an image in the file's coordinates, to 0.1 mm."""
    return np.asarray(transform_points(point / lumen.spacing, lumen.affine).round(1) + 0.0)


def _note_loops(loops: list[Loop], lumen: Image) -> list[str]:
    """Return notes on the places at which loops of a lumen are cut."""
    notes = [
        f"the lumen forms a loop, {loop.length:.0f} mm round: two branches touch at "
        f"{format_point(_round_place(loop.point, lumen))}; it is cut there"
        for loop in loops[:MAX_LISTED_LOOPS]
    ]
    if len(loops) > MAX_LISTED_LOOPS:
        notes.append(f"the lumen forms {len(loops) - MAX_LISTED_LOOPS} more loops, cut where branches touch")
    return notes


def _note_separate_parts(graph: VoxelGraph, root: int, spacing: Array) -> list[str]:
    """Return a note on the voxels that are not connected with the root; spacing: (3,) mm."""
    sizes = np.delete(np.bincount(graph.part), graph.part[root])
    if not sizes.size:
        return []
    largest = f"{sizes.max() * float(np.prod(spacing)):.3g} mm^3"
    what = "a part is" if sizes.size == 1 else f"{sizes.size} parts are"
    return [f"{what} not connected with the entry and left out; the largest one has {largest}"]


def _note_offsets(tree: VoxelTree, tube: Array) -> str:
    """Return a note on how far the points (n, 4) of the paths are from the widest routes through the voxels."""
    route = np.unique(np.concatenate(tree.routes))
    away, _ = cKDTree(tree.graph.points[route]).query(tube[:, :3])
    return (
        f"paths are {np.median(away):.1f} mm from the widest way through the voxels in the median, "
        f"{away.max():.1f} mm at most"
    )


def _sample_routes(tree: VoxelTree) -> _Nodes:
    """Return points about every millimetre along the routes of a tree, parted where branches leave."""
    graph = tree.graph
    starts = {int(route[0]) for route in tree.routes[1:]}
    tube = list[Array]()
    before = list[int]()
    tips = list[int]()
    node = dict[int, int]()
    for number, route in enumerate(tree.routes):
        points = graph.points[route]
        radius = tree.radius[route]
        if number == 0:
            points, radius = (values[::-1] for values in _cut_cap(graph, points[::-1], radius[::-1]))
            tube.append(np.append(points[0], radius[0]))
            before.append(-1)
            node[int(route[0])] = 0
        points, radius = _cut_cap(graph, points, radius)
        # Cutting keeps the number of points: those in the cap are on a straight line.
        along = cumulative_arc_length(points)
        last = node[int(route[0])]
        done = 0.0
        stops = [k for k, voxel in enumerate(route.tolist()) if k and (voxel in starts or k == len(route) - 1)]
        for k in stops:
            if k < len(route) - 1 and min(along[k] - done, along[-1] - along[k]) < MIN_PIECE_MM:
                node[int(route[k])] = last
                continue
            count = max(1, round((along[k] - done) / STEP_MM))
            for place in np.linspace(done, along[k], count + 1)[1:]:
                tube.append(np.array([np.interp(place, along, column) for column in (*points.T, radius)]))
                before.append(last)
                last = len(tube) - 1
            node[int(route[k])] = last
            done = along[k]
        tips.append(last)
    return _Nodes(np.array(tube), np.array(before), tips)


def _cut_cap(graph: VoxelGraph, points: Array, radius: Array) -> tuple[Array, Array]:
    """Return a route's points (n, 3) and radii (n,) with a straight end that stops before the cap of the lumen.

    The farthest voxel is in a corner of the cap. The straight end begins at the last point from which a ball up to
    the wall contains it, and runs in the direction of the route there.
    """
    end = points[-1]
    away = np.linalg.norm(points - end, axis=1)
    outside = np.flatnonzero(away > radius)
    first = int(outside[-1]) if outside.size else 0
    if first < 1 or first > len(points) - 3:
        return points, radius
    along = cumulative_arc_length(points)
    behind = int(np.searchsorted(along, along[first] - 2 * radius[first]))
    heading = points[first] - points[min(behind, first - 1)]
    heading /= max(float(np.linalg.norm(heading)), 1e-9)
    index = np.rint(end / graph.spacing).astype(int)
    cut = bool(((index == 0) | (index == np.array(graph.lumen.shape) - 1)).any())
    reach = float((end - points[first]) @ heading) - (0.0 if cut else END_CLEARANCE_RADII * float(radius[first]))
    part = np.linspace(0, 1, len(points) - first)[:, None]
    straight = points[first] + part * max(reach, 0.1) * heading
    return np.vstack([points[:first], straight]), np.append(radius[:first], np.full(len(part), radius[first]))


def _walk_to_tips(nodes: _Nodes) -> list[Index]:
    """Return the numbers of the points from the root to each tip, neighbouring branches one after another."""
    ways = list[Index]()
    for tip in nodes.tips:
        way = [tip]
        while nodes.before[way[-1]] >= 0:
            way.append(int(nodes.before[way[-1]]))
        ways.append(np.array(way[::-1]))
    # Points are numbered along the longest routes first: at a bifurcation the one with the longest way comes
    # first.
    return sorted(ways, key=lambda way: way.tolist())
