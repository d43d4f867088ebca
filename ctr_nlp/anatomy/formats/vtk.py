"""Centrelines that VMTK, SlicerVMTK and other tools save as lines in VTK files.

VTK files do not say what their coordinates are. 3D Slicer adds SPACE=LPS or SPACE=RAS, to the second line of a
legacy .vtk file and to the field data of the others; without it they are taken as LPS, as Slicer does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import (
    CENTRELINE_SPACE_TO_LPS,
    Branch,
    Branches,
    check_points,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.formats.network import SAME_MM, CentrelineNetwork
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

Indices = npt.NDArray[np.intp]

VTK_RADIUS_ARRAYS = ("MaximumInscribedSphereRadius", "Radius", "radius")
"""Point arrays with the lumen's radius in mm: of VMTK, of SlicerVMTK, of others."""
TRACTS = ("CenterlineIds", "TractIds")
"""Cell arrays of VMTK's branch extractor: of which centreline a line is a piece, and its place along it."""
LEGACY = "vtkGenericDataObjectReader"
VTK_READERS = {
    ".vtk": ("vtkIOLegacy", LEGACY),
    ".vtp": ("vtkIOXML", "vtkXMLPolyDataReader"),
    ".vtu": ("vtkIOXML", "vtkXMLUnstructuredGridReader"),
}
"""Module and class of VTK's readers, by the end of a file's name."""
VTK_LINE, VTK_POLY_LINE = 3, 4
"""VTK's cell types that are read; other cells are ignored."""


def read_vtk(
    path: str | Path, entry: npt.ArrayLike | None = None, options: ReadOptions = AS_THE_FILE_SAYS
) -> Branches:
    """Read the paths from root to tips of the lines in a .vtp, .vtu or legacy .vtk file.

    path: the file. entry: (3,) mm in the file's coordinates, which settles where a tree starts when the file does
    not; see formats/network.py. options: what a person states about the file. Points that repeat the
    one before them are left out. Raises CurveError, and OptionError where pyvista is missing.
    """
    mesh, stated = _read(path)
    space = stated or "LPS"
    points = _numbers(mesh.points)
    with name_source_in_errors(path):
        if space not in CENTRELINE_SPACE_TO_LPS:
            raise CurveError(f"SPACE is {space!r}; it must be one of {', '.join(CENTRELINE_SPACE_TO_LPS)}")
        lines = _lines(mesh)  # first of all: a file cut short has none, and its points may be anything
        check_points(points)
        radius = _radius(mesh, len(points))
        network = CentrelineNetwork(points, radius, tuple(_join_tracts(mesh, lines, points)))
        paths = network.paths(None if entry is None else np.asarray(entry, dtype=float))
    branches = [
        Branch(
            f"branch {k}",
            transform_points(points[line], CENTRELINE_SPACE_TO_LPS[space]),
            None if radius is None else radius[line],
        )
        for k, line in enumerate(paths, start=1)
    ]
    return Branches(tuple(branches), space, CENTRELINE_SPACE_TO_LPS[space])


def _read(path: str | Path) -> tuple[Any, str]:
    """Return the unstructured grid of a file, and the coordinate system that it states, or an empty string."""
    if not Path(path).is_file():
        raise CurveError(f"centreline {path} cannot be read: there is no such file")
    pyvista = import_extra("pyvista")
    room, kind = VTK_READERS[Path(path).suffix.lower()]
    reader = getattr(import_extra(f"vtkmodules.{room}"), kind)()
    reader.SetFileName(str(path))
    legacy = kind == LEGACY
    if legacy:
        # By default the legacy reader reads only the first array of each kind.
        reader.ReadAllScalarsOn()
        reader.ReadAllFieldsOn()
    with pyvista.vtk_verbosity("off"), _capture_vtk_errors() as errors:
        reader.Update()
    if errors or not reader.GetOutput().IsA("vtkPointSet"):
        reason = f" ({errors[0]})" if errors else ""
        raise CurveError(f"centreline {path} cannot be read: it is damaged, or no VTK file of lines{reason}")
    mesh = pyvista.wrap(reader.GetOutput())
    header = re.search(r"SPACE=(\w*)", _text(reader.GetHeader())) if legacy else None
    field = str(mesh.field_data["SPACE"][0]) if "SPACE" in mesh.field_data else ""
    return mesh.cast_to_unstructured_grid(), header[1] if header else field


