"""Files of anatomy: the reader of every kind, by the ends of their names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import (
    Branches,
    check_branches,
    checked_point,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.formats.slicer import find_pieces_beside, list_types, read_pieces, read_slicer
from ctr_nlp.anatomy.formats.table import read_table
from ctr_nlp.anatomy.formats.vtk import read_vtk
from ctr_nlp.anatomy.pieces import join_pieces
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.anatomy.suffixes import (
    ANATOMY_SUFFIXES,
    CENTRELINE_SUFFIXES,
    MARKUPS_SUFFIXES,
    MASK_SUFFIXES,
    POLYLINE_SUFFIXES,
    TABLE_SUFFIXES,
)
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.typing import Array

Point: TypeAlias = npt.ArrayLike | None

MASK_PATH_SMOOTHING_MM = 2.0
"""How far the followed curve may be from the middle of a mask's lumen by default, mm."""


def _read_mask(path: str | Path, entry: Point, target: Point, options: ReadOptions) -> Branches:
    # Imported where they are used, since they bring scipy.ndimage.
    if entry is None or target is None:
        from ctr_nlp.anatomy.segmentation.tree import read_mask_tree

        return read_mask_tree(path, entry, options)
    from ctr_nlp.anatomy.segmentation.mask import read_mask

    return read_mask(path, entry, target, options)


@dataclass(frozen=True)
class FileReader:
    """A kind of file of anatomy.

    suffixes: ends of the names of such files, in lower case. read: called with a path, entry and target, (3,) mm
    in the file's coordinates or None, and ReadOptions. mask: whether it is a mask rather than centrelines. bare:
    reads the lines of a file as they stand in it, for pieces of a tree in several files; None where `read` does.
    """

    suffixes: tuple[str, ...]
    read: Callable[[str | Path, Point, Point, ReadOptions], Branches]
    mask: bool = False
    bare: Callable[[str | Path, ReadOptions], Branches] | None = None


READERS = (
    FileReader(TABLE_SUFFIXES, lambda path, _entry, _target, options: read_table(path, options)),
    FileReader(
        MARKUPS_SUFFIXES, lambda path, entry, _, options: read_slicer(path, options, entry), bare=read_pieces
    ),
    FileReader(POLYLINE_SUFFIXES, lambda path, entry, _, options: read_vtk(path, entry, options)),
    FileReader(MASK_SUFFIXES, _read_mask, mask=True),
)
"""Every kind of file that is read. A new format is a line here."""


def centrelines_in(folder: str | Path) -> list[Path]:
    """Return the sorted centreline files in a folder, without .txt files, which mostly are something else; raise
    OptionError where it has none.
    """
    found = sorted(
        path
        for path in Path(folder).glob("*")
        if path.name.endswith(CENTRELINE_SUFFIXES) and path.suffix != ".txt"
    )
    if not found:
        raise OptionError(f"folder {folder} has no centreline files ({', '.join(CENTRELINE_SUFFIXES)})")
    return found


def read_branches(
    path: str | Path,
    entry: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
    options: ReadOptions = AS_THE_FILE_SAYS,
    pieces: Sequence[str | Path] = (),
) -> Branches:
    """Read the branches of a centreline file or of a mask, each fit to be a curve.

    path: the file. entry: (3,) mm in the file's coordinates, where the robot enters; it settles where a tree
    starts, if the file does not; in a mask it is guessed. target: (3,) mm; a mask with both has one branch, from
    one to the other. options: what a person states about the file. pieces: further files with pieces of the same
    tree. Raises CurveError, and OptionError where an extra is missing.
    """
    for what, point in (("entry", entry), ("target", target)):
        if point is not None:
            checked_point(what, point)
    others = [piece for piece in pieces if Path(piece).resolve() != Path(path).resolve()]
    if others:
        return check_branches(path, _read_tree([path, *others], entry, options))
    reader = _reader_of(path)
    found = check_branches(path, reader.read(path, entry, target, options))
    return _note_pieces_beside(path, found) if reader.suffixes == MARKUPS_SUFFIXES else found


def is_mask(path: str | Path) -> bool:
    """Return whether the file `path` contains a mask rather than centrelines, by its name."""
    return Path(path).name.lower().endswith(MASK_SUFFIXES)


