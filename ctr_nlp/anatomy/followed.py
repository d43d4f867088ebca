"""The way that a robot is to go through the anatomy of a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy.typing as npt

from ctr_nlp.anatomy.branch import Branches
from ctr_nlp.anatomy.choose import chosen, extent
from ctr_nlp.anatomy.files import is_mask, read_branches
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.target.curve import Curve, curve_from_points
from ctr_nlp.target.points import SHORTEST_MM
from ctr_nlp.typing import Array


@dataclass(frozen=True)
class Way:
    """A whole branch in LPS, from where to where along it, in mm, and to_lps (4, 4) from the file's own."""

    branch: Curve
    start: float
    stop: float
    to_lps: Array

    @property
    def path(self) -> Curve:
        """The part that is followed."""
        return self.branch.part(self.start, self.stop)


def way_through(
    path: str | Path,
    branch: str | int | None = None,
    entry: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
    reverse: bool = False,
) -> Way:
    """The way along a branch of a file, by its name or its number from 1, from entry to target.

    entry, target: (3,) mm in the file's own coordinates, by default the ends of the branch. reverse: the file's
    lines run from the tip to the root. A mask has one branch, between the two points. Raises CurveError and
    OptionError.
    """
    if is_mask(path):
        for option, value in (("branch", branch), ("reverse", reverse or None)):
            if value is not None:
                raise OptionError(
                    f"{option} does not go with a mask, as {path} is one: its path leads from entry to target"
                )
        branches = read_branches(path, entry, target)
        entry = target = None
    else:
        branches = read_branches(path, target if reverse else entry)
    if reverse:
        branches = branches.reversed()
    try:
        return _way(branches, None if branch is None else str(branch), entry, target)
    except CurveError as error:
        raise CurveError(f"{path}: {error}") from error


def _way(branches: Branches, name: str | None, entry: npt.ArrayLike | None, target: npt.ArrayLike | None) -> Way:
    found = chosen(branches, name, entry, target)
    curve = curve_from_points(found.points, found.radius)
    start, stop = extent(curve, branches, entry, target)
    if stop - start < SHORTEST_MM:
        raise CurveError(
            f"from entry to target the path is {stop - start:.3g} mm long; it must be at least {SHORTEST_MM:g} mm"
        )
    return Way(curve, start, stop, branches.to_lps)
