"""Data of a plan, in memory and in its file: arrays over its frames, and meta, which records how it was made."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OutputError
from ctr_nlp.models import KINEMATIC_MODELS, Model, model_with_load
from ctr_nlp.models.loads import Load, LoadOverTime, load_from_dict
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.points import FARTHEST_MM, LONGEST_S
from ctr_nlp.paths.wall_surfaces import DrawnWall, walls_to_draw
from ctr_nlp.paths.walls import Body, WallGeometry, is_lumen_wall, nearest_of
from ctr_nlp.plan.robustness import SAMPLE_ARRAY_PREFIX, Robustness
from ctr_nlp.robot import Robot
from ctr_nlp.support.packing import Packed, unpack_value
from ctr_nlp.support.value_checks import frozen
from ctr_nlp.support.value_objects import Value, read_only
from ctr_nlp.typing import Array, Flags


@dataclass(frozen=True, eq=False, repr=False)
class PlanData(Value):
    """Data of a plan: T frames of motion for a robot of d tubes; the arrays of plan.npz under their names.

    time (T,) s; alpha (T, d) rad; beta (T, d) mm; theta (T, 2) rad; target, shape (T, 101, 3) mm at uniform sigma;
    target_direction, tip_direction (T, 3) unit tangents at the tip; solve_time (T,) s; success (T,); objective
    (T,) mm^2; kkt (T,); stability, stability_between (T,), NaN on the dominant model; to_robot (4, 4), file to
    robot frame; where known, truth (T, 2d + 2), the configurations that the target was made with; lumen_radius (T,
    101) mm at the target's points; lumen (N, 4), path and radius of the whole lumen, mm; clearance (T, 101) mm
    between tubes and wall in each frame; clearance_between (T, 101) mm, the least in the sub-steps to each frame;
    wall_clearance, wall_clearance_between (T, W, 101) mm, those of each wall where there are several; free (T, 2d
    + 2), the motion that was found without the wall; where the robot leans on a wall that gives, wall_force,
    wall_force_along (T, K), the wall's force on each piece of the robot, N, and the middle of the piece, mm;
    wall_force_direction (T, K, 3); place_force, place_force_between (T,), the largest force at one place in each
    frame and in the sub-steps to it, N; stability_without_wall (T,), the margin if the wall gave way; drawn, the
    results on samples of the robot; walls, the bodies that the robot stays inside of or keeps away from. Frames
    that were never reached are NaN. Arrays and meta are read-only copies.
    """

    time: Array
    alpha: Array
    beta: Array
    theta: Array
    target: Array
    shape: Array
    target_direction: Array
    tip_direction: Array
    solve_time: Array
    success: Flags
    objective: Array
    kkt: Array
    stability: Array
    stability_between: Array
    to_robot: Array
    meta: dict[str, Any]
    lumen_radius: Array | None = None
    truth: Array | None = None
    lumen: Array | None = None
    clearance: Array | None = None
    clearance_between: Array | None = None
    wall_clearance: Array | None = None
    wall_clearance_between: Array | None = None
    free: Array | None = None
    wall_force: Array | None = None
    wall_force_along: Array | None = None
    wall_force_direction: Array | None = None
    place_force: Array | None = None
    place_force_between: Array | None = None
    stability_without_wall: Array | None = None
    drawn: Robustness | None = None
    walls: tuple[Body, ...] = ()

    def __post_init__(self) -> None:
        for f in fields(self):
            given = getattr(self, f.name)
            if isinstance(given, np.ndarray):
                object.__setattr__(self, f.name, frozen(given))
        object.__setattr__(self, "meta", read_only(self.meta))

    @cached_property
    def robot(self) -> Robot:
        """The robot that the plan is for."""
        return Robot.from_dict(self.meta["robot"])

    @cached_property
    def q(self) -> Array:
        """Configurations (T, 2d + 2), eq. (5)."""
        return frozen(np.concatenate([self.alpha, self.beta, self.theta], axis=1))

    @cached_property
    def wall(self) -> WallGeometry | None:
        """The wall that counts at every point: that of the lumen, or the nearest of several; None for none."""
        return nearest_of(None if self.lumen is None else Lumen(self.lumen), self.walls)

    @cached_property
    def lumen_wall(self) -> Array | None:
        """Lumen (N, 4) where the tube around the path is a wall; None where a body is what the robot is in."""
        return self.lumen if is_lumen_wall(self.walls) else None

    @cached_property
    def drawn_walls(self) -> list[DrawnWall]:
        """Surfaces of the walls other than the lumen around target and robot, for pictures."""
        points = np.concatenate([self.target.reshape(-1, 3), self.shape.reshape(-1, 3)])
        return walls_to_draw(self.walls, points[np.isfinite(points).all(axis=1)])

    @property
    def dt(self) -> float:
        """Time from frame to frame, s: frame j, from 1, is at time j dt."""
        return float(self.time[0])

    @property
    def evaluated_model_name(self) -> str:
        """Name of the model on which shapes and margins were computed."""
        return str(self.meta.get("evaluated", self.meta["model"]))

    @cached_property
    def evaluated_load(self) -> Load | LoadOverTime | None:
        """Load under which shapes and margins were computed; None without one."""
        return load_of(self.meta, "load" if "load" in self.meta else "planned_load")

    @cached_property
    def evaluated_model(self) -> Model:
        """Model on which shapes and margins were computed, under the load."""
        return _model_under_load(self.evaluated_model_name, self.evaluated_load)

    @property
    def as_planned(self) -> bool:
        """Whether shapes and margins are those of the model and the load that the motion was planned for."""
        return self.evaluated_model_name == self.meta["model"] and self.evaluated_load == load_of(
            self.meta, "planned_load"
        )

    @property
    def can_snap(self) -> bool:
        """Whether a robot can snap on the model on which shapes and margins were computed."""
        return self.evaluated_model.can_snap

    @cached_property
    def reached_frames(self) -> Flags:
        """Frames (T,) that have a shape, solved or not."""
        return frozen(np.asarray(np.isfinite(self.shape).all(axis=(1, 2))))

    @property
    def leans_on_wall(self) -> bool:
        """Whether shapes, margins and clearances are those of a robot on which the wall's forces act."""
        return self.wall_force is not None

    @property
    def complete(self) -> bool:
        """Whether every frame was solved."""
        return bool(self.success.all())

    @property
    def options(self) -> dict[str, Any]:
        """Options that the plan was made with, by name; empty where they are not known."""
        return dict(self.meta.get("options", {}))


