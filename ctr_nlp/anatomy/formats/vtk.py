"""Centrelines that VMTK, SlicerVMTK and other tools save as lines in VTK files.

VTK files do not say what their coordinates are. 3D Slicer adds SPACE=LPS or SPACE=RAS, to the second line of a
legacy .vtk file and to the field data of the others; without it LPS is assumed, as Slicer does, unless a person
states another. Units are stated nowhere.
"""

from __future__ import annotations

import re
from collections import Counter
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
    format_point,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.formats.network import SAME_MM, CentrelineNetwork
from ctr_nlp.anatomy.plausibility import find_units, tidy_branch
from ctr_nlp.anatomy.reading import (
    AS_THE_FILE_SAYS,
    ASSUMED,
    GIVEN,
    MM_PER_UNIT,
    STATED,
    FileFacts,
    ReadOptions,
)
from ctr_nlp.anatomy.width_names import WIDTH_NAMES, may_be_width
from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

Indices = npt.NDArray[np.intp]

UNIT_SUFFIX = re.compile(r"[\s_.:/\[(]+(mm|cm|m|um)[\])]?$")
"""A unit at the end of an array's name, in lower case."""
VTK_KIND = "centrelines in a VTK file"
TRACTS = ("CenterlineIds", "TractIds")
"""Cell arrays of VMTK's branch extractor: of which centreline a line is a piece, and its place along it."""
VMTK_RADIUS = "MaximumInscribedSphereRadius"
"""Point array of VMTK with the radius of the lumen."""
IMAGE_SPACES = (*CENTRELINE_SPACE_TO_LPS, "LAS")
"""Coordinates that are known to be those of a patient, in files of centrelines and of images."""
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
    with name_source_in_errors(path):
        space, space_known = _space(stated, options)
        lines = _lines(mesh)  # first of all: a file cut short has none, and its points may be anything
        used = np.unique(np.concatenate(lines))
        points = _numbers(mesh.points)[used]
        lines = [np.searchsorted(used, line) for line in lines]
        units = find_units(points, options)
        points *= units.mm_per_unit
        radius, radius_notes = _radius(mesh, units.mm_per_unit)
        radius = None if radius is None else radius[used]
        network = CentrelineNetwork(points, radius, tuple(_join_tracts(mesh, lines, points)))
        found = network.find_paths(None if entry is None else np.asarray(entry, dtype=float))
    notes = [*units.notes, *radius_notes, *found.notes]
    if space_known == ASSUMED:
        notes.append(f"the file states no coordinate system: {space} is assumed; --space RAS says otherwise")
    branches = list[Branch]()
    repairs: dict[str, list[str]] = {}
    ways = Counter((int(line[0]), int(line[-1])) for line in found.paths)
    for line in found.paths:
        name = f"branch {len(branches) + 1}"
        place = f"{path}, {name}" if len(found.paths) > 1 else str(path)
        lps = transform_points(points[line], CENTRELINE_SPACE_TO_LPS[space])
        given = Branch(name, lps, None if radius is None else radius[line])
        try:
            with name_source_in_errors(place):
                branch, repaired = tidy_branch(given, options)
        except CurveError as error:
            ends = (int(line[0]), int(line[-1]))
            if ways[ends] == 1:
                raise
            # Round a loop one way often runs back, which settles that the other one is right.
            ways[ends] -= 1
            tip = format_point(points[line[-1]].round(2))
            notes.append(f"left out one of the ways to {tip}: {str(error.__cause__).partition(';')[0]}")
            continue
        branches.append(branch)
        for note in repaired:
            repairs.setdefault(note, []).append(name)
    several = len(branches) > 1
    notes += [f"{_list_names(names)}: {note}" if several else note for note, names in repairs.items()]
    facts = FileFacts(VTK_KIND, units.units, units.known, space_known, tuple(notes))
    return Branches(tuple(branches), space, CENTRELINE_SPACE_TO_LPS[space], facts)


def write_vtk(path: str | Path, branches: Branches) -> None:
    """Write branches as whole centrelines of a .vtp file, as VMTK and 3D Slicer read them.

    path: the file, which is replaced. branches: their lines are written in LPS, which the file states, with the
    radius of the inscribed sphere in the array that VMTK calls MaximumInscribedSphereRadius. Raises OptionError
    where pyvista is missing.
    """
    pyvista = import_extra("pyvista")
    every = branches.branches
    counts = [len(branch.points) for branch in every]
    starts = np.cumsum([0, *counts[:-1]])
    lines = [np.append(count, start + np.arange(count)) for start, count in zip(starts, counts, strict=True)]
    mesh = pyvista.PolyData(np.concatenate([branch.points for branch in every]), lines=np.concatenate(lines))
    radii = [branch.radius for branch in every if branch.radius is not None]
    if len(radii) == len(every):
        mesh.point_data[VMTK_RADIUS] = np.concatenate(radii)
    if branches.space in IMAGE_SPACES:
        mesh.add_field_data(["LPS"], "SPACE")
    mesh.save(str(path))


