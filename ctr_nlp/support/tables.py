"""Tables as Markdown and as CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt


def markdown(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table whose first column is aligned to the left and all others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A file with a line for each of rows, at least one, and the keys of the first on top."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def by_line(columns: Mapping[str, npt.NDArray[Any]]) -> list[dict[str, Any]]:
    """Named columns (n,) as the rows that write_csv takes."""
    lines = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, line, strict=True)) for line in lines]
