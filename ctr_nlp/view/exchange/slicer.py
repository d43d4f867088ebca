"""Write a plan for 3D Slicer, in the coordinates of the scan that its path was found in.

Shapes go from the robot's base frame to the file of the path (the inverse of the plan's to_robot), and from its
axes to LPS, the coordinates of DICOM. Every file says that it is in LPS; Slicer converts it to its own RAS.

Curves follow the schema markups-schema-v1.0.3.json of Slicer's Markups module, models the convention of its
vtkMRMLModelStorageNode, which reads the coordinate system from the field SPACE.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ctr_nlp.anatomy.branch import transform_points
from ctr_nlp.anatomy.formats.images import IMAGE_SPACE_TO_LPS
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array
from ctr_nlp.view.exchange.plan_surfaces import (
    INSCRIBED_TUBE_NAME,
    ShadedSurface,
    frames_with_shape,
    tube_surfaces,
    wall_surfaces,
)
from ctr_nlp.view.figures.parts.palette import BLACK, BLUE

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
SLICER_SPACES = ("LPS", "RAS")
"""Coordinates that a caller may state for a path whose file does not."""
UNSTATED = "xyz"
"""Space of a file that does not state its coordinates; see Problem."""
SLICER_SCRIPT_FILE, SLICER_TUBES_FILE = "load_in_slicer.py", "tubes.pvd"
"""Names of the files that exist once: the script for Slicer, and the list of tubes over time."""
SLICER_TUBE_WALL_FILE, SLICER_INSIDE_FILE, SLICER_KEEP_OUT_FILE = "inscribed_tube.vtp", "wall.vtp", "keep_out.vtp"
"""Names of the files of walls: the tube around the path, the surfaces of what the robot stays inside of, and those
of what it keeps away from.
"""
TEMPLATE = Path(__file__).parent / "templates" / SLICER_SCRIPT_FILE
SLICER_DECIMALS = 6
"""Decimals of coordinates in mm."""
LINE_MM = 0.6
"""Thickness of curves in Slicer, mm."""


def slicer_files(plan: Plan, space: str | None = None) -> dict[str, str]:
    """Return the files of a folder for 3D Slicer, by name: texts in UTF-8.

    For every frame that has a shape, numbered from 1: frames/robot_001.mrk.json and frames/target_001.mrk.json,
    the 101 points at uniform sigma of the robot's centreline and of its target as open curves, and
    frames/tubes_001.vtp, the tubes as surfaces with their outer diameters. tubes.pvd lists those with their times
    in s. wall.vtp is the surface that the robot stays inside of, or, where only a centreline with radii is known,
    inscribed_tube.vtp the tube around it; keep_out.vtp is what the robot keeps away from. load_in_slicer.py loads
    and films all of it in Slicer.
    The script, and the first point of every curve, say that nothing here is validated for use on patients.

    plan: the plan. space: as in to_scan. Raises OptionError, also where pyvista is missing, and OutputError where
    no frame has a shape.
    """
    to_lps = to_scan(plan, space)
    frames = frames_with_shape(plan)
    digits = max(3, len(str(len(plan.time))))
    numbers = {j: str(j + 1).zfill(digits) for j in frames}
    found = {
        SLICER_SCRIPT_FILE: TEMPLATE.read_text(encoding="utf-8"),
        SLICER_TUBES_FILE: _collection(plan, numbers),
    }
    for j, number in numbers.items():
        for name, points, colour in (("robot", plan.shape[j], BLUE), ("target", plan.target[j], BLACK)):
            found[f"frames/{name}_{number}.mrk.json"] = _curve(name, transform_points(points, to_lps), colour)
        found[tubes_file(number)] = _model(tube_surfaces(plan, j), to_lps, float(plan.time[j]))
    return found | _wall_files(plan, to_lps)


def _wall_files(plan: Plan, to_lps: Array) -> dict[str, str]:
    """Return the files of a plan's walls, by name; to_lps (4, 4): from the robot's base frame to LPS, mm."""
    kept_out = {body.name for body in plan.walls if body.keep_out}
    by_file: dict[str, list[ShadedSurface]] = {}
    for name, surface in wall_surfaces(plan).items():
        file = SLICER_KEEP_OUT_FILE if name in kept_out else SLICER_INSIDE_FILE
        by_file.setdefault(SLICER_TUBE_WALL_FILE if name == INSCRIBED_TUBE_NAME else file, []).append(surface)
    return {file: _model(dict(enumerate(surfaces)), to_lps) for file, surfaces in by_file.items()}


def to_scan(plan: Plan, space: str | None = None) -> Array:
    """Return the transform (4, 4), mm, from the robot's base frame to LPS coordinates of the scan that the plan's
    path was found in.

    plan: the plan. space: LPS or RAS, where the file of the path does not state its patient coordinates. It counts
    before those that were assumed when the file was read. A plan whose path comes from no file is written in the
    coordinates of its path. Raises OptionError where the coordinates are not known, or the file states others.
    """
    stated = plan.meta["problem"].get("space", UNSTATED)
    # Plans of earlier versions do not say whether their space was assumed.
    assumed = plan.meta["problem"].get("space_assumed", False)
    if stated in IMAGE_SPACE_TO_LPS and not (assumed and space):
        if space not in (None, stated):
            raise OptionError(
                f"space is {space}, but the file of the plan's path, or the one who planned, states {stated}"
            )
    elif space is not None:
        if space not in SLICER_SPACES:
            raise OptionError(f"space is {space!r}; it must be one of {', '.join(SLICER_SPACES)}")
        stated = space
    elif stated is None or np.array_equal(plan.to_robot, np.eye(4)):
        stated = "LPS"
    else:
        raise OptionError(
            "the plan does not say whether its path is in LPS or RAS coordinates of the scan (neither does its "
            "file, or an earlier version made the plan); give --space LPS or --space RAS"
        )
    # to_robot takes the file's coordinates to the base frame; its inverse leads back to the file, whose axes are
    # then turned to LPS. From LAS, a left-handed system, that is a reflection.
    return np.asarray(IMAGE_SPACE_TO_LPS[stated] @ np.linalg.inv(plan.to_robot), dtype=float)


def tubes_file(number: str) -> str:
    """Return the name of the file of a frame's tubes; number: the frame's number as text, with leading zeros."""
    return f"frames/tubes_{number}.vtp"


def _curve(name: str, points: Array, colour: str) -> str:
    """Return a markups file with one open curve through points (n, 3), mm in LPS; colour: such as #0072B2."""
    controls: list[dict[str, Any]] = [
        {"id": str(k), "label": f"{name}-{k}", "position": place, "positionStatus": "defined", "locked": True}
        for k, place in enumerate((np.round(points, SLICER_DECIMALS) + 0.0).tolist(), start=1)
    ]
    controls[0]["description"] = NOT_FOR_PATIENTS  # the schema has no description of a whole curve
    shades = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    display = {
        "color": shades,
        "selectedColor": shades,
        "pointLabelsVisibility": False,
        "propertiesLabelVisibility": False,
        "useGlyphScale": False,
        "glyphSize": LINE_MM / 2,
        "lineDiameter": LINE_MM,
        "curveLineSizeMode": "SetLineDiameter",
        "handlesInteractive": False,
    }
    markup = {
        "type": "Curve",
        "name": name,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "controlPoints": controls,
        "display": display,
    }
    return json.dumps({"@schema": SCHEMA, "markups": [markup]}, allow_nan=False) + "\n"


