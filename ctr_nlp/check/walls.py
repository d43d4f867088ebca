"""Walls of a plan's file, and the depth of robots in them, by nearest-point search and by evaluation of splines.

A lumen is a path with a radius; its clearance at a point is the radius at the nearest place of the path less the
distance to it. A body is a signed distance, positive inside, that the file holds as coefficients of tricubic
B-splines in blocks of grids; `scipy.ndimage` evaluates these. The splines round off edges: where the file has the
triangles of the surface, the clearances that decide are measured at these.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ctr_nlp.check.tubes import Array, RobotShape

WALL_SPACING_MM = 0.1
"""Between the points of a lumen's path."""
BODY_SPACING_MM = 0.5
"""At most, between the places along the body whose clearance is found."""
FIELD_ERROR_MM = 0.6
"""By which the splines may be off near a surface."""
MEASURED_MM = 1.0
"""Clearance beyond which plans record that from the splines."""
SAME_DISTANCE_MM = 1e-6
"""Difference of the distances of two triangles that meet at the nearest point."""
PAIRS = 200_000
"""Points and triangles that are looked at together."""
BLOCK_CELLS = 8
"""Cells along each side of a block of a grid, as the format of the file has it."""


class MeasuredWall(Protocol):
    """Protocol of walls; kept_out: whether it is a body that the robot keeps out of."""

    kept_out: bool

    def left(self, points: Array) -> Array:
        """Return the distance (..,) mm from points (.., 3) to the wall, negative beyond it."""

    def left_exactly(self, points: Array) -> Array:
        """Return the same (n,) of points (n, 3) from the triangles, where the wall has any."""


class LumenWall:
    """The wall of a lumen, from a table (N, 4) of x, y, z and radius, mm.

    The path is a polyline through the table's points, of which each part is divided finely, and the nearest place
    is looked for on the two parts beside the nearest point.
    """

    kept_out = False

    def __init__(self, table: Array) -> None:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1))])
        keep = np.concatenate([[True], np.diff(along) > 1e-9])
        along = along[keep]
        table = table[keep]
        between = [
            np.linspace(a, b, max(2, int(np.ceil((b - a) / WALL_SPACING_MM)) + 1))[:-1]
            for a, b in itertools.pairwise(along)
        ]
        fine = np.concatenate([*between, along[-1:]])
        self._points = np.stack([np.interp(fine, along, table[:, k]) for k in range(3)], axis=-1)
        self._radius = np.interp(fine, along, table[:, 3])
        self._tree = cKDTree(self._points)

    def left(self, points: Array) -> Array:
        """Return the distance (..,) mm from points (.., 3) to the wall, negative beyond it."""
        nearest = self._tree.query(points)[1]
        best = np.full(nearest.shape, np.inf)
        radius = np.zeros(nearest.shape)
        for shift in (-1, 0):
            k = np.clip(nearest + shift, 0, len(self._points) - 2)
            start = self._points[k]
            span = self._points[k + 1] - start
            z = np.clip(((points - start) * span).sum(-1) / (span**2).sum(-1), 0.0, 1.0)
            distance = np.linalg.norm(points - start - z[..., None] * span, axis=-1)
            closer = distance < best
            best = np.where(closer, distance, best)
            radius = np.where(closer, self._radius[k] + z * (self._radius[k + 1] - self._radius[k]), radius)
        return radius - best

    left_exactly = left


