"""Trees of lumens whose ends are planned one after another; tree and wall are read once for all of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import (
    Branch,
    Branches,
    checked_point,
    format_point,
    name_source_in_errors,
    transform_points,
)
from ctr_nlp.anatomy.branch_measures import count_bifurcations
from ctr_nlp.anatomy.branch_selection import find_extent
from ctr_nlp.anatomy.distance_fields import crop_surface, field_of_surface, flatten_steps, surface_of_mask
from ctr_nlp.anatomy.files import path_smoothing, read_branches, title
from ctr_nlp.anatomy.lumen_surfaces import open_tree_ends
from ctr_nlp.anatomy.reading import ASSUMED, SPACES, ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.curve import Curve, curve_from_points
from ctr_nlp.paths.placement import move_to_robot_frame, trim_curve
from ctr_nlp.paths.points import SHORTEST_MM
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import growing
from ctr_nlp.paths.walls import Body
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

CARINA_SHARE = 1 / 6
"""Part of all ends to which each of two sides of the main bifurcation leads at least."""
WIDTH_MARGIN_MM = 0.2
"""By how much the inscribed radius exceeds the robot's radius along a path that is wide enough, mm."""
WIDTH_SPACING_MM = 0.5
"""Distance between the places along a path at which its width is looked at, mm."""
TREES_IN_MEMORY = 2
"""Trees that a process keeps: each takes seconds to read."""


class Narrowest(NamedTuple):
    """The place of a path where a robot has the least room.

    margin: inscribed radius of the lumen less the radius of the robot, mm. depth: mm from the entry. radius: of
    the lumen there, mm. point: (3,) mm in the file's coordinates.
    """

    margin: float
    depth: float
    radius: float
    point: Array


@dataclass(frozen=True, eq=False)
class TreeEnd:
    """An end of a tree, and the path to it.

    Attributes
    ----------
    number : int
        Number of its branch, from 1.
    name : str
        Name of its branch.
    generation : int or None
        Number of bifurcations from the root of the tree; None where that is unknown.
    tip : ndarray
        The end (3,), mm in the file's coordinates.
    branch : Curve
        The whole branch, mm in LPS.
    start : float or None
        Arc length of the entry along the branch, mm; None where the branch does not pass the entry.
    """

    number: int
    name: str
    generation: int | None
    tip: Array
    branch: Curve
    start: float | None

    @cached_property
    def path(self) -> Curve:
        """The path from the entry to the end, mm in LPS."""
        assert self.start is not None
        return self.branch.part(self.start, self.branch.length)

    @property
    def depth(self) -> float:
        """Length of the path from the entry to the end, mm; NaN where the branch does not pass the entry."""
        return math.nan if self.start is None else self.branch.length - self.start


