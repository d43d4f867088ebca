"""Curves that 3D Slicer saves as markups, `.mrk.json`.

After the schema markups-schema-v1.0.3.json of Slicer's Markups module and its vtkMRMLMarkupsJsonStorageNode.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.anatomy.branch import (
    CENTRELINE_SPACE_TO_LPS,
    Branch,
    Branches,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.typing import Array

WIDTHS = {
    "radius": 1.0,
    "maximuminscribedsphereradius": 1.0,
    "diameter": 0.5,
}
"""Measurements of the lumen's size, by names in lower case, and the factor from each to the radius.

SlicerVMTK's Extract Centerline writes "Radius".
"""
UNPLACED = ("undefined", "preview", "missing")
"""Statuses of control points without a position: they are left out."""


def read_slicer(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> Branches:
    """Read the open curves of the markups file `path`, each from its first control point to its last.

    The lumen's radius is taken from a measurement with a value for each control point. options: what a person
    states about the file. Raises CurveError.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise CurveError(f"centreline {path} cannot be read: {error}") from error
    markups = found.get("markups") if isinstance(found, dict) else None
    if not (isinstance(markups, list) and markups and all(isinstance(markup, dict) for markup in markups)):
        raise CurveError(f'{path} is not a markups file of 3D Slicer: it must have a list "markups" of curves')
    stem = Path(path).name.partition(".")[0] or Path(path).stem
    names = [
        str(markup.get("name") or (stem if len(markups) == 1 else f"curve {k}"))
        for k, markup in enumerate(markups, start=1)
    ]
    with name_source_in_errors(path):
        spaces = [_space(name, markup) for name, markup in zip(names, markups, strict=True)]
        if len(set(spaces)) > 1:
            raise CurveError("its curves are in different coordinate systems, LPS and RAS; save them in one")
        branches = [_branch(name, markup) for name, markup in zip(names, markups, strict=True)]
    return Branches(tuple(branches), spaces[0], CENTRELINE_SPACE_TO_LPS[spaces[0]])


def _space(name: str, markup: dict[str, Any]) -> str:
    """Return the coordinate system of a markup; raise CurveError unless it is an open curve in millimetres."""
    kind = markup.get("type")
    space = markup.get("coordinateSystem")
    if kind != "Curve":
        raise CurveError(f"markup {name!r} is of type {kind!r}; it must be an open curve, type 'Curve'")
    if space not in tuple(CENTRELINE_SPACE_TO_LPS):
        stated = "missing" if space is None else repr(space)
        raise CurveError(
            f"coordinateSystem of {name!r} is {stated}; it must be one of {', '.join(CENTRELINE_SPACE_TO_LPS)}"
        )
    _check_unit(f"coordinateUnits of {name!r}", markup.get("coordinateUnits", "mm"))
    return str(space)


def _check_unit(what: str, unit: Any) -> None:
    """Raise CurveError unless a unit is mm, as its UCUM code or as a list of code, coding scheme and meaning."""
    code = unit[0] if isinstance(unit, list) and unit else unit
    if code != "mm":
        raise CurveError(f"{what} is {code!r}; it must be 'mm', millimetres")


def _branch(name: str, markup: dict[str, Any]) -> Branch:
    controls = markup.get("controlPoints")
    if not (isinstance(controls, list) and all(isinstance(control, dict) for control in controls)):
        raise CurveError(f"controlPoints of {name!r} must be a list of control points")
    statuses = [control.get("positionStatus", "defined") for control in controls]
    if wrong := [status for status in statuses if not isinstance(status, str)]:
        raise CurveError(f"positionStatus of a control point of {name!r} is {wrong[0]!r}; it must be a word")
    placed = np.array([status not in UNPLACED for status in statuses], bool)
    points = [_position(name, k, control) for k, control in enumerate(controls, start=1) if placed[k - 1]]
    radius = _radius(name, markup, len(controls))
    lps = transform_points(np.array(points).reshape(-1, 3), CENTRELINE_SPACE_TO_LPS[markup["coordinateSystem"]])
    return Branch(name, lps, None if radius is None else radius[placed])


def _position(name: str, number: int, control: dict[str, Any]) -> Array:
    position = _numbers(control.get("position"))
    if position is None or position.shape != (3,):
        raise CurveError(
            f"control point {number} of {name!r} is at {control.get('position')!r}; it must be three numbers in mm"
        )
    return position


def _radius(name: str, markup: dict[str, Any], count: int) -> Array | None:
    """Return the lumen's radius (count,) in mm at all control points; None where no measurement gives it."""
    measurements = markup.get("measurements") or []
    if not isinstance(measurements, list):
        raise CurveError(f"measurements of {name!r} must be a list")
    for measurement in measurements:
        if not isinstance(measurement, dict) or "controlPointValues" not in measurement:
            continue
        label = str(measurement.get("name"))
        share = WIDTHS.get(label.lower())
        if share is None:
            continue
        values = _numbers(measurement["controlPointValues"])
        if values is None or values.size != count:
            held = "no numbers" if values is None else f"{values.size} values"
            raise CurveError(
                f"measurement {label!r} of {name!r} has {held} for {count} control points; it needs one for each"
            )
        _check_unit(f"the unit of measurement {label!r} of {name!r}", measurement.get("units", "mm"))
        return values.reshape(count) * share
    return None


def _numbers(value: Any) -> Array | None:
    """Return a list of numbers as an array, None for anything else."""
    try:
        return np.array(value, dtype=float) if isinstance(value, list) else None
    except (TypeError, ValueError, OverflowError):
        return None
