"""Structures of C that Python mirrors field by field, checked when their library is loaded.

ctypes copies bytes and knows nothing of the C source: a field that is missing on one side, or two that are
exchanged, would make C read other numbers, without an error. So every library also holds, for each
`typedef struct {..} NAME;` of its source, its size and the names of its fields.
"""

from __future__ import annotations

import ctypes
import re

_TYPEDEF = re.compile(r"typedef struct \{(.*?)\}\s*(\w+);", re.DOTALL)
"""A structure in C: its body, and its name."""


def describe_structures(source: str) -> str:
    """Return C code that exports `size_of_NAME` and `fields_of_NAME` for every structure that `source` defines."""
    return "".join(
        f"const long size_of_{name} = sizeof({name});\nconst char fields_of_{name}[] = "
        f'"{",".join(_field_names(body))}";\n'
        for body, name in _TYPEDEF.findall(source)
    )


def _field_names(body: str) -> list[str]:
    """Return the names of the fields of a structure from what stands between its braces."""
    names = []
    for declaration in re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL).split(";"):
        # A pointer to a function has its name in the first parentheses, and commas between its arguments.
        pointer = re.search(r"\(\*(\w+)\)", declaration)
        if pointer:
            names.append(pointer[1])
            continue
        plain = re.sub(r"\[[^\]]*\]", "", declaration)
        names += [found[1] for part in plain.split(",") if (found := re.search(r"(\w+)\s*$", part))]
    return names


def check_structure(library: ctypes.CDLL, name: str, mirror: type[ctypes.Structure]) -> None:
    """Raise RuntimeError where `mirror` is not the structure called `name` that `library` was compiled with."""
    names = ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(library, f"fields_of_{name}"))).decode()
    size = ctypes.c_long.in_dll(library, f"size_of_{name}").value
    mirrored = ",".join(field[0] for field in mirror._fields_)
    if (names, size) != (mirrored, ctypes.sizeof(mirror)):
        raise RuntimeError(
            f"struct {name} has the fields {names} and {size} bytes in C, and {mirrored} and "
            f"{ctypes.sizeof(mirror)} bytes "
            f"in {mirror.__module__}.{mirror.__name__}; change the two together"
        )
