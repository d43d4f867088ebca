"""Conversion of values to arrays and JSON and back, for files that are read without pickle."""

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
"""Classes whose values a file may hold, by names that stay when classes move."""
JSON_SCALAR_TYPES = bool, int, float, str, type(None)


def packable(name: str) -> Callable[[Kind], Kind]:
    """Return a decorator that lets files hold values of a dataclass, under this name."""

    def known(kind: Kind) -> Kind:
        _kinds[name] = kind
        return kind

    return known


@dataclass
class Packed:
    """Values as a table for JSON, each once, and the arrays that they hold."""

    arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    table: list[Any] = field(default_factory=list)
    _rows: dict[int, tuple[int, Any]] = field(default_factory=dict)

    def add(self, value: Any) -> Any:
        """Add a value, and return what stands for it in JSON; raises TypeError for what no file can hold."""
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, float) and not math.isfinite(value):
            return {"number": str(value)}
        if isinstance(value, JSON_SCALAR_TYPES):
            return value
        if isinstance(value, list | tuple):
            return [self.add(item) for item in value]
        if isinstance(value, MethodType):
            return {"of": self.add(value.__self__), "method": value.__func__.__name__}
        if id(value) not in self._rows:
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
    """Return the value that `packed` is in JSON; raises TypeError, LookupError, or what its class raises."""
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
