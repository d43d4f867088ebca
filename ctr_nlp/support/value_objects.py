"""Value objects, which are equal where all their fields are, and read-only dicts and lists for JSON data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import MethodType
from typing import Any, ClassVar

import numpy as np

from ctr_nlp.support.value_checks import frozen, strict_json


class Value:
    """Base of frozen dataclasses, declared with eq=False, whose fields may be arrays or methods of other values.

    They are equal where all fields are: arrays by content, NaN equal to NaN. They have no hash. Pickling and
    copying build them again from their fields, so that read-only arrays stay read-only.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        return equal(self, other) if type(other) is type(self) else NotImplemented

    def __reduce__(self) -> Any:
        return type(self), tuple(getattr(self, f.name) for f in fields(self))  # type: ignore[arg-type]


class ReadOnlyValue(Value):
    """A value whose arrays are read-only copies of the given ones."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            if isinstance(given := getattr(self, f.name), np.ndarray):
                object.__setattr__(self, f.name, frozen(given))


def equal(one: Any, other: Any, known_equal: set[tuple[int, int]] | None = None) -> bool:
    """Return whether `one` and `other` have equal contents; NaN is equal to NaN.

    known_equal: pairs of ids that were found equal before. Frames of a target share their curve, which would
    otherwise be compared once for every frame.
    """
    known_equal = set() if known_equal is None else known_equal
    pair = id(one), id(other)
    if one is other or pair in known_equal:
        return True
    if _equal(one, other, known_equal):
        known_equal.add(pair)
        return True
    return False


def _equal(one: Any, other: Any, known: set[tuple[int, int]]) -> bool:
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(equal(one[key], other[key], known) for key in one)
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        # numpy tests for NaN in numbers only; it raises TypeError for arrays of texts.
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
    # NaN alone differs from itself.
    return bool(one == other or (one != one and other != other))


def _refuse(self: Any, *_: Any, **__: Any) -> Any:
    raise TypeError(f"this {type(self).__bases__[0].__name__} is read-only: make a changed copy of it")


class ReadOnlyDict(dict[str, Any]):
    """A dict that refuses to be changed; `|` makes a changed copy, an ordinary one."""

    __setitem__: Any = _refuse
    __delitem__: Any = _refuse
    __ior__: Any = _refuse
    clear: Any = _refuse
    pop: Any = _refuse
    popitem: Any = _refuse
    setdefault: Any = _refuse
    update: Any = _refuse

    def __reduce__(self) -> Any:
        # By default pickle would fill the new dict item by item, which __setitem__ refuses.
        return ReadOnlyDict, (dict(self),)


class ReadOnlyList(list[Any]):
    """A list that refuses to be changed."""

    __setitem__: Any = _refuse
    __delitem__: Any = _refuse
    __iadd__: Any = _refuse
    __imul__: Any = _refuse
    append: Any = _refuse
    clear: Any = _refuse
    extend: Any = _refuse
    insert: Any = _refuse
    pop: Any = _refuse
    remove: Any = _refuse
    reverse: Any = _refuse
    sort: Any = _refuse

    def __reduce__(self) -> Any:
        return ReadOnlyList, (list(self),)


def read_only(value: Any) -> Any:
    """Return a copy of `value`, nested dicts and lists, that cannot be changed.

    Arrays and tuples become lists, as in strict JSON.
    """
    plain = strict_json(value)
    if isinstance(plain, dict):
        return ReadOnlyDict({key: read_only(item) for key, item in plain.items()})
    return ReadOnlyList(map(read_only, plain)) if isinstance(plain, list) else plain