def path_smoothing(asked: float | None, of_mask: bool) -> float:
    """Return how far a followed curve may be from the path in a file, mm; where `asked` is None, a default.

    A person chose the points of a centreline. The path through a mask is made here, from voxel to voxel: followed
    as it is, its bends are sharper than any robot's, and plans miss ends that the same robot reaches on a smooth
    path. The curve keeps within half of the lumen's radius in any case.
    """
    return asked if asked is not None else MASK_PATH_SMOOTHING_MM if of_mask else 0.0


def is_markups(path: str | Path) -> bool:
    """Return whether the file `path` is a markups file of 3D Slicer, by its name."""
    return Path(path).name.lower().endswith(MARKUPS_SUFFIXES)


def title(path: str | Path) -> str:
    """Return the name of the file `path` without the suffix that identifies its kind."""
    name = Path(path).name
    known = [suffix for suffix in ANATOMY_SUFFIXES if name.lower().endswith(suffix)]
    return name[: -max(map(len, known))] if known else name


def _reader_of(path: str | Path) -> FileReader:
    """Return the reader of a file by its name; raise CurveError where there is none."""
    for reader in READERS:
        if Path(path).name.lower().endswith(reader.suffixes):
            return reader
    raise CurveError(f"{path} is not a known kind of file; its name must end in {', '.join(ANATOMY_SUFFIXES)}")


def _read_tree(paths: Sequence[str | Path], entry: Point, options: ReadOptions) -> Branches:
    """Read pieces of one tree in several files, in the coordinates of the first.

    paths: the files. entry: (3,) mm in these coordinates, or None. options: what a person states about the files.
    """
    read = list[Branches]()
    # A scene of Slicer has the end points of a tree beside its pieces, so that *.mrk.json names them too.
    others = [path for path in paths if is_markups(path) and "Curve" not in list_types(path)]
    paths = [path for path in paths if path not in others]
    if not paths:
        raise CurveError(f"{list_files([str(path) for path in others])} hold no open curve")
    left_out = [
        f"{Path(path).name}: left out, it holds no open curve but {list_types(path)[0]}" for path in others
    ]
    for path in paths:
        reader = _reader_of(path)
        if reader.mask:
            raise OptionError(f"{path} is a mask; pieces of a tree must be centreline files")
        read.append(reader.bare(path, options) if reader.bare else reader.read(path, entry, None, options))
    first = read[0]
    at: Array | None = None
    if entry is not None:
        at = transform_points(np.asarray(entry, dtype=float), first.to_lps)
    for path, branches in zip(paths, read, strict=True):
        if branches.space != first.space:
            raise CurveError(
                f"{path} is in {branches.space}, but {paths[0]} in {first.space}; pieces of a tree must be in one "
                "coordinate system"
            )
    with name_source_in_errors(paths[0]):
        joined, notes = join_pieces([piece for branches in read for piece in branches.branches], options, at)
    own = [
        f"{Path(path).name}: {note}"
        for path, branches in zip(paths, read, strict=True)
        for note in branches.facts.notes
    ]
    facts = replace(first.facts, kind=f"{first.facts.kind}, {len(paths)} files", notes=(*left_out, *own, *notes))
    return Branches(tuple(joined), first.space, first.to_lps, facts)


def _note_pieces_beside(path: str | Path, branches: Branches) -> Branches:
    """Return the branches of a markups file with a note on files beside it that hold pieces of the same tree."""
    before, after = find_pieces_beside(path, branches)
    notes = list(branches.facts.notes)
    if before:
        notes.append(
            f"it begins on the curve of {list_files(before)}, as a piece of a tree: give both files, or --pieces"
        )
    if after:
        notes.append(f"the tree goes on in {list_files(after)}: give both files, or --pieces")
    return replace(branches, facts=replace(branches.facts, notes=tuple(notes)))


MAX_LISTED_FILES = 3


def list_files(names: Sequence[str]) -> str:
    """Return names of files as text, at most three of them."""
    others = f" and {len(names) - MAX_LISTED_FILES} more" if len(names) > MAX_LISTED_FILES else ""
    return ", ".join(names[:MAX_LISTED_FILES]) + others
