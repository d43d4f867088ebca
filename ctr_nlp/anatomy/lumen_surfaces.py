"""The surface of a lumen around a path, out of meshes that are open, thick-walled, or made of several parts.

A segmentation ends where the robot enters, and often where it arrives. There the surface is opened: an end that
was only cut is no wall. A mesh may also have openings, an outer surface, and walls inside of the lumen where its
parts meet. The lumen is then what is connected to the path: it is flooded on a grid, between the voxels that
triangles pass and lids on the openings. Triangles with the lumen on one side are its wall, whatever way they were
turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.surface import Surface, cut_triangles
from ctr_nlp.typing import Array, Flags

END_HEADING_MM = 3.0
"""Length over which the direction of a path's end is measured, mm."""
END_ROOM_PART = 0.3
"""Part of the lumen's radius at a path's end: where the wall leaves less beside a point one radius beyond it, the
lumen ends there."""
END_REACH_RADII = 2.5
"""Distance from a path's end in radii of the lumen up to which triangles beyond it are its lid."""
FLOOD_CELL_MM = 0.6
"""Side of the voxels that are flooded, mm."""
FLOOD_AROUND_MM = 20.0
"""How far from the path voxels are flooded, mm."""
LID_RADII = 3.0
"""Radius of the lid across a path's end, in radii of the lumen."""
SIDE_CELLS = (1.1, 1.6, 2.2)
"""Distances from a triangle, in voxels, at which its two sides are looked at: its own voxels are not flooded."""
LEAST_REGION_PART = 0.05
"""Part of a path that must lie in a connected region for it to be lumen."""
ACROSS = 0.5
"""Cosine of the angle between a triangle's normal and the path above which it lies across the path."""
MAX_RIM_PART = 0.5
"""Part of the border of the flooded box that a lumen may reach; what is outside of all surfaces reaches most."""
LEAST_INSIDE = 0.9
"""Part of a path that must lie inside of a surface that the robot stays inside of."""

Index = npt.NDArray[np.integer[Any]]


def part_inside(surface: Surface, path: Array) -> float:
    """Return which part of the points of a path (n, 3), mm, is inside of a surface."""
    return float((surface.signed_distances(path) > 0).mean())


def open_ends(surface: Surface, path: Array) -> tuple[Surface, list[str]]:
    """Open a surface where it ends at an end of a path.

    Parameters
    ----------
    surface : Surface
        Around the path.
    path : ndarray
        Points (n, 3), mm, from the entry to the target.

    Returns
    -------
    surface : Surface
        Without the triangles beyond the ends, where the lumen ends there.
    names : list of str
        Which ends these are, "entry" and "target".
    """
    kept = np.ones(len(surface.triangles), bool)
    names = []
    for name, line in (("entry", path), ("target", path[::-1])):
        lid = _find_lid(surface, line)
        if lid.any():
            kept &= ~lid
            names.append(name)
    return surface.keep_triangles(kept), names


def open_tree_ends(surface: Surface, paths: Sequence[Array]) -> Surface:
    """Open the surface of a tree where it ends at its entry and at the ends of its branches.

    Parameters
    ----------
    surface : Surface
        Around the tree.
    paths : sequence of ndarray
        Points (n, 3) of each branch, mm, from the entry of all of them to its end.

    Returns
    -------
    Surface
        Without the triangles beyond these ends.
    """
    lids = [_find_lid(surface, line) for line in (paths[0], *(path[::-1] for path in paths))]
    return surface.keep_triangles(~np.any(lids, axis=0))


def _find_lid(surface: Surface, line: Array) -> Flags:
    """Find the triangles (m,) beyond the first point of a path where the lumen ends; none where it goes on.

    line: points (n, 3), mm, from that point on.
    """
    end, outward, radius = _describe_end(surface, line)
    if surface.signed_distances(end + radius * outward[None])[0] > END_ROOM_PART * radius:
        return np.zeros(len(surface.triangles), bool)
    offset = surface.corners.mean(axis=1) - end
    reach = END_REACH_RADII * radius + END_HEADING_MM
    lid: Flags = (offset @ outward > 0) & (np.linalg.norm(offset, axis=1) < reach)
    # A plane that has the whole surface beyond it would leave no wall.
    return np.zeros_like(lid) if lid.all() else lid


