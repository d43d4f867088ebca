"""Faults of plans, and files that have them: what a mistake of a program, a person or a disk may leave there.

Every fault but the last is saved with a digest that fits, as a program would that makes the mistake itself.
Nothing here knows the checker; `findings` names what a check should object to, any of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.plan.plan_data import digest

Arrays = dict[str, np.ndarray]
Change = Callable[[np.random.Generator, Arrays, dict[str, Any]], bool]
"""Changes the arrays and meta of a file; False where the plan has nothing that this fault could change."""


class Fault(NamedTuple):
    """A kind of fault: how it changes a file, and which findings may name it."""

    name: str
    change: Change
    findings: tuple[str, ...]
    fits_digest: bool = True


def read(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """The arrays and meta of a plan's file."""
    with np.load(path) as data:
        arrays = {name: data[name].copy() for name in data.files if name not in ("meta", "digest")}
        return arrays, json.loads(str(data["meta"]))


def write(path: Path, arrays: Arrays, meta: dict[str, Any], old: str | None = None) -> None:
    """Write a plan's file, with a digest that fits, or an old one."""
    text = json.dumps(meta)
    np.savez(path, digest=np.array(old or digest(arrays, text)), meta=np.array(text), **arrays)


def insert(fault: Fault, seed: int, source: Path, target: Path) -> bool:
    """Write a plan's file with a fault; False where the plan cannot have it."""
    arrays, meta = read(source)
    old = None if fault.fits_digest else digest(arrays, json.dumps(meta))
    if not fault.change(np.random.default_rng(seed), arrays, meta):
        return False
    write(target, arrays, meta, old)
    return True


def _tubes(meta: dict[str, Any]) -> list[dict[str, Any]]:
    return list(meta["robot"]["tubes"])


def _frame(random: np.random.Generator, arrays: Arrays, first: int = 1) -> int:
    return int(random.integers(first, len(arrays["time"])))


def too_fast(random, arrays, meta):
    """The robot's largest speed is lower than that of the motion."""
    axis = ("beta", "alpha")[int(random.integers(2))]
    used = abs(np.diff(arrays[axis], axis=0)).max() / arrays["time"][0]
    if used < 1e-3:
        return False
    meta["robot"]["limits"][f"{axis}_speed"] = used * float(random.uniform(0.5, 0.98))
    return True


def beyond_range(random, arrays, meta):
    """A tube is pushed further out than it may be, or the base is tilted too far."""
    frame = _frame(random, arrays)
    if random.random() < 0.5:
        arrays["beta"][frame, -1] = _tubes(meta)[-1]["length"] + random.uniform(0.1, 5)
    else:
        arrays["theta"][frame, 0] = np.pi + random.uniform(0.01, 1)
    return True


def out_of_order(random, arrays, meta):
    """An inner tube ends within the one around it."""
    d = arrays["beta"].shape[1]
    if d < 2:
        return False
    frame, i = _frame(random, arrays), int(random.integers(d - 1))
    arrays["beta"][frame, [i, i + 1]] = arrays["beta"][frame, [i + 1, i]] + [0.1, 0]
    return True


def exchanged_tubes(random, arrays, meta):
    """Two neighbouring tubes are exchanged in the robot's description."""
    tubes = meta["robot"]["tubes"]
    if len(tubes) < 2:
        return False
    i = int(random.integers(len(tubes) - 1))
    tubes[i], tubes[i + 1] = tubes[i + 1], tubes[i]
    return True


def wrong_robot(random, arrays, meta):
    """The file describes a robot whose outermost tube, and all others, are bent more."""
    for tube in meta["robot"]["tubes"]:
        tube["curvature"] = (np.array(tube["curvature"]) * random.uniform(1.1, 1.5) + 5e-4).tolist()
    return True


def wrong_model(random, arrays, meta):
    """The file says that shapes are those of a model that they are not of."""
    if len(_tubes(meta)) < 2:
        return False
    meta["evaluated"] = "dominant" if meta.get("evaluated", meta["model"]) == "elastic" else "elastic"
    return True


def axes_of_patient(random, arrays, meta):
    """LPS coordinates are taken for RAS: the file's axes are turned by half a turn."""
    arrays["to_robot"] = arrays["to_robot"] @ np.diag([-1.0, -1, 1, 1])
    return True


def mirrored_axes(random, arrays, meta):
    """One of the file's axes is mirrored."""
    signs = np.ones(4)
    signs[int(random.integers(3))] = -1
    arrays["to_robot"] = arrays["to_robot"] @ np.diag(signs)
    return True


def edited_shape(random, arrays, meta):
    """The body is moved in one frame."""
    away = random.normal(size=3)
    arrays["shape"][_frame(random, arrays)] += random.uniform(0.1, 2) * away / np.linalg.norm(away)
    return True


def edited_configuration(random, arrays, meta):
    """A tube is pushed further, or the base is tilted, in one frame."""
    frame = _frame(random, arrays)
    if random.random() < 0.5:
        arrays["beta"][frame, -1] += random.uniform(0.2, 1)
    else:
        arrays["theta"][frame, int(random.integers(2))] += random.choice([-1, 1]) * random.uniform(0.005, 0.05)
    return True


def _turn_walls(arrays: Arrays, meta: dict[str, Any], transform: np.ndarray) -> bool:
    """Move the lumen and all bodies by an affine transform (4, 4)."""
    back = np.linalg.inv(transform)
    if "lumen" in arrays:
        arrays["lumen"][:, :3] = arrays["lumen"][:, :3] @ transform[:3, :3].T + transform[:3, 3]
    for row in meta.get("walls", {}).get("table", []):
        if "to_grid" in row.get("fields", {}):
            place = meta["walls"]["table"][row["fields"]["to_grid"]["row"]]["array"]
            arrays["walls_" + place] = arrays["walls_" + place] @ back
    return "lumen" in arrays or "walls" in meta


