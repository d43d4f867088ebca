"""The lumen around a path: how much room a robot has in it, and what the wall is like near to it."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.robot import Robot
from ctr_nlp.support.values import floats
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.points import walked
from ctr_nlp.typing import Array, Index

SPACING = 0.5
"""mm between the points of a lumen's table."""
NEWTON = 4
"""Steps from the nearest point of the table to the nearest point of the path."""


class Near(NamedTuple):
    """Places (..,) of a path nearest to points: distance and lumen radius there, mm, and the path around them.

    centre, tangent, bend (.., 3): the path's point, mm, its derivative by arc length and its second, 1/mm.
    taper: by how much the radius grows a mm that a point moves along the tangent. behind, ahead: what there is of
    the path before and after, mm.
    """

    distance: Array
    radius: Array
    centre: Array
    tangent: Array
    bend: Array
    taper: Array
    behind: Array
    ahead: Array


class Lumen:
    """A path and the radius of the lumen around it, from a table (N, 4): x, y, z and radius, mm."""

    def __init__(self, table: Array) -> None:
        self._table = floats(CurveError, "table of a lumen", table, (None, 4))
        centre, radius = self._table[:, :3], self._table[:, 3]
        if (radius <= 0).any():
            raise CurveError(f"radius of a lumen is {radius.min():g} mm; it must be positive all along")
        self._along = walked(centre)
        if len(centre) < 2 or (np.diff(self._along) <= 0).any():
            raise CurveError(f"table of a lumen has {len(centre)} points; it must have two, and none repeated")

    @cached_property
    def _path(self) -> CubicSpline:
        return CubicSpline(self._along, self._table[:, :3])

    @cached_property
    def _radius(self) -> PchipInterpolator:
        return PchipInterpolator(self._along, self._table[:, 3])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self._table[:, :3])

    @classmethod
    def around(cls, curve: Curve) -> Lumen:
        """That of a whole curve with a radius."""
        assert curve.radius is not None
        s = np.linspace(0.0, curve.length, int(np.ceil(curve.length / SPACING)) + 1)
        return cls(np.column_stack([curve.point(s), curve.radius(s)]))

    @property
    def table(self) -> Array:
        """(N, 4), read-only: x, y, z and radius, mm."""
        return self._table

    @property
    def along(self) -> Array:
        """Arc lengths (N,) of the table's points, mm."""
        return self._along

    @property
    def pieces(self) -> tuple[Array, Array]:
        """Cubic pieces of path (4, N - 1, 3) and radius (4, N - 1), mm: coefficients by falling powers."""
        return self._path.c, self._radius.c

    def near(self, points: Array) -> Near:
        """The path and the wall near to points (.., 3) in mm; everything is NaN for points that are."""
        known = np.isfinite(points).all(axis=-1, keepdims=True)
        points = np.where(known, points, 0.0)
        s = self._along[self._tree.query(points)[1]]
        for _ in range(NEWTON):
            away, tangent = points - self._path(s), self._path(s, 1)
            stretch = (tangent**2).sum(axis=-1) - (away * self._path(s, 2)).sum(axis=-1)
            step = (away * tangent).sum(axis=-1) / np.maximum(stretch, 0.1)
            s = np.clip(s + np.clip(step, -SPACING, SPACING), 0.0, self._along[-1])
        centre, tangent, bend = (np.where(known, self._path(s, order), np.nan) for order in range(3))
        away = points - centre
        taper = self._radius(s, 1) / np.maximum(1.0 - (away * bend).sum(axis=-1), 0.1)
        distance = np.linalg.norm(away, axis=-1)
        return Near(distance, self._radius(s), centre, tangent, bend, taper, s, self._along[-1] - s)

    def clearance(self, robot: Robot, beta: Array, sigma: Array, shape: Array) -> Array:
        """What is left between tubes and the wall, (T, n) mm, negative in contact.

        The lumen's radius at the place nearest to a sample, less the distance to it, less the radius of the
        outermost tube there. beta (T, d); sigma (n,) or (T, n); shape (T, n, 3) mm.
        """
        near = self.near(shape)
        return np.asarray(near.radius - near.distance - outer_radii(robot, beta, sigma))


def rings(table: Array, angle: Array) -> Array:
    """Points (N, n, 3) mm of the wall around a table (N, 4), at angles (n,) in rotation-minimising axes."""
    centre, radius = table[:, :3], table[:, 3]
    tangents = np.gradient(centre, walked(centre), axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side, sides = np.eye(3)[abs(tangents[0]).argmin()], np.empty_like(tangents)
    for j, tangent in enumerate(tangents):
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        sides[j] = side
    across = np.cos(angle)[:, None] * sides[:, None] + np.sin(angle)[:, None] * np.cross(tangents, sides)[:, None]
    return np.asarray(centre[:, None] + radius[:, None, None] * across)


def surface(table: Array, around: int) -> tuple[Array, npt.NDArray[np.uint32]]:
    """Vertices (N around, 3) mm of the wall around a table (N, 4), and its triangles, (2 (N - 1) around, 3).

    around: how many vertices each ring has. Triangles turn left seen from outside.
    """
    vertices = rings(table, np.linspace(0.0, 2 * np.pi, around, endpoint=False))
    here = np.arange(vertices[..., 0].size).reshape(-1, around)
    beside, ahead = np.roll(here, -1, axis=1)[:-1], here[1:]
    across = np.roll(here, -1, axis=1)[1:]
    triangles = np.stack([here[:-1], beside, ahead, beside, across, ahead], axis=-1)
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.uint32)


def outer_radius(robot: Robot) -> Array:
    """Of every tube, (d,) mm."""
    return np.array([tube.outer_diameter / 2 for tube in robot.tubes])


def outer_radii(robot: Robot, beta: Array, sigma: Array) -> Array:
    """Of the outermost tube at sigma (n,) or (T, n) of robots beta (T, d): (T, n) mm."""
    return np.asarray(outer_radius(robot)[outermost(beta, sigma)])


def outermost(beta: Array, sigma: Array) -> Index:
    """The outermost tube (T, n), from 0, at normalised arc lengths sigma (n,) or (T, n) of robots beta (T, d)."""
    s = sigma * beta[:, -1:]
    return np.asarray((s[..., None] > beta[:, None, :-1] + 1e-9).sum(axis=-1))
