"""The manifest of an output folder: which of its files runs have written, and so which are the user's.

A file is ours while its size and SHA-256 are those in the manifest. A user who changes or replaces it makes it
theirs, and no run touches it any more.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OutputError

MARK = ".ctr_nlp"
"""Name of the manifest in its folder."""
FORMAT = 1
ABOUT = "Files that ctr_nlp wrote here. It leaves alone all others, and those of them that were changed since."

STAGING = re.compile(r"\.ctr_nlp-[0-9a-f]{8}")
"""Names of the hidden folders in which runs write their files before publication."""

PLAN_FIGURES = "shapes", "errors", "by_frame", "configuration", "stability", "clearance", "robustness"
"""Names of the files of a plan's figures, without their suffix."""
STANDARD: Mapping[str, tuple[str, ...]] = {
    "plan": (
        *("plan.npz", "errors.csv", "summary.json", "pareto.csv", "pareto.png"),
        *(f"{name}.png" for name in PLAN_FIGURES),
        *("trade_off.csv", "trade_off.png"),
    ),
    "robust": ("plan.npz", "errors.csv", "summary.json", "robustness.png"),
    "under": (
        *("plan.npz", "errors.csv", "summary.json", "shapes.png", "errors.png", "by_frame.png"),
        *("configuration.png", "stability.png", "clearance.png"),
    ),
    "force": ("forces.json", "forces.csv", "forces.png"),
    "contact": ("contact.json", "contact.csv", "contact.png"),
    "play": ("tracking.csv", "tracking.png"),
    "report": ("report.html", *(f"{name}.{suffix}" for name in PLAN_FIGURES for suffix in ("pdf", "svg"))),
    "slicer": ("load_in_slicer.py", "tubes.pvd", "inscribed_tube.vtp", "wall.vtp", "keep_out.vtp"),
    "import": (
        *("plan.npz", "errors.csv", "summary.json", "shapes.png", "errors.png", "by_frame.png"),
        *("configuration.png", "stability.png", "clearance.png"),
    ),
    "bag": ("metadata.yaml", "{folder}.mcap", "{folder}.db3"),
    "comparison": ("comparison.md", "comparison.csv", "comparison.json", "agreement.json"),
    "clearance": ("clearance.md", "clearance.csv", "clearance.png"),
    "calibration": (
        *("robot.toml", "calibration.json", "residuals.csv", "next.csv"),
        *("residuals.png", "measured.png", "parameters.png", "correlations.png"),
    ),
    "design": ("robot.toml", "design.json", "sheet.svg", "sheet.pdf"),
    "baselines": ("baselines.md", "baselines.csv", "baselines.png", "baselines.pdf"),
    "learn": ("learn.csv", "learn.png"),
    "trade": ("trade.md", "trade.csv", "trade.json"),
    "study": ("study.toml",),
    "by": ("by.png", "worst.html"),
    "survival": ("survival.md", "survival.csv", "survival.png", "survival.pdf"),
    "reached": ("reached.md", "reached.csv", "reached.png", "reached.pdf"),
    "reach": ("reach.csv", "summary.json", "tree.png", "reach.html"),
    "seed": (
        *("seed.md", "table2.csv", "fig9d.csv", "fig9d.png"),
        *(f"fig{number}.{suffix}" for number in (3, 4, 5, 6, 7, 8, 10) for suffix in ("csv", "png")),
    ),
}
"""Files that each kind of run may write; {folder} stands for the name of their folder."""
MADE_FROM: Mapping[str, tuple[str, ...]] = dict.fromkeys(("plan", "robust", "under", "import"), ("report",))
"""Kinds of runs whose files show what a run of another kind wrote: a new run of that kind makes them wrong."""


@dataclass(frozen=True)
class WrittenFile:
    """A file as a run has written it; kind: of the run, a key of STANDARD."""

    kind: str
    size: int
    sha256: str

    def is_at(self, place: Path) -> bool:
        """Tell whether this file, unchanged, lies at `place`."""
        # The size first: it is cheap, and shows most changes without reading the file.
        if place.is_symlink() or not place.is_file() or place.stat().st_size != self.size:
            return False
        return hashlib.sha256(place.read_bytes()).hexdigest() == self.sha256


def describe_file(kind: str, place: Path) -> WrittenFile:
    """Describe the file at `place` as one that a run of this kind has written."""
    content = place.read_bytes()
    return WrittenFile(kind, len(content), hashlib.sha256(content).hexdigest())


@dataclass(frozen=True)
class Publication:
    """Pending changes of a folder: files to move there from a staging folder, superseded files to delete."""

    staging: str
    files: Mapping[str, WrittenFile]
    superseded: tuple[str, ...]


