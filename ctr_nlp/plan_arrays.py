"""What the arrays of a plan and its meta must be like, where they come from a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.errors import OutputError
from ctr_nlp.models import MODELS

SHAPES: dict[str, tuple[int | str, ...]] = {
    **dict.fromkeys(
        ("time", "solve_time", "success", "objective", "kkt", "stability", "stability_between"), ("T",)
    ),
    **dict.fromkeys(("alpha", "beta"), ("T", "d")),
    "theta": ("T", 2),
    **dict.fromkeys(("target", "shape"), ("T", 101, 3)),
    **dict.fromkeys(("target_direction", "tip_direction"), ("T", 3)),
    **dict.fromkeys(("lumen_radius", "clearance"), ("T", 101)),
    **dict.fromkeys(("truth", "free"), ("T", "q")),
    "to_robot": (4, 4),
    "lumen": ("N", 4),
}
"""Sizes of the arrays: T frames, d tubes, q = 2d + 2 joints, N points of a lumen."""
OPTIONAL = "lumen_radius", "clearance", "truth", "free", "lumen"
REQUIRED = tuple(name for name in SHAPES if name not in OPTIONAL)
META: dict[str, type] = {
    **dict.fromkeys(("robot", "problem"), dict),
    **dict.fromkeys(("model", "formulation", "solver"), str),
}
"""What meta must tell, and as what."""


def check_meta(meta: Any) -> None:
    """Raise OutputError unless meta tells what every plan tells."""
    if not isinstance(meta, dict):
        raise OutputError(f"meta is {meta!r:.60}; it must be a JSON object")
    for key, kind in META.items():
        if not isinstance(meta.get(key), kind):
            raise OutputError(f"{key} of meta is {meta.get(key)!r:.60}; it must be a {kind.__name__}")
    if not isinstance(meta.get("options", {}), dict):
        raise OutputError(f"options of meta is {meta['options']!r:.60}; it must be a dict")
    if not isinstance(meta["problem"].get("name"), str):
        raise OutputError(f"name of meta's problem is {meta['problem'].get('name')!r:.60}; it must be a str")
    for key in ("model", "evaluated"):
        if str(meta.get(key, "dominant")) not in MODELS:
            raise OutputError(f"{key} of meta is {meta[key]!r:.60}; it must be one of {', '.join(MODELS)}")


def check_arrays(arrays: Mapping[str, npt.NDArray[Any]], tubes: int) -> None:
    """Raise OutputError unless arrays are numbers of the sizes that a plan for so many tubes has."""
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise OutputError(f"it has no {missing[0]}")
    frames = arrays["time"].size
    sizes = {
        "T": frames,
        "d": tubes,
        "q": 2 * tubes + 2,
        "N": len(np.atleast_1d(arrays.get("lumen", np.empty(0)))),
    }
    for name, array in arrays.items():
        wanted = tuple(sizes.get(size, size) if isinstance(size, str) else size for size in SHAPES[name])
        if array.shape != wanted:
            raise OutputError(f"{name} has shape {array.shape}, not {wanted}")
        if array.dtype.kind not in "biuf":
            raise OutputError(f"{name} holds {array.dtype}; it must be numbers")
    if not frames:
        raise OutputError("it has no frames")
    time = arrays["time"]
    if not (np.isfinite(time).all() and (np.diff(time, prepend=0.0) > 0).all()):
        raise OutputError(
            f"time runs from {time[0]} to {time[-1]} s; it must be finite and grow from frame to frame"
        )
