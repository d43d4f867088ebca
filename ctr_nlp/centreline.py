"""Centreline CSV files, and moving a path before the robot."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ctr_nlp.curve import Curve, curve_from_points
from ctr_nlp.errors import CurveError

Array = npt.NDArray[np.float64]

HEADING_MM = 10.0
"""The mean direction over this first length becomes the insertion direction."""


def placed(curve: Curve) -> tuple[Curve, Array]:
    """Move a curve before the robot; also the rigid transform (4, 4) from the curve's frame to the robot's.

    Its first point goes to the origin; its mean direction over the first 10 mm turns to +z by the smallest
    rotation.
    """
    ends = curve.point(np.array([0.0, min(HEADING_MM, curve.length)]))
    heading = ends[1] - ends[0]
    if np.linalg.norm(heading) < 1e-9:
        raise CurveError(f"the path returns to its start within {HEADING_MM:g} mm; no insertion direction")
    heading /= np.linalg.norm(heading)
    axis = np.cross(heading, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis), heading[2]
    unit = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    rotation = Rotation.from_rotvec(np.arctan2(sine, cosine) * unit).as_matrix()
    to_robot = np.eye(4)
    to_robot[:3, :3], to_robot[:3, 3] = rotation, -rotation @ ends[0]
    return curve.moved(to_robot), to_robot


def trimmed(curve: Curve, longest: float, drop: Literal["start", "end"]) -> Curve:
    """The curve without what exceeds longest mm, dropped at its start or its end."""
    if curve.length <= longest:
        return curve
    return curve.part(curve.length - longest, curve.length) if drop == "start" else curve.part(0.0, longest)


CSV_COLUMNS = ("x_mm", "y_mm", "z_mm")


def read_csv(path: str | Path, smoothing: float = 0.0) -> Curve:
    """The curve of a CSV file with columns x_mm, y_mm, z_mm and optionally radius_mm; raises CurveError."""
    try:
        lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise CurveError(f"centreline {path} cannot be read: {error}") from error
    columns = [name.strip().lower() for name in lines[0].split(",")] if lines else []
    expected = "expected a header x_mm,y_mm,z_mm and optionally radius_mm, then one point a line"
    if not set(CSV_COLUMNS) <= set(columns) or len(set(columns)) != len(columns):
        raise CurveError(f"{path} is not a centreline: its first line is {(lines or [''])[0][:60]!r}; {expected}")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            row = [float(cell) for cell in line.split(",")]
        except ValueError as error:
            raise CurveError(f"{path} is not a centreline: row {number} is {line[:60]!r}; {expected}") from error
        if len(row) != len(columns):
            raise CurveError(f"{path}: row {number} has {len(row)} cells, the header {len(columns)}")
        rows.append(row)
    table = np.array(rows).reshape(len(rows), len(columns))
    points = table[:, [columns.index(name) for name in CSV_COLUMNS]]
    radius = table[:, columns.index("radius_mm")] if "radius_mm" in columns else None
    try:
        return curve_from_points(points, radius, smoothing)
    except CurveError as error:
        raise CurveError(f"{path}: {error}") from error
