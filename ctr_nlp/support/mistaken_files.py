"""Files that were given for another one: what kind of file is there, and which existing one has nearly that name.

Kinds are recognised by what only they contain, so that a message can say that two files were swapped.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

from ctr_nlp.exceptions import find_near_names

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PLAN, ROBOT_FILE, HARDWARE_FILE, STUDY_FILE = "plan", "robot file", "hardware file", "study file"
"""Kinds of files that messages name."""
TOML_KINDS = {"tubes": ROBOT_FILE, "axes": HARDWARE_FILE, "ways": STUDY_FILE}
"""Lists of tables, each of which one kind of TOML file alone has."""
ARCHIVE_START = b"PK\x03\x04"
"""The first bytes of an archive of arrays (.npz)."""
PLAN_NAME = "plan.npz"
"""File of a plan in the folder of its results."""


def name_other_kind(path: str | Path, wanted: str) -> str:
    """Say what a file is that was given for one of another kind.

    Parameters
    ----------
    path : str or Path
        The file.
    wanted : str
        The kind of file that was asked for, such as :data:`ROBOT_FILE`.

    Returns
    -------
    str
        The end of a message; empty where the file cannot be read, is of no known kind, or of the one that was
        asked for.
    """
    found = _find_kind(path)
    if found in ("", wanted):
        return ""
    return f"it is a {found}, not a {wanted}; were two files swapped?"


def _find_kind(path: str | Path) -> str:
    """Return the kind of a file, empty where it is not known."""
    try:
        data = Path(path).read_bytes()
        if data.startswith(ARCHIVE_START):
            return PLAN
        tables = tomllib.loads(data.decode("utf-8"))
    except (OSError, TypeError, ValueError, RecursionError):  # also where the path is none
        return ""
    return next((kind for key, kind in TOML_KINDS.items() if isinstance(tables.get(key), list)), "")


def suggest_file(path: str | Path) -> str:
    """Name the existing file whose path is nearly one that leads to no file.

    Parameters
    ----------
    path : str or Path
        A path that does not exist, or a folder.

    Returns
    -------
    str
        The end of a message, such as ``". Did you mean 'runs/first/plan.npz'?"``; empty where there is none.
    """
    found = Path()
    with suppress(OSError):
        if Path(path).is_dir():
            found = Path(path) / PLAN_NAME
        else:
            for name in Path(path).parts:
                if not (found / name).exists():
                    near = find_near_names(name, (entry.name for entry in found.iterdir()))
                    if not near:
                        return ""
                    name = near[0]
                found /= name
        if found.is_file() and found != Path(path):
            return f". Did you mean {str(found)!r}?"
    return ""
