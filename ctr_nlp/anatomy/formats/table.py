"""Centreline CSV files: one path, a point a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctr_nlp.anatomy.branch import Branch, Branches
from ctr_nlp.exceptions import CurveError
from ctr_nlp.typing import Array

COLUMNS = ("x_mm", "y_mm", "z_mm")
EXPECTED = "expected a header x_mm,y_mm,z_mm and optionally radius_mm, then one point a line"


def read_table(path: str | Path) -> Branches:
    """The path of a CSV file with columns x_mm, y_mm, z_mm and optionally radius_mm; raises CurveError.

    Such a file says nothing of the patient's axes: its coordinates are kept as they are.
    """
    points, radius = _columns(path)
    return Branches((Branch(Path(path).stem, points, radius),), "xyz", np.eye(4))


def _columns(path: str | Path) -> tuple[Array, Array | None]:
    try:
        lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise CurveError(f"centreline {path} cannot be read: {error}") from error
    names = [name.strip().lower() for name in lines[0].split(",")] if lines else []
    if not set(COLUMNS) <= set(names) or len(set(names)) != len(names):
        raise CurveError(f"{path} is not a centreline: its first line is {(lines or [''])[0][:60]!r}; {EXPECTED}")
    rows = [_row(path, number, line, len(names)) for number, line in enumerate(lines[1:], start=2)]
    table = np.array(rows).reshape(len(rows), len(names))
    points = table[:, [names.index(name) for name in COLUMNS]]
    return points, table[:, names.index("radius_mm")] if "radius_mm" in names else None


def _row(path: str | Path, number: int, line: str, width: int) -> list[float]:
    try:
        row = [float(cell) for cell in line.split(",")]
    except ValueError as error:
        raise CurveError(f"{path} is not a centreline: row {number} is {line[:60]!r}; {EXPECTED}") from error
    if len(row) != width:
        raise CurveError(f"{path}: row {number} has {len(row)} cells, the header {width}")
    return row
