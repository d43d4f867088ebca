"""The middle of a lumen and its radius, from cross-sections along a route through it.

Seen from a point, the wall of a cross-section is at the distance r + a cos t + b sin t + c cos 2t + d sin 2t in
the direction t. To first order (a, b) is the vector to the middle and (c, d) the ellipticity. Points are moved by
(a, b) and smoothed along the path (Whittaker 1923), PASSES times in turn.

A tube is an array (n, 4): points and radius in mm, along the axes of the image, counted from the middle of its
first voxel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates
from scipy.sparse.linalg import spsolve

from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.typing import Array, Flags, Index

STEP_MM = 1.0
"""Between neighbouring cross-sections, and between points of the result."""
LEAST_SECTIONS = 13
END_SEARCH_SUBDIVISIONS = 200
"""Places between neighbouring cross-sections among which those nearest to the ends are looked for."""
PASSES = 6
RAYS = 48
SAMPLES_PER_RAY = 64
"""Along each ray, up to twice the radius."""
TREE_PASSES, TREE_RAYS, TREE_SAMPLES = 4, 24, 32
"""The same for trees, which have many more cross-sections."""
ROUTE_WEIGHT = 0.3
"""Weight of the route through the voxels in the caps of a lumen, where that of a cross-section is 1."""
BIFURCATION_WEIGHT, BIFURCATION_RADII = 0.01, 1.0
"""Weight of cross-sections behind a bifurcation, in which two branches meet, and how far they are from it, in
radii of the wide branch."""
LEAST_STEP_MM = 1e-3
"""Between points of a tree, so that nothing is divided by 0."""
HARMONIC_REGULARISATION = (1e-3, 1e-3, 1e-3, 0.1, 0.1)
"""Regularisation of r, a, b, c, d towards 0, for cross-sections of which few rays see the wall."""
MAX_RAY_TO_MEDIAN_RATIO = 1.35
"""A ray longer than this times the median of its cross-section looks into another branch."""
SMOOTHING_LENGTH_VOXELS = 2.0
"""Waves along the path shorter than 2 pi times this many voxels are smoothed away."""
SMOOTHING_PADDING_SECTIONS = 5
"""Cross-sections by which a smoothed path is continued at either end."""
MAX_END_OFFSET_RADII = 1.5
"""An end is as many radii, at most, from a route that has not yet come to the middle: sqrt(2) in a corner."""
END_CAP_RADII = 0.15
"""Cross-sections so near to an end, in radii, may cut through a cap of the lumen: they are ignored."""


def centre_route(lumen: Flags, spacing: Array, route: Array, depth: Array, ends: Array) -> Array:
    """Return the tube (n, 4) along the middle of a lumen, its points about 1 mm apart.

    lumen: (l, m, n), its voxels spacing (3,) mm apart. route: (k, 3) mm, through the lumen, depth (k,) mm from the
    wall. ends: (2, 3) mm; the tube begins and stops where it is nearest to them within the lumen.
    """
    voxel = float(np.linalg.norm(spacing))
    tube = np.column_stack([route, depth])
    for end in ends[::-1]:
        tube = _straighten_beginning(tube[::-1], end, voxel)
    tube = _resample_tube(tube)
    trusted = np.ones(len(tube), bool)
    for _ in range(PASSES):
        tube = _between(_smooth_tube(tube, trusted, SMOOTHING_LENGTH_VOXELS * spacing.max()), ends, lumen, spacing)
        along = cumulative_arc_length(tube[:, :3])
        from_end = np.minimum(along, along[-1] - along)
        trusted = from_end > np.minimum(voxel + END_CAP_RADII * tube[:, 3], along[-1] / 4)
        moved = recentre_points(lumen, spacing, tube, _tangents(tube), rays=RAYS, samples=SAMPLES_PER_RAY)
        tube = np.where(trusted[:, None], moved, tube)
    return _between(_smooth_tube(tube, trusted, SMOOTHING_LENGTH_VOXELS * spacing.max()), ends, lumen, spacing)


def centre_tree(lumen: Flags, spacing: Array, tube: Array, before: Index) -> Array:
    """Return the points and radii (n, 4) of a tree, each moved to the middle of its cross-section and smoothed.

    lumen: (l, m, n), its voxels spacing (3,) mm apart. tube: (n, 4) points about 1 mm apart with the radius, mm.
    before: (n,) number of the point before each, less than its own; negative at the root. Branches share the
    points up to where they part.
    """
    voxel = float(np.linalg.norm(spacing))
    number = np.arange(len(tube))
    parent = np.where(before >= 0, before, number)
    # The branch that goes on from a point is the one with the widest next point.
    ahead = number.copy()
    for k in tube[1:, 3].argsort(kind="stable") + 1:
        ahead[before[k]] = k
    tips = np.setdiff1d(number, before)
    length = SMOOTHING_LENGTH_VOXELS * float(spacing.max())
    from_end = _distances_to_ends(tube[:, :3], before, tips)
    # In a cap the section says nothing: there, and where a path has left the lumen, the route through the voxels
    # counts.
    trusted = from_end > voxel + END_CAP_RADII * tube[:, 3]
    weight = np.where(trusted, 1.0, ROUTE_WEIGHT)
    weight[trusted & _lie_at_bifurcations(tube, before)] = BIFURCATION_WEIGHT
    route = tube
    for left in range(TREE_PASSES, -1, -1):
        steps = np.maximum(np.linalg.norm(tube[:, :3] - tube[parent, :3], axis=1), LEAST_STEP_MM)
        points = _smooth_tree(tube[:, :3], weight, before, steps, length, 3)
        radius = _smooth_tree(tube[:, 3:], weight, before, steps, length, 2)
        tube = np.column_stack([points, np.maximum(radius, spacing.min() / 2)])
        if left:
            tangent = tube[ahead, :3] - tube[parent, :3]
            tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), LEAST_STEP_MM)
            moved = recentre_points(lumen, spacing, tube, tangent, rays=TREE_RAYS, samples=TREE_SAMPLES)
            inside = lie_in_lumen(lumen, spacing, tube[:, :3]) & lie_in_lumen(lumen, spacing, moved[:, :3])
            tube = np.where((trusted & inside)[:, None], moved, route)
    return tube


def _lie_at_bifurcations(tube: Array, before: Index) -> Flags:
    """Return which points (n, 4) of a tree are in the lumen of the branch that their own one leaves.

    before: (n,) number of the point before each.
    """
    children = np.bincount(before[1:], minlength=len(tube))
    steps = np.linalg.norm(tube[:, :3] - tube[before, :3], axis=1)
    left = np.zeros(len(tube))
    for k in range(1, len(tube)):
        behind = before[k]
        radius = BIFURCATION_RADII * tube[behind, 3] if children[behind] > 1 else 0.0
        left[k] = max(left[behind], radius) - steps[k]
    return left > 0


def _distances_to_ends(points: Array, before: Index, tips: Index) -> Array:
    """Return the distance (n,) in mm along a tree from each of its points to the nearest end beyond, or to its
    root.

    points: (n, 3) mm. before: (n,) number of the point before each. tips: numbers of the ends.
    """
    away = np.full(len(points), np.inf)
    away[tips] = 0.0
    along = np.zeros(len(points))
    steps = np.linalg.norm(points - points[before], axis=1)
    for k in range(len(points) - 1, 0, -1):
        away[before[k]] = min(away[before[k]], away[k] + steps[k])
    for k in range(1, len(points)):
        along[k] = along[before[k]] + steps[k]
    return np.minimum(away, along)


def lie_in_lumen(lumen: Flags, spacing: Array, points: Array) -> Flags:
    """Return whether points (n, 3) in mm lie in voxels of a lumen (l, m, n) with voxels of `spacing` (3,) mm."""
    index = np.rint(points / spacing).astype(int)
    within = ((index >= 0) & (index < lumen.shape)).all(axis=1)
    # Clipped, since indices beyond the image would raise or wrap around; `within` leaves them out.
    return within & lumen[tuple(np.clip(index, 0, np.array(lumen.shape) - 1).T)]


def _resample_tube(tube: Array) -> Array:
    along = cumulative_arc_length(tube[:, :3])
    even = np.linspace(0, along[-1], max(LEAST_SECTIONS, round(along[-1] / STEP_MM) + 1))
    return np.column_stack([np.interp(even, along, column) for column in tube.T])


def _straighten_beginning(tube: Array, end: Array, slack: float) -> Array:
    """Return the tube with a straight beginning: the way from its end (3,) to the middle is no middle.

    slack: mm by which distances may be off, a voxel's diagonal. The beginning comes from the last point, in the
    tube's first third, from which a ball up to the wall contains the end.
    """
    along = cumulative_arc_length(tube[:, :3])
    away = np.linalg.norm(tube[:, :3] - end, axis=1) > MAX_END_OFFSET_RADII * tube[:, 3] + slack
    first = int((away | (along > along[-1] / 3)).argmax())
    ahead = int(np.clip(np.searchsorted(along, along[first] + tube[first, 3]), first + 1, len(tube) - 1))
    outwards = tube[first, :3] - tube[ahead, :3]
    outwards /= np.linalg.norm(outwards)
    beginning = tube[first].copy()
    beginning[:3] += outwards * np.maximum(0, (end - tube[first, :3]) @ outwards)
    return np.vstack([beginning, tube[first:]])


def _smooth_tube(tube: Array, trusted: Flags, length: float) -> Array:
    """Smooth the tube by Whittaker's method (1923), keeping waves longer than `length` mm, and extend both ends.

    trusted: (n,) points that count. Third differences are small in points, so that they continue at a constant
    curvature, second ones in radii.
    """
    tube_at = np.pad(tube, ((SMOOTHING_PADDING_SECTIONS, SMOOTHING_PADDING_SECTIONS), (0, 0)))
    # Weight 0: padding and untrusted points have no data, and the penalty alone extrapolates into them.
    kept = np.pad(trusted, SMOOTHING_PADDING_SECTIONS).astype(float)
    step = cumulative_arc_length(tube[:, :3])[-1] / (len(tube) - 1)
    before = np.arange(-1, len(kept) - 1)
    steps = np.full(len(kept), step)
    points = _smooth_tree(tube_at[:, :3], kept, before, steps, length, 3)
    return np.column_stack([points, _smooth_tree(tube_at[:, 3:], kept, before, steps, length, 2)])


def _smooth_tree(values: Array, weight: Array, before: Index, steps: Array, length: float, order: int) -> Array:
    """Smooth values (n, k) along the branches of a tree, keeping waves longer than `length` mm.

    weight: (n,) of each value. before: (n,) number of the point before each, negative at the root. steps: (n,) mm
    from there. order: of the differences along branches that are small.
    """
    # Minimises sum_k w_k |x_k - p_k|^2 + (length / step)^(2 m) |D^m x|^2, with D^m the differences of order m. A
    # wave of wavelength L keeps about the part 1 / (1 + (2 pi length / L)^(2 m)) of its amplitude: half at L = 2
    # pi length.
    chain = [np.arange(len(values))]
    place = [np.zeros(len(values))]
    for _ in range(order):
        last = chain[-1]
        place.append(place[-1] - np.where(last >= 0, steps[last], 0.0))
        chain.append(np.where(last >= 0, before[last], -1))
    whole = chain[-1] >= 0
    mean = float(np.mean(steps[before >= 0]))
    columns = np.column_stack(chain)[whole]
    at = np.column_stack(place)[whole] / mean
    # Divided differences, times m!: those of evenly spaced points are 1, -3, 3, -1 for m = 3.
    gaps = at[:, :, None] - at[:, None, :] + np.eye(order + 1)
    factors = math.factorial(order) / gaps.prod(axis=2)
    rows = np.repeat(np.arange(len(columns)), order + 1)
    differences = sparse.csc_array((factors.ravel(), (rows, columns.ravel())), shape=(len(columns), len(values)))
    penalty = (length / mean) ** (2 * order) * differences.T @ differences
    smoothed = spsolve(sparse.csc_array(sparse.diags_array(weight) + penalty), weight[:, None] * values)
    return np.asarray(smoothed).reshape(values.shape)


def _between(tube: Array, ends: Array, lumen: Flags, spacing: Array) -> Array:
    """Return the piece of a spline through the tube between its points in the lumen nearest to ends (2, 3),
    resampled.
    """
    dense = CubicSpline(np.arange(len(tube)), tube)(
        np.linspace(0, len(tube) - 1, END_SEARCH_SUBDIVISIONS * len(tube))
    )
    # Either end is looked for in its own half: on a path that turns back, the other end may be nearer.
    half = len(dense) // 2
    inside = lie_in_lumen(lumen, spacing, dense[:, :3])
    first, last = (
        int(np.where(inside[part], np.linalg.norm(dense[part, :3] - end, axis=1), np.inf).argmin()) + part.start
        for part, end in zip((slice(0, half), slice(half, len(dense))), ends, strict=True)
    )
    return _resample_tube(dense[first : last + 1])


def recentre_points(
    lumen: Flags, spacing: Array, tube: Array, tangent: Array, *, rays: int, samples: int
) -> Array:
    """Return each point moved to the middle of its cross-section, with the distance to the wall there.

    From a point the wall is r + a cos t + b sin t + c cos 2t + d sin 2t away at angle t: the middle is at (a, b),
    and the least distance from there is r - |(c, d)|. tangent: (n, 3) of the path. rays: of a
    cross-section. samples: along each ray.
    """
    distances, angle, first, second = cast_rays(lumen, spacing, tube, tangent, rays=rays, samples=samples)
    seen = np.isfinite(distances)
    distances = np.where(seen, distances, tube[:, 3:])
    median = np.median(distances, axis=1, keepdims=True)
    # Limited, not left out: the harmonics are badly determined where a whole side has no data.
    distances = np.where(distances > MAX_RAY_TO_MEDIAN_RATIO * median, median, distances)
    harmonics = np.column_stack([np.ones(rays), *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))])
    # Least squares over the rays that see the wall, for the difference from the radius so far, with
    # regularisation.
    normal = np.einsum("nr,ri,rj->nij", seen, harmonics, harmonics) + rays * np.diag(HARMONIC_REGULARISATION)
    found = np.linalg.solve(normal, (seen * (distances - tube[:, 3:]) @ harmonics)[..., None])[..., 0]
    points = tube[:, :3] + found[:, 1:2] * first + found[:, 2:3] * second
    radius = tube[:, 3] + found[:, 0] - np.hypot(found[:, 3], found[:, 4])
    return np.column_stack([points, np.maximum(radius, spacing.min() / 2)])


def _tangents(tube: Array) -> Array:
    """Return the unit vectors (n, 3) along a tube (n, 4)."""
    tangent = np.gradient(tube[:, :3], axis=0)
    return np.asarray(tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


def cast_rays(
    lumen: Flags, spacing: Array, tube: Array, tangent: Array, *, rays: int, samples: int
) -> tuple[Array, Array, Array, Array]:
    """Return distances (n, rays) in mm to the wall across a tube, the angles of the rays, and the vectors from
    which these count: the first and the second axis (n, 3) of each cross-section.

    lumen: (l, m, n), its voxels spacing (3,) mm apart. tube: (n, 4). tangent: (n, 3) unit vectors along it.
    samples: along each ray. A ray that leaves the image is NaN.
    """
    # The axis that the tangent is least parallel to: the product with it is never near 0.
    first = np.cross(tangent, np.eye(3)[np.abs(tangent).argmin(axis=1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    second = np.cross(tangent, first)
    angle = 2 * np.pi * np.arange(rays) / rays
    directions = np.cos(angle)[:, None] * first[:, None] + np.sin(angle)[:, None] * second[:, None]
    return _to_wall(lumen, spacing, tube, directions, samples), angle, first, second


def _to_wall(lumen: Flags, spacing: Array, tube: Array, directions: Array, samples: int) -> Array:
    """Return the distance in mm from the tube's points to the wall along directions (n, rays, 3), up to two radii.

    The wall is where the lumen, 1 at its voxels and interpolated between them, falls to 1/2. A ray that leaves the
    image before that is NaN.
    """
    reach = 2 * tube[:, 3] + np.linalg.norm(spacing)
    far = reach[:, None] * np.linspace(0, 1, samples)
    index = (tube[:, None, None, :3] + far[:, None, :, None] * directions[:, :, None]) / spacing
    value = map_coordinates(
        lumen.view(np.uint8), np.moveaxis(index, -1, 0), output=np.float32, order=1, mode="nearest"
    )
    outside = ((index < -0.5) | (index > np.array(lumen.shape) - 0.5)).any(axis=-1)
    wall = (value < 0.5) | outside
    # The first sample beyond the wall, at least 1, since the crossing lies between it and the one before.
    met = np.maximum(wall.argmax(axis=-1), 1)[..., None]

    def at(values: npt.NDArray[Any], place: npt.NDArray[Any]) -> Array:
        return np.take_along_axis(values, place, axis=-1)[..., 0].astype(float)

    before = at(value, met - 1)
    after = at(value, met)
    # Linear interpolation of the value 1/2 between these two samples.
    part = np.clip((before - 0.5) / np.maximum(before - after, 1e-6), 0, 1)
    distance = (met[..., 0] - 1 + part) / (samples - 1) * reach[:, None]
    distance = np.where(wall.any(axis=-1), distance, reach[:, None])
    return np.where(at(np.asarray(outside), met) > 0, np.nan, distance)