def _space(stated: str, options: ReadOptions) -> tuple[str, str]:
    """Return the coordinate system of a file, and how it is known; raise CurveError where it is not one of ours.

    stated: by the file, or an empty string. options: what a person states.
    """
    if not stated:
        return (options.space, GIVEN) if options.space else ("LPS", ASSUMED)
    if stated not in CENTRELINE_SPACE_TO_LPS:
        raise CurveError(f"SPACE is {stated!r:.60}; it must be one of {', '.join(CENTRELINE_SPACE_TO_LPS)}")
    if options.space not in (None, stated):
        raise CurveError(f"space is {options.space}, but the file states {stated}; leave out --space")
    return stated, STATED


def _list_names(names: list[str]) -> str:
    """Return the names of branches as text, at most three of them."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


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
    with pyvista.vtk_verbosity("off"), capture_vtk_errors() as errors:
        reader.Update()
    if errors or not reader.GetOutput().IsA("vtkPointSet"):
        reason = f" ({errors[0]})" if errors else ""
        raise CurveError(f"centreline {path} cannot be read: it is damaged, or no VTK file of lines{reason}")
    mesh = pyvista.wrap(reader.GetOutput())
    header = re.search(r"SPACE=(\w*)", _text(reader.GetHeader())) if legacy else None
    field = str(mesh.field_data["SPACE"][0]) if "SPACE" in mesh.field_data else ""
    return mesh.cast_to_unstructured_grid(), header[1] if header else field


@contextmanager
def capture_vtk_errors() -> Iterator[list[str]]:
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


def _radius(mesh: Any, mm_per_unit: float) -> tuple[Array | None, list[str]]:
    """Return the lumen's radius at the points of a mesh, mm, None where it is unknown, and notes on its arrays.

    mm_per_unit: of the file's lengths. The first array whose name says for certain what it is, in the order of
    WIDTH_NAMES, is read; others that may be the lumen's size are named. Raises CurveError where one is no array of
    a number a point.
    """
    plain = {}
    for title in mesh.point_data:
        suffix = UNIT_SUFFIX.search(title.lower())
        stem = title[: suffix.start()] if suffix else title
        plain[title] = re.sub(r"[^a-z0-9]", "", stem.lower()), suffix[1] if suffix else None
    certain = sorted(
        (title for title in plain if plain[title][0] in WIDTH_NAMES), key=lambda t: _rank(plain[t][0])
    )
    unread = [title for title in plain if title not in certain and may_be_width(plain[title][0])]
    unread += [f"{title} (of lines)" for title in mesh.cell_data if may_be_width(title.lower())]
    notes = []
    if unread:
        notes.append(
            f"not read: {', '.join(unread)}, which may be the lumen's size; if so, name the point array Radius or "
            "Diameter"
        )
    if not certain:
        return None, [*notes, "the file has no radius of the lumen: its wall is unknown"]
    title = certain[0]
    values = _numbers(mesh.point_data[title])
    count = len(mesh.points)
    if values.size != count:
        raise CurveError(f"{title} has shape {values.shape}; it must be one radius in mm a point")
    name, unit = plain[title]
    values = values.reshape(count) * WIDTH_NAMES[name] * (mm_per_unit if unit is None else MM_PER_UNIT[unit])
    if len(certain) > 1:
        notes.append(f"of {', '.join(certain)} the first is read as the size of the lumen")
    if not (np.isnan(values) | (values == 0)).all():
        return values, notes
    return None, [*notes, f"{title} is zero at all points: the lumen's radius is taken as unknown"]


def _rank(name: str) -> tuple[bool, int]:
    """Return where a name of the lumen's size stands among several; VMTK's own, the surest, comes first."""
    return name != "maximuminscribedsphereradius", list(WIDTH_NAMES).index(name)


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
    first, last = (int(pick([pick(line, initial=0) for line in lines])) + 1 for pick in (np.min, np.max))
    if first < 1 or last > mesh.n_points:
        wrong = first if first < 1 else last
        raise CurveError(f"it is damaged: a line passes point {wrong} of {mesh.n_points}")
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
