"""The lumen around a path: clearance between tubes and its wall, and the wall's geometry near a point.

A path x(s) has a lumen of radius r(s). A point p of the robot is r(s) - |p - x(s)| away from the wall, with s the
arc length of the nearest point of the path; the clearance is that distance less the radius of the outermost tube
there.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.curve import Curve
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array, Flags, Index

LUMEN_TABLE_SPACING_MM = 0.5
"""Distance between the points of a lumen's table, mm."""
LEAST_CURVATURE_PER_MM = 1e-9
"""Replaces a curvature of 0 in denominators, 1/mm."""
PROJECTION_NEWTON_STEPS = 4
"""Newton steps from the nearest point of the table to the nearest point of the path."""


class LumenProjection(NamedTuple):
    """The path and the wall near points (..,), to second order of the path and first order of the wall.

    Attributes
    ----------
    distance : ndarray
        From the point to the nearest point of the path (..,), mm.
    radius : ndarray
        Radius of the lumen there (..,), mm.
    centre : ndarray
        The nearest point of the path (.., 3), mm.
    tangent, curvature_vector : ndarray
        First and second derivative of the path there by arc length (.., 3); the second in 1/mm.
    bend : ndarray
        The second derivative again, limited to a bend as sharp as the lumen is wide (.., 3), 1/mm: sharper ones
        are noise of the path's points.
    taper : ndarray
        Growth of the radius per mm that the point moves along the tangent (..,).
    length_before, length_after : ndarray
        Length of the path before and after that point (..,), mm.
    slope : ndarray
        How much less room there is for each mm farther from the path (..,): 1 beside a path, less in the narrow
        places of a smoothed distance field.
    """

    distance: Array
    radius: Array
    centre: Array
    tangent: Array
    curvature_vector: Array
    bend: Array
    taper: Array
    length_before: Array
    length_after: Array
    slope: Array

    @property
    def room_on_path(self) -> Array:
        """Room on the path (..,), mm, of which programs take away the slope times the distance from it."""
        return np.asarray(self.radius + (self.slope - 1) * self.distance)


class Lumen:
    """A path and the radius of the lumen around it.

    Parameters
    ----------
    table : ndarray
        Points and radii (N, 4), N >= 2: x, y, z and radius, mm; close enough for the spline through them.

    Raises
    ------
    CurveError
        A radius is not positive, or a point is repeated.
    """

    def __init__(self, table: Array) -> None:
        self._table = floats(CurveError, "table of a lumen", table, (None, 4))
        centre = self._table[:, :3]
        radius = self._table[:, 3]
        if (radius <= 0).any():
            raise CurveError(f"radius of a lumen is {radius.min():g} mm; it must be positive all along")
        self._along = cumulative_arc_length(centre)
        if len(centre) < 2 or (np.diff(self._along) <= 0).any():
            raise CurveError(f"table of a lumen has {len(centre)} points; it must have two, and none repeated")

    @cached_property
    def _path(self) -> CubicSpline:
        """C2 spline x(s) through the points, by the lengths of the lines between them."""
        return CubicSpline(self._along, self._table[:, :3])

    @cached_property
    def _radius(self) -> PchipInterpolator:
        """Radius r(s), interpolated without overshoot."""
        return PchipInterpolator(self._along, self._table[:, 3])

    @cached_property
    def _tree(self) -> cKDTree:
        """Search tree of the points, which finds the nearest of them."""
        return cKDTree(self._table[:, :3])

    @classmethod
    def from_curve(cls, curve: Curve) -> Lumen:
        """Sample a whole curve that has a radius, every half mm.

        Parameters
        ----------
        curve : Curve
            A curve within a lumen.

        Returns
        -------
        Lumen
            The lumen around it.
        """
        assert curve.radius is not None
        s = np.linspace(0.0, curve.length, int(np.ceil(curve.length / LUMEN_TABLE_SPACING_MM)) + 1)
        return cls(np.column_stack([curve.point(s), curve.radius(s)]))

    @property
    def table(self) -> Array:
        """Points and radii (N, 4), read-only: x, y, z and radius, mm."""
        return self._table

    @property
    def arc_lengths(self) -> Array:
        """Arc lengths (N,) of the table's points, mm."""
        return self._along

    @property
    def spline_coefficients(self) -> tuple[Array, Array]:
        """Coefficients of the cubic pieces by falling powers: path (4, N - 1, 3) and radius (4, N - 1), mm."""
        return self._path.c, self._radius.c

    def project(self, points: Array) -> LumenProjection:
        """Find the path and the wall near points.

        Parameters
        ----------
        points : ndarray
            Points (.., 3), mm.

        Returns
        -------
        LumenProjection
            The path and the wall at the nearest points of the path; NaN for points that are NaN.
        """
        # The search tree takes no NaN; frames that were not reached are put back as NaN below.
        known: Flags = np.asarray(np.isfinite(points).all(axis=-1, keepdims=True))
        points = np.where(known, points, 0.0)
        # The nearest point of the table is on the right branch of the path, also where the path passes itself
        # closely.
        s = self._along[self._tree.query(points)[1]]
        for _ in range(PROJECTION_NEWTON_STEPS):
            # Newton on |p - x(s)|^2 / 2: its slope is -(p - x) x', its curvature |x'|^2 - (p - x) x''. That
            # vanishes at the centre of curvature of the path, where the nearest point is not unique; it is kept
            # above 0.1, and steps below the spacing of the table, so that the search stays at the branch of the
            # path that the table found.
            away = points - self._path(s)
            tangent = self._path(s, 1)
            stretch = (tangent**2).sum(axis=-1) - (away * self._path(s, 2)).sum(axis=-1)
            step = (away * tangent).sum(axis=-1) / np.maximum(stretch, 0.1)
            s = np.clip(s + np.clip(step, -LUMEN_TABLE_SPACING_MM, LUMEN_TABLE_SPACING_MM), 0.0, self._along[-1])
        s = np.where(known[..., 0], s, np.nan)
        centre, tangent, curvature = (self._path(s, order) for order in range(3))
        away = points - centre
        # A point that moves along the tangent by 1 mm moves the nearest place by 1 / (1 - (p - x) x'') mm.
        taper = self._radius(s, 1) / np.maximum(1.0 - (away * curvature).sum(axis=-1), 0.1)
        distance = np.linalg.norm(away, axis=-1)
        radius = self._radius(s)
        sharpest = 1.0 / radius / np.maximum(np.linalg.norm(curvature, axis=-1), LEAST_CURVATURE_PER_MM)
        bend = curvature * np.minimum(sharpest, 1.0)[..., None]
        along = s, self._along[-1] - s
        # A slope of 1, and NaN where the point is.
        return LumenProjection(distance, radius, centre, tangent, curvature, bend, taper, *along, 1 + 0 * s)

    def clearance(self, robot: Robot, beta: Array, sigma: Array, shape: Array) -> Array:
        """Return the clearance between tubes and the wall.

        Parameters
        ----------
        robot : Robot
            Whose tubes' diameters count.
        beta : ndarray
            Extensions (T, d), mm.
        sigma : ndarray
            Normalised arc lengths (n,) or (T, n) of the samples.
        shape : ndarray
            Samples of the robot's centreline (T, n, 3), mm.

        Returns
        -------
        ndarray
            Clearance (T, n), mm, negative in contact: the lumen's radius at the nearest place, less the distance
            to it, less the radius of the outermost tube there.
        """
        near = self.project(shape)
        return np.asarray(near.radius - near.distance - outermost_tube_radii(robot, beta, sigma))