@dataclass(frozen=True)
class Manifest:
    """Files that runs have written, by names relative to the folder, and a publication that is not finished."""

    files: Mapping[str, WrittenFile]
    pending: Publication | None = None

    def with_pending(self, staging: str, kind: str, new: Mapping[str, WrittenFile]) -> Manifest:
        """Return this manifest with new files of a run pending, which supersede those of the same kind and those
        made from them.

        staging: name of the folder that they are moved from. kind: of the run. new: the files by name.
        """
        kinds = (kind, *MADE_FROM.get(kind, ()))
        old = (name for name, one in self.files.items() if one.kind in kinds and name not in new)
        return Manifest(self.files, Publication(staging, new, tuple(old)))

    def without_pending(self, folder: Path) -> Manifest:
        """Return this manifest with nothing pending, and with what is now in `folder` under each pending or
        superseded name.
        """
        if self.pending is None:
            return self
        superseded = self.pending.superseded
        files = {n: one for n, one in self.files.items() if n not in superseded or one.is_at(folder / n)}
        for name, one in self.pending.files.items():
            if one.is_at(folder / name):
                files[name] = one
            elif name in files and not files[name].is_at(folder / name):
                # Neither the old file nor the new one: it is missing, or the user's.
                del files[name]
        return Manifest(files)

    def owns_file(self, folder: Path, name: str) -> bool:
        """Tell whether the file called `name` in `folder` is as a run has written it, with no links on its
        path.
        """
        return (
            name in self.files
            and _find_blocking_parent(folder, name) is None
            and self.files[name].is_at(folder / name)
        )

    def find_conflict(self, folder: Path, name: str) -> Path | None:
        """Return what of the user's is in the way of a file called `name` in `folder`; None where nothing is."""
        place = folder / name
        if (blocked := _find_blocking_parent(folder, name)) is not None:
            return blocked
        return place if os.path.lexists(place) and not self.owns_file(folder, name) else None

    def write(self, place: Path) -> None:
        """Write the manifest to the file `place`, and wait until it is on the disk."""
        pending = {} if self.pending is None else {"pending": asdict(self.pending)}
        files = {name: asdict(one) for name, one in self.files.items()}
        data = {"format": FORMAT, "about": ABOUT, "files": files} | pending
        with open(place, "w", encoding="utf-8") as file:
            file.write(json.dumps(data, indent=1) + "\n")
            file.flush()
            os.fsync(file.fileno())


def _find_blocking_parent(folder: Path, name: str) -> Path | None:
    """Return the link or file in place of a folder between `folder` and the file called `name`; None
    without one.
    """
    # Through a link, a run would write or delete files outside of its folder.
    parents = [folder / parent for parent in Path(name).parents]
    return next((one for one in parents[:-1] if one.is_symlink() or (one.exists() and not one.is_dir())), None)


def standard_file_names(kind: str, folder: Path) -> list[str]:
    """Return the names of the files that a run of this kind may write into `folder`."""
    return [name.replace("{folder}", folder.absolute().name) for name in STANDARD[kind]]


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of a folder, None where it has none; raises OutputError for one that cannot be
    understood.

    Earlier versions marked a folder with a line of text instead: all files with standard names count as theirs.
    """
    try:
        text = (folder / MARK).read_text(encoding="utf-8")
        return _parse_manifest(json.loads(text)) if text.startswith("{") else _manifest_from_mark(folder)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise OutputError(
            f"manifest {folder / MARK} cannot be read ({error}); name another folder with --out"
        ) from error


def _manifest_from_mark(folder: Path) -> Manifest:
    """Return the manifest of a folder marked by an earlier version: files with standard names count as a run's."""
    found: dict[str, WrittenFile] = {}
    for kind in STANDARD:
        for name in standard_file_names(kind, folder):
            if name not in found and (folder / name).is_file():
                found[name] = describe_file(kind, folder / name)
    return Manifest(found)


def _parse_manifest(data: Any) -> Manifest:
    """Return the manifest that JSON data describe; raises ValueError and what bad data raise."""
    if data["format"] != FORMAT:
        raise ValueError(f"its format is {data['format']!r}, and this version reads {FORMAT}")
    files = _files(data["files"])
    pending = data.get("pending")
    if pending is None:
        return Manifest(files)
    if STAGING.fullmatch(pending["staging"]) is None:
        raise ValueError(f"{pending['staging']!r} is not the name of a staging folder")
    superseded = tuple(_inner(name) for name in pending["superseded"])
    return Manifest(files, Publication(pending["staging"], _files(pending["files"]), superseded))


def _files(data: Mapping[str, Any]) -> dict[str, WrittenFile]:
    return {_inner(name): WrittenFile(**entry) for name, entry in data.items()}


def _inner(name: str) -> str:
    """Return a name that stays within its folder; raises ValueError for others."""
    # Anybody may have edited the manifest, and its names are written to and deleted.
    path = Path(name)
    if not path.parts or path.anchor or ".." in path.parts or path.as_posix() != name or "\0" in name:
        raise ValueError(f"{name!r} is not a name of a file within the folder")
    return name
