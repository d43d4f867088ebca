"""Conversion of values to arrays and JSON and back, for files that are read without pickle.

A file has a table of rows, one for every array and every dataclass that is used, and refers to them by number:
curves that many frames share are stored once. Unlike pickle, reading builds registered classes only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from types import MethodType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Kind = TypeVar("Kind", bound=type)

_kinds: dict[str, type] = {}
"""Classes whose values a file may contain, by names that do not change when classes are moved or renamed."""
JSON_SCALAR_TYPES = bool, int, float, str, type(None)


def packable(name: str) -> Callable[[Kind], Kind]:
    """Return a decorator that registers a dataclass, under this name, for values in files."""

    def known(kind: Kind) -> Kind:
        _kinds[name] = kind
        return kind

    return known


@dataclass
class Packed:
    """Packed values: a table for JSON, with each value once, and the arrays that the rows refer to."""

    arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    table: list[Any] = field(default_factory=list)
    _rows: dict[int, tuple[int, Any]] = field(default_factory=dict)

    def add(self, value: Any) -> Any:
        """Add a value and return its representation in JSON; raises TypeError where no file can contain it."""
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, float) and not math.isfinite(value):
            # Strict JSON has neither NaN nor infinity.
            return {"number": str(value)}
        if isinstance(value, JSON_SCALAR_TYPES):
            return value
        if isinstance(value, list | tuple):
            return [self.add(item) for item in value]
        if isinstance(value, MethodType):
            return {"of": self.add(value.__self__), "method": value.__func__.__name__}
        if id(value) not in self._rows:
            # The row adds the value's fields first, so that a row refers to earlier rows only.
            row = self._row(value)
            self._rows[id(value)] = len(self.table), value  # which keeps its id from being used again
            self.table.append(row)
        return {"row": self._rows[id(value)][0]}

    def _row(self, value: Any) -> dict[str, Any]:
        """Return the row of the table for an array, which is stored, or for a packable dataclass."""
        if isinstance(value, np.ndarray):
            name = f"array_{len(self.arrays)}"
            self.arrays[name] = value
            return {"array": name}
        for name, kind in _kinds.items():
            if type(value) is kind and is_dataclass(kind):
                return {"kind": name, "fields": {f.name: self.add(getattr(value, f.name)) for f in fields(kind)}}
        raise TypeError(f"{value!r:.80} is not made by this library: a file cannot hold it")


def unpack_value(packed: Any, table: list[Any], arrays: Mapping[str, npt.NDArray[Any]]) -> Any:
    """Rebuild a value from its representation in JSON.

    packed: what `Packed.add` returned for it. table: rows of the file. arrays: its arrays, by name. Raises
    TypeError, LookupError, or what the value's class raises.
    """
    made: list[Any] = []

    def value(part: Any) -> Any:
        if isinstance(part, JSON_SCALAR_TYPES):
            return part
        if isinstance(part, list):
            return tuple(map(value, part))
        if "number" in part:
            return float(part["number"])
        if "row" in part:
            return made[part["row"]]
        owner = value(part["of"])
        # A file is not trusted: it may name public methods of registered classes, and nothing else that getattr
        # finds.
        if type(owner) not in _kinds.values() or part["method"].startswith("_"):
            raise TypeError(f"{part['method']!r} is not what a file may name")
        return getattr(owner, part["method"])

    for row in table:
        if "array" in row:
            made.append(arrays[row["array"]])
        elif row["kind"] in _kinds:
            made.append(_kinds[row["kind"]](**{name: value(part) for name, part in row["fields"].items()}))
        else:
            raise LookupError(f"{row['kind']!r} is unknown; known are {', '.join(_kinds)}")
    return value(packed)
