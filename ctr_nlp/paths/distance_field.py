"""Signed distance to a wall as a smooth function of the place, for walls that are not round.

The distance is stored at the nodes of grids, as coefficients c of tricubic B-splines:

    d(p) = sum_ijk c_ijk B(u - i) B(v - j) B(w - k)

with (u, v, w) the place of p in units of the grid. It is positive inside the lumen and negative beyond the wall,
in mm, and has continuous second derivatives within a grid. The coefficients are c = (1 - D_x/6)(1 - D_y/6)(1 -
D_z/6) f of the distances f at the nodes, D the second difference along an axis. This quasi-interpolant is exact
for cubics (de Boor and Fix, J. Approx. Theory 8, 1973), with an error of h^4 f''''/36 along each axis for nodes h
apart; it needs the neighbours of a node alone, so that only the blocks of nodes around the wall are stored.

A field has a fine grid near the wall, in blocks, and a coarse one everywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.lumen import LumenProjection
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_objects import Value
from ctr_nlp.typing import Array, Flags

BLOCK_NODES = 8
"""Cells along each side of a block; a block stores the coefficients that its cells need."""
STENCIL_NODES = 4
"""Coefficients along each axis that a place depends on."""
BLOCK_COEFFICIENTS = BLOCK_NODES + STENCIL_NODES - 1
"""Coefficients along each side of a block."""
FLATTEST_RADIUS_MM = 50.0
"""Radius of curvature in mm beyond which a wall counts as flat."""
SHARPEST_RADIUS_CELLS = 0.5
"""Least radius of curvature of a wall, in cells of the finest grid: sharper bends are noise of the voxels."""
FAR_MM = 1e4
"""Length in mm by which a field continues beside any place: it has no ends as a path has."""


@packable("distance-grid")
@dataclass(frozen=True, eq=False)
class DistanceGrid(Value):
    """Blocks of coefficients of one grid.

    to_grid: affine transform (4, 4) from mm to units of the grid. index: number of the block at each place
    (l, m, n) of the grid of blocks, -1 where there is none. coefficients: (blocks, 11, 11, 11) mm, the first for
    the node before the block's first.
    """

    to_grid: Array
    index: npt.NDArray[np.int32]
    coefficients: npt.NDArray[np.float32]

    @property
    def last_place(self) -> Array:
        """Largest place (3,) within the grid."""
        return np.array(self.index.shape) * BLOCK_NODES - 1e-9

    def locate(self, points: Array, clip: bool = False) -> tuple[Array, npt.NDArray[np.intp]]:
        """Return the places (n, 3) of points (n, 3) in units of the grid, and their blocks (n,), -1 outside.

        clip: whether points outside are taken for those at the grid's border.
        """
        places = points @ self.to_grid[:3, :3].T + self.to_grid[:3, 3]
        if clip:
            places = np.clip(places, 0.0, self.last_place)
        blocks = np.floor(places / BLOCK_NODES).astype(np.intp)
        inside = ((blocks >= 0) & (blocks < self.index.shape)).all(axis=1)
        found = np.full(len(points), -1, np.intp)
        found[inside] = self.index[tuple(blocks[inside].T)]
        return places, found

    def evaluate(self, places: Array, blocks: npt.NDArray[np.intp]) -> tuple[Array, Array, Array]:
        """Return distance (n,), gradient (n, 3) and second derivatives (n, 3, 3) by mm at places in blocks.

        places (n, 3), blocks (n,): as `locate` gives them, all in a block.
        """
        cells = np.floor(places).astype(np.intp)
        first = cells % BLOCK_NODES
        # (n, order, axis, 4): the B-spline's values and derivatives at the four coefficients along each axis.
        basis = cubic_basis(places - cells)
        steps = np.arange(STENCIL_NODES)
        at = [first[:, axis, None] + steps for axis in range(3)]
        local = self.coefficients[
            blocks[:, None, None, None], at[0][:, :, None, None], at[1][:, None, :, None], at[2][:, None, None, :]
        ].astype(float)

        # One axis is summed after the other, so that (n, 3, 3, 3) has the derivatives of orders 0 to 2 along each.
        along_z = local.reshape(-1, STENCIL_NODES**2, STENCIL_NODES) @ np.swapaxes(basis[:, :, 2], 1, 2)
        along_yz = basis[:, None, :, 1] @ along_z.reshape(-1, STENCIL_NODES, STENCIL_NODES, 3)
        found = (basis[:, :, 0] @ along_yz.reshape(-1, STENCIL_NODES, 9)).reshape(-1, 3, 3, 3)
        distance = found[:, 0, 0, 0]
        slope = np.stack([found[:, 1, 0, 0], found[:, 0, 1, 0], found[:, 0, 0, 1]], axis=1)
        bend = np.empty((len(places), 3, 3))
        for row, column, orders in (
            *((0, 0, (2, 0, 0)), (1, 1, (0, 2, 0)), (2, 2, (0, 0, 2))),
            *((0, 1, (1, 1, 0)), (0, 2, (1, 0, 1)), (1, 2, (0, 1, 1))),
        ):
            bend[:, row, column] = bend[:, column, row] = found[(..., *orders)]
        # Derivatives by units of the grid become derivatives by mm.
        scale = self.to_grid[:3, :3]
        return distance, slope @ scale, scale.T @ bend @ scale


@packable("distance-field")
@dataclass(frozen=True, eq=False)
class DistanceField(Value):
    """Signed distance to a wall: positive inside the lumen, mm.

    grids: from the finest to the coarsest; the coarsest has every block. A place belongs to the first grid that
    has its block. Beyond the coarsest grid the distance falls by a mm for each mm.
    """

    grids: tuple[DistanceGrid, ...]

    def __post_init__(self) -> None:
        if not self.grids or (self.grids[-1].index < 0).any():
            raise CurveError("a distance field needs a coarsest grid in which every block is known")

    def apply_transform(self, transform: Array) -> DistanceField:
        """Return the field moved by a rigid transform (4, 4)."""
        back = np.linalg.inv(transform)
        return DistanceField(tuple(replace(grid, to_grid=grid.to_grid @ back) for grid in self.grids))

    @property
    def cell_mm(self) -> float:
        """Least side of the finest grid's cells, mm."""
        return float(1.0 / np.linalg.norm(self.grids[0].to_grid[:3, :3], axis=1).max())

    @property
    def sharpest_radius(self) -> float:
        """Least radius of curvature of the wall, mm."""
        return SHARPEST_RADIUS_CELLS * self.cell_mm

    def evaluate(self, points: Array) -> tuple[Array, Array, Array]:
        """Evaluate the distance and its derivatives.

        Parameters
        ----------
        points : ndarray
            Points (n, 3), mm.

        Returns
        -------
        distance : ndarray
            Signed distances (n,), mm; NaN for points that are NaN.
        gradient : ndarray
            First derivatives (n, 3).
        hessian : ndarray
            Second derivatives (n, 3, 3), 1/mm.
        """
        distance, gradient = np.full(len(points), np.nan), np.full((len(points), 3), np.nan)
        hessian = np.full((len(points), 3, 3), np.nan)
        left: Flags = np.asarray(np.isfinite(points).all(axis=1))
        inside, beyond = self._clip_to_coarsest(np.where(left[:, None], points, 0.0))
        for grid in self.grids:
            if not left.any():
                break
            # Rounding must not take a point at the border of the coarsest grid out of it.
            places, blocks = grid.locate(inside, clip=grid is self.grids[-1])
            here = np.flatnonzero(left & (blocks >= 0))
            distance[here], gradient[here], hessian[here] = grid.evaluate(places[here], blocks[here])
            left[here] = False
        away = np.linalg.norm(beyond, axis=1)
        out = np.flatnonzero(np.isfinite(distance) & (away > 0))
        # Beyond the grids the field is that of the nearest place in them, less the distance from there.
        distance[out] -= away[out]
        gradient[out] = -beyond[out] / away[out, None]
        hessian[out] = 0.0
        return distance, gradient, hessian

    def _clip_to_coarsest(self, points: Array) -> tuple[Array, Array]:
        """Return the nearest places (n, 3) within the coarsest grid, and by how much (n, 3) points are beyond."""
        grid = self.grids[-1]
        places = points @ grid.to_grid[:3, :3].T + grid.to_grid[:3, 3]
        most = grid.last_place
        back = np.linalg.inv(grid.to_grid)
        inside = np.clip(places, 0.0, most) @ back[:3, :3].T + back[:3, 3]
        outside: Flags = np.asarray(((places < 0) | (places > most)).any(axis=1))
        return np.where(outside[:, None], inside, points), np.where(outside[:, None], points - inside, 0.0)

    def project(self, points: Array, sign: float = 1.0, margin: float = 0.0) -> LumenProjection:
        """Describe the wall near points as a lumen around a path, so that programs see one kind of wall.

        Parameters
        ----------
        points : ndarray
            Points (.., 3), mm.
        sign : float
            1 for a robot inside the field's body, -1 for one outside of it.
        margin : float
            Distance that is taken off, mm.

        Returns
        -------
        LumenProjection
            A path and a radius with the same distance to the wall, the same slope direction and the same two
            curvatures as the field at the point, as :func:`osculating_path` finds them.
        """
        flat = points.reshape(-1, 3)
        distance, gradient, hessian = self.evaluate(flat)
        given = sign * distance - margin, sign * gradient, sign * hessian
        found = osculating_path(flat, *given, self.sharpest_radius)
        return LumenProjection(*(each.reshape(points.shape[:-1] + each.shape[1:]) for each in found))


