"""What the tables of malformed inputs share: cases, how they are judged, and the good inputs that they spoil."""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from common import ROOT

from ctr_nlp import Plan, Problem, curve_from_points, growing, table_i_robot
from ctr_nlp.exceptions import CtrError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.plan.plan import plan_from_configurations

EXAMPLES = ROOT / "examples"
ROBOT = (EXAMPLES / "robot.toml").read_text(encoding="utf-8")
RIG = (EXAMPLES / "hardware.toml").read_text(encoding="utf-8").replace("# robot =", "robot =")
ENTRY, TARGET = (8, 8, 2), (8, 8, 57)
"""In the mask, mm."""


class Said(CtrError):
    """What a program said on stderr before it ended with exit status 2."""


class Case(NamedTuple):
    """An input, given to `run` with an empty folder, and what is wanted of it.

    error: the class of the one clear error, whose message has the fragment `message` (a regular expression); None
    where the input is rightly accepted, `message` then saying why.
    """

    name: str
    run: Callable[[Path], Any]
    error: type[CtrError] | None
    message: str


def judge(case: Case, folder: Path) -> None:
    """Fail unless what happens is what is wanted; an error is one line and no longer than one reads."""
    if case.error is None:
        case.run(folder)
        return
    with pytest.raises(case.error) as raised:
        case.run(folder)
    text = str(raised.value)
    assert re.search(case.message, text), text
    assert "\n" not in text, text
    assert len(text) < 700, text


def program(main: Callable[..., int], *arguments: Any) -> int:
    """The exit status of a program, run here; what it says is raised where that is 2."""
    argv = [str(argument) for argument in arguments]
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            status = main(argv)
        except SystemExit as ended:
            status = int(ended.code or 0)
    assert "Traceback" not in said.getvalue()
    if status == 2:
        raise Said(said.getvalue().strip().splitlines()[-1])
    return status


def written(folder: Path, name: str, content: str | bytes) -> Path:
    """A file of a name with some content."""
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def of_file(
    reader: Callable[..., Any], name: str, content: str | bytes, error: Any, message: str, label: str
) -> Case:
    """A case of a file that a reader is given."""
    return Case(f"{name}: {label}", lambda folder: reader(written(folder, name, content)), error, message)


def rig(folder: Path, text: str) -> Hardware:
    """The hardware of a file beside the example's robot file."""
    written(folder, "robot.toml", ROBOT)
    return Hardware.from_toml(written(folder, "rig.toml", text))


def spoilt(text: str, old: str, new: str) -> str:
    """A good text with one thing changed."""
    assert old in text, old
    return text.replace(old, new, 1)


def changed(good: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A good JSON object with the entry at a path such as markups.0.type changed, or removed (value = ...)."""
    found = copy.deepcopy(good)
    *way, last = (int(key) if key.isdecimal() else key for key in path.split("."))
    at: Any = functools.reduce(lambda there, key: there[key], way, found)
    if value is ...:
        del at[last]
    else:
        at[last] = value
    return found


def helix(count: int = 61) -> np.ndarray:
    """Points (count, 3) mm of a gentle path of about 75 mm that sets out along z."""
    t = np.linspace(0, 1, count)
    return np.column_stack([8 * (1 - np.cos(1.2 * t)), 5 * t**2, 72 * t])


def table(points: np.ndarray | None = None, radius: float = 6.0) -> str:
    """A centreline CSV file."""
    points = helix() if points is None else points
    return "x_mm,y_mm,z_mm,radius_mm\n" + "".join(f"{x:.6f},{y:.6f},{z:.6f},{radius}\n" for x, y, z in points)


def markups() -> dict[str, Any]:
    """A curve of 3D Slicer."""
    points = helix(16)
    return {
        "markups": [
            {
                "type": "Curve",
                "coordinateSystem": "LPS",
                "coordinateUnits": "mm",
                "name": "path",
                "controlPoints": [{"id": str(i), "position": list(map(float, p))} for i, p in enumerate(points)],
                "measurements": [{"name": "Radius", "controlPointValues": [5.0] * 16, "units": "mm"}],
            }
        ]
    }


def legacy_vtk() -> str:
    """A line in a legacy VTK file."""
    points = helix(16)
    lines = "\n".join(" ".join(f"{c:.6f}" for c in p) for p in points)
    return (
        "# vtk DataFile Version 3.0\nSPACE=LPS\nASCII\nDATASET POLYDATA\n"
        f"POINTS 16 float\n{lines}\nLINES 1 17\n16 {' '.join(map(str, range(16)))}\n"
        f"POINT_DATA 16\nSCALARS Radius float 1\nLOOKUP_TABLE default\n{' '.join(['5.0'] * 16)}\n"
    )


NRRD_HEADER = """NRRD0004
type: unsigned char
dimension: 3
space: left-posterior-superior
sizes: 16 16 60
space directions: (1,0,0) (0,1,0) (0,0,1)
kinds: domain domain domain
endian: little
encoding: raw
space origin: (0,0,0)

"""


def voxels() -> np.ndarray:
    """A mask (60, 16, 16), z first: a tube of radius 4 mm along z through (8, 8)."""
    _, y, x = np.mgrid[:60, :16, :16]
    return ((x - 8) ** 2 + (y - 8) ** 2 <= 16).astype(np.uint8)


def mask(header: str = NRRD_HEADER, content: np.ndarray | None = None) -> bytes:
    """A mask as an NRRD file."""
    return header.encode() + (voxels() if content is None else content).tobytes()


@functools.cache
def plan() -> Plan:
    """A plan of four frames of the seed's robot, along the helix, made by hand."""
    robot = table_i_robot()
    path = curve_from_points(helix(), np.full(61, 6.0))
    problem = Problem("helix", robot, growing(path, 4))
    q = np.array(
        [[0, 0, 0, *np.minimum(beta, [20, 45, 75]), 0, 0] for beta in problem.target.lengths], dtype=float
    )
    meta = {"formulation": "joint", "model": "dominant", "solver": "ipopt", "options": {"stability_margin": None}}
    meta |= {"build_s": 0.0, "search_s": 0.0, "iterations": 0, "interrupted": False}
    meta |= {"failures": {}, "fallbacks": {}, "contact_weight": None}
    each = dict.fromkeys(("solve_time", "objective", "kkt"), np.zeros(4))
    return plan_from_configurations(problem, q, meta, success=np.full(4, True), **each)


@functools.cache
def plan_entries() -> dict[str, Any]:
    """The entries of a plan.npz without a digest, as versions wrote it that kept none; meta as a JSON object."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.npz"
        plan().save(path)
        with np.load(path, allow_pickle=False) as data:
            entries: dict[str, Any] = {name: data[name] for name in data.files if name != "digest"}
    return entries | {"meta": json.loads(str(entries["meta"]))}


def plan_file(folder: Path, **changes: Any) -> Path:
    """A plan.npz with some entries changed, or removed (...); meta is a JSON object, or the text itself."""
    entries = {name: value for name, value in (plan_entries() | changes).items() if value is not ...}
    if "meta" in entries and not isinstance(entries["meta"], str):
        entries["meta"] = json.dumps(entries["meta"])
    path = folder / "plan.npz"
    with open(path, "wb") as file:
        np.savez_compressed(file, **{name: np.asarray(value) for name, value in entries.items()})
    return path
