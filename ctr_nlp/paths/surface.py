"""Surfaces of triangles, and the exact signed distance of points from them.

A smooth distance field (distance_field.py) rounds off edges and the middle of a narrow lumen. Verdicts therefore
measure at the triangles. The distance is that to the nearest triangle; its sign is that of the surface's normal at
the nearest point, interpolated between normals of the corners that are weighted by angle (Baerentzen and Aanaes,
IEEE TVCG 11, 2005). The sign needs no closed surface: beyond an opening the surface counts as going on.

The nearest triangle is found among pieces of triangles, none wider than PIECE_MM: where the k-th nearest centre of
a piece is further away than the nearest of these triangles plus the radius of a piece, no other one is nearer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_objects import Value
from ctr_nlp.typing import Array, Flags

PIECE_MM = 1.5
"""Longest side in mm of the pieces of triangles that are searched."""
FIRST_PIECES = 8
"""Pieces whose triangles are looked at first; twice as many where these do not settle which one is nearest."""
MAX_PIECES = 2048
"""Most pieces of a point that are looked at: further away all triangles are nearly as near."""
CHUNK_PAIRS = 150_000
"""Pairs of points and pieces that are looked at together, which bounds the memory."""
SMALLEST = float(np.finfo(float).tiny)


class _Foot(NamedTuple):
    """The nearest point of the nearest triangle: its squared distance (n,), triangle (n,), and weights (n, 3)."""

    square: Array
    triangle: npt.NDArray[np.intp]
    weights: Array


@packable("surface")
@dataclass(frozen=True, eq=False)
class Surface(Value):
    """Triangles in space, closed or open.

    Attributes
    ----------
    vertices : ndarray
        Points (n, 3), mm.
    triangles : ndarray
        Indices (m, 3) of corners, which turn left seen from outside of the body.

    Raises
    ------
    CurveError
        There is no triangle, or an index or a coordinate is out of range.

    Examples
    --------
    >>> corner = Surface(np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
    >>> corner.signed_distances(np.array([[1.0, 1.0, -2.0], [1.0, 1.0, 3.0]])).tolist()
    [2.0, -3.0]
    """

    vertices: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, np.float32)
        triangles = np.ascontiguousarray(self.triangles, np.int32)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)
        if triangles.ndim != 2 or triangles.shape[1:] != (3,) or not len(triangles):
            raise CurveError(f"triangles of a surface have shape {triangles.shape}; it must be (m, 3) with m > 0")
        if vertices.shape[1:] != (3,) or not np.isfinite(vertices).all():
            raise CurveError("vertices of a surface must be finite points (n, 3) in mm")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise CurveError(f"a triangle has a corner that is none of the {len(vertices)} vertices")

    @cached_property
    def corners(self) -> Array:
        """Corners (m, 3, 3) of the triangles, mm."""
        return np.asarray(self.vertices[self.triangles], dtype=float)

    @cached_property
    def normals(self) -> Array:
        """Outward normals (m, 3) of the triangles, of length 1; 0 for triangles without an area."""
        return _unit(self._crosses)

    @cached_property
    def _crosses(self) -> Array:
        """Normals (m, 3), twice as long as the triangles are large."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def vertex_normals(self) -> Array:
        """Outward normals (n, 3) at the vertices, weighted by the angles of the triangles there."""
        found = np.zeros((len(self.vertices), 3))
        for k in range(3):
            side = _unit(self.corners[:, (k + 1) % 3] - self.corners[:, k])
            other = _unit(self.corners[:, (k + 2) % 3] - self.corners[:, k])
            angle = np.arccos(np.clip((side * other).sum(axis=1), -1.0, 1.0))
            np.add.at(found, self.triangles[:, k], angle[:, None] * self.normals)
        return _unit(found)

    @cached_property
    def _sides(self) -> tuple[Array, Array, Array, Array, Array, Array]:
        """First corner a and sides ab, ac of each triangle (m, 3), and the products ab ab, ab ac, ac ac (m,)."""
        a = np.ascontiguousarray(self.corners[:, 0])
        ab = self.corners[:, 1] - a
        ac = self.corners[:, 2] - a
        return a, ab, ac, (ab * ab).sum(axis=1), (ab * ac).sum(axis=1), (ac * ac).sum(axis=1)

    @cached_property
    def _pieces(self) -> tuple[Array, npt.NDArray[np.intp], float]:
        """Centres (p, 3) of pieces of the triangles, the triangle of each (p,), and their largest radius, mm."""
        pieces, owners = cut_triangles(self.corners, PIECE_MM)
        centres = pieces.mean(axis=1)
        radius = np.sqrt(((pieces - centres[:, None]) ** 2).sum(axis=2).max())
        return centres, owners, float(radius)

    @cached_property
    def _tree(self) -> cKDTree:
        """Search tree of the pieces' centres."""
        return cKDTree(self._pieces[0])

    @property
    def piece_centres(self) -> Array:
        """Points (p, 3) of the surface, mm, at most PIECE_MM apart."""
        return self._pieces[0]

    @property
    def piece_triangles(self) -> npt.NDArray[np.intp]:
        """The triangle (p,) of each of `piece_centres`."""
        return self._pieces[1]

    def apply_transform(self, transform: Array) -> Surface:
        """Return the surface moved by a rigid transform (4, 4)."""
        moved = self.vertices @ transform[:3, :3].T + transform[:3, 3]
        # A reflection, as from one patient space to a mirrored one, would turn the surface inside out.
        turned = self.triangles if np.linalg.det(transform[:3, :3]) > 0 else self.triangles[:, ::-1]
        return Surface(moved.astype(np.float32), turned)

    def keep_triangles(self, kept: Flags) -> Surface:
        """Return the surface of some triangles.

        Parameters
        ----------
        kept : ndarray of bool
            Which triangles (m,), at least one.

        Returns
        -------
        Surface
            Their surface, with no other vertices.
        """
        used, triangles = np.unique(self.triangles[kept], return_inverse=True)
        return Surface(self.vertices[used], triangles.reshape(-1, 3).astype(np.int32))

    def signed_distances(self, points: Array, exact: bool = True) -> Array:
        """Compute the distance from the surface.

        Parameters
        ----------
        points : ndarray
            Points (n, 3), mm.
        exact : bool
            Whether the search goes on until no nearer triangle is possible. Otherwise the triangles of the
            FIRST_PIECES / 2 nearest pieces are looked at alone, which is exact but for long thin triangles.

        Returns
        -------
        ndarray
            Distances (n,), mm, positive inside and negative outside; NaN for points that are NaN.
        """
        found = np.full(len(points), np.nan)
        known = np.flatnonzero(np.isfinite(points).all(axis=1))
        count = FIRST_PIECES if exact else FIRST_PIECES // 2
        while known.size:
            count = min(count, len(self._pieces[0]))
            left = []
            for chunk in np.array_split(known, -(-known.size * count // CHUNK_PAIRS)):
                at = points[chunk]
                away, pieces = self._tree.query(at, k=[*range(1, count + 1)])
                foot = self._nearest(at, self._pieces[1][pieces])
                distance = np.sqrt(foot.square)
                found[chunk] = np.where(self._outside(at, foot), -distance, distance)
                left.append(chunk[away[:, -1] < distance + self._pieces[2]])
            known = np.concatenate(left) if exact and count < min(MAX_PIECES, len(self._pieces[0])) else known[:0]
            count *= 2
        return found

    def _nearest(self, points: Array, triangles: npt.NDArray[np.intp]) -> _Foot:
        """Return the nearest point of some triangles (n, k) of each point (n, 3).

        A point of a triangle is a + v ab + w ac. All is computed from scalar products of ap with the sides.
        """
        a, ab, ac, bb, bc, cc = (each[triangles] for each in self._sides)
        ap = points[:, None] - a
        pb, pc = (ap * ab).sum(axis=2), (ap * ac).sum(axis=2)
        area = bb * cc - bc * bc
        flat = area <= 1e-18 * bb * cc
        scale = np.where(flat, 1.0, area)
        v, w = (cc * pb - bc * pc) / scale, (bb * pc - bc * pb) / scale
        inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)
        # Where the foot of the perpendicular is outside, the nearest point is on one of three edges.
        on_b = np.clip(pb / np.maximum(bb, SMALLEST), 0.0, 1.0)
        on_c = np.clip(pc / np.maximum(cc, SMALLEST), 0.0, 1.0)
        across = bb - 2 * bc + cc
        on_a = np.clip((pc - pb + bb - bc) / np.maximum(across, SMALLEST), 0.0, 1.0)
        zero = np.zeros_like(v)
        each_v = np.stack([np.where(inside, v, 0.0), on_b, zero, 1 - on_a])
        each_w = np.stack([np.where(inside, w, 0.0), zero, on_c, on_a])
        square = (
            (ap * ap).sum(axis=2)
            - 2 * (each_v * pb + each_w * pc)
            + (each_v**2 * bb + 2 * each_v * each_w * bc + each_w**2 * cc)
        )
        square[0] = np.where(inside, square[0], np.inf)
        side = square.argmin(axis=0)
        square = np.maximum(np.take_along_axis(square, side[None], axis=0)[0], 0.0)
        best = square.argmin(axis=1)
        rows = np.arange(len(points))
        v = each_v[side[rows, best], rows, best]
        w = each_w[side[rows, best], rows, best]
        return _Foot(square[rows, best], triangles[rows, best], np.stack([1 - v - w, v, w], axis=1))

    def _outside(self, points: Array, foot: _Foot) -> Flags:
        """Return which points (n, 3) are outside, by the normal at their nearest points."""
        nearest = (foot.weights[:, :, None] * self.corners[foot.triangle]).sum(axis=1)
        normal = (foot.weights[:, :, None] * self.vertex_normals[self.triangles[foot.triangle]]).sum(axis=1)
        return np.asarray(((points - nearest) * normal).sum(axis=1) > 0)


def _unit(vectors: Array) -> Array:
    """Return vectors (n, 3) at length 1; those of length 0 stay."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), SMALLEST))


def cut_triangles(corners: Array, longest: float) -> tuple[Array, npt.NDArray[np.intp]]:
    """Cut triangles into pieces.

    Parameters
    ----------
    corners : ndarray
        Corners (m, 3, 3), mm.
    longest : float
        Longest side of a piece, mm.

    Returns
    -------
    corners : ndarray
        Those of the pieces (p, 3, 3), mm.
    owners : ndarray
        The triangle (p,) of each.
    """
    owners = np.arange(len(corners))
    done = [(np.zeros((0, 3, 3)), owners[:0])]
    while len(corners):
        # The longest side is halved, so that slivers make few pieces.
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        small = sides.max(axis=1) <= longest
        done.append((corners[small], owners[small]))
        first = sides[~small].argmax(axis=1)
        rows = np.arange(len(first))
        one, two, three = (corners[~small][rows, (first + k) % 3] for k in range(3))
        middle = (one + two) / 2
        corners = np.concatenate([np.stack([one, middle, three], 1), np.stack([middle, two, three], 1)])
        owners = np.tile(owners[~small], 2)
    return np.concatenate([each for each, _ in done]), np.concatenate([each for _, each in done])
