"""Values: things that are equal where all that they hold is: arrays, methods, other values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import MethodType
from typing import Any, ClassVar

import numpy as np

from ctr_nlp.support.values import frozen


class Value:
    """Base of frozen dataclasses, declared with eq=False, that hold arrays or methods of other values.

    They are equal where all fields are, arrays by content and NaN to NaN. They have no hash. Pickled or copied
    they are made anew from their fields, so that read-only arrays stay read-only.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        return equal(self, other) if type(other) is type(self) else NotImplemented

    def __reduce__(self) -> Any:
        return type(self), tuple(getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]


class Kept(Value):
    """A value that keeps read-only copies of its arrays."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            if isinstance(given := getattr(self, f.name), np.ndarray):
                object.__setattr__(self, f.name, frozen(given))


def equal(one: Any, other: Any, known: set[tuple[int, int]] | None = None) -> bool:
    """Whether two things hold the same; NaN is equal to NaN.

    known: pairs, by id, that were found equal before: frames of a target share their curve.
    """
    known = set() if known is None else known
    pair = id(one), id(other)
    if one is other or pair in known:
        return True
    if _equal(one, other, known):
        known.add(pair)
        return True
    return False


def _equal(one: Any, other: Any, known: set[tuple[int, int]]) -> bool:
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(equal(one[key], other[key], known) for key in one)
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind in "fc" and other.dtype.kind in "fc")
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(equal(a, b, known) for a, b in zip(one, other, strict=True))
    if isinstance(one, MethodType) and isinstance(other, MethodType):
        return one.__func__ is other.__func__ and equal(one.__self__, other.__self__, known)
    if is_dataclass(one) and isinstance(one, Value):
        same = type(one) is type(other)
        return same and all(equal(getattr(one, f.name), getattr(other, f.name), known) for f in fields(one))
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return False
    return bool(one == other or (one != one and other != other))
