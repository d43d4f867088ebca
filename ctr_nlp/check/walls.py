"""Walls of a plan's file, and the depth of robots in them, by nearest-point search and by evaluation of splines.

A lumen is a path with a radius; its clearance at a point is the radius at the nearest place of the path less the
distance to it. A body is a signed distance, positive inside, that the file holds as coefficients of tricubic
B-splines in blocks of grids; `scipy.ndimage` evaluates these.
"""

from __future__ import annotations

import itertools
from typing import Any, Protocol

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ctr_nlp.check.tubes import Array, Body

WALL_SPACING_MM = 0.1
"""Between the points of a lumen's path."""
BODY_SPACING_MM = 0.5
"""At most, between the places along the body whose clearance is found."""
BLOCK_CELLS = 8
"""Cells along each side of a block of a grid, as the format of the file has it."""


class Wall(Protocol):
    """Protocol of walls."""

    def left(self, points: Array) -> Array:
        """Return the distance (..,) mm from points (.., 3) to the wall, negative beyond it."""


class LumenWall:
    """The wall of a lumen, from a table (N, 4) of x, y, z and radius, mm.

    The path is a polyline through the table's points, of which each part is divided finely, and the nearest place
    is looked for on the two parts beside the nearest point.
    """

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


class FieldWall:
    """The surface of a body, from the rows and arrays of a plan's file; lengths in mm.

    body: with ``keep_out``, ``margin`` and ``field``, whose ``grids`` go from the finest to the coarsest; each has
    ``to_grid`` (4, 4), ``index`` of blocks, -1 where there is none, and their ``coefficients``.
    """

    def __init__(self, body: dict[str, Any]) -> None:
        self._sign = -1.0 if body["keep_out"] else 1.0
        self._margin = float(body["margin"])
        self._grids = body["field"]["grids"]

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


class NearestWall:
    """Several walls, of which the nearest counts at every point."""

    def __init__(self, walls: list[Wall]) -> None:
        self._walls = walls

    def left(self, points: Array) -> Array:
        """Return the distance (..,) mm from points (.., 3) to the nearest wall, negative beyond it."""
        return np.asarray(np.min([wall.left(points) for wall in self._walls], axis=0))


def read_wall(arrays: dict[str, Array], meta: dict[str, Any]) -> Wall | None:
    """Return the wall in a plan's arrays and meta; None without one."""
    bodies = _read_bodies(arrays, meta.get("walls"))
    walls: list[Wall] = [FieldWall(body) for body in bodies]
    # The lumen around the path is no wall where the robot stays inside of a body.
    if "lumen" in arrays and all(body["keep_out"] for body in bodies):
        walls.append(LumenWall(arrays["lumen"]))
    return NearestWall(walls) if walls else None


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


def find_deepest_contact(wall: Wall, body: Body) -> Array:
    """Return the deepest contact (n,) of robots, mm; negative where a robot is clear of the wall, by that much."""
    lengths = np.diff(body.s, axis=0)
    steps, count = lengths.shape
    step, row = (each.ravel() for each in np.indices((steps, count)))

    def clearances(chosen: Array, parts: int) -> Array:
        """Return the least clearance of steps (m,) at parts + 1 places of each."""
        z = np.linspace(0, 1, parts + 1)
        points = body.points_in_steps(step[chosen, None], row[chosen, None], z[None])
        # Both ends of every step count: where a tube ends, the place belongs to the wider tube as well.
        return wall.left(points).min(axis=1) - body.radius[step[chosen], row[chosen]]

    present = np.flatnonzero(lengths.ravel() > 0)
    least = np.full(steps * count, np.inf)
    least[present] = clearances(present, 2)
    # Between these places, which are half a step apart, a clearance falls by less than half a step.
    bound = least.reshape(steps, count).min(axis=0) + lengths.max(axis=0) / 2
    fine = present[least[present] <= bound[row[present]]]
    least[fine] = clearances(fine, int(np.ceil(lengths.max() / BODY_SPACING_MM)))
    return -least.reshape(steps, count).min(axis=0)