def mirrored_wall(random, arrays, meta):
    """The wall is mirrored sideways, as where rows of an image are read in the wrong order."""
    spread = np.ptp(arrays["target"][-1][:, :2], axis=0)
    if spread.max() < 3:
        return False
    signs = np.ones(4)
    signs[int(spread.argmax())] = -1
    return _turn_walls(arrays, meta, np.diag(signs))


def stale_wall(random, arrays, meta):
    """The wall is that of an earlier image: it lies elsewhere."""
    shift = np.eye(4)
    side = random.normal(size=2)
    shift[:2, 3] = random.uniform(0.5, 3) * side / np.linalg.norm(side)
    return _turn_walls(arrays, meta, shift)


def edited_clearance(random, arrays, meta):
    """Clearances are larger than they are."""
    if "clearance" not in arrays:
        return False
    shallow = np.flatnonzero(arrays["clearance"].min(axis=1) > -4)
    if not len(shallow):
        return False
    arrays["clearance"][random.choice(shallow)] += random.uniform(0.2, 2)
    return True


def edited_margin(random, arrays, meta):
    """Stability margins are larger than they are."""
    if not np.isfinite(arrays["stability"]).any():
        return False
    name = ("stability", "stability_between")[int(random.integers(2))]
    arrays[name][_frame(random, arrays)] += random.uniform(0.01, 0.3)
    return True


def changed_tolerances(random, arrays, meta):
    """The robot's tolerances are not those that samples were drawn from."""
    if "draws_parts" not in arrays:
        return False
    name = ("curvature", "bending_stiffness", "motor_zero")[int(random.integers(3))]
    meta["robot"]["tolerances"][name] *= float(random.choice([0.5, 2.0]))
    return True


def edited_samples(random, arrays, meta):
    """Results of some of the simulated robots are better than they are, or they are called lost."""
    if "draws_parts" not in arrays:
        return False
    count = len(arrays["draws_parts"])
    some = random.choice(count, max(3, count // 5), replace=False)
    kind = int(random.integers(3))
    if kind == 0:
        arrays["draws_lost"][some] = np.where(arrays["draws_lost"][some] > 0, 0, 1)
    elif kind == 1:
        arrays["draws_cloud"][-1, :, -1] += random.choice([-1, 1]) * random.uniform(0.5, 2)
    else:
        arrays["draws_e2"] *= random.uniform(0.2, 0.7)
        return bool(np.nanmax(arrays["draws_e2"]) > 0.3)
    return True


def stretched_time(random, arrays, meta):
    """The motion takes longer or shorter than planned, or one frame comes late."""
    if random.random() < 0.5:
        arrays["time"] *= random.choice([0.5, 0.9, 1.1, 2.0])
    else:
        arrays["time"][_frame(random, arrays)] += 0.3 * arrays["time"][0]
    return True


def unsolved_frame(random, arrays, meta):
    """A frame is marked as solved whose residual is large, or it is not solved."""
    frame = _frame(random, arrays)
    if random.random() < 0.5:
        arrays["kkt"][frame] = random.uniform(0.1, 10)
    else:
        arrays["success"][frame] = False
    return True


def edited_target(random, arrays, meta):
    """The target is turned by half a turn about the insertion axis, beside the wall and the robot."""
    if np.ptp(arrays["target"][-1][:, :2], axis=0).max() < 3 or "lumen" not in arrays:
        return False
    arrays["target"] = arrays["target"] * np.array([-1.0, -1, 1])
    return True


def damaged_bits(random, arrays, meta):
    """A number of the file changes after it was saved."""
    name = ("alpha", "beta", "objective", "solve_time", "target")[int(random.integers(5))]
    arrays[name].flat[int(random.integers(arrays[name].size))] += 1e-6
    return True


FAULTS = (
    Fault("too fast", too_fast, ("within_limits",)),
    Fault("beyond the range", beyond_range, ("within_limits",)),
    Fault("out of order", out_of_order, ("within_limits",)),
    Fault("exchanged tubes", exchanged_tubes, ("shapes", "within_limits")),
    Fault("wrong robot", wrong_robot, ("shapes",)),
    Fault("wrong model", wrong_model, ("shapes", "margins")),
    Fault("axes of the patient", axes_of_patient, ("frames_of_reference",)),
    Fault("mirrored axes", mirrored_axes, ("frames_of_reference",)),
    Fault("edited shape", edited_shape, ("shapes",)),
    Fault("edited configuration", edited_configuration, ("shapes",)),
    Fault("mirrored wall", mirrored_wall, ("clearances", "frames_of_reference")),
    Fault("stale wall", stale_wall, ("clearances", "frames_of_reference")),
    Fault("edited clearance", edited_clearance, ("clearances",)),
    Fault("edited margin", edited_margin, ("margins",)),
    Fault("changed tolerances", changed_tolerances, ("tolerances",)),
    Fault("edited samples", edited_samples, ("samples",)),
    Fault("stretched time", stretched_time, ("times",)),
    Fault("unsolved frame", unsolved_frame, ("solved",)),
    Fault("edited target", edited_target, ("frames_of_reference",)),
    Fault("damaged bits", damaged_bits, ("digest",), fits_digest=False),
)
