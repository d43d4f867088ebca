"""Text files of measurements as tables: encoding, separators, comments, names of columns and their units.

Programs write tables in several ways: with a byte order mark, in UTF-16, with semicolons and decimal commas, with
`#` before the names. Names of columns may carry a unit, as tip_x_m or tip_x [m]. Nothing is dropped in silence: a
column whose meaning is not certain is refused by its name.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ctr_nlp.exceptions import MeasurementError

COMMENT_MARKS = "#", "%", "//"
BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}
"""First bytes of a file, and its encoding; without them it is UTF-8, or else Windows' own."""
MISSING_CELLS = "", "nan", "na", "n/a", "null", "none"
"""What a cell holds, in small letters, where nothing was measured."""
COLUMN_UNITS = {
    "length": {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 0.001},
    "angle": {"rad": 1.0, "deg": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180},
    "time": {"s": 1.0, "ms": 1e-3},
    "force": {"n": 1.0, "mn": 1e-3},
}
"""Units that names of columns may end with, and the factor to mm, rad, s or N."""
COLUMN_KINDS = (
    (re.compile(r"beta_\d+|tip_[xyz]|p\d+_[xyzs]"), "length"),
    (re.compile(r"alpha_\d+|theta_[xy]"), "angle"),
    (re.compile(r"time"), "time"),
    (re.compile(r"force_[xyz]"), "force"),
)


class Column(NamedTuple):
    """A column of a file: its name without a unit, and the factor to the unit of that name."""

    name: str
    factor: float = 1.0


class TextTable(NamedTuple):
    """Cells of a file: those of the header, and for each row its line, from 1, and its cells."""

    header: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]
    has_decimal_comma: bool = False


def read_text_table(path: Path) -> TextTable:
    """Read the cells of a text file, whatever its encoding and separator.

    Parameters
    ----------
    path : Path
        The file. Lines that begin with one of COMMENT_MARKS are comments, but the last one before the rows may be
        the header.

    Returns
    -------
    TextTable
        Without columns at the end that are empty in all lines.

    Raises
    ------
    MeasurementError
        The file cannot be read, or it has no header and no rows.
    """
    try:
        lines = _decode(path.read_bytes()).splitlines()
    except (OSError, UnicodeError) as error:
        raise MeasurementError(f"measurements {path} cannot be read: {error}") from error
    found = [(n, line.strip()) for n, line in enumerate(lines, 1) if line.strip()]
    comments = [line for n, line in found if line.startswith(COMMENT_MARKS)]
    data = [(n, line) for n, line in found if not line.startswith(COMMENT_MARKS)]
    separator = _guess_separator(data[0][1] if data else "")
    try:
        cells = [(n, _split(line, separator)) for n, line in data]
        last_comment = _split(comments[-1].lstrip("#%/ "), separator) if comments else ()
    except csv.Error as error:
        raise MeasurementError(f"measurements {path} cannot be read: {error}") from error
    if cells and len(last_comment) == len(cells[0][1]) and all(map(_is_number, cells[0][1])):
        # numpy.savetxt writes the names of columns as a comment.
        cells.insert(0, (0, last_comment))
    if len(cells) < 2:
        raise MeasurementError(
            f"measurements {path} hold no rows; they must have a line of names and one of values"
        )
    width = max(len(row) for _, row in cells)
    while width > 1 and not any(row[width - 1 :] and row[width - 1] for _, row in cells):
        width -= 1
    rows = tuple((n, row[:width]) for n, row in cells[1:])
    return TextTable(cells[0][1][:width], rows, has_decimal_comma=separator != ",")


def _decode(content: bytes) -> str:
    """Return the text of a file, by its byte order mark, as UTF-8, or else in the encoding of Windows."""
    for mark, encoding in BYTE_ORDER_MARKS.items():
        if content.startswith(mark):
            return content.decode(encoding)
    if b"\0" in content:
        raise UnicodeError("it is no text")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("cp1252")


def _guess_separator(header: str) -> str | None:
    """Return what separates the cells of a header: a semicolon, a tab, a comma, or None for blanks."""
    for separator in (";", "\t", ","):
        if separator in header:
            return separator
    return None if len(header.split()) > 1 else ","


def _split(line: str, separator: str | None) -> tuple[str, ...]:
    """Return the cells of a line without blanks around them; separator: None for blanks."""
    if separator is None:
        return tuple(line.split())
    return tuple(cell.strip() for cell in next(csv.reader([line], delimiter=separator, strict=True)))


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, or empty."""
    try:
        parse_number(cell, True)
    except ValueError:
        return False
    return True


def parse_number(cell: str, has_decimal_comma: bool = False) -> float:
    """Return the number in a cell.

    Parameters
    ----------
    cell : str
        The cell.
    has_decimal_comma : bool
        Whether 1,5 is one and a half, as where semicolons separate cells.

    Returns
    -------
    float
        NaN where nothing was measured.

    Raises
    ------
    ValueError
        The cell holds no number.
    """
    if cell.strip().lower() in MISSING_CELLS:
        return math.nan
    return float(cell.replace(",", ".") if has_decimal_comma else cell)


def parse_column(text: str, known: Sequence[str]) -> Column | None:
    """Find which column a header means.

    Parameters
    ----------
    text : str
        Name in the file, such as ``alpha_1``, ``Alpha 1 [deg]`` or ``tip_x_m``.
    known : sequence of str
        Names of columns that are expected; points of the shape are known anyway.

    Returns
    -------
    Column or None
        None where the meaning is not certain.
    """
    bare = re.sub(r"[\s\-.\[\]()/]+", "_", text.strip().lower()).strip("_")
    # alpha1 is alpha_1; p1_x stays.
    bare = re.sub(r"^(alpha|beta)(\d)", r"\1_\2", bare)
    names = set(known)
    if bare in names or re.fullmatch(r"p[1-9]\d*_(x|y|z|sigma|s)", bare):
        return Column(bare)
    stem, _, unit = bare.rpartition("_")
    for pattern, kind in COLUMN_KINDS:
        if pattern.fullmatch(stem) and unit in COLUMN_UNITS[kind]:
            name = "time_s" if stem == "time" else stem
            is_known = name in names or name.startswith("p")
            return Column(name, COLUMN_UNITS[kind][unit]) if is_known else None
    return None
