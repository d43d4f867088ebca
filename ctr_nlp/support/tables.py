"""Tables as Markdown, CSV and TOML."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt

from ctr_nlp.exceptions import escape_control_characters


def markdown(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose first column is aligned to the left and all others to the right.

    header: titles of the columns. body: rows of cells, as text.
    """
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *body]
    return "".join(f"| {' | '.join(map(escape_control_characters, line))} |\n" for line in lines)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `rows`, at least one, to the file `path` as CSV, with the keys of the first row on top."""
    with open(path, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def columns_to_rows(columns: Mapping[str, npt.NDArray[Any]]) -> list[dict[str, Any]]:
    """Turn named columns (n,) into the rows that write_csv takes."""
    lines = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, line, strict=True)) for line in lines]


def toml_text(head: str, tables: Sequence[tuple[str, Mapping[str, Any]]], comments: Mapping[str, str]) -> str:
    """Return the text of a TOML file.

    head: comment on top, without marks; it may have several lines. tables: headings, such as [limits] or
    [[tubes]], and their keys and values. comments: written beside the values of these keys.
    """
    lines = [
        f"# {escape_control_characters(line)}" for line in head.splitlines()
    ]  # TOML takes no control characters in comments
    for heading, table in tables:
        lines += ["", heading, *_lines(table, comments)]
    return "\n".join(lines) + "\n"


def _lines(table: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Return a line for each key whose value is not None: TOML has no null."""
    found = [(name, _value(value)) for name, value in table.items() if value is not None]
    return [f"{name} = {text}{f'  # {comments[name]}' if name in comments else ''}" for name, text in found]


def _value(value: Any) -> str:
    """Return a number, a string or a list of these as TOML."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if value in ("inf", "-inf"):
        # to_dict writes infinity as text, for JSON; TOML has the bare word.
        return str(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # as TOML has it
    number = float(value)
    return repr(number) if math.isfinite(number) else f"{number}"