def load_of(meta: Mapping[str, Any], name: str) -> Load | LoadOverTime | None:
    """Return the load under the entry `name` of a plan's meta; None without one."""
    return None if meta.get(name) is None else load_from_dict(meta[name])


def planned_model(meta: Mapping[str, Any]) -> Model:
    """Return the model that a plan was made on, with the load that it was made for; meta: of the plan."""
    return _model_under_load(meta["model"], load_of(meta, "planned_load"))


def _model_under_load(name: str, load: Load | LoadOverTime | None) -> Model:
    """Return the model called `name`, under `load` if there is one."""
    return KINEMATIC_MODELS[name] if load is None else model_with_load(name, load)


FORMAT = 1
PLAN_ARRAY_SHAPES: dict[str, tuple[int | str, ...]] = {
    **dict.fromkeys(
        ("time", "solve_time", "success", "objective", "kkt", "stability", "stability_between"), ("T",)
    ),
    **dict.fromkeys(("alpha", "beta"), ("T", "d")),
    "theta": ("T", 2),
    **dict.fromkeys(("target", "shape"), ("T", 101, 3)),
    **dict.fromkeys(("target_direction", "tip_direction"), ("T", 3)),
    **dict.fromkeys(("lumen_radius", "clearance", "clearance_between"), ("T", 101)),
    **dict.fromkeys(("wall_clearance", "wall_clearance_between"), ("T", "W", 101)),
    **dict.fromkeys(("truth", "free"), ("T", "q")),
    **dict.fromkeys(("wall_force", "wall_force_along"), ("T", "K")),
    "wall_force_direction": ("T", "K", 3),
    **dict.fromkeys(("place_force", "place_force_between", "stability_without_wall"), ("T",)),
    "to_robot": (4, 4),
    "lumen": ("N", 4),
    "draws_parts": ("D", "d", 5),
    "draws_lags": ("D", "d"),
    "draws_e2": ("D", "T"),
    **{
        SAMPLE_ARRAY_PREFIX + name: ("D",)
        for name in ("largest", "lost", "snapped", "margin", "clearance", "contact")
    },
    "draws_cloud": ("C", "D", 26, 3),
    "draws_cloud_frames": ("C",),
    **{SAMPLE_ARRAY_PREFIX + name: ("d", 6) for name in ("growth", "lost_alone")},
    "draws_length": ("T",),
}
"""Sizes of the arrays: T frames, d tubes, q = 2d + 2 joints, N points of a lumen, W walls, K pieces of the
robot, D samples, C cloud frames."""
SAMPLE_ARRAY_NAMES = tuple(name for name in PLAN_ARRAY_SHAPES if name.startswith(SAMPLE_ARRAY_PREFIX))
WALL_FORCE_ARRAYS = (
    "wall_force",
    "wall_force_along",
    "wall_force_direction",
    "place_force",
    "place_force_between",
    "stability_without_wall",
)
"""Arrays of plans whose robot leans on a wall: all of them or none."""
OPTIONAL_PLAN_ARRAYS = (
    *WALL_FORCE_ARRAYS,
    "lumen_radius",
    "clearance",
    "clearance_between",
    "wall_clearance",
    "wall_clearance_between",
    "truth",
    "free",
    "lumen",
    *SAMPLE_ARRAY_NAMES,
)
SAMPLE_SIZE_ARRAYS = {"D": "parts", "C": "cloud_frames"}
"""Sizes of the arrays on samples, and the arrays that define them."""
REQUIRED_PLAN_ARRAYS = tuple(name for name in PLAN_ARRAY_SHAPES if name not in OPTIONAL_PLAN_ARRAYS)
REQUIRED_META_TYPES: dict[str, type] = {"robot": dict, "problem": dict, "model": str}
"""Entries that meta must have, and their types."""
OPTIONAL_META_TYPES: dict[str, type] = {
    **dict.fromkeys(("options", "draws", "failures", "fallbacks", "certificate", "wall_contact"), dict),
    **dict.fromkeys(("formulation", "solver", "not_shared"), str),
    **dict.fromkeys(("snaps", "interpolated"), list),
    **dict.fromkeys(("interrupted", "reversed"), bool),
}
"""Entries that meta may have, and their types."""
EVERY_FRAME_PLAN_ARRAYS = "target", "target_direction", "to_robot", "lumen", "lumen_radius", "truth"
"""Arrays that are finite in every frame."""
REACHED_FRAME_PLAN_ARRAYS = "alpha", "beta", "theta", "tip_direction"
"""Arrays that are finite in every frame in which the robot has a shape."""
NUMERIC_META_ENTRIES = "build_s", "search_s", "solve_s", "contact_weight", "iterations"
"""Entries of meta that are a number or null."""
WALL_ARRAY_PREFIX = "walls_"
"""Begin of the names of the arrays of walls in plan.npz; meta has the table that refers to them."""
DIGEST = "digest"
"""Name of the entry of plan.npz with the digest of all others."""


