"""Checks of values in files and arguments; errors name field, value and what is allowed."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import CtrError, OptionError, RobotError, suggest_names
from ctr_nlp.support.mistaken_files import suggest_file
from ctr_nlp.typing import Array

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Scalar = TypeVar("Scalar", bound=np.generic)

JSON_INFINITIES = ("inf", "-inf")
"""Texts for infinite numbers in strict JSON, which cannot represent them."""


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file whose lists are each of one kind.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    dict
        Its tables and values. Every list is of tables, of texts, or of numbers, in rows of one length where there
        are lists in it; every number is one that a float can hold.

    Raises
    ------
    RobotError
        The file cannot be read, is no TOML, or holds a list of another kind.
    """
    try:
        data = tomllib.loads(checked_path(RobotError, path).read_text(encoding="utf-8"))
        _check_values(data, "")
    except OSError as error:
        raise RobotError(f"it cannot be read: {error.strerror}{suggest_file(path)}") from error
    except (ValueError, RecursionError) as error:  # ValueError: also numbers of thousands of digits
        raise RobotError(f"it is no TOML: {error}") from error
    return data


def _check_values(table: dict[str, Any], place: str) -> None:
    """Raise RobotError where a list in a table mixes kinds or lengths; place: text with which messages begin."""
    for key, value in table.items():
        items = value if isinstance(value, list) else [value]
        tables = [isinstance(item, dict) for item in items]
        if items and all(tables):
            for number, item in enumerate(items, start=1):
                _check_values(item, f"{place}{key}{f', number {number}' * isinstance(value, list)}: ")
        elif any(tables):
            raise RobotError(f"{place}{key} is {value!r:.80}; it must be tables alone, or none")
        elif isinstance(value, list) and not _of_one_kind(value):
            raise RobotError(
                f"{place}{key} is {value!r:.80}; it must be all texts, all numbers, or lists of as many numbers"
            )
        # TOML's integers may have any size; converting this one to a float would overflow later.
        elif isinstance(value, int) and abs(value) > sys.float_info.max:
            raise RobotError(f"{place}{key} is {value!r:.20}..; it must be less than {sys.float_info.max:.2g}")


def _of_one_kind(items: list[Any]) -> bool:
    """Return whether `items` are of one type, neither number nor list, or numbers or equally long
    rows of numbers.
    """
    kinds = set(map(type, items))
    if len(kinds) == 1 and not kinds & {int, float, list}:
        return True
    try:
        plain_floats(items)
    except (TypeError, ValueError):
        return False
    return True


def build_from_table(cls: type, data: Any, name: str | None = None) -> Any:
    """Build the dataclass `cls` from `data`, a table of a file that messages call `name`, or by the class's name.

    Raises RobotError where `data` is no table, or its keys are unknown or missing.
    """
    allowed = [f.name for f in fields(cls)]
    of = name or cls.__name__.lower()
    check_keys(RobotError, of, data if isinstance(data, dict) else [data], allowed)
    try:
        return cls(**data)
    except TypeError as error:
        raise RobotError(f"{of}: {error}; keys are {', '.join(allowed)}") from error


MAX_SHOWN_KEY_LENGTH = 80
"""Characters of an unknown key that a message shows."""


def check_keys(error: type[CtrError], of: str, given: Iterable[Any], allowed: Sequence[str]) -> None:
    """Raise `error` where a key of a table is not allowed; the message offers what was probably meant.

    of: name of the table. given: its keys. allowed: the keys that it may have.
    """
    unknown = sorted(set(map(str, given)) - set(allowed))
    if unknown:
        near = suggest_names(unknown[0], allowed)
        # A damaged file may have a key of thousands of characters.
        key = unknown[0]
        shown = repr(key) if len(key) <= MAX_SHOWN_KEY_LENGTH else f"{key[:MAX_SHOWN_KEY_LENGTH]!r}.."
        raise error(f"key {shown} is unknown in {of}; allowed are {', '.join(allowed)}{near}")


def number(
    error: type[CtrError], name: str, value: Any, is_valid: Callable[[float], bool], allowed: str, unit: str = ""
) -> float:
    """Return `value` as a float where it is a number for which `is_valid` is true; raise `error` otherwise.

    name: what the message calls it. allowed: what it must do, such as "be a finite number". unit: of the number,
    with a space before it.
    """
    # bool is a subclass of int; a truth value is not accepted as a number.
    real = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not real or not is_valid(float(value)):
        raise error(f"{name} is {value if real else repr(value)}{unit}; it must {allowed}")
    return float(value)


