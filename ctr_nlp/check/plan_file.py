"""The content of a plan.npz, as the checker reads it: arrays, meta, and whether the file's digest fits."""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.check.tubes import Array, Tubes, read_tubes
from ctr_nlp.check.walls import Wall, read_walls

FRAME_ARRAYS = (
    *("time", "alpha", "beta", "theta", "target", "target_direction", "shape"),
    *("success", "kkt", "stability", "stability_between"),
)
"""Arrays of every plan, with a row a frame."""
DIGESTED_ARRAYS = (
    *("solve_time", "objective", "tip_direction", "lumen", "lumen_radius", "clearance", "clearance_between"),
    *("wall_clearance", "wall_clearance_between", "truth", "free", "to_robot", *FRAME_ARRAYS),
)
"""Arrays that the digest covers, besides those of samples and of walls; a file may hold others."""
DIGESTED_PREFIXES = "draws_", "walls_"


class CheckError(ValueError):
    """A file that the checker cannot read as a plan."""


@dataclass(frozen=True, eq=False)
class PlanFile:
    """Content of a plan.npz.

    Attributes
    ----------
    arrays : dict of str to array
        By their names.
    meta : dict
        How the plan was made.
    digest : str or None
        SHA-256 in the file; None in files without one.
    content_digest : str
        SHA-256 of the content that was read.
    """

    arrays: dict[str, Array]
    meta: dict[str, Any]
    digest: str | None
    content_digest: str

    @cached_property
    def q(self) -> Array:
        """Configurations (T, 2d + 2): angles in rad, extensions in mm, tilts in rad."""
        return np.concatenate([self.arrays[name] for name in ("alpha", "beta", "theta")], axis=1)

    @cached_property
    def tubes(self) -> Tubes:
        """The robot as described."""
        return read_tubes(self.meta["robot"])

    @cached_property
    def walls(self) -> list[Wall]:
        """The walls, an empty list without any."""
        return read_walls(self.arrays, self.meta)


def read_plan_file(path: str | Path) -> PlanFile:
    """Read a plan.npz without pickle.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    PlanFile
        Its content.

    Raises
    ------
    CheckError
        The file cannot be read, or is no plan.
    """
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is missing, or no archive of arrays (.npz)")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        text, saved = str(arrays.pop("meta")), arrays.pop("digest", None)
        meta = json.loads(text)
        missing = [*({*FRAME_ARRAYS, "to_robot"} - {*arrays}), *({"robot", "problem", "model"} - {*meta})]
        if missing:
            raise ValueError(f"it is no plan, as it has no {', '.join(sorted(missing))}")
        frames = {len(arrays[name]) for name in FRAME_ARRAYS}
        if len(frames) > 1 or 0 in frames:
            raise ValueError(f"it is damaged, with arrays of {sorted(frames)} frames instead of one number")
    except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise CheckError(f"{path} cannot be read as a plan: {error}") from error
    found = hashlib.sha256(text.encode(errors="backslashreplace"))
    for name, array in sorted(arrays.items()):
        if name in DIGESTED_ARRAYS or name.startswith(DIGESTED_PREFIXES):
            found.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode() + array.tobytes())
    return PlanFile(arrays, meta, None if saved is None else str(saved), found.hexdigest())