class Triangles:
    """Triangles (m, 3) of points (n, 3), mm, whose corners turn left seen from outside."""

    def __init__(self, points: Array, triangles: Array) -> None:
        self._corners = np.asarray(points, dtype=float)[triangles]
        middle = self._corners.mean(axis=1)
        self._reach = np.linalg.norm(self._corners - middle[:, None], axis=2).max(axis=1)
        # The few large triangles are looked at for every point; the others are found by their middles.
        self._large = np.flatnonzero(self._reach > 3 * np.median(self._reach))
        self._small = np.flatnonzero(self._reach <= 3 * np.median(self._reach))
        self._tree = cKDTree(middle[self._small])
        first, second, third = np.moveaxis(self._corners, 1, 0)
        self._across = np.cross(second - first, third - first)

    def signed_distance(self, points: Array) -> Array:
        """Return the distance (n,) mm of points (n, 3), positive inside."""
        away, _ = self._tree.query(points)
        # A triangle's middle is no further from its nearest point than the triangle reaches.
        reach = float(self._reach[self._small].max())
        near = self._tree.query_ball_point(points, away + reach + SAME_DISTANCE_MM)
        found, row = np.empty(len(points)), 0
        while row < len(points):
            sizes = np.cumsum([len(each) + len(self._large) for each in near[row : row + PAIRS]])
            count = max(1, int(np.searchsorted(sizes, PAIRS)))
            members = [np.concatenate([self._small[each], self._large]) for each in near[row : row + count]]
            found[row : row + count] = self._measure(points[row : row + count], members)
            row += count
        return found

    def _measure(self, points: Array, members: list[Array]) -> Array:
        """Return signed distances (n,) of points (n, 3) from the nearest of the triangles `members` of each."""
        owner = np.repeat(np.arange(len(points)), [len(each) for each in members])
        chosen = np.concatenate(members)
        offset = points[owner] - find_nearest(points[owner], self._corners[chosen])
        distance = np.linalg.norm(offset, axis=1)
        starts = np.concatenate([[0], np.cumsum([len(each) for each in members])[:-1]])
        least = np.minimum.reduceat(distance, starts)
        # At an edge or a corner, the normals of all triangles that meet there decide on the side.
        tied = distance <= least[owner] + SAME_DISTANCE_MM
        normal = self._across[chosen] / np.maximum(np.linalg.norm(self._across[chosen], axis=1), 1e-30)[:, None]
        side = np.add.reduceat(np.where(tied, (offset * normal).sum(axis=1), 0.0), starts)
        return np.where(side > 0, -least, least)


def find_nearest(points: Array, corners: Array) -> Array:
    """Return the nearest point (n, 3) of one triangle (n, 3, 3) to each point (n, 3).

    The foot of the perpendicular, where it is inside; else the nearest of the three edges.
    """
    found, best = np.empty_like(points), np.full(len(points), np.inf)
    for k in range(3):
        start, span = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        z = np.clip(((points - start) * span).sum(1) / np.maximum((span**2).sum(1), 1e-30), 0.0, 1.0)
        at = start + z[:, None] * span
        distance = ((points - at) ** 2).sum(axis=1)
        closer = distance < best
        found[closer], best[closer] = at[closer], distance[closer]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = (across**2).sum(axis=1)
    height = ((points - corners[:, 0]) * across).sum(axis=1) / np.maximum(area, 1e-30)
    foot = points - height[:, None] * across
    turns = [
        (np.cross(corners[:, (k + 1) % 3] - corners[:, k], foot - corners[:, k]) * across).sum(axis=1)
        for k in range(3)
    ]
    inside = (np.min(turns, axis=0) >= 0) & (area > 0)
    found[inside] = foot[inside]
    return found