def wall_rings(table: Array, angle: Array) -> Array:
    """Return points of the wall, ring by ring.

    Parameters
    ----------
    table : ndarray
        Points and radii of the lumen (N, 4), mm.
    angle : ndarray
        Angles (n,) of the points of each ring, rad, in axes that do not turn about the path (rotation-minimising).

    Returns
    -------
    ndarray
        Points (N, n, 3), mm.
    """
    centre = table[:, :3]
    radius = table[:, 3]
    # By the length of the polyline, so that unevenly spaced tables give the same directions.
    tangents = np.gradient(centre, cumulative_arc_length(centre), axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    # The axis that the first tangent is least parallel to: its projection across the path is never near 0.
    side = np.eye(3)[abs(tangents[0]).argmin()]
    sides = np.empty_like(tangents)
    for j, tangent in enumerate(tangents):
        # Projecting the previous axis into the plane across the path is, for close points, its parallel transport.
        # Frenet axes would jump where the path is straight.
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        sides[j] = side
    across = np.cos(angle)[:, None] * sides[:, None] + np.sin(angle)[:, None] * np.cross(tangents, sides)[:, None]
    return np.asarray(centre[:, None] + radius[:, None, None] * across)


def wall_mesh(table: Array, vertices_per_ring: int) -> tuple[Array, npt.NDArray[np.uint32]]:
    """Return the wall as a triangle mesh.

    Parameters
    ----------
    table : ndarray
        Points and radii of the lumen (N, 4), mm.
    vertices_per_ring : int
        Vertices of each ring.

    Returns
    -------
    vertices : ndarray
        (N around, 3), mm.
    triangles : ndarray
        Indices of their corners (2 (N - 1) around, 3), which turn left seen from outside.
    """
    vertices = wall_rings(table, np.linspace(0.0, 2 * np.pi, vertices_per_ring, endpoint=False))
    here = np.arange(vertices[..., 0].size).reshape(-1, vertices_per_ring)
    beside = np.roll(here, -1, axis=1)[:-1]
    ahead = here[1:]
    across = np.roll(here, -1, axis=1)[1:]
    # Two triangles for each quadrangle between neighbouring rings, their corners ordered so that normals point
    # outwards.
    triangles = np.stack([here[:-1], beside, ahead, beside, across, ahead], axis=-1)
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.uint32)


def tube_outer_radii(robot: Robot) -> Array:
    """Return the outer radius of every tube of a robot, (d,), mm."""
    return np.array([tube.outer_diameter / 2 for tube in robot.tubes])


def outermost_tube_radii(robot: Robot, beta: Array, sigma: Array) -> Array:
    """Return the radius of the outermost tube at samples along robots.

    Parameters
    ----------
    robot : Robot
        Of d tubes.
    beta : ndarray
        Extensions (T, d), mm.
    sigma : ndarray
        Normalised arc lengths (n,) or (T, n).

    Returns
    -------
    ndarray
        (T, n), mm.
    """
    return np.asarray(tube_outer_radii(robot)[outermost_tube_index(beta, sigma)])


def outermost_tube_index(beta: Array, sigma: Array) -> Index:
    """Return which tube is the outermost one at samples along robots.

    Parameters
    ----------
    beta : ndarray
        Extensions (T, d), mm.
    sigma : ndarray
        Normalised arc lengths (n,) or (T, n).

    Returns
    -------
    ndarray
        Numbers (T, n) of tubes, from 0.
    """
    s = sigma * beta[:, -1:]
    # Tubes end at beta_1 <= .. <= beta_d, so that the outermost tube at s is the first one that reaches beyond s:
    # its index is the number of tubes that end before s. 1e-9 mm covers rounding at a tube's end.
    return np.asarray((s[..., None] > beta[:, None, :-1] + 1e-9).sum(axis=-1))