@contextmanager
def _capture_vtk_errors() -> Iterator[list[str]]:
    """Capture VTK's messages on a bad file, which would go to stderr; after the block, the list that is yielded
    holds the first error.
    """
    common = import_extra("vtkmodules.vtkCommonCore")
    usual = common.vtkOutputWindow.GetInstance()
    heard = common.vtkStringOutputWindow()
    errors: list[str] = []
    common.vtkOutputWindow.SetInstance(heard)
    try:
        yield errors
    finally:
        common.vtkOutputWindow.SetInstance(usual)
        errors += re.findall(r"^ERROR.*\n.*?\): (.*)", _text(heard.GetOutput()), re.MULTILINE)[:1]


def _text(said: str | bytes | None) -> str:
    """Return text from VTK as a string: VTK gives bytes where it is not valid UTF-8, None where there is none."""
    return said.decode(errors="replace") if isinstance(said, bytes) else said or ""


def _numbers(values: Any) -> Array:
    """Return values of a file as double precision, without warnings; whether they are numbers is checked later.

    A file that was cut short has random bytes in its arrays; numpy warns where they are a signalling NaN.
    """
    with np.errstate(invalid="ignore"):
        return np.array(values, dtype=float)


def _radius(mesh: Any, count: int) -> Array | None:
    """Return the lumen's radius (count,) mm at the points of a mesh; None where no array of `VTK_RADIUS_ARRAYS` is
    there.
    """
    for name in VTK_RADIUS_ARRAYS:
        if name in mesh.point_data:
            values = _numbers(mesh.point_data[name])
            if values.size != count:
                raise CurveError(f"{name} has shape {values.shape}; it must be one radius in mm a point")
            return values.reshape(count)
    return None


def _lines(mesh: Any) -> list[Indices]:
    """Return the indices of the points of each line; raise CurveError where there is no line, or points are
    missing.
    """
    cells = np.flatnonzero(np.isin(mesh.celltypes, (VTK_LINE, VTK_POLY_LINE)))
    if not cells.size:
        raise CurveError("it holds no lines; centrelines are saved as lines, not as a surface or as points")
    ends = import_extra("pyvista").convert_array(mesh.GetCells().GetOffsetsArray())[1:-1]
    every = np.split(mesh.cell_connectivity, ends)
    lines = [every[i] for i in cells]
    last = max(line.max(initial=0) for line in lines) + 1
    if last > mesh.n_points:
        raise CurveError(f"it is damaged: a line passes point {last} of {mesh.n_points}")
    return lines


def _join_tracts(mesh: Any, lines: list[Indices], points: Array) -> list[Indices]:
    """Return the centrelines whose consecutive tracts the lines are, as VMTK's branch extractor leaves them.

    lines: indices of points, a line each. points: (n, 3) mm. The lines themselves where they are no tracts, or
    tracts that do not meet.
    """
    if not set(TRACTS) <= set(mesh.cell_data):
        return lines
    cells = np.isin(mesh.celltypes, (VTK_LINE, VTK_POLY_LINE))
    centreline, tract = (np.array(mesh.cell_data[name])[cells] for name in TRACTS)
    whole = []
    for number in np.unique(centreline):
        parts = np.flatnonzero(centreline == number)
        # A stable sort, so that lines with the same tract number stay in the order of the file.
        parts = parts[tract[parts].argsort(kind="stable")]
        for one, next_one in pairwise(parts):
            if np.linalg.norm(points[lines[one][-1]] - points[lines[next_one][0]]) > SAME_MM:
                return lines
        whole.append(np.concatenate([lines[part] for part in parts]))
    return whole