@dataclass(frozen=True, eq=False)
class LumenTree:
    """A tree of lumens: the paths from an entry to all its ends, and their wall.

    Attributes
    ----------
    name : str
        Name of the file without its suffix.
    branches : Branches
        The branches of the file.
    ends : tuple of TreeEnd
        One for each branch.
    entry : ndarray
        Where the robot enters (3,), mm in the file's coordinates.
    wall : Body or None
        Surface of the mask, mm in LPS, opened at the ends of the tree; None where the file has radii alone.
    """

    name: str
    branches: Branches
    ends: tuple[TreeEnd, ...]
    entry: Array
    wall: Body | None

    def find_narrowest(self, end: TreeEnd, robot: Robot) -> Narrowest | None:
        """Find where the path to an end leaves a robot the least room.

        The lumen's radius is that along the path, as `ctr-nlp branches` lists it: of the inscribed circle. The
        robot is taken as thin as it can be: at each depth the outermost tube counts that cannot be drawn back from
        there.

        Parameters
        ----------
        end : TreeEnd
            An end that is beyond the entry.
        robot : Robot
            The robot.

        Returns
        -------
        Narrowest or None
            None where the file tells no radii.
        """
        path = end.path
        if path.radius is None:
            return None
        s = np.linspace(0.0, path.length, max(2, math.ceil(path.length / WIDTH_SPACING_MM) + 1))
        points = path.point(s)
        radius = path.radius(s)
        least = robot.split(robot.lower)[1]
        # The innermost tube comes as deep as the path; others only as deep as they must.
        covered = np.append(least[:-1], np.inf)[:, None] > s
        outer = np.array([tube.outer_diameter / 2 for tube in robot.tubes])
        margin = radius - np.where(covered, outer[:, None], 0.0).max(axis=0)
        k = int(np.argmin(margin))
        place = transform_points(points[k], self.branches.from_lps)
        return Narrowest(float(margin[k]), float(s[k]), float(radius[k]), place)

    def problem(
        self,
        number: int,
        robot: Robot,
        frames: int = 100,
        duration: float = 10.0,
        *,
        trim: bool = False,
        smoothing: float | None = None,
    ) -> Problem:
        """Make the problem of advancing from the entry to an end.

        It is the one that :func:`problem_from_file` makes of the file for this branch, but for the wall, which is
        that of the whole tree.

        Parameters
        ----------
        number : int
            Number of the end's branch, from 1.
        robot : Robot
            The robot.
        frames : int
            Number of frames, evenly spaced in time.
        duration : float
            Time for all of them, s.
        trim : bool
            Whether the robot's base is moved inwards where the path is longer than the robot reaches.
        smoothing : float, optional
            How far the followed curve may be from the path, mm; see :meth:`Curve.smooth`. By default 2 mm in a
            mask, and 0 otherwise.

        Returns
        -------
        Problem
            In the robot's frame; its ``to_robot`` takes the file's coordinates there.

        Raises
        ------
        ProblemError
            The path is longer than the robot reaches, and `trim` is False.
        """
        end = self.ends[number - 1]
        followed = end.path.smooth(path_smoothing(smoothing, self.wall is not None))
        if trim:
            followed = trim_curve(followed, robot.reach, "start")
        followed, to_robot = move_to_robot_frame(followed)
        walls: tuple[Body, ...] = ()
        if self.wall is not None:
            assert self.wall.surface is not None
            # Verdicts search the nearest triangles: those around other branches would only slow them down.
            near = crop_surface(self.wall.surface, end.path.point(np.arange(0.0, end.path.length, 1.0)))
            walls = (replace(self.wall, surface=near).apply_transform(to_robot),)
        facts = self.branches.facts
        return Problem(
            f"{self.name} {number}",
            robot,
            growing(followed, frames),
            duration,
            to_robot=to_robot @ self.branches.to_lps,
            lumen=None if end.branch.radius is None else end.branch.apply_transform(to_robot),
            walls=walls,
            space=self.branches.space,
            space_assumed=self.branches.space in SPACES and facts.space_known == ASSUMED,
        )


def read_lumen_tree(
    path: str | Path,
    entry: npt.ArrayLike | None = None,
    *,
    from_carina: bool = False,
    options: ReadOptions | None = None,
    pieces: Sequence[str | Path] = (),
) -> LumenTree:
    r"""Read the tree of a file, and make its wall once for all its ends.

    Parameters
    ----------
    path : str or Path
        A mask of the lumen, or a centreline file with a tree.
    entry : (3,) array_like, optional
        Where the robot enters, mm in the file's coordinates; by default where the tree begins.
    from_carina : bool
        Whether the robot is inserted at the main bifurcation instead; see :func:`find_carina`. `entry` then says
        where the tree begins.
    options : ReadOptions, optional
        What a person states about the file.
    pieces : sequence of str or Path
        Further files with pieces of the same tree.

    Returns
    -------
    LumenTree
        The same object where the same unchanged file is read again.

    Raises
    ------
    CurveError
        The file cannot be read, no branch passes the entry, or a carina is asked for and there is none.
    OptionError
        A reader is missing.

    Examples
    --------
    >>> import tempfile
    >>> rows = [f"0,0,{z},4" for z in range(0, 101, 5)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "line.csv")
    ...     _ = file.write_text("\n".join(["x_mm,y_mm,z_mm,radius_mm", *rows]))
    ...     tree = read_lumen_tree(file, entry=(0, 0, 20))
    >>> [round(end.depth, 3) for end in tree.ends]
    [80.0]
    """
    at = None if entry is None else tuple(checked_point("entry", entry).tolist())
    files = tuple(str(each) for each in (path, *pieces))
    try:
        states = tuple(Path(file).stat().st_mtime_ns for file in files)
    except OSError as error:
        raise CurveError(f"{error.filename} cannot be read: {error.strerror}") from error
    return _read_tree(files, states, at, from_carina, options or ReadOptions())


