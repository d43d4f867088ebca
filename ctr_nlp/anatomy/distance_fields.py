"""Walls from masks and surfaces: signed distances at the nodes of grids (paths/distance_field.py).

The wall of a mask is the surface at half of the mask's value, smoothed by half a voxel: unbiased on cylinders,
where the nearest voxel centre lies 0.15 to 0.2 mm inside. Where the border of the image cuts the lumen, the
surface is open. Its steps from voxel to voxel are flattened before a field is made of it: programs follow the
field's curvatures, and verdicts measure at the surface itself. Distances are those to the nearest triangle.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, distance_transform_edt, find_objects, gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.distance_field import BLOCK_COEFFICIENTS, BLOCK_NODES, DistanceField, make_grid
from ctr_nlp.paths.surface import Surface
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array, Flags

MASK_SMOOTHING_VOXELS = 0.5
"""Standard deviation of the smoothing of a mask, in voxels along each axis."""
MASK_WALL_VALUE = 0.5
"""Value of the smoothed mask at the wall."""
STEP_SMOOTHING_ROUNDS = 30
"""Rounds of Taubin's filter, which flattens the steps of the voxels in the surface."""
STEP_PASS_BAND = 0.05
"""Frequency up to which that filter keeps the surface, as a part of its sampling frequency: measured on cylinders
and spheres of 2 to 7 voxels radius, where the median error falls from 0.12 to 0.06 voxels."""
BAND_CELLS = 4
"""Cells on both sides of the wall in which distances of the fine grid are exact."""
COARSE_STRIDE = 4
"""Nodes of the coarse grid are so many nodes of the fine one apart."""
COARSE_BAND_CELLS = 2
"""Cells of the coarse grid from the wall within which the nearest triangle is searched for each node."""
NEAR_MM = 30.0
"""How far a wall is known around a path, mm: robots that follow a path stay nearer to it."""
MARGIN_MM = 20.0
"""How far the coarse grid continues beyond a surface that is known as a whole, mm."""
MESH_CELL_MM = 0.6
"""Side of the fine grid's cells in mm, where a wall is a mesh: that of voxels in scans of the chest."""

Index = npt.NDArray[np.integer[Any]]


def surface_of_mask(lumen: Flags, affine: Array, near: Array | None = None) -> Surface:
    """Make the wall of a mask.

    Parameters
    ----------
    lumen : ndarray of bool
        Voxels of the lumen (l, m, n). Where the border of the image cuts it, the surface is open.
    affine : ndarray
        Transform (4, 4) from index to mm; its axes are perpendicular.
    near : ndarray, optional
        Points (n, 3), mm, around which the wall is made, up to NEAR_MM; by default everywhere.

    Returns
    -------
    Surface
        In the coordinates of `affine`.

    Raises
    ------
    CurveError
        The mask has no wall there.
    OptionError
        pyvista is not installed.
    """
    pyvista = import_extra("pyvista")
    # Cropped first: smoothing a whole scan would take most of the time and of the memory.
    lumen, affine = _crop(lumen, affine, near)
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    # The border is repeated, so that it is no wall.
    smooth = gaussian_filter(np.pad(lumen, 2, mode="edge").astype(np.float32), MASK_SMOOTHING_VOXELS)
    image = pyvista.ImageData(dimensions=smooth.shape, spacing=spacing)
    image.point_data["mask"] = smooth.ravel(order="F")
    found = image.contour([MASK_WALL_VALUE], scalars="mask", method="flying_edges", compute_normals=False)
    if not found.n_points:
        raise CurveError("its lumen is thinner than a voxel: no wall can be made of it")
    # flying_edges orders corners so that normals point to smaller values, out of the lumen.
    to_mm = affine @ np.diag([*(1 / spacing), 1.0])
    to_mm[:3, 3] -= 2 * affine[:3, :3].sum(axis=1)
    whole = Surface(found.points, found.faces.reshape(-1, 4)[:, 1:]).apply_transform(to_mm)
    return whole if near is None else crop_surface(whole, near)


def flatten_steps(surface: Surface) -> Surface:
    """Flatten the steps from voxel to voxel in the surface of a mask, by Taubin's filter.

    Parameters
    ----------
    surface : Surface
        As `surface_of_mask` makes it.

    Returns
    -------
    Surface
        The same triangles between moved vertices.
    """
    pyvista = import_extra("pyvista")
    mesh = pyvista.PolyData.from_regular_faces(surface.vertices, surface.triangles)
    flat = mesh.smooth_taubin(n_iter=STEP_SMOOTHING_ROUNDS, pass_band=STEP_PASS_BAND)
    return Surface(flat.points, surface.triangles)


