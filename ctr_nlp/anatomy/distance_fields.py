"""Walls from masks and surfaces: signed distances at the nodes of grids (paths/distance_field.py).

The wall of a mask is the surface at half of the mask's value, smoothed by half a voxel: unbiased on cylinders,
where the nearest voxel centre lies 0.15 to 0.2 mm inside. Distances are measured from the vertices of that
surface, about half a voxel apart, along their normals.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, distance_transform_edt, find_objects, gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.distance_field import BLOCK_COEFFICIENTS, BLOCK_NODES, DistanceField, make_grid
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array, Flags

MASK_SMOOTHING_VOXELS = 0.5
"""Standard deviation of the smoothing of a mask, in voxels along each axis."""
MASK_WALL_VALUE = 0.5
"""Value of the smoothed mask at the wall."""
STEP_SMOOTHING_ROUNDS = 20
"""Rounds of Taubin's filter, which flattens the steps of the voxels in the surface."""
STEP_PASS_BAND = 0.05
"""Frequency up to which that filter keeps the surface, as a part of its sampling frequency: measured on cylinders
and spheres of 2 to 7 voxels radius, where the median error falls from 0.12 to 0.06 voxels."""
BAND_CELLS = 4
"""Cells on both sides of the wall in which distances of the fine grid are exact."""
COARSE_STRIDE = 4
"""Nodes of the coarse grid are so many nodes of the fine one apart."""
COARSE_BAND_CELLS = 2
"""Cells of the coarse grid from the wall within which the nearest vertex is searched for each node."""
MARGIN_MM = 20.0
"""How far the coarse grid continues beyond the lumen."""
PLANE_RANGE_CELLS = 1.5
"""Distance from a vertex along the surface, in cells, within which the surface counts as its tangent plane."""


def surface_of_mask(lumen: Flags, affine: Array) -> tuple[Array, Array]:
    """Return vertices and unit normals into the lumen, both (n, 3), of the wall of a mask, in the mask's space.

    lumen (l, m, n): voxels of the lumen. affine (4, 4): from index to mm, with perpendicular axes. The border of
    the image is a wall. Raises CurveError where the mask has no wall, and OptionError where pyvista is missing.
    """
    pyvista = import_extra("pyvista")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    # Two voxels of wall on every side close the surface where the image cuts the lumen.
    smooth = gaussian_filter(np.pad(lumen, 2).astype(np.float32), MASK_SMOOTHING_VOXELS)
    image = pyvista.ImageData(dimensions=smooth.shape, spacing=spacing, origin=-2 * spacing)
    image.point_data["mask"] = smooth.ravel(order="F")
    found = image.contour([MASK_WALL_VALUE], scalars="mask", method="flying_edges", compute_normals=False)
    if not found.n_points:
        raise CurveError("its lumen is thinner than a voxel: no wall can be made of it")
    # Taubin's filter flattens the steps of the voxels without shrinking the surface.
    found = found.smooth_taubin(n_iter=STEP_SMOOTHING_ROUNDS, pass_band=STEP_PASS_BAND)
    # flying_edges orders corners so that normals point to smaller values, out of the lumen.
    found = found.compute_normals(
        cell_normals=False, split_vertices=False, consistent_normals=False, auto_orient_normals=False
    )
    axes = affine[:3, :3] / spacing
    vertices = np.asarray(found.points, dtype=float) @ axes.T + affine[:3, 3]
    return vertices, -np.asarray(found.point_data["Normals"], dtype=float) @ axes.T


def distances_to_surface(points: Array, vertices: Array, normals: Array, cell: float) -> Array:
    """Return distances (n,), mm, of points (n, 3) from a surface, without a sign.

    vertices, normals (m, 3): of the surface. cell: distance of neighbouring vertices, at most, mm.
    """
    away, nearest = cKDTree(vertices).query(points, workers=-1)
    offset = points - vertices[nearest]
    height = np.abs((offset * normals[nearest]).sum(axis=1))
    aside = np.sqrt(np.maximum(away**2 - height**2, 0.0))
    # The nearest vertex is beside the nearest point of the surface: near it the tangent plane is nearer to the
    # truth, further away (beyond an edge) the vertex itself.
    return np.asarray(np.where(aside <= PLANE_RANGE_CELLS * cell, height, away))


def field_of_mask(lumen: Flags, affine: Array) -> DistanceField:
    """Make the distance field of a mask.

    Parameters
    ----------
    lumen : ndarray of bool
        Voxels of the lumen (l, m, n).
    affine : ndarray
        Transform (4, 4) from index to mm; its axes are perpendicular.

    Returns
    -------
    DistanceField
        Positive in the lumen, in the coordinates of `affine`.

    Raises
    ------
    CurveError
        The mask has no wall.
    OptionError
        pyvista is not installed.
    """
    lumen, affine = _crop(lumen, affine)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    vertices, normals = surface_of_mask(lumen, affine)
    # A box of whole blocks around the lumen; the coarse grid has MARGIN_MM more.
    edge = COARSE_STRIDE * np.ceil(MARGIN_MM / spacing / COARSE_STRIDE).astype(int)
    shape = np.array(lumen.shape) + 2 * edge
    start = -edge
    coarse = _coarse_values(lumen, affine, vertices, normals, start, shape)
    coarse_to_mm = affine @ _scaling(float(COARSE_STRIDE), start)
    fine, wanted = _fine_values(lumen, affine, vertices, normals, coarse, start)
    fine_to_mm = affine @ _scaling(1.0, np.array(_FINE_PAD))
    return DistanceField(
        (
            make_grid(fine, np.asarray(np.linalg.inv(fine_to_mm), dtype=float), wanted),
            make_grid(coarse, np.asarray(np.linalg.inv(coarse_to_mm), dtype=float)),
        )
    )