class PlanFileContent(NamedTuple):
    """Content of a plan.npz.

    Attributes
    ----------
    arrays : dict of str to array
        Those that belong to a plan.
    meta : Any
        From its JSON.
    changed : bool
        Whether the content differs from what the file's digest was computed of; False in files of versions
        without a digest.
    """

    arrays: dict[str, npt.NDArray[Any]]
    meta: Any
    changed: bool


def digest(arrays: Mapping[str, npt.NDArray[Any]], meta: str) -> str:
    """Return the SHA-256 of the content of a plan's file.

    Parameters
    ----------
    arrays : mapping of str to array
        By the names that they have in the file; their types and sizes count, and their order does not.
    meta : str
        JSON, as it stands in the file.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    found = hashlib.sha256(meta.encode(errors="backslashreplace"))
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"\n{name} {array.dtype.str} {arrays[name].shape}\n".encode())
        found.update(array.data)
    return found.hexdigest()


def read_plan_file(path: Path) -> PlanFileContent:
    """Read the arrays and the meta of a plan from the file plan.npz at `path`.

    Raises OSError where it cannot be opened, and OutputError where it is no plan.
    """
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):  # numpy would offer to read it unsafely
            raise OutputError("it is no archive of arrays (.npz); it is damaged, or another file")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as data:
                if "meta" not in data.files:
                    raise OutputError("it has no meta")
                known = [
                    name for name in data.files if name in PLAN_ARRAY_SHAPES or name.startswith(WALL_ARRAY_PREFIX)
                ]
                arrays = {name: data[name] for name in known}
                meta = str(data["meta"])
                changed = DIGEST in data.files and str(data[DIGEST]) != digest(arrays, meta)
                return PlanFileContent(arrays, json.loads(meta, parse_constant=_reject_non_finite), changed)
        except OutputError:
            raise
        except Exception as error:  # whatever the readers of zip archives, arrays and JSON meet in a damaged file
            raise OutputError(f"it is damaged, or another file: {error}") from error


def pack_walls(walls: tuple[Body, ...]) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Return the entries of meta and the arrays of a plan's file that hold walls; both are empty without any."""
    if not walls:
        return {}, {}
    packed = Packed()
    listed = packed.add(walls)
    arrays = {WALL_ARRAY_PREFIX + name: array for name, array in packed.arrays.items()}
    return {"walls": {"bodies": listed, "table": packed.table}}, arrays


