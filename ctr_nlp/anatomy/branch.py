"""Branches in files of anatomy: paths from where a robot enters to the tips of a tree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.reading import NO_FACTS, FileFacts
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.points import LEAST_POINTS, LONGEST_MM, SHORTEST_MM, check_coordinates
from ctr_nlp.typing import Array, Flags

CENTRELINE_SPACE_TO_LPS = {"LPS": np.eye(4), "RAS": np.diag([-1.0, -1.0, 1.0, 1.0])}
"""Patient coordinates by the directions in which x, y, z grow (left, posterior, superior or right, anterior,
superior), and the transform (4, 4) that takes each to LPS, the coordinates of DICOM.
"""


@dataclass(frozen=True)
class Branch:
    """One path from an entry to a tip: points (n, 3) mm in LPS, radius (n,) mm of the lumen or None."""

    name: str
    points: Array
    radius: Array | None = None

    @property
    def length(self) -> float:
        """Length of the straight lines from point to point, mm."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def reverse_direction(self) -> Branch:
        """Return this path from its last point to its first."""
        return replace(self, points=self.points[::-1], radius=None if self.radius is None else self.radius[::-1])


@dataclass(frozen=True)
class LumenMask:
    """Voxels of a lumen (l, m, n), and the transform (4, 4) from their indices to mm in LPS."""

    voxels: Flags
    affine: Array


@dataclass(frozen=True)
class Branches:
    """The branches of a file.

    space: coordinate system of the file. to_lps (4, 4): rigid transform from it to LPS, both in mm.
    facts: what its reader found out about the file. mask: the lumen's voxels, where the file is a mask.
    """

    branches: tuple[Branch, ...]
    space: str
    to_lps: Array
    facts: FileFacts = NO_FACTS
    mask: LumenMask | None = None

    @property
    def from_lps(self) -> Array:
        """Transform (4, 4) from LPS to the coordinate system of the file."""
        return np.asarray(np.linalg.inv(self.to_lps), dtype=float)

    def reverse_direction(self) -> Branches:
        """Return these branches, each from its last point to its first."""
        return replace(self, branches=tuple(branch.reverse_direction() for branch in self.branches))


def transform_points(points: npt.ArrayLike, transform: Array) -> Array:
    """Apply an affine transform (4, 4) to points (n, 3) or to one point (3,)."""
    return np.asarray(points, dtype=float) @ transform[:3, :3].T + transform[:3, 3]


@contextmanager
def name_source_in_errors(where: str | Path) -> Iterator[None]:
    """Put `where`, the name of a file, before the message of any CurveError that the block raises."""
    try:
        yield
    except CurveError as error:
        raise CurveError(f"{where}: {error}") from error


def checked_point(name: str, given: npt.ArrayLike) -> Array:
    """Return `given` as a point (3,) in mm; raise CurveError, whose message calls it `name`, where it is none."""
    try:
        point = np.asarray(given, dtype=float)
    except (TypeError, ValueError) as error:
        raise CurveError(f"{name} is {given!r}; it must be three finite numbers in mm") from error
    if point.shape != (3,) or not np.isfinite(point).all():
        raise CurveError(f"{name} is {format_point(point.ravel())}; it must be three finite numbers in mm")
    return point


def format_point(point: Iterable[float]) -> str:
    """Write the coordinates of a point in brackets."""
    return f"({', '.join(f'{number:g}' for number in point)})"


def check_points(points: Array) -> None:
    """Raise CurveError unless points (n, 3) are finite and can be coordinates in millimetres."""
    check_coordinates(points)
    extent = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    if len(points) >= LEAST_POINTS and extent < SHORTEST_MM:
        raise CurveError(
            f"its points span {extent:.3g}; coordinates must be in millimetres, and these look like metres"
        )
    if extent > LONGEST_MM:
        raise CurveError(f"its points span {extent:.3g} mm; at most {LONGEST_MM:g} mm are allowed")


def check_branches(path: str | Path, branches: Branches) -> Branches:
    """Return the branches of the file at `path` once each is fit to be a curve; raise CurveError, which names file
    and branch, where one is not.
    """
    for branch in branches.branches:
        where = f"{path}, {branch.name}" if len(branches.branches) > 1 else str(path)
        with name_source_in_errors(where):
            check_points(branch.points)
            if len(branch.points) < LEAST_POINTS:
                raise CurveError(
                    f"the number of points of a centreline is {len(branch.points)}; "
                    f"it must be at least {LEAST_POINTS}"
                )
            radius = np.ones(0) if branch.radius is None else branch.radius
            bad = np.flatnonzero(~(np.isfinite(radius) & (radius > 0)))
            if bad.size:
                raise CurveError(
                    f"the lumen radius at point {bad[0] + 1} is {radius[bad[0]]:g}; radii must be positive finite "
                    "numbers in mm"
                )
    return branches