def whole_number(error: type[CtrError], name: str, value: Any, least: int = 1) -> int:
    """Return `value` where it is a whole number of at least `least`; raise `error`, which calls it `name`,
    otherwise.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise error(f"{name} is {value!r}; it must be a whole number of at least {least}")
    return int(value)


def text(error: type[CtrError], name: str, value: Any) -> str:
    """Return `value` where it is a text that is not empty and may name a file.

    name: what the message calls it. Raises `error` otherwise.
    """
    # A null character would end the path in calls of the operating system.
    if not isinstance(value, str) or not value or "\0" in value:
        raise error(f"{name} is {value!r:.80}; it must be a text that is not empty, without null characters")
    return value


def texts(error: type[CtrError], name: str, value: Any) -> list[str]:
    """Return `value` as a list where it consists of texts that are not empty and may name files.

    name: what the message calls it. Raises `error` otherwise.
    """
    if not isinstance(value, list | tuple):
        near = f"; did you mean [{value!r:.60}]?" if isinstance(value, str) else ""
        raise error(f"{name} is {value!r:.80}; it must be a list of texts{near}")
    return [text(error, f"number {number} of {name}", item) for number, item in enumerate(value, start=1)]


def check_instance(error: type[CtrError], name: str, value: Any, *kinds: type) -> None:
    """Raise `error`, which calls `value` by `name`, unless it is an instance of one of `kinds`."""
    if not isinstance(value, kinds):
        raise error(f"{name} is {value!r:.80}; it must be a {' or a '.join(kind.__name__ for kind in kinds)}")


def checked_path(error: type[CtrError], path: Any) -> Path:
    """Return a path; raise `error` where it is none."""
    if not isinstance(path, str | Path) or "\0" in str(path):
        raise error(f"path is {path!r:.80}; it must be the path of a file")
    return Path(path)


def floats(error: type[CtrError], name: str, value: Any, shape: tuple[int | None, ...]) -> Array:
    """Return finite numbers of a shape as a read-only array.

    name: what messages call them. value: numbers, nested lists or an array. shape: None stands for any length.
    Raises `error` where the numbers are not finite or have another shape.
    """
    try:
        array = plain_floats(value)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{name} is {value!r:.80}; it must be numbers") from None
    if len(array.shape) != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("n" if n is None else str(n) for n in shape) + "," * (len(shape) == 1)
        raise error(f"{name} has shape {array.shape}; it must be ({wanted})")
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0]
        raise error(f"{name} has {array[tuple(place)]} at {[int(i) + 1 for i in place]}; all of it must be finite")
    return frozen(array)


def plain_floats(value: Any) -> Array:
    """Convert a number, or nested lists of numbers, to an array of floats.

    Raises TypeError or ValueError for anything else. Truth values in `value` are refused, but text that reads as a
    number is accepted: strict_json writes infinity as "inf".
    """
    if isinstance(value, list | tuple):
        return np.array([plain_floats(item) for item in value])
    array = np.asarray(float(value) if isinstance(value, str) else value)
    if array.dtype.kind not in "iuf":
        raise TypeError(f"{value!r:.60} is no number")
    return array.astype(float)


def numbers(name: str, value: Any, size: int, infinite: bool = False) -> Array:
    """Return one number, repeated, or `size` numbers as an array (size,).

    name: what messages call them. value: a number or a sequence. infinite: whether infinite numbers are allowed.
    Raises RobotError otherwise.
    """
    try:
        array = np.broadcast_to(plain_floats(value), (size,))
    except (TypeError, ValueError) as error:
        raise RobotError(
            f"{name} is {value!r}; it must be a number" + (f" or {size} of them" * (size > 1))
        ) from error
    if np.isnan(array).any() or (not infinite and np.isinf(array).any()):
        raise RobotError(f"{name} is {value!r}; it must be a {'' if infinite else 'finite '}number")
    return array


def pairs(name: str, value: Any, size: int) -> Array:
    """Return one pair (lower, upper), repeated, or `size` pairs as an array (size, 2).

    name: what messages call them. value: a pair or a sequence of pairs. Raises RobotError otherwise.
    """
    try:
        array = plain_floats(value)
        if array.shape in ((2,), (size, 2)):
            return np.broadcast_to(array, (size, 2))
    except (TypeError, ValueError):
        pass
    raise RobotError(f"limits of {name} are {value!r}; give (lower, upper), or {size} of them")


def strict_json(value: Any) -> Any:
    """Convert `value`, nested dicts, lists, arrays and numbers, for strict JSON.

    Infinity becomes "inf", which `pairs` and `numbers` can read.
    """
    if isinstance(value, dict):
        return {key: strict_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return strict_json(value.tolist())
    if isinstance(value, list | tuple):
        return [strict_json(item) for item in value]
    return str(float(value)) if isinstance(value, float) and math.isinf(value) else value


def frozen(array: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
    """Return a read-only copy of an array."""
    copy = np.array(array)
    copy.flags.writeable = False
    return copy


def to_nested_tuples(value: Any) -> Any:
    """Convert `value` and all lists and arrays in it to tuples, and "inf" of strict JSON to the number."""
    if isinstance(value, np.ndarray | np.generic):
        return to_nested_tuples(value.tolist())
    if isinstance(value, str) and value in JSON_INFINITIES:
        return float(value)
    return tuple(to_nested_tuples(item) for item in value) if isinstance(value, list | tuple) else value


def check_choice(name: str, value: str, allowed: Collection[str]) -> None:
    """Raise OptionError, with the valid values, unless `value` is in `allowed`; messages call it `name`."""
    if not isinstance(value, str) or value not in allowed:
        raise OptionError(
            f"{name} is {value!r}; it must be one of {', '.join(allowed)}{suggest_names(value, allowed)}"
        )
