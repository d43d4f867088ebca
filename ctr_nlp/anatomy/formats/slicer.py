"""Curves that 3D Slicer saves as markups, `.mrk.json`.

After the schema markups-schema-v1.0.3.json of Slicer's Markups module and its vtkMRMLMarkupsJsonStorageNode.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import (
    CENTRELINE_SPACE_TO_LPS,
    Branch,
    Branches,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.pieces import find_meeting, join_pieces
from ctr_nlp.anatomy.plausibility import find_units
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, MM_PER_UNIT, STATED, FileFacts, ReadOptions
from ctr_nlp.anatomy.width_names import WIDTH_NAMES, may_be_width
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.points import check_coordinates
from ctr_nlp.typing import Array

UNPLACED = ("undefined", "preview", "missing")
"""Statuses of control points without a position: they are left out."""


OTHER_TYPES = {
    "ClosedCurve": "a closed curve has no first and no last point: save the path as an open curve",
    "Fiducial": "points are no path: draw an open curve, or save the list as .fcsv if it is in the path's order",
    "Line": "a line has two points: draw an open curve",
}
"""Types of markups that are taken for centrelines, and what to do instead."""
PIECE_NAME = re.compile(r"\((\d+)\)$")
"""End of the name of a piece: Slicer numbers the pieces of a tree, the first from 0."""
MAX_FILES_BESIDE, MAX_BYTES_BESIDE = 60, 20_000_000
"""Files beside a piece that are looked at for pieces it continues, and their largest size."""


def read_slicer(
    path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS, entry: npt.ArrayLike | None = None
) -> Branches:
    """Read the open curves of the markups file `path`, each from its first control point to its last.

    Curves that meet are pieces of a tree, and are joined. The lumen's radius is taken from a measurement with a
    value for each control point. options: what a person states about the file. entry: (3,) mm in the file's
    coordinates; see ctr_nlp/anatomy/pieces.py. Raises CurveError.
    """
    pieces = read_pieces(path, options)
    with name_source_in_errors(path):
        at = None if entry is None else transform_points(np.asarray(entry, dtype=float), pieces.to_lps)
        branches, notes = join_pieces(pieces.branches, options, at)
    facts = replace(pieces.facts, notes=(*pieces.facts.notes, *notes, *_name_notes(pieces.branches)))
    return replace(pieces, branches=tuple(branches), facts=facts)


def read_pieces(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> Branches:
    """Read the open curves of the markups file `path` as they stand in it, in mm; raise CurveError.

    options: what a person states about the file.
    """
    markups = _markups(path)
    stem = Path(path).name.partition(".")[0] or Path(path).stem
    names = [
        str(markup.get("name") or (stem if len(markups) == 1 else f"curve {k}"))
        for k, markup in enumerate(markups, start=1)
    ]
    with name_source_in_errors(path):
        spaces = [_space(name, markup) for name, markup in zip(names, markups, strict=True)]
        if len(set(spaces)) > 1:
            raise CurveError("its curves are in different coordinate systems, LPS and RAS; save them in one")
        if options.space not in (None, spaces[0]):
            raise CurveError(f"space is {options.space}, but the file states {spaces[0]}; leave out --space")
        units = [
            _unit(f"coordinateUnits of {name!r}", markup.get("coordinateUnits"))
            for name, markup in zip(names, markups, strict=True)
        ]
        if len(set(units)) > 1:
            raise CurveError(f"its curves are in different units, {' and '.join(map(str, set(units)))}")
        read = [_piece(name, markup, units[0]) for name, markup in zip(names, markups, strict=True)]
        pieces = [piece for piece, _ in read]
        for piece in pieces:
            check_coordinates(piece.points)
        unit = find_units(np.vstack([piece.points for piece in pieces]), options, units[0])
    to_lps = CENTRELINE_SPACE_TO_LPS[spaces[0]]
    scaled = [_scale(piece, unit.mm_per_unit, to_lps) for piece in pieces]
    notes = (*unit.notes, *(note for _, more in read for note in more))
    facts = FileFacts("markups of 3D Slicer", unit.units, unit.known, STATED, notes)
    return Branches(tuple(scaled), spaces[0], to_lps, facts)


def list_types(path: str | Path) -> list[str]:
    """Return the types of the markups of the file `path`, such as "Curve" or "Fiducial"; raise CurveError."""
    return [str(markup.get("type")) for markup in _markups(path)]


def _markups(path: str | Path) -> list[dict[str, Any]]:
    """Return the markups of the file `path` as they stand in it; raise CurveError where it holds none."""
    try:
        raw = Path(path).read_bytes()
        try:
            found = json.loads(raw)
        except UnicodeDecodeError:
            # Only names have letters beyond ASCII, and a file in another encoding still has its numbers.
            found = json.loads(raw.decode("latin-1"))
    except (OSError, ValueError, RecursionError) as error:
        raise CurveError(f"centreline {path} cannot be read: {error}") from error
    markups = found.get("markups") if isinstance(found, dict) else None
    if not (isinstance(markups, list) and markups and all(isinstance(markup, dict) for markup in markups)):
        raise CurveError(f'{path} is not a markups file of 3D Slicer: it must have a list "markups" of curves')
    return markups


def find_pieces_beside(path: str | Path, branches: Branches) -> tuple[list[str], list[str]]:
    """Return the names of markups files beside `path` on whose curves it begins, and that begin where it ends.

    branches: of the file at `path`. Where it begins at the end of a file's curve, files on whose middle it begins
    are not listed: these are whole paths along the same tree. Files that cannot be read are passed over.
    """
    at_end = list[str]()
    on_side = list[str]()
    after = list[str]()
    beside = sorted(Path(path).resolve().parent.glob("*.mrk.json"))[:MAX_FILES_BESIDE]
    for file in beside:
        if file.name == Path(path).name or file.stat().st_size > MAX_BYTES_BESIDE:
            continue
        try:
            others = read_slicer(file)
        except CurveError:
            continue
        for other in others.branches:
            for own in branches.branches:
                if min(len(own.points), len(other.points)) < 2:
                    continue
                meeting = find_meeting([other, own], 1)
                if meeting is not None:
                    (at_end if meeting.point == len(other.points) - 1 else on_side).append(file.name)
                meeting = find_meeting([own, other], 1)
                if meeting is not None and meeting.point == len(own.points) - 1:
                    after.append(file.name)
    return list(dict.fromkeys(at_end or on_side)), list(dict.fromkeys(after))


def _name_notes(pieces: Sequence[Branch]) -> list[str]:
    """Return a note where a single curve has the number of a piece that is not the first of a tree.

    pieces: as they stand in the file.
    """
    match = PIECE_NAME.search(pieces[0].name)
    if len(pieces) > 1 or match is None or int(match[1]) == 0:
        return []
    return [
        f"the curve's name, {pieces[0].name!r}, is that of a piece of a tree: check that it begins where the "
        "robot enters, or give the other pieces too (--pieces FILE ..)"
    ]


def _scale(piece: Branch, factor: float, to_lps: Array) -> Branch:
    """Return a piece in mm and LPS.

    piece: in the file's unit and axes. factor: mm per unit. to_lps: transform (4, 4) from its axes to LPS.
    """
    radius = None if piece.radius is None else piece.radius * factor
    return Branch(piece.name, transform_points(piece.points * factor, to_lps), radius)


def _space(name: str, markup: dict[str, Any]) -> str:
    """Return the coordinate system of a markup; raise CurveError unless it is an open curve.

    name: of the markup, for messages. markup: as it stands in the file.
    """
    kind = markup.get("type")
    space = markup.get("coordinateSystem")
    if kind != "Curve":
        hint = OTHER_TYPES.get(str(kind), "")
        raise CurveError(
            f"markup {name!r} is of type {kind!r:.60}; it must be an open curve, type 'Curve'"
            f"{hint and f'; {hint}'}"
        )
    if space not in tuple(CENTRELINE_SPACE_TO_LPS):
        stated = "missing" if space is None else f"{space!r:.60}"
        raise CurveError(
            f"coordinateSystem of {name!r} is {stated}; it must be one of {', '.join(CENTRELINE_SPACE_TO_LPS)}"
        )
    return str(space)


def _unit(what: str, unit: Any) -> str | None:
    """Return a unit, one of MM_PER_UNIT, or None where none is stated; raise CurveError for another.

    what: whose unit it is, for messages. unit: its UCUM code, or a list of code, coding scheme and meaning.
    """
    code = unit[0] if isinstance(unit, list) and unit else unit
    if code is None:
        return None
    if not isinstance(code, str) or code not in MM_PER_UNIT:
        raise CurveError(f"{what} is {code!r:.60}; it must be one of {', '.join(MM_PER_UNIT)}")
    return code


def _piece(name: str, markup: dict[str, Any], unit: str | None) -> tuple[Branch, list[str]]:
    """Return a curve as it stands in a file, and notes.

    name: of the curve. markup: as it stands in the file. unit: of its coordinates.
    """
    controls = markup.get("controlPoints")
    if not (isinstance(controls, list) and all(isinstance(control, dict) for control in controls)):
        raise CurveError(f"controlPoints of {name!r} must be a list of control points")
    statuses = [control.get("positionStatus", "defined") for control in controls]
    if wrong := [status for status in statuses if not isinstance(status, str)]:
        raise CurveError(f"positionStatus of a control point of {name!r} is {wrong[0]!r}; it must be a word")
    placed = np.array([status not in UNPLACED for status in statuses], bool)
    points = [_position(name, k, control) for k, control in enumerate(controls, start=1) if placed[k - 1]]
    radius = _radius(name, markup, len(controls), unit)
    notes = _measurement_notes(name, markup)
    if left := int((~placed).sum()):
        notes.append(f"{name}: left out {left} control point{'s' * (left > 1)} without a position")
    piece = Branch(name, np.array(points).reshape(-1, 3), None if radius is None else radius[placed])
    return piece, notes


def _position(name: str, number: int, control: dict[str, Any]) -> Array:
    position = _numbers(control.get("position"))
    if position is None or position.shape != (3,):
        raise CurveError(
            f"control point {number} of {name!r} is at {control.get('position')!r}; it must be three numbers in mm"
        )
    return position


def _radius(name: str, markup: dict[str, Any], count: int, unit: str | None) -> Array | None:
    """Return the lumen's radius (count,) in the unit of the coordinates; None where no measurement gives it.

    name: of the curve. markup: as it stands in the file. count: number of control points. unit: of coordinates.
    """
    measurements = markup.get("measurements") or []
    if not isinstance(measurements, list):
        raise CurveError(f"measurements of {name!r} must be a list")
    for measurement in measurements:
        if not isinstance(measurement, dict) or "controlPointValues" not in measurement:
            continue
        label = str(measurement.get("name"))
        share = WIDTH_NAMES.get(_plain(label))
        if share is None:
            continue
        values = _numbers(measurement["controlPointValues"])
        if values is None or values.size != count:
            held = "no numbers" if values is None else f"{values.size} values"
            raise CurveError(
                f"measurement {label!r} of {name!r} has {held} for {count} control points; it needs one for each"
            )
        own = _unit(f"the unit of measurement {label!r} of {name!r}", measurement.get("units"))
        ratio = 1.0 if own is None else MM_PER_UNIT[own] / MM_PER_UNIT[unit or "mm"]
        return values.reshape(count) * share * ratio
    return None


def _measurement_notes(name: str, markup: dict[str, Any]) -> list[str]:
    """Return a note on measurements at control points that are not used.

    name: of the curve. markup: as it stands in the file. Raises CurveError where one of them may be the radius.
    """
    labels = [
        str(measurement.get("name"))
        for measurement in markup.get("measurements") or []
        if isinstance(measurement, dict) and measurement.get("controlPointValues")
    ]
    if any(_plain(label) in WIDTH_NAMES for label in labels):
        labels = [label for label in labels if _plain(label) not in WIDTH_NAMES]
    elif perhaps := [label for label in labels if may_be_width(_plain(label))]:
        raise CurveError(
            f"it is not certain what measurement {perhaps[0]!r} of {name!r} means; if it is the lumen's size, "
            "name it Radius or Diameter, otherwise remove it"
        )
    return [f"{name}: measurement{'s' * (len(labels) > 1)} not used: {', '.join(labels)}"] if labels else []


def _plain(label: str) -> str:
    """Return a name without punctuation and without a unit of mm at its end, in lower case."""
    return re.sub(r"[^0-9a-z]", "", re.sub(r"[\s_(\[]*mm[)\]]?$", "", label.lower()))


def _numbers(value: Any) -> Array | None:
    """Return a list of numbers as an array, None for anything else."""
    try:
        return np.array(value, dtype=float) if isinstance(value, list) else None
    except (TypeError, ValueError, OverflowError):
        return None
