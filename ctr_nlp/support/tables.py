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
    """Write a table whose first column is aligned to the left and all others to the right; cells as text."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *body]
    return "".join(f"| {' | '.join(map(escape_control_characters, line))} |\n" for line in lines)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a file with a line for each of rows, at least one, and the keys of the first on top."""
    with open(path, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def columns_to_rows(columns: Mapping[str, npt.NDArray[Any]]) -> list[dict[str, Any]]:
    """Turn named columns (n,) into the rows that write_csv takes."""
    lines = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, line, strict=True)) for line in lines]


def toml_text(head: str, tables: Sequence[tuple[str, Mapping[str, Any]]], comments: Mapping[str, str]) -> str:
    """Write a TOML file's text of tables with their headings, such as [limits] or [[tubes]].

    head: lines of comment that it begins with, without their marks. comments: what is said beside keys.
    """
    lines = [
        f"# {escape_control_characters(line)}" for line in head.splitlines()
    ]  # TOML takes no control characters in comments
    for heading, table in tables:
        lines += ["", heading, *_lines(table, comments)]
    return "\n".join(lines) + "\n"


def _lines(table: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Write a line for each key that has a value, since TOML has no word for none."""
    found = [(name, _value(value)) for name, value in table.items() if value is not None]
    return [f"{name} = {text}{f'  # {comments[name]}' if name in comments else ''}" for name, text in found]


def _value(value: Any) -> str:
    """Write a number, a string or a list of these."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if value in ("inf", "-inf"):
        return str(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # as TOML has it
    number = float(value)
    return repr(number) if math.isfinite(number) else f"{number}"