_FINE_PAD = (-8, -8, -8)
"""First node of the fine grid, in voxels: room for the blocks at the border of the image."""


def _crop(lumen: Flags, affine: Array) -> tuple[Flags, Array]:
    """Return the smallest box of a mask that holds its lumen, and the transform (4, 4) of its indices to mm."""
    if not lumen.any():
        raise CurveError("its lumen has no voxel")
    (box,) = find_objects(lumen.view(np.uint8))
    moved = affine.copy()
    moved[:3, 3] += affine[:3, :3] @ [part.start for part in box]
    return np.ascontiguousarray(lumen[box]), moved


def _scaling(stride: float, start: npt.NDArray[np.integer[Any]]) -> Array:
    """Return the transform (4, 4) from nodes of a grid to voxels; start (3,): its first node."""
    found = np.diag([stride, stride, stride, 1.0])
    found[:3, 3] = start
    return found


def _inside(lumen: Flags, nodes: npt.NDArray[np.integer[Any]]) -> Flags:
    """Return which nodes (n, 3), in voxels, are voxels of the lumen."""
    within = ((nodes >= 0) & (nodes < lumen.shape)).all(axis=1)
    found = np.zeros(len(nodes), bool)
    found[within] = lumen[tuple(nodes[within].T)]
    return found


def _measure_signed_distances(
    lumen: Flags, affine: Array, vertices: Array, normals: Array, nodes: npt.NDArray[np.integer[Any]]
) -> Array:
    """Return signed distances (n,), mm, at nodes (n, 3) in voxels."""
    cell = float(np.linalg.norm(affine[:3, :3], axis=0).max())
    away = distances_to_surface(nodes @ affine[:3, :3].T + affine[:3, 3], vertices, normals, cell)
    return np.where(_inside(lumen, nodes), away, -away)


def _coarse_values(
    lumen: Flags,
    affine: Array,
    vertices: Array,
    normals: Array,
    start: npt.NDArray[np.integer[Any]],
    shape: npt.NDArray[np.integer[Any]],
) -> Array:
    """Return signed distances (l, m, n), mm, at the nodes of the coarse grid, whole blocks and what they need.

    Exact near the wall. Further away the vertex that is nearest to the closest such node is taken for the nearest:
    a search for each node would take most of the time that a field needs.
    """
    cells = -(-shape // COARSE_STRIDE)
    count = BLOCK_NODES * -(-cells // BLOCK_NODES) + 5
    nodes = start + COARSE_STRIDE * np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1).reshape(-1, 3)
    points = nodes @ affine[:3, :3].T + affine[:3, 3]
    spacing = COARSE_STRIDE * np.linalg.norm(affine[:3, :3], axis=0)
    _, nearest = cKDTree(vertices).query(
        points, distance_upper_bound=COARSE_BAND_CELLS * float(spacing.max()), workers=-1
    )
    searched = nearest < len(vertices)
    _, closest = distance_transform_edt(~searched.reshape(count), sampling=spacing, return_indices=True)
    nearest = nearest[np.ravel_multi_index(tuple(closest.reshape(3, -1)), count)]
    away = np.linalg.norm(points - vertices[nearest], axis=1)
    return np.where(_inside(lumen, nodes), away, -away).reshape(count)


def _fine_values(
    lumen: Flags,
    affine: Array,
    vertices: Array,
    normals: Array,
    coarse: Array,
    start: npt.NDArray[np.integer[Any]],
) -> tuple[Array, Flags]:
    """Return signed distances, mm, at the nodes of the fine grid, and the blocks (a, b, c) that touch the band."""
    pad = -np.array(_FINE_PAD)
    blocks = -(-(np.array(lumen.shape) + 2 * pad - 5) // BLOCK_NODES)
    shape = BLOCK_NODES * blocks + 5
    back = np.linalg.inv(affine)
    at = np.rint(vertices @ back[:3, :3].T + back[:3, 3]).astype(int) + pad
    band = np.zeros(shape, bool)
    band[tuple(at.T)] = True
    band = binary_dilation(band, np.ones((3, 3, 3), bool), iterations=BAND_CELLS)
    # Blocks with a cell in the band; block 0 begins at the third node.
    inner = band[2 : 2 + BLOCK_NODES * blocks[0], 2 : 2 + BLOCK_NODES * blocks[1], 2 : 2 + BLOCK_NODES * blocks[2]]
    wanted = inner.reshape(blocks[0], BLOCK_NODES, blocks[1], BLOCK_NODES, blocks[2], BLOCK_NODES).any(
        axis=(1, 3, 5)
    )
    values = np.zeros(shape, np.float32)
    needed = _nodes_of_blocks(wanted, shape)
    # Nodes of these blocks outside of the band are filled from the coarse grid: no cell of the band needs them.
    far = np.argwhere(needed & ~band)
    values[tuple(far.T)] = map_coordinates(coarse, ((far - pad - start) / COARSE_STRIDE).T, order=1)
    near = np.argwhere(band & needed)
    values[tuple(near.T)] = _measure_signed_distances(lumen, affine, vertices, normals, near - pad)
    return values, wanted


def _nodes_of_blocks(wanted: Flags, shape: npt.NDArray[np.integer[Any]]) -> Flags:
    """Return which nodes (of `shape`) the blocks that are wanted need, with the neighbours of their nodes."""
    found = np.zeros(shape, bool)
    side = BLOCK_COEFFICIENTS + 2
    for place in np.argwhere(wanted) * BLOCK_NODES:
        found[tuple(slice(first, first + side) for first in place)] = True
    return found
