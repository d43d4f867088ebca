"""Surfaces of a plan's frames: each tube where it is the outermost one, and the wall of the lumen."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from ctr_nlp.exceptions import OutputError
from ctr_nlp.paths.lumen import tube_outer_radii, wall_mesh
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array

TUBE_SURFACE_SIDES = 16
"""Sides of the polygon that approximates a tube's cross-section."""
WALL_SURFACE_SIDES = 24
INSCRIBED_TUBE_NAME = "inscribed tube"
"""Name of the tube around the path, of the radius of the lumen, among walls."""
MIN_VISIBLE_TUBE_MM = 1e-3
"""Visible length, mm, below which a tube is left out."""


class ShadedSurface(NamedTuple):
    """Triangle mesh: points (n, 3) mm, outward unit normals (n, 3), triangles (m, 3) anticlockwise seen from
    outside.
    """

    points: Array
    normals: Array
    triangles: npt.NDArray[Any]


def frames_with_shape(plan: Plan) -> list[int]:
    """Return the frames of `plan`, from 0, that have a shape; raise OutputError where none has."""
    found: list[int] = np.flatnonzero(plan.reached_frames).tolist()
    if not found:
        raise OutputError("no frame of the plan has a shape; there is nothing to show")
    return found


def tube_surfaces(plan: Plan, frame: int) -> dict[int, ShadedSurface]:
    """Return the visible part of every tube in a frame, by the tube's number from 1, in the robot's base frame.

    plan: the plan. frame: index from 0. Each surface has the tube's outer diameter, and flat ends. Tubes that
    others cover are left out.
    """
    beta = plan.beta[frame]
    radius = tube_outer_radii(plan.robot)
    found = {}
    for i, (start, stop) in enumerate(zip(np.append(0.0, beta[:-1]), beta, strict=True)):
        if stop - start >= MIN_VISIBLE_TUBE_MM:
            s = SIGMA_GRID * beta[-1]
            # Grid points too near to an end are left out: two rings in one place have no direction between them.
            s = np.concatenate(
                [[start], s[(s > start + MIN_VISIBLE_TUBE_MM / 2) & (s < stop - MIN_VISIBLE_TUBE_MM / 2)], [stop]]
            )
            centre = CubicSpline(SIGMA_GRID * beta[-1], plan.shape[frame])(s)
            found[i + 1] = _sweep_capped_surface(np.column_stack([centre, np.full(len(s), radius[i])]))
    return found


def wall_surfaces(plan: Plan) -> dict[str, ShadedSurface]:
    """Return the plan's walls in the robot's base frame, by name.

    plan: the plan. The tube around the path (INSCRIBED_TUBE_NAME), open at both ends, is among them where it is a
    wall; of the surfaces of bodies, the part around target and robot.
    """
    found = {}
    if plan.lumen_wall is not None:
        found[INSCRIBED_TUBE_NAME] = _sweep_surface(plan.lumen_wall, WALL_SURFACE_SIDES)
    for wall in plan.drawn_walls:
        found[wall.name] = ShadedSurface(wall.vertices, wall.normals, wall.triangles)
    return found


def _sweep_surface(table: Array, sides: int) -> ShadedSurface:
    """Return the surface around a path (n, 4) of x, y, z and radius in mm; sides: of its cross-section."""
    points, triangles = wall_mesh(table, sides)
    outwards = points - np.repeat(table[:, :3], sides, axis=0)
    return ShadedSurface(points, outwards / np.linalg.norm(outwards, axis=-1, keepdims=True), triangles)


def _sweep_capped_surface(table: Array) -> ShadedSurface:
    """Return the surface around a path, a table (n, 4) of x, y, z and radius in mm, with a disc at either end."""
    body = _sweep_surface(table, TUBE_SURFACE_SIDES)
    # Each disc has rim points of its own: shared ones would share normals, and edges would look round.
    points = [body.points]
    normals = [body.normals]
    triangles = [body.triangles]
    for end, inner, ring in (
        (0, 1, body.points[:TUBE_SURFACE_SIDES]),
        (-1, -2, body.points[-TUBE_SURFACE_SIDES:]),
    ):
        outwards = table[end, :3] - table[inner, :3]
        count = sum(map(len, points))
        rim = count + 1 + np.arange(TUBE_SURFACE_SIDES)
        disc = np.stack([np.full(TUBE_SURFACE_SIDES, count), rim, np.roll(rim, -1)], axis=-1)
        points.append(np.vstack([table[end, :3], ring]))
        normals.append(np.tile(outwards / np.linalg.norm(outwards), (TUBE_SURFACE_SIDES + 1, 1)))
        triangles.append(disc[:, ::-1] if end == 0 else disc)
    return ShadedSurface(np.vstack(points), np.vstack(normals), np.vstack(triangles))