def take_walls(meta: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> tuple[Body, ...]:
    """Take the walls out of the meta and the arrays of a plan's file; raise OutputError where they are damaged."""
    names = [name for name in arrays if name.startswith(WALL_ARRAY_PREFIX)]
    own = {name.removeprefix(WALL_ARRAY_PREFIX): arrays.pop(name) for name in names}
    entry = meta.pop("walls", None)
    if entry is None:
        return ()
    try:
        walls = unpack_value(entry["bodies"], entry["table"], own)
    except Exception as error:  # whatever a damaged table leads to
        raise OutputError(f"its walls are damaged: {error}") from error
    if not (isinstance(walls, tuple) and all(isinstance(body, Body) for body in walls)):
        raise OutputError(f"its walls are {walls!r:.60}; they must be bodies")
    return walls


def count_walls(lumen_known: bool, walls: tuple[Body, ...]) -> int:
    """Return the number of walls that count.

    lumen_known: whether there is a path with radii. walls: the bodies.
    """
    return len(walls) + (lumen_known and is_lumen_wall(walls))


def _reject_non_finite(constant: str) -> Any:
    """Raise OutputError: JSON has no NaN and no infinity, and plans are saved without them."""
    raise OutputError(f"meta holds {constant}; its numbers must be finite")


def check_meta(meta: Any) -> None:
    """Raise OutputError unless meta has the entries and types of a plan's meta."""
    if not isinstance(meta, dict):
        raise OutputError(f"meta is {meta!r:.60}; it must be a JSON object")
    if meta.get("format") != FORMAT:
        raise OutputError(f"it has format {meta.get('format')!r}; this version reads {FORMAT}")
    for key, kind in (
        REQUIRED_META_TYPES | {key: kind for key, kind in OPTIONAL_META_TYPES.items() if key in meta}
    ).items():
        if not isinstance(meta.get(key), kind):
            raise OutputError(f"{key} of meta is {meta.get(key)!r:.60}; it must be a {kind.__name__}")
    if not isinstance(meta["problem"].get("name"), str):
        raise OutputError(f"name of meta's problem is {meta['problem'].get('name')!r:.60}; it must be a str")
    for key in ("model", "evaluated"):
        if str(meta.get(key, "dominant")) not in KINEMATIC_MODELS:
            raise OutputError(
                f"{key} of meta is {meta[key]!r:.60}; it must be one of {', '.join(KINEMATIC_MODELS)}"
            )
    for key in ("load", "planned_load"):
        load_of(meta, key)
    _check_meta_entries(meta)


def _check_meta_entries(meta: Mapping[str, Any]) -> None:
    """Raise OutputError where an entry of meta on frames or numbers has another form than in plans."""
    for key in NUMERIC_META_ENTRIES:
        if isinstance(meta.get(key), bool) or not isinstance(meta.get(key), int | float | None):
            raise OutputError(f"{key} of meta is {meta[key]!r:.60}; it must be a number or null")
    for key in ("failures", "fallbacks"):
        for frame, why in meta.get(key, {}).items():
            if not (frame == "all" or (frame.isascii() and frame.isdigit())) or not isinstance(why, str):
                raise OutputError(f"{key} of meta tell {frame!r:.40}: {why!r:.40}; it must be a frame and a text")
    for snap in meta.get("snaps", []):
        if not (
            isinstance(snap, dict)
            and isinstance(snap.get("frame"), int)
            and isinstance(snap.get("tubes"), list)
            and isinstance(snap.get("jump"), int | float | None)
        ):
            raise OutputError(f"snaps of meta hold {snap!r:.60}; each must have frame, tubes and jump")
    for frame in meta.get("interpolated", []):
        if not isinstance(frame, int):
            raise OutputError(f"interpolated of meta holds {frame!r:.40}; it must be a list of frames")


def check_arrays(arrays: Mapping[str, npt.NDArray[Any]], tubes: int, walls: int) -> None:
    """Raise OutputError unless arrays, by name, have types and sizes of a plan.

    tubes: number of tubes of its robot. walls: number of its walls, the lumen's included where it is one.
    """
    missing = [name for name in REQUIRED_PLAN_ARRAYS if name not in arrays]
    if missing:
        raise OutputError(f"it has no {missing[0]}")
    frames = arrays["time"].size
    points = len(np.atleast_1d(arrays.get("lumen", np.empty(0))))
    sizes = {"T": frames, "d": tubes, "q": 2 * tubes + 2, "N": points, "W": walls}
    sizes |= {
        size: len(np.atleast_1d(arrays.get(SAMPLE_ARRAY_PREFIX + name, ())))
        for size, name in SAMPLE_SIZE_ARRAYS.items()
    }
    sizes["K"] = np.atleast_2d(arrays.get("wall_force", np.empty((0, 0)))).shape[1]
    for group in (SAMPLE_ARRAY_NAMES, WALL_FORCE_ARRAYS):
        present = [name for name in group if name in arrays]
        if present and len(present) < len(group):
            raise OutputError(f"it has {present[0]} and no {next(name for name in group if name not in present)}")
    for name, array in arrays.items():
        wanted = tuple(
            sizes.get(size, size) if isinstance(size, str) else size for size in PLAN_ARRAY_SHAPES[name]
        )
        if array.shape != wanted:
            raise OutputError(f"{name} has shape {array.shape}, not {wanted}")
        if array.dtype.kind not in ("b" if name == "success" else "iuf"):
            kind = "bool" if name == "success" else "numbers"
            raise OutputError(f"{name} holds {array.dtype}; it must be {kind}")
    if not frames:
        raise OutputError("it has no frames")
    time = arrays["time"]
    if not (np.isfinite(time).all() and (np.diff(time, prepend=0.0) > 0).all() and time[-1] <= LONGEST_S):
        raise OutputError(
            f"time runs from {time[0]} to {time[-1]} s; it must be finite and grow from frame to frame, to "
            f"{LONGEST_S:g} s at most"
        )
    _check_values(arrays)


def _check_values(arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Raise OutputError where a point, a direction or a joint is not finite or out of range."""
    reached = np.isfinite(arrays["shape"]).all(axis=(1, 2))
    for name in (*EVERY_FRAME_PLAN_ARRAYS, *REACHED_FRAME_PLAN_ARRAYS, "shape"):
        array = arrays.get(name)
        if array is None:
            continue
        bad = ~(np.abs(array) <= FARTHEST_MM)  # NaN, too
        if name in REACHED_FRAME_PLAN_ARRAYS:
            bad = bad & reached.reshape(-1, *[1] * (array.ndim - 1))
        elif name == "shape":
            bad = bad & ~np.isnan(array)
        if bad.any():
            at = np.argwhere(bad)[0]
            raise OutputError(
                f"{name} is {array[tuple(at)]} at {[int(i) + 1 for i in at]}; it must be finite and at most "
                f"{FARTHEST_MM:g} in size"
                + (", as the robot has a shape there" if name in REACHED_FRAME_PLAN_ARRAYS else "")
            )