def _model(surfaces: dict[int, ShadedSurface], to_lps: Array, time: float | None = None) -> str:
    """Return a .vtp file of surfaces by tube number, moved from the robot's base frame to LPS; each cell has the
    number of its tube, or of its wall, from 0.

    to_lps: transform (4, 4), mm. time: in s, kept in the field TimeValue.
    """
    pyvista = import_extra("pyvista")
    writing = import_extra("vtkmodules.vtkIOXML")
    sizes = np.cumsum([0, *(len(surface.points) for surface in surfaces.values())])[:-1]
    triangles = [surface.triangles + first for surface, first in zip(surfaces.values(), sizes, strict=True)]
    # A reflection turns triangles inside out; their corners in reverse order face outwards again.
    mirrored = np.linalg.det(to_lps[:3, :3]) < 0
    mesh = pyvista.PolyData.from_regular_faces(
        transform_points(_stack_rows([surface.points for surface in surfaces.values()]), to_lps),
        _stack_rows(triangles).astype(int)[:, :: -1 if mirrored else 1],
    )
    # to_lps is orthogonal, so that normals turn as vectors do.
    mesh.point_data["Normals"] = _stack_rows([surface.normals for surface in surfaces.values()]) @ to_lps[:3, :3].T
    mesh.cell_data["tube"] = np.repeat(list(surfaces), [len(each) for each in triangles]).astype(np.int32)
    mesh.field_data["SPACE"] = ["LPS"]
    if time is not None:
        mesh.field_data["TimeValue"] = [time]
    writer = writing.vtkXMLPolyDataWriter()
    writer.SetInputData(mesh)
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString())


def _stack_rows(parts: Sequence[Any]) -> Any:
    """Stack the rows of several arrays (n, 3), of no array too."""
    return np.vstack([np.zeros((0, 3)), *parts])


def _collection(plan: Plan, numbers: dict[int, str]) -> str:
    """List the tubes over time in ParaView's collection format; numbers: the number, as text, of each frame from
    0.
    """
    root = ElementTree.Element("VTKFile", type="Collection", version="1.0")
    listed = ElementTree.SubElement(root, "Collection")
    for j, number in numbers.items():
        ElementTree.SubElement(listed, "DataSet", timestep=f"{plan.time[j]:.9g}", file=tubes_file(number))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
