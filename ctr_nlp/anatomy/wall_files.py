"""Walls that are read from files: surfaces to stay inside of, and bodies to keep out of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy.typing as npt

from ctr_nlp.anatomy.branch import LumenMask, name_source_in_errors
from ctr_nlp.anatomy.distance_fields import crop_surface, field_of_surface, flatten_steps, surface_of_mask
from ctr_nlp.anatomy.files import is_mask, title
from ctr_nlp.anatomy.formats.images import IMAGE_SPACE_TO_LPS
from ctr_nlp.anatomy.formats.mesh import read_mesh
from ctr_nlp.anatomy.lumen_surfaces import LEAST_INSIDE, open_ends, part_inside, wall_around_path
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.anatomy.suffixes import MESH_SUFFIXES
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.paths.surface import Surface
from ctr_nlp.paths.walls import MAX_MARGIN_MM, Body
from ctr_nlp.support.value_checks import checked_path, floats, number
from ctr_nlp.typing import Array

MASK_OPTIONS = "labels", "segment", "threshold", "form"
"""Options of reading that go with masks alone."""


class PlacedWall(NamedTuple):
    """A body in mm in LPS, and notes on how it was read."""

    body: Body
    notes: tuple[str, ...]


@dataclass(frozen=True)
class WallFile:
    """A wall that is read from a file, once the path that it is near is known.

    Attributes
    ----------
    path : str or Path
        A mask, or a mesh.
    keep_out : bool
        Whether the robot keeps out of it; otherwise it stays inside.
    margin : float
        Distance that the robot keeps from its surface, mm.
    name : str or None
        Name under which its contact is reported; by default that of the file.
    options : ReadOptions
        What a person states about the file.

    Raises
    ------
    OptionError
        The margin is out of range, or an option does not go with this kind of file.
    """

    path: str | Path
    keep_out: bool = True
    margin: float = 0.0
    name: str | None = None
    options: ReadOptions = AS_THE_FILE_SAYS

    def __post_init__(self) -> None:
        checked_path(CurveError, self.path)
        allowed = f"lie in [0, {MAX_MARGIN_MM:g}] mm"
        number(
            OptionError, f"margin of {self.path}", self.margin, lambda x: 0 <= x <= MAX_MARGIN_MM, allowed, " mm"
        )
        given = [name for name in MASK_OPTIONS if getattr(self.options, name) not in (None, ())]
        if given and not is_mask(self.path):
            raise OptionError(f"{given[0].removesuffix('s')} goes with a mask; {self.path} is a mesh")

    def read(self, near: Array | None = None) -> PlacedWall:
        """Read the wall near a path.

        Parameters
        ----------
        near : ndarray, optional
            Points (n, 3) of the path, mm in LPS; by default the whole surface is read, and is not opened at a
            path's ends.

        Returns
        -------
        PlacedWall
            The body, and notes.

        Raises
        ------
        CurveError
            The file cannot be read, holds no surface, or the path is not inside of a surface to stay inside of.
        OptionError
            pyvista, or the reader of a mask, is missing.
        """
        name = self.name or name_of_wall(self.path)
        with name_source_in_errors(self.path):
            if is_mask(self.path):
                from ctr_nlp.anatomy.segmentation.mask import read_lumen  # and with it scipy.ndimage

                image, notes = read_lumen(self.path, self.options)
                mask = LumenMask(image.voxels, IMAGE_SPACE_TO_LPS[image.space] @ image.affine)
                return body_of_mask(name, mask, near, self.keep_out, self.margin, notes)
            mesh = read_mesh(self.path, self.options)
            surface = mesh.surface if near is None else crop_surface(mesh.surface, near)
            notes = mesh.notes
            if not self.keep_out and near is not None:
                surface, more = _lumen_of_mesh(surface, near, mesh.open_edges)
                notes = (*notes, *more)
            elif mesh.open_edges:
                notes = (*notes, f"{mesh.open_edges} edges are open: beyond them the surface counts as going on")
            return _body(name, surface, near, self.keep_out, self.margin, notes)


def read_wall(
    path: str | Path,
    *,
    keep_out: bool = True,
    margin: float = 0.0,
    name: str | None = None,
    near: npt.ArrayLike | None = None,
    units: str | None = None,
    space: str | None = None,
    label: Sequence[int] = (),
    segment: str | None = None,
    threshold: float | None = None,
    form: str | None = None,
) -> Body:
    """Read a surface that a robot stays inside of, or keeps out of.

    Parameters
    ----------
    path : str or Path
        A mask (NIfTI, NRRD), or a mesh (.stl, .vtp, .vtk, .ply, .obj).
    keep_out : bool
        Whether the robot keeps out of it; otherwise it stays inside.
    margin : float
        Distance that the robot keeps from the surface, mm.
    name : str, optional
        Name under which contact is reported; by default that of the file.
    near : (n, 3) array_like, optional
        Points of the path from entry to target, mm in LPS. The wall is made up to 30 mm around them, and opened
        where the lumen ends at the path's ends. By default it is made everywhere.
    units : {"mm", "cm", "m", "um"}, optional
        Unit of a mesh, where it is not mm.
    space : {"LPS", "RAS"}, optional
        Patient coordinates of a mesh, where the file does not state them; by default LPS.
    label : sequence of int
        Labels of a mask that are the body, where it has several.
    segment : str, optional
        Name of the segment that is the body.
    threshold : float, optional
        Value from which a voxel belongs to the body, in a probability map.
    form : {"qform", "sform"}, optional
        Which transform of a NIfTI header counts, where they differ.

    Returns
    -------
    Body
        In mm in LPS; ``body.apply_transform(to_robot)`` moves it before the robot, as
        :func:`problem_from_file` does with its argument `walls`.

    Raises
    ------
    CurveError
        The file cannot be read, or holds no surface there.
    OptionError
        An option is out of its range, or a reader is missing.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import pyvista
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     pyvista.Sphere(radius=5).save(Path(folder, "node.stl"))
    ...     body = read_wall(Path(folder, "node.stl"), margin=2)
    >>> body.name, body.room(np.array([[9.0, 0.0, 0.0]])).round(1).tolist()
    ('node', [2.0])
    """
    options = ReadOptions(units, space, labels=tuple(label), segment=segment, threshold=threshold, form=form)
    line = None if near is None else floats(CurveError, "near", near, (None, 3))
    return WallFile(path, keep_out, margin, name, options).read(line).body


def body_of_mask(
    name: str,
    mask: LumenMask,
    near: Array | None,
    keep_out: bool = False,
    margin: float = 0.0,
    notes: tuple[str, ...] = (),
) -> PlacedWall:
    """Make the body of a mask, and notes on how.

    name: of the body. mask: its voxels. near: points (n, 3) of the path, mm in LPS, or None. keep_out, margin: of
    the body. notes: that were made before. Raises CurveError, and OptionError where pyvista is missing.
    """
    surface = surface_of_mask(mask.voxels, mask.affine, near)
    if not keep_out and near is not None:
        surface, ends = open_ends(surface, near)
        notes = (*notes, *_note_ends(ends))
        _check_inside(surface, near)
    return _body(name, surface, near, keep_out, margin, notes, cells=mask.affine)


def _body(
    name: str,
    surface: Surface,
    near: Array | None,
    keep_out: bool,
    margin: float,
    notes: tuple[str, ...],
    cells: Array | None = None,
) -> PlacedWall:
    """Make a body of a surface, with a note where the path leads through one to keep out of.

    cells: transform (4, 4) from the voxels of a mask to mm, or None for a mesh.
    """
    if keep_out and near is not None:
        through = part_inside(surface, near)
        if through:
            notes = (*notes, f"{100 * through:.0f} % of the path lies inside of it: no robot can follow that part")
    field = field_of_surface(surface if cells is None else flatten_steps(surface), near, cells)
    return PlacedWall(Body(name, field, keep_out, margin, surface), notes)


def _lumen_of_mesh(surface: Surface, near: Array, open_edges: int) -> tuple[Surface, list[str]]:
    """Return the wall of the lumen around a path (n, 3) out of a mesh, and notes; raise CurveError without one.

    open_edges: number of edges with one triangle.
    """
    notes = []
    if open_edges or part_inside(surface, near) < 1:
        surface, inner = wall_around_path(surface, near)
        notes.append("the inside is what is connected to the path, with lids on the surface's openings")
        if inner:
            notes.append(f"{inner} triangles inside of the lumen, or across the path, are left out")
    surface, ends = open_ends(surface, near)
    _check_inside(surface, near)
    return surface, [*notes, *_note_ends(ends)]


def _note_ends(ends: Sequence[str]) -> list[str]:
    """Return a note on the ends of a path, "entry" and "target", at which a wall was opened."""
    return [f"the surface ends at the {' and the '.join(ends)}: its end counts as open"] if ends else []


def _check_inside(surface: Surface, near: Array) -> None:
    """Raise CurveError unless most of a path (n, 3) lies inside of a surface."""
    inside = part_inside(surface, near)
    if inside >= LEAST_INSIDE:
        return
    mirrored = part_inside(surface, near * [-1, -1, 1])
    hint = "; with x and y negated it does: is it in RAS instead of LPS, or the other way round (--space)?"
    raise CurveError(
        f"{100 * inside:.0f} % of the path lies inside of it; of a surface to stay inside of it must be "
        f"{100 * LEAST_INSIDE:.0f} %{hint if mirrored >= LEAST_INSIDE else ''}"
    )


def name_of_wall(path: str | Path) -> str:
    """Return the name of a file without the suffix of its kind."""
    name = title(path)
    return next((name[: -len(end)] for end in MESH_SUFFIXES if name.lower().endswith(end)), name)


def place_walls(
    walls: Sequence[Body | WallFile], near: Array, to_robot: Array, options: ReadOptions
) -> tuple[tuple[Body, ...], list[str]]:
    """Read walls near a path and move them before the robot; return them and notes.

    near: points (n, 3) of the path, mm in LPS. to_robot: transform (4, 4) from LPS. options: what a person states
    about the file of the path; its coordinates are also those of meshes that state none.
    """
    found, notes = list[Body](), list[str]()
    for wall in walls:
        if isinstance(wall, WallFile):
            own = wall.options
            if not is_mask(wall.path):
                own = replace(own, space=own.space or options.space)
            read = replace(wall, options=own).read(near)
            found.append(read.body.apply_transform(to_robot))
            notes += [f"{read.body.name}: {note}" for note in read.notes]
        elif isinstance(wall, Body):
            found.append(wall.apply_transform(to_robot))
        else:
            raise OptionError(f"a wall is {wall!r:.60}; give a Body, or a WallFile")
    return tuple(found), notes
