"""Surfaces of triangles, and the exact distance of points from them.

Verdicts use it, since a distance field rounds off the middle of a narrow lumen and the steps between voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_objects import Value
from ctr_nlp.typing import Array

NEAREST_VERTICES = 3
"""Vertices near a point whose triangles are looked at: the nearest triangle need not touch the nearest vertex."""
LEAST_SINE = 1e-9
"""Sine of the angle between two sides of a triangle below which it has no area."""
CHUNK_POINTS = 20_000
"""Points that are looked at together, which bounds the memory."""


@packable("surface")
@dataclass(frozen=True, eq=False)
class Surface(Value):
    """Triangles in space. vertices: (n, 3) mm. triangles: (m, 3), indices of their corners.

    Distances are exact where triangles are about as wide as long, as those of marching cubes are.
    """

    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]

    @cached_property
    def _tree(self) -> cKDTree:
        """Search tree of the vertices."""
        return cKDTree(self.vertices)

    @cached_property
    def _beside(self) -> npt.NDArray[np.int32]:
        """Triangles (n, most) at every vertex; shorter lists repeat their last."""
        corners = self.triangles.ravel()
        order = np.argsort(corners, kind="stable")
        count = np.bincount(corners, minlength=len(self.vertices))
        first = np.cumsum(count) - count
        place = np.minimum(np.arange(max(int(count.max(initial=0)), 1)), np.maximum(count - 1, 0)[:, None])
        return np.asarray((order // 3)[np.minimum(first[:, None] + place, len(order) - 1)], dtype=np.int32)

    def apply_transform(self, transform: Array) -> Surface:
        """Return the surface moved by a rigid transform (4, 4)."""
        moved = self.vertices @ transform[:3, :3].T + transform[:3, 3]
        return Surface(moved.astype(np.float32), self.triangles)

    def distances(self, points: Array) -> Array:
        """Return the distances (n,) of points (n, 3) from the surface, mm, without a sign; NaN for NaN."""
        found = np.full(len(points), np.nan)
        known = np.flatnonzero(np.isfinite(points).all(axis=1))
        for chunk in np.array_split(known, max(1, -(-len(known) // CHUNK_POINTS))):
            found[chunk] = self._distances(points[chunk])
        return found

    def _distances(self, points: Array) -> Array:
        """Return the distances (n,) of some points (n, 3), all finite."""
        if not len(points):
            return np.zeros(0)
        count = min(NEAREST_VERTICES, len(self.vertices))
        _, near = self._tree.query(points, k=count)
        candidates = self._beside[near.reshape(len(points), count)].reshape(len(points), -1)
        corners = self.vertices[self.triangles[candidates]].astype(float)
        a, b, c = np.moveaxis(corners, -2, 0)
        return np.asarray(np.sqrt(triangle_distances_squared(points[:, None], a, b, c).min(axis=1)))


def triangle_distances_squared(point: Array, a: Array, b: Array, c: Array) -> Array:
    """Compute squared distances of points from triangles.

    Parameters
    ----------
    point, a, b, c : ndarray
        Points and corners (.., 3), mm.

    Returns
    -------
    ndarray
        Squared distances (..,), mm^2: to the plane where the foot of the perpendicular lies in the triangle, else
        to the nearest edge.
    """
    ab, ac = b - a, c - a
    normal = np.cross(ab, ac)
    square = (normal**2).sum(axis=-1)
    # Triangles without an area have no plane: their edges are all that they are.
    flat = square <= LEAST_SINE**2 * (ab**2).sum(axis=-1) * (ac**2).sum(axis=-1)
    size = np.where(flat, 1.0, square)
    offset = point - a
    # Barycentric coordinates of the foot of the perpendicular.
    v = (np.cross(offset, ac) * normal).sum(axis=-1) / size
    w = (np.cross(ab, offset) * normal).sum(axis=-1) / size
    inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)
    height = (offset * normal).sum(axis=-1) ** 2 / size
    edges = [_segment_distances_squared(point, *ends) for ends in ((a, b), (b, c), (c, a))]
    return np.where(inside, height, np.minimum.reduce(edges))


def _segment_distances_squared(point: Array, start: Array, end: Array) -> Array:
    """Return squared distances (..,) of points (.., 3) from the segments from start to end (.., 3), mm^2."""
    along = end - start
    length = np.maximum((along**2).sum(axis=-1), np.finfo(float).tiny)
    part = np.clip(((point - start) * along).sum(axis=-1) / length, 0.0, 1.0)
    return np.asarray(((point - start - part[..., None] * along) ** 2).sum(axis=-1))
