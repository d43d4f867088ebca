"""Walls of a plan's file, and the clearance of robots in them, by nearest-point search and evaluation of splines.

A lumen is a path with a radius; its clearance at a point is the radius at the nearest place of the path less the
distance to it. A body is a signed distance, positive inside, that the file holds as coefficients of tricubic
B-splines in blocks of grids; `scipy.ndimage` evaluates these. The splines round off edges: where the file has the
triangles of the surface, the clearances that decide are measured at these.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ctr_nlp.check.tubes import Array

WALL_SPACING_MM = 0.1
"""Between the points of a lumen's path."""
FIELD_ERROR_MM = 0.6
"""By which the splines may be off near a surface."""
MEASURED_MM = 1.0
"""Clearance beyond which plans record that from the splines."""
SAME_DISTANCE_MM = 1e-6
"""Difference of the distances of two triangles that meet at the nearest point."""
ROWS = 400
"""Points whose nearest triangles are looked for together."""
BLOCK_CELLS = 8
"""Cells along each side of a block of a grid, as the format of the file has it."""


class LumenWall:
    """The wall of a lumen, from a table (N, 4) of x, y, z and radius, mm.

    The path through the table's points is divided evenly and finely, and the nearest place is looked for on the
    two parts beside the nearest point.
    """

    kept_out = False

    def __init__(self, table: Array) -> None:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1))])
        fine = np.linspace(0, along[-1], int(np.ceil(along[-1] / WALL_SPACING_MM)) + 1)
        self._table = np.stack([np.interp(fine, along, column) for column in table.T], axis=-1)
        self._tree = cKDTree(self._table[:, :3])

    def left(self, points: Array) -> Array:
        """Return the distance (..,) mm from points (.., 3) to the wall, negative beyond it."""
        k = np.clip(self._tree.query(points)[1][..., None] + [-1, 0], 0, len(self._table) - 2)
        start, span = self._table[k], self._table[k + 1] - self._table[k]
        along = ((points[..., None, :] - start[..., :3]) * span[..., :3]).sum(axis=-1)
        foot = start + np.clip(along / (span[..., :3] ** 2).sum(axis=-1), 0.0, 1.0)[..., None] * span
        distance = np.linalg.norm(points[..., None, :] - foot[..., :3], axis=-1)
        best = distance.argmin(axis=-1)[..., None]
        return np.take_along_axis(foot[..., 3] - distance, best, axis=-1)[..., 0]

    left_exactly = left


class Triangles:
    """Triangles (m, 3) of points (n, 3), mm, whose corners turn left seen from outside.

    A point's nearest place is the foot of its perpendicular on the triangle's plane where that is inside, which is
    to the left of all three edges; else it is on one of the edges.
    """

    def __init__(self, points: Array, triangles: Array) -> None:
        self._corners = np.asarray(points, dtype=float)[triangles]
        self._edges = np.roll(self._corners, -1, axis=1) - self._corners
        across = np.cross(self._edges[:, 0], self._edges[:, 1])
        self._normals = across / np.maximum(np.linalg.norm(across, axis=1), 1e-30)[:, None]
        middle = self._corners.mean(axis=1)
        reach = np.linalg.norm(self._corners - middle[:, None], axis=2).max(axis=1)
        # The few large triangles are looked at for every point; the others are found by their middles.
        large = reach > 3 * np.median(reach)
        self._large, self._small = np.flatnonzero(large), np.flatnonzero(~large)
        self._reach = float(reach[self._small].max())
        self._tree = cKDTree(middle[self._small])

    def signed_distance(self, points: Array) -> Array:
        """Return the distance (n,) mm of points (n, 3), positive inside."""
        found = [self._measure(points[k : k + ROWS]) for k in range(0, len(points), ROWS)]
        return np.concatenate([np.empty(0), *found])

    def _measure(self, points: Array) -> Array:
        """Return the signed distances (n,) mm of few points (n, 3)."""
        # A triangle's middle is no further from its nearest point than the triangle reaches.
        away = self._tree.query(points)[0] + self._reach + SAME_DISTANCE_MM
        members = [
            np.concatenate([self._small[k], self._large]) for k in self._tree.query_ball_point(points, away)
        ]
        counts, chosen = np.array([len(each) for each in members]), np.concatenate(members)
        owner = np.repeat(np.arange(len(points)), counts)
        from_corners, edges = points[owner][:, None] - self._corners[chosen], self._edges[chosen]
        normals = self._normals[chosen]
        height = (from_corners[:, 0] * normals).sum(axis=1)
        part = (from_corners * edges).sum(axis=2) / np.maximum((edges**2).sum(axis=2), 1e-30)
        beside = from_corners - np.clip(part, 0.0, 1.0)[..., None] * edges
        inside = ((np.cross(edges, from_corners) * normals[:, None]).sum(axis=2) > 0).all(axis=1)
        distance = np.where(inside, abs(height), np.sqrt((beside**2).sum(axis=2)).min(axis=1))
        starts = np.cumsum(counts) - counts
        least = np.minimum.reduceat(distance, starts)
        # At an edge or a corner, the heights over all triangles that meet there decide on the side.
        tied = distance <= least[owner] + SAME_DISTANCE_MM
        side = np.add.reduceat(np.where(tied, height, 0.0), starts)
        return np.where(side > 0, -least, least)


