"""Meshes of triangles, as 3D Slicer and other tools save the surfaces of organs.

Such files state no unit, and a coordinate system only where 3D Slicer wrote them: SPACE=LPS or SPACE=RAS in the
header, or in the field data of a .vtp file.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import CENTRELINE_SPACE_TO_LPS
from ctr_nlp.anatomy.formats.vtk import capture_vtk_errors
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, MM_PER_UNIT, ReadOptions
from ctr_nlp.anatomy.suffixes import MESH_SUFFIXES
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.surface import Surface
from ctr_nlp.support.extras import import_extra

LEAST_SPAN_MM, LARGEST_SPAN_MM = 1.0, 3000.0
"""Diagonals of the box of a body: outside of these it is in another unit."""
HEADER_BYTES = 2000
"""Bytes at the begin of a file in which its coordinate system may be stated."""


class Mesh(NamedTuple):
    """A surface in mm in LPS, how many open edges it has, and notes on what was assumed."""

    surface: Surface
    open_edges: int
    notes: tuple[str, ...]


def read_mesh(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> Mesh:
    """Read the triangles of a mesh.

    path: the file. options: what a person states about it. Triangles of each part are ordered alike, so that
    normals point away from the middle of the part. Raises CurveError, and OptionError where pyvista is missing.
    """
    pyvista = import_extra("pyvista")
    if not Path(path).is_file():
        raise CurveError("there is no such file")
    if Path(path).suffix.lower() not in MESH_SUFFIXES:
        raise CurveError(f"it is no known kind of mesh; its name must end in {', '.join(MESH_SUFFIXES)}")
    try:
        with pyvista.vtk_verbosity("off"), capture_vtk_errors() as errors:
            mesh = pyvista.read(path)
    except Exception as error:  # whatever the readers of these formats meet in a damaged file
        raise CurveError(f"it cannot be read as a mesh: {str(error).splitlines()[0]}") from error
    if errors:
        raise CurveError(f"it cannot be read as a mesh: {errors[0]}")
    if not isinstance(mesh, pyvista.PolyData) or not mesh.n_cells:
        raise CurveError("it holds no triangles; give a surface, or a mask")
    stated = str(mesh.field_data["SPACE"][0]) if "SPACE" in mesh.field_data else _stated_space(Path(path))
    notes = []
    space = stated or options.space or "LPS"
    if space not in CENTRELINE_SPACE_TO_LPS:
        raise CurveError(f"SPACE is {space!r:.60}; it must be one of {', '.join(CENTRELINE_SPACE_TO_LPS)}")
    if not stated and options.space is None:
        notes.append("the file states no coordinate system: LPS is assumed; --space RAS says otherwise")
    # Corners of neighbouring triangles are the same point: STL files have each three times.
    mesh = mesh.triangulate().clean(lines_to_points=False, polys_to_lines=False)
    scale = MM_PER_UNIT[options.units or "mm"]
    span = scale * mesh.length
    if not LEAST_SPAN_MM <= span <= LARGEST_SPAN_MM:
        raise CurveError(
            f"its surface is {span:.3g} mm across; it must be {LEAST_SPAN_MM:g} to {LARGEST_SPAN_MM:g} mm. State "
            f"the unit with --units {'m' if span < LEAST_SPAN_MM else 'um'}, if it is another one"
        )
    mesh = mesh.compute_normals(
        cell_normals=True, point_normals=False, split_vertices=False, consistent_normals=True
    )
    triangles = mesh.faces.reshape(-1, 4)[:, 1:]
    part = mesh.connectivity().cell_data["RegionId"]
    vertices = np.asarray(mesh.points * scale, np.float32)
    surface = _orient_parts(Surface(vertices, triangles), np.asarray(part))
    return Mesh(surface.apply_transform(CENTRELINE_SPACE_TO_LPS[space]), mesh.n_open_edges, tuple(notes))


def _stated_space(path: Path) -> str:
    """Return the coordinate system that the header of a file states; empty where it states none."""
    with path.open("rb") as file:
        found = re.search(rb"SPACE=(\w+)", file.read(HEADER_BYTES))
    return found[1].decode(errors="replace") if found else ""


def _orient_parts(surface: Surface, part: npt.NDArray[Any]) -> Surface:
    """Return a surface whose parts have normals that point away from their middle; part (m,): of each triangle."""
    triangles = surface.triangles.copy()
    middle = surface.corners.mean(axis=1)
    a, b, c = np.moveaxis(surface.corners, 1, 0)
    cross = np.cross(b - a, c - a)
    for k in np.unique(part):
        own = part == k
        # Six times the volume of the part, seen from its middle: that of a closed part is the same from anywhere.
        if ((middle[own] - middle[own].mean(axis=0)) * cross[own]).sum() < 0:
            triangles[own] = triangles[own][:, ::-1]
    return Surface(surface.vertices, triangles)