def wall_around_path(surface: Surface, path: Array) -> tuple[Surface, int]:
    """Find the wall of the lumen that is connected to a path.

    Parameters
    ----------
    surface : Surface
        Triangles in any order and with any normals.
    path : ndarray
        Points (n, 3), mm.

    Returns
    -------
    surface : Surface
        The triangles with the lumen on one side, their normals out of it.
    inner : int
        Number of triangles with the lumen on both sides, or across the path, which are left out.

    Raises
    ------
    CurveError
        No triangle separates the path from what is around it.
    """
    origin = path.min(axis=0) - FLOOD_AROUND_MM
    shape = np.ceil((np.ptp(path, axis=0) + 2 * FLOOD_AROUND_MM) / FLOOD_CELL_MM).astype(int)
    blocked = np.zeros(shape, bool)
    lids = [_disc(*_describe_end(surface, line)) for line in (path, path[::-1])]
    for triangles in (surface.corners, _cover_openings(surface), *lids):
        _mark(blocked, (_sample(triangles, FLOOD_CELL_MM / 2) - origin) / FLOOD_CELL_MM)
    regions, _ = label(~blocked)
    at = _voxels((path - origin) / FLOOD_CELL_MM, shape)[0]
    there = regions[tuple(at.T)]
    if not (there > 0).any():
        raise CurveError("its surface leaves no room around the path")
    # A path may leave the surface at its end, into what is outside: such a region is none of the lumen.
    number, count = np.unique(there[there > 0], return_counts=True)
    chosen = number[count >= LEAST_REGION_PART * count.sum()]
    rim = np.ones(shape, bool)
    rim[1:-1, 1:-1, 1:-1] = False
    if np.isin(regions[rim], chosen).mean() > MAX_RIM_PART:
        raise CurveError(
            "the path lies outside of its surface, or the surface has gaps: are both in the same coordinates "
            "(--space)?"
        )
    own = np.flatnonzero(np.isin(there, chosen))
    middle = surface.corners.mean(axis=1)
    near = own[cKDTree(path[own]).query(middle)[1]]
    before, behind = (
        [
            _look_up(regions, (middle + sign * part * FLOOD_CELL_MM * surface.normals - origin) / FLOOD_CELL_MM)
            for part in SIDE_CELLS
        ]
        for sign in (1, -1)
    )
    # What is lumen beside one part of the path may be tissue beside another: the nearest part counts.
    here = there[near]
    in_front = np.any([side == here for side in before], axis=0)
    at_back = np.any([side == here for side in behind], axis=0)
    # A wall across the path, between two of its regions, is one of the mesh and none of the lumen.
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    beyond = np.where(in_front, behind, before)
    leads_on = np.isin(beyond, there[own]).any(axis=0) & (
        np.abs((surface.normals * tangent[near]).sum(1)) > ACROSS
    )
    inner = (in_front & at_back) | ((in_front ^ at_back) & leads_on)
    wall = (in_front ^ at_back) & ~inner
    if not wall.any() or inner.sum() > wall.sum():
        raise CurveError("its surface does not close around the path: what is inside of it is not known")
    turned = surface.triangles.copy()
    turned[in_front] = turned[in_front][:, ::-1]
    return Surface(surface.vertices, turned).keep_triangles(wall), int(inner.sum())


def _describe_end(surface: Surface, path: Array) -> tuple[Array, Array, float]:
    """Return the first point of a path (n, 3), the direction out of it there, and the lumen's radius, mm."""
    along = np.linalg.norm(path - path[0], axis=1)
    inner = path[int(np.argmax(along >= min(END_HEADING_MM, along.max())))]
    outward = (path[0] - inner) / np.linalg.norm(path[0] - inner)
    # Measured further inside: at the end itself its lid would be the nearest part of the surface.
    radius = float(abs(surface.signed_distances(inner[None])[0]))
    return path[0], outward, max(radius, FLOOD_CELL_MM)


def _disc(centre: Array, normal: Array, radius: float) -> Array:
    """Return triangles (m, 3, 3) of a disc of LID_RADII radii around a point."""
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, 25)
    rim = centre + LID_RADII * radius * (
        np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(normal, across)
    )
    return np.stack([np.broadcast_to(centre, rim[1:].shape), rim[:-1], rim[1:]], axis=1)


def _cover_openings(surface: Surface) -> Array:
    """Return triangles (m, 3, 3) of lids on the openings: from each open edge to the middle of its opening."""
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    single, count = np.unique(edges, axis=0, return_counts=True)
    rim = single[count == 1]
    if not len(rim):
        return np.zeros((0, 3, 3))
    # Edges with a common vertex belong to one opening.
    size = len(surface.vertices)
    links = coo_array((np.ones(len(rim)), tuple(rim.T)), shape=(size, size))
    opening = connected_components(links, directed=False)[1][rim[:, 0]]
    found = []
    for k in np.unique(opening):
        ends = surface.vertices[rim[opening == k]].astype(float)
        middle = np.broadcast_to(ends.mean(axis=(0, 1)), (len(ends), 3))
        found.append(np.stack([middle, ends[:, 0], ends[:, 1]], axis=1))
    return np.concatenate(found)


def _sample(corners: Array, apart: float) -> Array:
    """Return points (n, 3) of triangles (m, 3, 3), at most `apart` mm from each other."""
    pieces, _ = cut_triangles(corners, apart)
    return np.concatenate([pieces.reshape(-1, 3), pieces.mean(axis=1)])


def _voxels(places: Array, shape: Index) -> tuple[Index, Flags]:
    """Return the voxels (n, 3) that places (n, 3) are in, clipped to a grid of this shape, and which are in it."""
    at = np.floor(places).astype(int)
    inside = ((at >= 0) & (at < shape)).all(axis=1)
    return np.clip(at, 0, np.array(shape) - 1), np.asarray(inside)


def _mark(voxels: Flags, places: Array) -> None:
    """Set the voxels (l, m, n) in which places (n, 3) are."""
    at, inside = _voxels(places, np.array(voxels.shape))
    voxels[tuple(at[inside].T)] = True


def _look_up(regions: Index, places: Array) -> Index:
    """Return the values (n,) of voxels (l, m, n) at places (n, 3); -1 outside of them."""
    at, inside = _voxels(places, np.array(regions.shape))
    return np.where(inside, regions[tuple(at.T)], -1)