class FieldWall:
    """The surface of a body, from the rows and arrays of a plan's file; lengths in mm.

    body: with ``keep_out``, ``margin`` and ``field``, whose ``grids`` go from the finest to the coarsest; each has
    ``to_grid`` (4, 4), ``index`` of blocks, -1 where there is none, and their ``coefficients``.
    """

    def __init__(self, body: dict[str, Any]) -> None:
        self.kept_out = bool(body["keep_out"])
        self._sign, self._margin = -1.0 if self.kept_out else 1.0, float(body["margin"])
        self._grids = body["field"]["grids"]
        surface = body.get("surface")
        self._triangles = None if surface is None else Triangles(surface["vertices"], surface["triangles"])

    def left_exactly(self, points: Array) -> Array:
        """Return the distance (n,) mm from points (n, 3) to the triangles, if there are any; else as `left`."""
        if self._triangles is None:
            return self.left(points)
        return self._sign * self._triangles.signed_distance(points) - self._margin

    def left(self, points: Array) -> Array:
        """Return the distance (..,) mm from points (.., 3) to the surface, negative beyond it."""
        flat = points.reshape(-1, 3)
        # Beyond the coarsest grid the distance is that of the nearest place in it, less a mm for each mm.
        nearest = flat - _locate(self._grids[-1], flat)[1]
        found = np.full(len(flat), np.nan)
        for grid in self._grids:
            places, beyond = _locate(grid, nearest)
            block = grid["index"][tuple((places // BLOCK_CELLS).astype(int).T)]
            known = np.isnan(found) & (block >= 0) & (abs(beyond).max(axis=1) <= SAME_DISTANCE_MM)
            # A block's first coefficient belongs to the node before its first cell. Blocks are laid end to end.
            values = grid["coefficients"]
            local = places[known].T % BLOCK_CELLS + 1
            local[0] += block[known] * values.shape[1]
            stacked = values.reshape(-1, *values.shape[2:])
            found[known] = map_coordinates(stacked, local, float, order=3, prefilter=False, mode="nearest")
        found -= np.linalg.norm(flat - nearest, axis=1)
        return (self._sign * found - self._margin).reshape(points.shape[:-1])


def _locate(grid: dict[str, Any], points: Array) -> tuple[Array, Array]:
    """Return the nearest places in a grid (n, 3), in its cells, and how far points (n, 3) are from there, mm."""
    to_grid = np.asarray(grid["to_grid"], dtype=float)
    places = points @ to_grid[:3, :3].T + to_grid[:3, 3]
    inside = np.clip(places, 0.0, np.array(grid["index"].shape) * BLOCK_CELLS - 1e-9)
    return inside, (places - inside) @ np.linalg.inv(to_grid[:3, :3]).T


Wall = LumenWall | FieldWall


def read_walls(arrays: dict[str, Array], meta: dict[str, Any]) -> list[Wall]:
    """Return the walls in a plan's arrays and meta, an empty list without any."""
    rows: list[Any] = []

    def resolve(part: dict[str, Any]) -> Any:
        """Return what stands for a reference to a row, or for a number that JSON does not have."""
        if "row" in part:
            return rows[part["row"]]
        return float(part["number"]) if "number" in part else part

    def unpack(part: Any) -> Any:
        return json.loads(json.dumps(part), object_hook=resolve)

    packed = meta.get("walls", {"table": [], "bodies": []})
    for row in packed["table"]:
        rows.append(arrays["walls_" + row["array"]] if "array" in row else unpack(row.get("fields", {})))
    bodies = unpack(packed["bodies"])
    walls: list[Wall] = [FieldWall(body) for body in bodies]
    # The lumen around the path is no wall where the robot stays inside of a body.
    if "lumen" in arrays and all(body["keep_out"] for body in bodies):
        walls.append(LumenWall(arrays["lumen"]))
    return walls


def measure_clearance(walls: list[Wall], points: Array, radius: Array, known: Array | float = np.inf) -> Array:
    """Return the clearance (n, m), mm, of points (n, m, 3) of n robots from the nearest of some walls.

    radius (n, m): of the robots there, mm. Where a place may be the nearest one of its robot, and nearer than is
    known of the robots (n, 1) already, it is measured at the triangles of the walls.
    """
    found = np.full(radius.shape, np.inf)
    for wall in walls:
        clear = wall.left(points) - radius
        least = np.minimum(clear.min(axis=1, keepdims=True), known)
        small = clear <= np.minimum(least + FIELD_ERROR_MM, MEASURED_MM)
        clear[small] = wall.left_exactly(points[small]) - radius[small]
        found = np.minimum(found, clear)
    return found
