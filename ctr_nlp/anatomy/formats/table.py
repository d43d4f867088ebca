"""Centrelines as tables: CSV of any program, fiducial lists of 3D Slicer (.fcsv), point tables of VMTK (.dat).

A column is read where its name says for certain what it is. A column that might be the lumen's radius, but need
not be, is refused by name; columns that are clearly something else are left out with a note.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ctr_nlp.anatomy.branch import (
    CENTRELINE_SPACE_TO_LPS,
    Branch,
    Branches,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.pieces import join_pieces
from ctr_nlp.anatomy.plausibility import MIN_LONG_STEP_MM, REPEATED_POINT_MM, FoundUnits, find_units
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ASSUMED, GIVEN, MM_PER_UNIT, STATED, FileFacts, ReadOptions
from ctr_nlp.anatomy.width_names import WIDTH_NAMES, may_be_width
from ctr_nlp.exceptions import CurveError
from ctr_nlp.typing import Array

EXPECTED = (
    "expected a header x_mm,y_mm,z_mm (or x,y,z) and optionally radius_mm or diameter_mm, then one point a line"
)
AXES = ("x", "y", "z")
AXIS_PATTERN = re.compile(
    r"(?:p|pos|position|point|points|coord|coords|coordinate|coordinates|centerline|centreline)?(?P<first>[xyz])"
    r"|(?P<second>[xyz])(?:pos|position|coord|coordinate)"
    r"|(?:point|points|coord|coords|coordinate|coordinates|position)(?P<number>[012])"
)
"""Names of a coordinate without punctuation, in lower case: x, pos_x, x position, Points:0 of ParaView."""
PATIENT_AXES = {"RAS": ("r", "a", "s"), "LPS": ("l", "p", "s")}
"""Names of the three coordinates that state the patient's axes as well."""
WIDTH_COLUMNS = WIDTH_NAMES | {"r": 1.0}
"""Names of the lumen's size without punctuation, in lower case, and the factor from each to the radius."""
UNIT_PATTERN = re.compile(r"^(?P<name>.*?)[\s_:/]*[\[(]?(?P<unit>(?<![A-Za-z])(?:mm|cm|m|um|µm|μm))[\])]?$", re.I)
"""A column's name with a unit at its end: x_mm, x (mm), radius [cm]."""
BARE_AXIS_PATTERN = re.compile(r"^(?P<name>[xyz])(?P<unit>mm|cm|um|µm|μm)$", re.I)
"""A coordinate with its unit right behind it: Xmm."""
TABLE_COMMENT_MARKS = ("#", "%")
SEPARATOR_LINE = re.compile(r"sep=.?", re.I)
"""A first line that tells Excel what separates the cells."""
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf(?:inity)?)", re.I)
STATED_UNIT = re.compile(r"\bunits?\b\s*[:=]?\s*(mm|cm|m|um|µm|μm)\b", re.I)
STATED_SPACE = re.compile(r"\b(?:coordinate\s*system|space)\b\s*[:=]?\s*(LPS|RAS|[01])\b", re.I)
"""Statements in lines that begin with #. Slicer wrote 0 for RAS and 1 for LPS before version 4.11."""
FCSV_SPACE_CODES = {"0": "RAS", "1": "LPS"}
FIDUCIAL_COLUMNS = ("label", "x", "y", "z", "sel", "vis")
"""Columns of a fiducial list without a list of columns, as Slicer 3 wrote them."""
FIDUCIAL_STATUS = 2
"""Cells behind the named ones of a fiducial list: the first is the point's state, DEFINED if it was placed."""
DEFINED = "2"
EDGE_COLUMNS = ("edgearray0", "edgearray1")
"""Columns of VMTK that number the two nodes of the piece of a network that a point belongs to."""


@dataclass(frozen=True)
class Column:
    """A column of a table: its name in the file, the name without unit and punctuation in lower case, its unit."""

    title: str
    name: str
    unit: str | None


