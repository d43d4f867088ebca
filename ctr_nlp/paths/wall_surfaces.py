"""Walls as triangles for pictures: their part around a path, with fewer triangles, and its sections.

Programs and verdicts never see these: they measure at the whole wall (walls.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.paths.surface import Surface
from ctr_nlp.paths.walls import Body
from ctr_nlp.typing import Array, Index

DRAWN_WITHIN_MM = 15.0
"""Distance from a path within which walls are drawn, mm."""
DRAWN_CELL_MM = 0.8
"""Side of the cells whose vertices are drawn as one, mm."""
SECTION_RADIUS_MM = 12.0
"""Distance from a path within which sections are drawn, mm: further away are other branches."""


class DrawnWall(NamedTuple):
    """The part of a body's surface that is drawn.

    name: of the body. keep_out: whether the robot keeps outside of it. vertices (n, 3), mm; normals (n, 3), of
    length 1, out of the body; triangles (m, 3), whose corners turn left seen from outside of the body.
    """

    name: str
    keep_out: bool
    vertices: Array
    normals: Array
    triangles: Index


def walls_to_draw(
    bodies: tuple[Body, ...], points: Array, within: float = DRAWN_WITHIN_MM, cell: float = DRAWN_CELL_MM
) -> list[DrawnWall]:
    """Return the surfaces of bodies around points; those that have no triangles so near are left out.

    Parameters
    ----------
    bodies : tuple of Body
        The bodies.
    points : ndarray
        Points (n, 3), mm, as those of a path.
    within : float
        Distance from the nearest of them, mm.
    cell : float
        Side of the cells whose vertices are drawn as one, mm.

    Returns
    -------
    list of DrawnWall
        In the order of `bodies`.
    """
    found = []
    for body in bodies:
        try:
            surface = body.surface_near(points, within)
        except ProblemError:
            continue
        vertices, triangles = merge_vertices(
            np.asarray(surface.vertices, float), surface.triangles.astype(np.intp), cell
        )
        if len(triangles):
            normals = Surface(vertices.astype(np.float32), triangles.astype(np.int32)).vertex_normals
            found.append(DrawnWall(body.name, body.keep_out, vertices, normals, triangles))
    return found


def merge_vertices(vertices: Array, triangles: Index, cell: float) -> tuple[Array, Index]:
    """Merge all vertices of a surface that lie in one cell of a grid.

    Parameters
    ----------
    vertices : ndarray
        Points (n, 3), mm.
    triangles : ndarray
        Indices (m, 3) of their corners.
    cell : float
        Side of the cells, mm.

    Returns
    -------
    vertices : ndarray
        The mean (n, 3), mm, of the vertices in each cell.
    triangles : ndarray
        Indices (m, 3), without the triangles of which two corners lie in one cell, and without copies.

    Notes
    -----
    Vertex clustering: Rossignac and Borrel, Modeling in Computer Graphics, 1993.

    Examples
    --------
    >>> corners = [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [4, 0.1, 0]]
    >>> square = np.array([[0, 1, 2], [0, 4, 2], [0, 2, 3]])
    >>> vertices, triangles = merge_vertices(np.array(corners), square, 1.0)
    >>> len(vertices), len(triangles)
    (4, 2)
    """
    used, renumbered = np.unique(triangles, return_inverse=True)
    corners = np.asarray(vertices[used], float)
    _, group = np.unique(np.floor(corners / cell).astype(int), axis=0, return_inverse=True)
    group = group.reshape(-1)
    vertices = (
        np.stack([np.bincount(group, corners[:, k]) for k in range(3)], axis=1) / np.bincount(group)[:, None]
    )
    triangles = group[renumbered.reshape(-1, 3)]
    first, second, third = triangles.T
    triangles = triangles[(first != second) & (second != third) & (third != first)]
    # Two triangles with the same three corners are one, whichever corner comes first.
    _, kept = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return vertices, triangles[np.sort(kept)]


def section_lines(wall: DrawnWall, points: Array, tangents: Array, within: float) -> Array:
    """Cut a surface with planes at right angles to a path.

    Parameters
    ----------
    wall : DrawnWall
        The surface.
    points : ndarray
        Points (n, 3) of the path, mm.
    tangents : ndarray
        Directions (n, 3) of the path there, of length 1.
    within : float
        Distance from each point within which the section is kept, mm.

    Returns
    -------
    ndarray
        Ends of the pieces of line (m, 2, 3), mm, in which triangles meet planes.
    """
    found = []
    for point, tangent in zip(points, tangents, strict=True):
        offset = wall.vertices - point
        height = offset @ tangent
        near = np.linalg.norm(offset, axis=1) <= within
        chosen = wall.triangles[near[wall.triangles].all(axis=1)]
        above = height[chosen] > 0
        # One corner of such a triangle is alone on its side of the plane; two edges lead from it to the others.
        cut = above.any(axis=1) & ~above.all(axis=1)
        alone = np.argmax(above[cut] == (above[cut].sum(axis=1) == 1)[:, None], axis=1)
        corners = chosen[cut][np.arange(cut.sum())[:, None], (alone[:, None] + np.arange(3)) % 3]
        part = height[corners[:, :1]] / (height[corners[:, :1]] - height[corners[:, 1:]])
        ends = wall.vertices[corners]
        found.append(ends[:, :1] + part[..., None] * (ends[:, 1:] - ends[:, :1]))
    return np.concatenate(found) if found else np.zeros((0, 2, 3))


def wall_sections(wall: DrawnWall, path: Array, spacing: float, within: float = SECTION_RADIUS_MM) -> Array:
    """Cut a surface at right angles to a path, at equal distances along it.

    Parameters
    ----------
    wall : DrawnWall
        The surface.
    path : ndarray
        Points (n, 3), mm.
    spacing : float
        Distance between sections, mm.
    within : float
        Distance from the path within which sections are kept, mm.

    Returns
    -------
    ndarray
        Ends of pieces of line (m, 2, 3), mm.
    """
    along = cumulative_arc_length(path)
    places = np.arange(0.0, along[-1], spacing)
    points = np.stack([np.interp(places, along, values) for values in path.T], axis=1)
    tangents = np.stack(
        [np.interp(places, along, values) for values in np.gradient(path, along, axis=0).T], axis=1
    )
    return section_lines(wall, points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True), within)