def cubic_basis(part: Array) -> Array:
    """Evaluate the cubic B-splines that are not 0 at a place, and their derivatives.

    Parameters
    ----------
    part : ndarray
        Part of a cell (..,), in [0, 1].

    Returns
    -------
    ndarray
        For each place its axis moved last but one: (n, 3, axes, 4): values, first and second derivatives of the
        four splines, for ``part`` (n, axes).
    """
    t = part[..., None]
    values = np.concatenate(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=-1
    )
    first = np.concatenate([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], axis=-1)
    second = np.concatenate([1 - t, 3 * t - 2, 1 - 3 * t, t], axis=-1)
    return np.stack([values / 6, first / 2, second], axis=1)


def osculating_path(
    points: Array, distance: Array, gradient: Array, hessian: Array, sharpest: float
) -> tuple[Array, ...]:
    r"""Find the path and radius whose lumen has the wall of a distance field near points.

    With n the direction in which the distance grows, the wall has two principal curvatures k1 >= k2 across n,
    along e1 and e2. The path passes at rho = -1/k2 from the point, in the direction n, along the tangent e1, and
    bends by -k1 n; the lumen's radius there is d + rho. The distance to the wall of that lumen then agrees with
    the field in its value, in the direction of its slope, and in its curvatures across it, up to rho limited to
    [sharpest, FLATTEST_RADIUS_MM]: a wall that is flat or bulges inwards along e2 counts as flat in that
    direction. The size of the slope is a number of its own: it is 1 for distances, but less where a smoothed field
    has walls on both sides nearby, and programs that take it for 1 have slopes there that are far off.

    Parameters
    ----------
    points, distance, gradient, hessian : ndarray
        Points (n, 3), mm, and the field there: (n,), (n, 3), (n, 3, 3).
    sharpest : float
        Least radius of curvature, mm.

    Returns
    -------
    tuple of ndarray
        The fields of LumenProjection, (n,) or (n, 3).
    """
    length = np.linalg.norm(gradient, axis=1)
    # Where the slope vanishes, in the middle of a lumen, any direction serves: no wall is near. NaN stays NaN.
    flat = length <= 1e-6
    steep = np.where(flat, 1.0, length)
    normal = np.where(flat[:, None], [0.0, 0.0, 1.0], gradient / steep[:, None])
    e1, e2 = perpendicular_axes(normal)
    across = np.stack([e1, e2], axis=1)
    # Curvatures of the surface on which the field has this value.
    bend = across @ hessian @ across.transpose(0, 2, 1) / steep[:, None, None]
    # Eigenvalues of the symmetric 2 x 2 matrix in closed form; C has the same lines (wall.c).
    mean = (bend[:, 0, 0] + bend[:, 1, 1]) / 2
    # Adding 0 makes a negative zero a positive one, whose angle is 0 in C, too.
    half = (bend[:, 0, 0] - bend[:, 1, 1]) / 2 + 0.0
    spread = np.hypot(half, bend[:, 0, 1])
    angle = np.arctan2(bend[:, 0, 1], half) / 2
    tangent = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    along = np.clip(mean + spread, -1 / sharpest, 1 / sharpest)
    radius_across = 1.0 / np.clip(-(mean - spread), 1 / FLATTEST_RADIUS_MM, 1 / sharpest)
    centre = points + radius_across[:, None] * normal
    bend_along = -along[:, None] * normal
    far = np.where(np.isfinite(distance), FAR_MM, np.nan)
    return (
        *(radius_across, distance + radius_across, centre, tangent, bend_along, bend_along),
        *(0.0 * distance, far, far, length),
    )