@lru_cache(maxsize=TREES_IN_MEMORY)
def _read_tree(
    files: tuple[str, ...],
    states: tuple[int, ...],
    entry: tuple[float, float, float] | None,
    from_carina: bool,
    options: ReadOptions,
) -> LumenTree:
    """Read a tree; states: times of the last change of the files, so that a changed file is read again."""
    branches = read_branches(files[0], entry, options=options, pieces=files[1:])
    with name_source_in_errors(files[0]):
        carina = find_carina(branches.branches) if from_carina else None
        generations = count_bifurcations(branches.branches)
        ends = []
        for number, branch in enumerate(branches.branches, start=1):
            curve = curve_from_points(branch.points, branch.radius)
            start = _find_start(branch, curve, branches, entry, carina)
            tip = transform_points(branch.points[-1], branches.from_lps)
            ends.append(TreeEnd(number, branch.name, generations[number - 1], tip, curve, start))
        beyond = next((end for end in ends if end.start is not None), None)
        if beyond is None:
            assert entry is not None
            raise CurveError(f"no branch passes the entry {format_point(entry)}; it must lie in the lumen")
        wall = None if branches.mask is None else _wall_of_mask(title(files[0]), branches)
    begin = transform_points(beyond.branch.point(np.array([beyond.start]))[0], branches.from_lps)
    return LumenTree(title(files[0]), branches, tuple(ends), begin, wall)


def _find_start(
    branch: Branch,
    curve: Curve,
    branches: Branches,
    entry: tuple[float, float, float] | None,
    carina: Array | None,
) -> float | None:
    """Return the arc length, mm, at which a branch passes the entry or the carina; None where it does not.

    curve: through the branch's points. carina: (3,) mm in LPS, a point of all branches that pass it.
    """
    if carina is not None:
        if not (branch.points == carina).all(axis=1).any():
            return None
        entry = tuple(transform_points(carina, branches.from_lps).tolist())
    elif entry is None or branches.mask is not None:
        return 0.0  # Paths in a mask begin where the robot enters.
    start, stop = find_extent(curve, branches, entry)
    at = transform_points(checked_point("entry", entry), branches.to_lps)
    radius = np.inf if curve.radius is None else float(curve.radius(np.array([start]))[0])
    inside = np.linalg.norm(curve.point(np.array([start]))[0] - at) <= radius
    return start if inside and stop - start >= SHORTEST_MM else None


def find_carina(branches: Sequence[Branch]) -> Array:
    """Find the main bifurcation of a tree, as the carina is in airways.

    It is the first bifurcation from the entry of which two sides each lead to at least a sixth of all ends, so
    that a small branch of the trachea, or a spur of a segmentation, does not count.

    Parameters
    ----------
    branches : sequence of Branch
        Branches of one tree, which share the points up to where they part.

    Returns
    -------
    ndarray
        The point (3,) at which they part, mm in LPS.

    Raises
    ------
    CurveError
        There is none: the tree has one end, or its branches share no points.
    """
    least = max(1, math.ceil(CARINA_SHARE * len(branches)))
    # All branches that pass the carina share their points up to it: one of the most of them is enough to walk.
    inside = [(branch, k) for branch in branches for k in (0,)]
    while inside:
        ahead = Counter(
            branch.points[k + 1].tobytes() for branch, k in inside if k + 1 < len(branch.points)
        ).most_common(2)
        if len(ahead) == 2 and ahead[1][1] >= least:
            branch, k = inside[0]
            if k:
                return np.asarray(branch.points[k])
            break
        main = ahead[0][0] if ahead else b""
        inside = [
            (branch, k + 1)
            for branch, k in inside
            if k + 1 < len(branch.points) and branch.points[k + 1].tobytes() == main
        ]
    raise CurveError(
        "there is no main bifurcation: the tree has one end, or its branches share no points; give the entry as a "
        "point (--entry X Y Z)"
    )


def _wall_of_mask(name: str, branches: Branches) -> Body:
    """Make the wall of a whole mask, mm in LPS, opened at the ends of its branches."""
    assert branches.mask is not None
    points = np.unique(np.concatenate([branch.points for branch in branches.branches]), axis=0)
    surface = open_tree_ends(
        surface_of_mask(branches.mask.voxels, branches.mask.affine, points),
        [branch.points for branch in branches.branches],
    )
    field = field_of_surface(flatten_steps(surface), points, branches.mask.affine)
    return Body(name, field, surface=surface)