@dataclass(frozen=True)
class Table:
    """Cells of a table and what lines before them state.

    columns: of the header. rows: a list of cells each. lines: their numbers in the file, from 1. comments: lines
    that begin with #, without it. cut: whether the last row may have been cut short.
    """

    columns: tuple[Column, ...]
    rows: list[list[str]]
    lines: list[int]
    comments: tuple[str, ...]
    cut: bool


def read_table(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> Branches:
    """Read the path of a table with a header, or the lines of a table of VMTK.

    A table that does not name the patient's axes keeps its coordinates as they are. path: the file. options: what
    a person states about it. Raises CurveError.
    """
    fiducials = Path(path).name.lower().endswith(".fcsv")
    text = _decode(path)
    with name_source_in_errors(path):
        table = _parse(text, fiducials)
        axes, named_space = _find_axes(table.columns)
        width = _find_width(table.columns, axes)
        points = np.column_stack([_values(table, k) for k in axes])
        _check_finite(points, table)
        stated_unit = _stated_unit(table, axes)
        found = find_units(points, options, stated_unit)
        radius = None
        if width is not None:
            factor = _width_factor(table.columns[width], found, stated_unit)
            radius = _values(table, width, empty_is_nan=True) * factor
        space, space_known = _find_space(table, named_space, options, fiducials)
        to_lps = CENTRELINE_SPACE_TO_LPS.get(space, np.eye(4))
        whole = Branch(Path(path).stem, transform_points(points * found.mm_per_unit, to_lps), radius)
        branches, repairs = join_pieces(_split(whole, table), options)
    notes = list(found.notes)
    if fiducials:
        notes.append("a list of points is taken as a path in their order")
    elif found.known == ASSUMED:
        notes.append("the file states no unit: mm is assumed; --units says another")
    notes += [*_unused_note(table, axes, width, fiducials), *_cut_note(table), *repairs]
    facts = FileFacts(_kind(path), found.units, found.known, space_known, tuple(notes))
    return Branches(tuple(branches), space, to_lps, facts)


def _kind(path: str | Path) -> str:
    kinds = {".fcsv": "fiducial list of 3D Slicer", ".dat": "point table of VMTK"}
    return kinds.get(Path(path).suffix.lower(), "table of points")


def _decode(path: str | Path) -> str:
    """Return the text of a file in UTF-8, UTF-16 or Latin-1; raise CurveError where it is no text."""
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise CurveError(f"centreline {path} cannot be read: {error}") from error
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encodings = ["utf-16"]
    elif b"\x00" in raw[:100]:
        # ASCII in UTF-16 without a mark: every other byte is 0, the first one where the order is big-endian.
        encodings = ["utf-16-be" if raw[:1] == b"\x00" else "utf-16-le"]
    else:
        encodings = ["utf-8-sig", "latin-1"]
    for encoding in encodings:
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\x00" not in text:
            return text
    raise CurveError(f"centreline {path} cannot be read: it is no text (UTF-8, UTF-16 or Latin-1)")


def _parse(text: str, fiducials: bool) -> Table:
    """Return the table of a text; raise CurveError where it has no header or a row of another width.

    fiducials: whether it is a fiducial list, whose columns are named in a comment, and whose rows may be longer.
    """
    numbered = [(k, line.strip(" ")) for k, line in enumerate(text.splitlines(), start=1) if line.strip()]
    comments = [line.lstrip("#% ").strip() for _, line in numbered if line.startswith(TABLE_COMMENT_MARKS)]
    body = [(k, line) for k, line in numbered if not line.startswith(TABLE_COMMENT_MARKS)]
    if body and SEPARATOR_LINE.fullmatch(body[0][1]):
        body = body[1:]
    if fiducials:
        listed = [c.partition("=")[2].strip() for c in comments if c.lower().startswith("columns")]
        titles = listed[-1].split(",") if listed else list(FIDUCIAL_COLUMNS)
        delimiter: str | None = ","
    else:
        first = body[0][1] if body else ""
        delimiter = _delimiter(first)
        titles = _cells(first, delimiter)
        if not body or all(_is_number(cell) for cell in titles):
            # Some programs write the names of the columns as a comment.
            named = [c for c in comments if _names_axes(_columns(_cells(c, _delimiter(c))))]
            if not named:
                raise CurveError(f"it is not a centreline: its first line is {first[:60]!r}; {EXPECTED}")
            titles = _cells(named[-1], _delimiter(named[-1]))
        else:
            body = body[1:]
    columns = _columns(titles)
    if body and not fiducials and (units := _unit_row(_cells(body[0][1], delimiter), columns)):
        columns = units
        body = body[1:]
    if not _names_axes(columns):
        shown = ",".join(titles)[:60]
        raise CurveError(f"it is not a centreline: its first line is {shown!r}; {EXPECTED}")
    rows = [_row(number, line, delimiter, len(columns), fiducials, line is body[-1][1]) for number, line in body]
    lines = [number for number, _ in body]
    if fiducials:
        placed = [len(row) < len(columns) + FIDUCIAL_STATUS or row[len(columns)] == DEFINED for row in rows]
        lines = [number for number, there in zip(lines, placed, strict=True) if there]
        rows = [row for row, there in zip(rows, placed, strict=True) if there]
    return Table(columns, rows, lines, tuple(comments), not text.endswith(("\n", "\r")))


def _unit_row(cells: Sequence[str], columns: Sequence[Column]) -> tuple[Column, ...]:
    """Return the columns with the units that a row below the header states, none where it states no unit.

    cells: of the row. columns: of the header.
    """
    units = [cell.strip("[]() ").lower().replace("µ", "u").replace("μ", "u") for cell in cells]
    if len(cells) != len(columns) or not set(units) & set(MM_PER_UNIT) or any(_is_number(cell) for cell in cells):
        return ()
    return tuple(
        replace(column, unit=column.unit or unit) if unit in MM_PER_UNIT else column
        for column, unit in zip(columns, units, strict=True)
    )


def _delimiter(line: str) -> str | None:
    """Return what separates the cells of a line; None for white space of any width."""
    return next((mark for mark in ("\t", ";", ",") if mark in line), None)


def _cells(line: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line, without quotation marks."""
    if delimiter is None:
        return [cell.strip('"') for cell in line.split()]
    try:
        (cells,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except (csv.Error, ValueError) as error:
        raise CurveError(f"it is not a centreline: {line[:60]!r} is no line of a table; {EXPECTED}") from error
    return [cell.strip() for cell in cells]


def _row(number: int, line: str, delimiter: str | None, width: int, longer: bool, last: bool) -> list[str]:
    """Return the cells of a row; raise CurveError where their number is not that of the header.

    number: of the line in the file. delimiter: of the cells. width: number of columns. longer: whether more cells
    are allowed. last: whether it is the last line.
    """
    cells = _cells(line, delimiter)
    while len(cells) > width and not cells[-1]:
        cells = cells[:-1]
    if len(cells) < width or (len(cells) > width and not longer):
        if last and len(cells) < width:
            hint = "; the file seems to be cut short"
        elif delimiter == "," and len(cells) == 2 * width:
            hint = "; with decimal commas, cells must be separated by semicolons or tabs"
        else:
            hint = ""
        raise CurveError(f"row {number} has {len(cells)} cells, but the header has {width}{hint}")
    return cells


def _columns(titles: Sequence[str]) -> tuple[Column, ...]:
    """Return the columns with the given titles."""
    found = []
    for title in titles:
        match = UNIT_PATTERN.match(title) or BARE_AXIS_PATTERN.match(title)
        unit = None
        name = title
        # x_m is x in metres, but "m" alone is a name.
        if match and match["name"]:
            name = match["name"]
            unit = match["unit"].lower().replace("µ", "u").replace("μ", "u")
        found.append(Column(title, re.sub(r"[^0-9a-z]", "", name.lower()), unit))
    return tuple(found)


def _axis(column: Column) -> str | None:
    """Return which of AXES a column is, None if none."""
    match = AXIS_PATTERN.fullmatch(column.name)
    if match is None:
        return None
    return match["first"] or match["second"] or AXES[int(match["number"])]


def _names_axes(columns: Sequence[Column]) -> bool:
    """Return whether the columns include three coordinates."""
    names = {column.name for column in columns}
    return set(AXES) <= {_axis(column) for column in columns} or any(
        set(axes) <= names for axes in PATIENT_AXES.values()
    )


def _find_axes(columns: Sequence[Column]) -> tuple[tuple[int, ...], str | None]:
    """Return the indices of the columns of x, y and z, and the patient coordinates that their names state.

    columns: of the header, which include three coordinates. Raises CurveError where two columns may be one.
    """
    by_axis = {axis: [k for k, column in enumerate(columns) if _axis(column) == axis] for axis in AXES}
    space = None
    if not all(by_axis.values()):
        names = {column.name for column in columns}
        space = next(space for space, axes in PATIENT_AXES.items() if set(axes) <= names)
        by_axis = {
            axis: [k for k, column in enumerate(columns) if column.name == own]
            for axis, own in zip(AXES, PATIENT_AXES[space], strict=True)
        }
    for axis, found in by_axis.items():
        if len(found) > 1:
            listed = " and ".join(repr(columns[k].title) for k in found)
            raise CurveError(f"columns {listed} may both be {axis}; leave one of them")
    return tuple(by_axis[axis][0] for axis in AXES), space


def _find_width(columns: Sequence[Column], axes: tuple[int, ...]) -> int | None:
    """Return the index of the column of the lumen's radius or diameter, None where there is none.

    columns: of the header. axes: indices of the coordinates. Raises CurveError where several columns or none for
    certain may be it.
    """
    others = [k for k in range(len(columns)) if k not in axes]
    certain = [k for k in others if columns[k].name in WIDTH_COLUMNS]
    if len(certain) > 1:
        listed = " and ".join(repr(columns[k].title) for k in certain)
        raise CurveError(f"columns {listed} may both be the lumen's size; leave one of them")
    if certain:
        return certain[0]
    perhaps = [k for k in others if may_be_width(columns[k].name)]
    if perhaps:
        listed = ", ".join(repr(columns[k].title) for k in perhaps)
        raise CurveError(
            f"it is not certain what column {listed} means; if it is the lumen's size, name it radius_mm or "
            "diameter_mm, otherwise remove it"
        )
    return None


def _is_number(cell: str) -> bool:
    return NUMBER.fullmatch(cell.replace(",", ".")) is not None


def _values(table: Table, column: int, empty_is_nan: bool = False) -> Array:
    """Return the numbers (n,) of a column; raise CurveError where a cell holds none.

    table: the table. column: its index. empty_is_nan: whether an empty cell is allowed, as NaN.
    """
    values = []
    for number, row in zip(table.lines, table.rows, strict=True):
        # In a file whose cells are not separated by commas, a comma in a number is a decimal comma.
        cell = row[column] if row[column].count(",") != 1 or "." in row[column] else row[column].replace(",", ".")
        if empty_is_nan and cell.lower() in ("", "na", "n/a", "nan", "null"):
            values.append(np.nan)
        elif NUMBER.fullmatch(cell):
            values.append(float(cell))
        else:
            shown = ",".join(row)[:60]
            title = table.columns[column].title
            raise CurveError(
                f"it is not a centreline: row {number} is {shown!r}, where {title!r} is no number; {EXPECTED}"
            )
    return np.array(values, dtype=float)


def _check_finite(points: Array, table: Table) -> None:
    """Raise CurveError, which names the line, where points (n, 3) of a table are not finite."""
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        k = int(bad[0])
        raise CurveError(
            f"point {k + 1} in row {table.lines[k]} is {points[k].tolist()}; coordinates must be finite"
        )


def _stated_unit(table: Table, axes: tuple[int, ...]) -> str | None:
    """Return the unit that the names of the coordinates or a comment state; None where there is none.

    table: the table. axes: indices of the coordinates. Raises CurveError where the coordinates differ.
    """
    named = {table.columns[k].unit for k in axes}
    if len(named) > 1:
        listed = ", ".join(repr(table.columns[k].title) for k in axes)
        raise CurveError(f"the units of columns {listed} differ; coordinates must be in one unit")
    (unit,) = named
    if unit is not None:
        return unit
    stated = [match[1].lower() for comment in table.comments if (match := STATED_UNIT.search(comment))]
    return re.sub("[µμ]", "u", stated[-1]) if stated else None


def _width_factor(column: Column, found: FoundUnits, stated: str | None) -> float:
    """Return the factor from a column of the lumen's size to its radius in mm.

    column: it. found: unit of the coordinates. stated: unit that the file states for them. A unit that a person
    gives for the file also replaces that of a column in the same unit as the coordinates.
    """
    own = None if column.unit == stated else column.unit
    return WIDTH_COLUMNS[column.name] * (found.mm_per_unit if own is None else MM_PER_UNIT[own])


def _find_space(table: Table, named: str | None, options: ReadOptions, fiducials: bool) -> tuple[str, str]:
    """Return the coordinate system of a table, "xyz" where nothing tells it, and how it is known.

    table: the table. named: what the names of its columns state. options: what a person states. fiducials: whether
    it is a fiducial list. Raises CurveError where file and person contradict each other.
    """
    stated = named
    for comment in table.comments:
        match = STATED_SPACE.search(comment)
        if match and stated is None:
            stated = FCSV_SPACE_CODES.get(match[1], match[1].upper())
    if stated is not None and options.space not in (None, stated):
        raise CurveError(f"space is {options.space}, but the file states {stated}; leave out --space")
    if stated is not None:
        return stated, STATED
    if options.space is not None:
        return options.space, GIVEN
    # Slicer's fiducial lists were in RAS before they stated it.
    return "RAS" if fiducials else "xyz", ASSUMED


def _unused_note(table: Table, axes: tuple[int, ...], width: int | None, fiducials: bool) -> list[str]:
    """Return a note that names the columns that are not used; none for the known ones of a fiducial list."""
    used = {*axes, width}
    titles = [
        column.title or f"number {k + 1}"
        for k, column in enumerate(table.columns)
        if k not in used and any(row[k] for row in table.rows)
    ]
    if fiducials or not titles:
        return []
    return [f"column{'s' * (len(titles) > 1)} not used: {', '.join(titles)}"]


def _cut_note(table: Table) -> list[str]:
    """Return a note where the last number of a file has fewer digits than all before, as in one cut short."""
    if not table.cut or len(table.rows) < 3:
        return []
    for k in range(len(table.columns)):
        digits = [len(row[k].partition(".")[2]) for row in table.rows if k < len(row)]
        if digits[-1] < min(digits[:-1]):
            return ["the last line is shorter than the others and has no end: the file may have been cut short"]
    return []


def _split(whole: Branch, table: Table) -> list[Branch]:
    """Return the lines whose points follow each other in a table, the path itself where there is but one.

    VMTK numbers the two nodes of the edge of a network that each point belongs to. Whole lines of a tree are told
    by the point at which all of them begin. whole: the points of all rows, in mm. table: the table.
    """
    names = [column.name for column in table.columns]
    points = whole.points
    titles: list[str]
    if set(EDGE_COLUMNS) <= set(names):
        first, second = (names.index(name) for name in EDGE_COLUMNS)
        edges = [(row[first], row[second]) for row in table.rows]
        cuts = [k for k, (one, other) in enumerate(pairwise(edges), start=1) if one != other]
        titles = [f"edge {edges[k][0]}-{edges[k][1]}" for k in [0, *cuts] if edges]
    else:
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        back = np.linalg.norm(points[1:] - points[:1], axis=1) < REPEATED_POINT_MM
        cuts = (np.flatnonzero(back & (steps >= MIN_LONG_STEP_MM)) + 1).tolist()
        titles = [f"line {k}" for k in range(1, len(cuts) + 2)]
    if not cuts:
        return [whole]
    return [
        Branch(title, points[start:stop], None if whole.radius is None else whole.radius[start:stop])
        for title, (start, stop) in zip(titles, pairwise([0, *cuts, len(points)]), strict=True)
    ]