def perpendicular_axes(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors (n, 3) perpendicular to unit vectors (n, 3) and to each other."""
    # The axis that the vector is least parallel to, so that the product is never near 0.
    least = np.abs(normal).argmin(axis=1)
    first = np.cross(normal, np.eye(3)[least])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normal, first)


def quasi_interpolant(values: Array) -> Array:
    """Return B-spline coefficients of values at the nodes of blocks, one layer of nodes less on every side.

    Parameters
    ----------
    values : ndarray
        Values (.., l, m, n) at the nodes.

    Returns
    -------
    ndarray
        Coefficients (.., l - 2, m - 2, n - 2), exact for cubics.
    """
    for axis in (-3, -2, -1):
        one = np.moveaxis(values, axis, -1)
        values = np.moveaxis((8 * one[..., 1:-1] - one[..., :-2] - one[..., 2:]) / 6, -1, axis)
    return values


def make_grid(values: Array, to_grid: Array, wanted: Flags | None = None) -> DistanceGrid:
    """Make a grid from distances at all nodes of a box.

    Parameters
    ----------
    values : ndarray
        Signed distances (l, m, n), mm, at whole units of the grid.
    to_grid : ndarray
        Affine transform (4, 4) from mm to indices of `values`.
    wanted : ndarray of bool, optional
        Which blocks (a, b, c) are stored, counted from the third node on along each axis; by default all that fit.

    Returns
    -------
    DistanceGrid
        The blocks that are wanted; its place 0 is the third node.
    """
    # The quasi-interpolant takes one layer of nodes, and a cell another one before its first node.
    count = (np.array(values.shape) - 5) // BLOCK_NODES
    wanted = np.ones(count, bool) if wanted is None else wanted
    places = np.argwhere(wanted)
    index = np.full(wanted.shape, -1, np.int32)
    index[tuple(places.T)] = np.arange(len(places), dtype=np.int32)
    side = BLOCK_COEFFICIENTS + 2
    windows = np.lib.stride_tricks.sliding_window_view(values, (side,) * 3)
    picked = windows[tuple((places * BLOCK_NODES).T)]
    coefficients = np.ascontiguousarray(quasi_interpolant(picked.astype(float)), dtype=np.float32)
    shift = np.eye(4)
    shift[:3, 3] = -2.0
    return DistanceGrid(shift @ to_grid, index, coefficients)