def field_of_mask(lumen: Flags, affine: Array, near: Array | None = None) -> DistanceField:
    """Make the distance field of a mask.

    Parameters
    ----------
    lumen : ndarray of bool
        Voxels of the lumen (l, m, n). The border of the image is no wall.
    affine : ndarray
        Transform (4, 4) from index to mm; its axes are perpendicular.
    near : ndarray, optional
        Points (n, 3), mm, around which the field is made, up to NEAR_MM; by default everywhere.

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
    return field_of_surface(flatten_steps(surface_of_mask(lumen, affine, near)), near, cells=affine)


def field_of_surface(surface: Surface, near: Array | None = None, cells: Array | None = None) -> DistanceField:
    """Make the distance field of a surface of triangles.

    Parameters
    ----------
    surface : Surface
        Closed or open.
    near : ndarray, optional
        Points (n, 3), mm, around which the field is made, up to NEAR_MM; by default around the whole surface.
    cells : ndarray, optional
        Transform (4, 4) to mm from nodes of the fine grid, with perpendicular axes, as that of a mask; by default
        cubes of MESH_CELL_MM.

    Returns
    -------
    DistanceField
        Positive inside.

    Examples
    --------
    >>> corner = Surface([[0, 0, 0], [40, 0, 0], [0, 40, 0]], [[0, 1, 2]])
    >>> field = field_of_surface(corner)
    >>> np.round(field.evaluate(np.array([[9.0, 9.0, -2.0], [9.0, 9.0, 1.0]]))[0], 3).tolist()
    [2.0, -1.0]
    """
    to_mm = np.diag([*[MESH_CELL_MM] * 3, 1.0]) if cells is None else cells.copy()
    around, margin = (surface.vertices, MARGIN_MM) if near is None else (near, NEAR_MM)
    first, last = _bounds(np.asarray(around, dtype=float), to_mm, margin)
    # From here on nodes count from the first of the box.
    to_mm[:3, 3] += to_mm[:3, :3] @ first
    coarse_to_mm = to_mm @ _scaling(float(COARSE_STRIDE))
    coarse = _coarse_values(surface, coarse_to_mm, last - first)
    fine, wanted, start = _fine_values(surface, to_mm, coarse, last - first)
    fine_to_mm = to_mm.copy()
    fine_to_mm[:3, 3] += to_mm[:3, :3] @ start
    return DistanceField(
        (
            make_grid(fine, np.asarray(np.linalg.inv(fine_to_mm), dtype=float), wanted),
            make_grid(coarse, np.asarray(np.linalg.inv(coarse_to_mm), dtype=float)),
        )
    )


def crop_surface(surface: Surface, near: Array, within: float = NEAR_MM) -> Surface:
    """Keep the triangles of a surface that are near points.

    Parameters
    ----------
    surface : Surface
        The surface.
    near : ndarray
        Points (n, 3), mm.
    within : float
        Distance from the nearest of them, mm.

    Returns
    -------
    Surface
        The triangles of which a part is so near.

    Raises
    ------
    CurveError
        No triangle is so near.
    """
    away, _ = cKDTree(near).query(surface.piece_centres, distance_upper_bound=within)
    kept = np.zeros(len(surface.triangles), bool)
    kept[surface.piece_triangles[np.isfinite(away)]] = True
    if not kept.any():
        gap = cKDTree(near).query(surface.piece_centres)[0].min()
        raise CurveError(
            f"its surface is {gap:.0f} mm away from the path; it must come within {within:g} mm: are both in the "
            "same coordinates (--space) and units (--units)?"
        )
    return surface.keep_triangles(kept)


def _crop(lumen: Flags, affine: Array, near: Array | None) -> tuple[Flags, Array]:
    """Return the box of a mask that holds its lumen near points, and the transform (4, 4) from its indices to mm.

    near: points (n, 3), mm, or None for the whole lumen. A voxel around the lumen is kept, where the image has
    one: it is wall.
    """
    start, stop = np.zeros(3, int), np.array(lumen.shape)
    if near is not None:
        first, last = _bounds(near, affine, NEAR_MM)
        start, stop = np.clip(first, 0, stop), np.clip(last + 1, 0, stop)
    part = lumen[tuple(map(slice, start, stop))]
    if not part.any():
        raise CurveError("its lumen has no voxel" + (f" within {NEAR_MM:g} mm of the path" * (near is not None)))
    (box,) = find_objects(part.view(np.uint8))
    inner = [slice(max(0, each.start - 1), each.stop + 1) for each in box]
    moved = affine.copy()
    moved[:3, 3] += affine[:3, :3] @ (start + [each.start for each in inner])
    return np.ascontiguousarray(part[tuple(inner)]), moved


def _bounds(points: Array, to_mm: Array, margin: float) -> tuple[Index, Index]:
    """Return the first and the last node (3,) of the box of points (n, 3), mm, with a margin in mm.

    to_mm: transform (4, 4) from nodes to mm.
    """
    back = np.linalg.inv(to_mm)
    nodes = points @ back[:3, :3].T + back[:3, 3]
    room = margin / np.linalg.norm(to_mm[:3, :3], axis=0)
    return np.floor(nodes.min(axis=0) - room).astype(int), np.ceil(nodes.max(axis=0) + room).astype(int)


def _scaling(stride: float) -> Array:
    """Return the transform (4, 4) from nodes of a grid to those of one that is `stride` times as fine."""
    return np.diag([stride, stride, stride, 1.0])


def _coarse_values(surface: Surface, to_mm: Array, size: Index) -> Array:
    """Return signed distances (l, m, n), mm, at the nodes of the coarse grid, whole blocks and what they need.

    to_mm: transform (4, 4) from its nodes to mm. size: nodes (3,) of the fine grid that it covers.

    Near the wall each node is measured. Further away the part of the surface that is nearest to the closest such
    node is taken for the nearest, and its sign: a search for each node would take most of the time.
    """
    cells = -(-size // COARSE_STRIDE)
    count = BLOCK_NODES * -(-cells // BLOCK_NODES) + 5
    nodes = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1).reshape(-1, 3)
    points = nodes @ to_mm[:3, :3].T + to_mm[:3, 3]
    spacing = np.linalg.norm(to_mm[:3, :3], axis=0)
    centres = surface.piece_centres
    _, nearest = cKDTree(centres).query(points, distance_upper_bound=COARSE_BAND_CELLS * float(spacing.max()))
    searched = nearest < len(centres)
    if not searched.any():
        return surface.signed_distances(points, exact=False).reshape(count)
    _, closest = distance_transform_edt(~searched.reshape(count), sampling=spacing, return_indices=True)
    closest = np.ravel_multi_index(tuple(closest.reshape(3, -1)), count)
    values = np.empty(len(points))
    values[searched] = surface.signed_distances(points[searched], exact=False)
    far = np.flatnonzero(~searched)
    away = np.linalg.norm(points[far] - centres[nearest[closest[far]]], axis=1)
    values[far] = np.copysign(away, values[closest[far]])
    return values.reshape(count)


def _fine_values(surface: Surface, to_mm: Array, coarse: Array, size: Index) -> tuple[Array, Flags, Index]:
    """Return signed distances, mm, at the nodes of the fine grid, the blocks in the band, and its first node.

    to_mm: transform (4, 4) from nodes to mm. coarse: values of the coarse grid, whose first node is the same.
    size: nodes (3,) of the box.
    """
    back = np.linalg.inv(to_mm)
    at = np.rint(surface.piece_centres @ back[:3, :3].T + back[:3, 3]).astype(int)
    at = at[((at >= 0) & (at < size)).all(axis=1)]
    # A box of whole blocks around the wall and its band; block 0 begins at the third node.
    start = np.maximum((at.min(axis=0) if len(at) else np.zeros(3, int)) - BAND_CELLS - 4, 0)
    stop = np.minimum((at.max(axis=0) if len(at) else np.zeros(3, int)) + BAND_CELLS + 5, size)
    blocks = np.maximum(1, -(-(stop - start) // BLOCK_NODES))
    shape = BLOCK_NODES * blocks + 5
    band = np.zeros(shape, bool)
    band[tuple((at - start).T)] = True
    band = binary_dilation(band, np.ones((3, 3, 3), bool), iterations=BAND_CELLS)
    inner = band[2 : 2 + BLOCK_NODES * blocks[0], 2 : 2 + BLOCK_NODES * blocks[1], 2 : 2 + BLOCK_NODES * blocks[2]]
    wanted = inner.reshape(blocks[0], BLOCK_NODES, blocks[1], BLOCK_NODES, blocks[2], BLOCK_NODES).any(
        axis=(1, 3, 5)
    )
    values = np.zeros(shape, np.float32)
    needed = _nodes_of_blocks(wanted, shape)
    # Nodes of these blocks outside of the band are filled from the coarse grid: no cell of the band needs them.
    far = np.argwhere(needed & ~band)
    values[tuple(far.T)] = map_coordinates(coarse, ((far + start) / COARSE_STRIDE).T, order=1, mode="nearest")
    near = np.argwhere(band & needed)
    points = (near + start) @ to_mm[:3, :3].T + to_mm[:3, 3]
    values[tuple(near.T)] = surface.signed_distances(points, exact=False)
    return values, wanted, start


def _nodes_of_blocks(wanted: Flags, shape: Index) -> Flags:
    """Return which nodes (of `shape`) the blocks that are wanted need, with the neighbours of their nodes."""
    found = np.zeros(shape, bool)
    side = BLOCK_COEFFICIENTS + 2
    for place in np.argwhere(wanted) * BLOCK_NODES:
        found[tuple(slice(first, first + side) for first in place)] = True
    return found