class FieldWall:
    """The surface of a body, from the rows and arrays of a plan's file; lengths in mm.

    body: with ``keep_out``, ``margin`` and ``field``, whose ``grids`` go from the finest to the coarsest; each has
    ``to_grid`` (4, 4), ``index`` of blocks, -1 where there is none, and their ``coefficients``.
    """

    def __init__(self, body: dict[str, Any]) -> None:
        self._sign = -1.0 if body["keep_out"] else 1.0
        self._margin = float(body["margin"])
        self._grids = body["field"]["grids"]
        self.kept_out = bool(body["keep_out"])
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
        found = np.full(len(flat), np.nan)
        for number, grid in enumerate(self._grids):
            todo = np.flatnonzero(np.isnan(found))
            to_grid = np.asarray(grid["to_grid"], dtype=float)
            places = flat[todo] @ to_grid[:3, :3].T + to_grid[:3, 3]
            cells = np.array(grid["index"].shape) * BLOCK_CELLS
            within = ((places >= 0) & (places < cells)).all(axis=1)
            beyond = np.zeros(len(todo))
            if number == len(self._grids) - 1:
                # Outside the coarsest grid the distance falls by a mm for each mm.
                inside = np.clip(places, 0.0, cells - 1e-9)
                beyond = np.linalg.norm((places - inside) @ np.linalg.inv(to_grid[:3, :3]).T, axis=1)
                places = inside
                within[:] = True
            blocks = np.full(len(todo), -1)
            blocks[within] = grid["index"][tuple((places[within] // BLOCK_CELLS).astype(int).T)]
            for block in np.unique(blocks[blocks >= 0]):
                own = np.flatnonzero(blocks == block)
                # A block's first coefficient belongs to the node before its first cell.
                local = places[own] % BLOCK_CELLS + 1
                values = grid["coefficients"][block].astype(float)
                found[todo[own]] = map_coordinates(values, local.T, order=3, prefilter=False, mode="nearest")
            found[todo] -= beyond
        return (self._sign * found - self._margin).reshape(points.shape[:-1])


def read_walls(arrays: dict[str, Array], meta: dict[str, Any]) -> list[MeasuredWall]:
    """Return the walls in a plan's arrays and meta, an empty list without any."""
    bodies = _read_bodies(arrays, meta.get("walls"))
    walls: list[MeasuredWall] = [FieldWall(body) for body in bodies]
    # The lumen around the path is no wall where the robot stays inside of a body.
    if "lumen" in arrays and all(body["keep_out"] for body in bodies):
        walls.append(LumenWall(arrays["lumen"]))
    return walls


def measure_left(walls: list[MeasuredWall], points: Array, radius: Array, exactly: bool = True) -> Array:
    """Return the clearance (n, m), mm, of points (n, m, 3) from the nearest of some walls.

    radius (n, m): of the robot there, mm. exactly: whether points that may be the least of their row are measured
    at the triangles of the walls.
    """
    found = np.full(radius.shape, np.inf)
    for wall in walls:
        clear = wall.left(points) - radius
        if exactly:
            small = clear <= np.minimum(clear.min(axis=1, keepdims=True) + FIELD_ERROR_MM, MEASURED_MM)
            clear[small] = wall.left_exactly(points[small]) - radius[small]
        found = np.minimum(found, clear)
    return found


def _read_bodies(arrays: dict[str, Array], packed: dict[str, Any] | None) -> list[Any]:
    """Resolve the table of rows in which a plan's meta describes its bodies, into nested dictionaries."""
    if packed is None:
        return []
    rows: list[Any] = []

    def resolve(part: Any) -> Any:
        if isinstance(part, list):
            return [resolve(item) for item in part]
        if isinstance(part, dict):
            return rows[part["row"]] if "row" in part else float(part["number"])
        return part

    for row in packed["table"]:
        if "array" in row:
            rows.append(arrays["walls_" + row["array"]])
        else:
            rows.append({name: resolve(part) for name, part in row["fields"].items()})
    return list(resolve(packed["bodies"]))


def find_deepest_contact(wall: MeasuredWall, body: RobotShape, exactly: bool = True) -> Array:
    """Return the deepest contact (n,) of robots, mm; negative where a robot is clear of the wall, by that much.

    exactly: whether the places that decide are measured at the triangles of the wall.
    """
    lengths = np.diff(body.s, axis=0)
    steps, count = lengths.shape
    step, row = (each.ravel() for each in np.indices((steps, count)))

    def clearances(chosen: Array, parts: int, left: Callable[[Array], Array]) -> Array:
        """Return the least clearance of steps (m,) at parts + 1 places of each."""
        z = np.linspace(0, 1, parts + 1)
        points = body.points_in_steps(step[chosen, None], row[chosen, None], z[None])
        # Both ends of every step count: where a tube ends, the place belongs to the wider tube as well.
        away = left(points.reshape(-1, 3)).reshape(points.shape[:-1])
        return away.min(axis=1) - body.radius[step[chosen], row[chosen]]

    present = np.flatnonzero(lengths.ravel() > 0)
    least = np.full(steps * count, np.inf)
    least[present] = clearances(present, 2, wall.left)
    # Between these places, which are half a step apart, a clearance falls by less than half a step.
    bound = least.reshape(steps, count).min(axis=0) + lengths.max(axis=0) / 2
    fine = present[least[present] <= bound[row[present]]]
    parts = int(np.ceil(lengths.max() / BODY_SPACING_MM))
    least[fine] = clearances(fine, parts, wall.left)
    if exactly:
        bound = least.reshape(steps, count).min(axis=0) + FIELD_ERROR_MM
        decisive = fine[least[fine] <= bound[row[fine]]]
        least[decisive] = clearances(decisive, parts, wall.left_exactly)
    return -least.reshape(steps, count).min(axis=0)
