"""Problems of advancing into the anatomy of a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import check_branches, name_source_in_errors
from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.anatomy.distance_fields import NEAR_MM
from ctr_nlp.anatomy.files import is_mask, path_smoothing, title
from ctr_nlp.anatomy.formats.table import read_table
from ctr_nlp.anatomy.plausibility import check_reach
from ctr_nlp.anatomy.reading import ASSUMED, SPACES, WALLS_OF_MASKS, ReadOptions
from ctr_nlp.anatomy.wall_files import WallFile, body_of_mask, place_walls
from ctr_nlp.exceptions import CurveError, OptionError, RobotError
from ctr_nlp.paths.curve import Curve, curve_from_points
from ctr_nlp.paths.placement import move_to_robot_frame, normalise_direction, trim_curve
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import check_frames, growing
from ctr_nlp.paths.walls import Body
from ctr_nlp.robot import Robot, table_i_robot
from ctr_nlp.robot.units import between, did_you_mean, suggest_angle
from ctr_nlp.support.value_checks import check_choice, check_instance, checked_path, number
from ctr_nlp.typing import Array

SURFACE_NOTE = (
    f"the wall is the surface of the mask, up to {NEAR_MM:g} mm from the path; --wall-of-mask lumen takes a round "
    "lumen with the path's radius instead"
)
LUMEN_NOTE = (
    "the wall is a round lumen with the path's radius, which lumens are not: contact may be off by a millimetre"
)
PATH_SPACING_MM = 1.0
"""Distance between the points of a path around which walls are read, mm."""


def problem_from_file(
    path: str | Path,
    robot: Robot | None = None,
    frames: int = 100,
    duration: float = 10.0,
    *,
    branch: str | int | None = None,
    entry: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
    reverse: bool = False,
    smoothing: float | None = None,
    trim: Literal["start", "end"] | None = None,
    insertion: npt.ArrayLike | None = None,
    tilt: float | None = None,
    units: str | None = None,
    space: str | None = None,
    label: Sequence[int] = (),
    segment: str | None = None,
    threshold: float | None = None,
    form: str | None = None,
    accept: Sequence[str] = (),
    pieces: Sequence[str | Path] = (),
    wall_of_mask: Literal["surface", "lumen"] | None = None,
    walls: Sequence[Body | WallFile] = (),
) -> Problem:
    r"""Make the problem of advancing along a path in a file: a centreline file or a mask of the lumen.

    The path is moved before the robot: its first point goes to the origin, and the insertion direction to +z. The
    target of frame j is the part of the path that has been advanced along by then, eq. (7).

    Parameters
    ----------
    path : str or Path
        The file; its suffix identifies the kind.
    robot : Robot, optional
        The robot; by default that of Table I of the paper.
    frames : int
        Number of frames, evenly spaced in time.
    duration : float
        Time for all of them, s.
    branch : str or int, optional
        Which branch of a centreline file is followed: its name, or its number from 1.
    entry, target : (3,) array_like, optional
        Points in the file's own coordinates, mm, between which the branch is followed; by default its ends.
    reverse : bool
        Whether the file's lines run from tip to root.
    smoothing : float, optional
        How far the followed curve may be from the path in the file, mm; see :meth:`Curve.smooth`. By default 0 for
        a centreline, which is followed as it is, and 2 mm for a mask, whose path has the steps of its voxels.
    trim : {"start", "end"}, optional
        Which end to drop where the path is longer than the robot reaches.
    insertion : (3,) array_like, optional
        Direction in which the robot is inserted, in the file's own coordinates and of any length; by default the
        mean direction of the first 10 mm of what is followed.
    tilt : float, optional
        Largest angle by which the base may turn about each of its axes, rad, where the robot's limits allow more.
    units : {"mm", "cm", "m", "um"}, optional
        Unit of the lengths in the file, where it does not state one.
    space : {"LPS", "RAS"}, optional
        Patient coordinates of the file, where it does not state them.
    label : sequence of int
        Labels of a mask that are the lumen, where it has several.
    segment : str, optional
        Name of the segment that is the lumen, in a segmentation of several.
    threshold : float, optional
        Value from which a voxel belongs to the lumen, in a probability map.
    form : {"qform", "sform"}, optional
        Which transform of a NIfTI header counts, where they differ.
    accept : sequence of {"leak", "ends", "steps"}
        Findings that are refused unless they are accepted here: a path through a leak of the segmentation, entry
        and target that seem exchanged, steps between points that are much longer than their neighbours.
    pieces : sequence of str or Path
        Further files with pieces of the same tree, as 3D Slicer saves one curve for each; those that meet are
        joined.
    wall_of_mask : {"surface", "lumen"}, optional
        What the wall of a mask is: its surface, the default, or a round lumen with the path's radius.
    walls : sequence of Body or WallFile
        Further walls, mm in LPS: bodies to keep out of or to stay inside of. Files are read near the path; see
        :func:`read_wall` and :class:`WallFile`.

    Returns
    -------
    Problem
        Its ``walls`` are the surface of a mask, named like the file, and those given. Its ``lumen`` is the whole
        branch where the file has radii, also what lies beyond `entry` and `target`; its ``to_robot`` takes the
        file's coordinates to the robot's frame; its ``notes`` say what was assumed, repaired or left out when the
        files were read.

    Raises
    ------
    CurveError
        The file cannot be read, or holds no such path.
    ProblemError
        The path is longer than the robot reaches and `trim` is not given, or `frames` or `duration` is out of
        range.
    RobotError
        `robot` is no robot.
    OptionError
        An option is out of its range or does not go with this kind of file.

    Examples
    --------
    A straight lumen of 100 mm and a radius of 4 mm:

    >>> import tempfile
    >>> rows = [f"0,0,{z},4" for z in range(0, 101, 5)]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "line.csv")
    ...     _ = path.write_text("\n".join(["x_mm,y_mm,z_mm,radius_mm", *rows]))
    ...     problem = problem_from_file(path, frames=4)
    >>> np.round(problem.target.lengths, 6).tolist()
    [25.0, 50.0, 75.0, 100.0]
    """
    path = checked_path(CurveError, path)
    check_frames(frames)
    if trim not in (None, "start", "end"):
        raise OptionError(f"trim is {trim!r}; it must be 'start' or 'end'")
    if robot is not None:
        check_instance(RobotError, "robot", robot, Robot)
    robot = _limit_tilt(robot or table_i_robot(), tilt)
    along = None if insertion is None else normalise_direction(insertion)
    if wall_of_mask is not None:
        check_choice("wall_of_mask", wall_of_mask, WALLS_OF_MASKS)
        if not is_mask(path):
            raise OptionError(f"wall_of_mask goes with a mask; {path} holds a path, whose radii are its lumen")
    options = ReadOptions(units, space, tuple(label), segment, threshold, form, tuple(accept))
    found = read_branch_segment(path, branch, entry, target, reverse, options, pieces)
    notes = list(found.facts.notes)
    with name_source_in_errors(path):
        if not is_mask(path):
            thinnest = min(tube.outer_diameter for tube in robot.tubes) / 2
            notes += check_reach(found.whole, robot.reach, thinnest, found.facts)
        # Smoothed before it is trimmed: smoothing changes the length, and what is left must be within reach.
        allowed = path_smoothing(smoothing, is_mask(path))
        followed = found.followed_path.smooth(allowed)
        if smoothing is None and allowed:
            notes.append(
                f"the path is the one that bends least within {allowed:g} mm of the middle of the lumen; "
                "--smoothing 0 follows the middle itself"
            )
        if trim is not None:
            whole = followed.length
            followed = trim_curve(followed, robot.reach, trim)
            notes += _trim_notes(whole - followed.length, trim, entry is not None, target is not None)
        near = _sample_path(followed)
        # Paths are in LPS, the direction in the file's own axes.
        followed, to_robot = move_to_robot_frame(followed, None if along is None else found.to_lps[:3, :3] @ along)
    own = list[Body]()
    if is_mask(path) and wall_of_mask != "lumen":
        assert found.mask is not None
        with name_source_in_errors(path):
            placed = body_of_mask(title(path), found.mask, near)
        own.append(placed.body.apply_transform(to_robot))
        notes += [SURFACE_NOTE, *placed.notes]
    elif is_mask(path):
        notes.append(LUMEN_NOTE)
    others, wall_notes = place_walls(walls, near, to_robot, options)
    notes += wall_notes
    # The lumen of the whole branch, in the same frame: tubes touch walls before the entry and beyond the target,
    # too.
    lumen = None if found.branch.radius is None else found.branch.apply_transform(to_robot)
    return Problem(
        title(path),
        robot,
        growing(followed, frames),
        duration,
        to_robot=to_robot @ found.to_lps,
        lumen=lumen,
        walls=(*own, *others),
        space=found.space,
        space_assumed=found.space in SPACES and found.facts.space_known == ASSUMED,
        notes=tuple(notes),
    )


def _sample_path(curve: Curve) -> Array:
    """Return points (n, 3) of a curve, PATH_SPACING_MM apart, mm."""
    return curve.point(np.linspace(0.0, curve.length, max(2, round(curve.length / PATH_SPACING_MM) + 1)))


def _trim_notes(dropped: float, trim: str, entry_given: bool, target_given: bool) -> list[str]:
    """Return a note on the part of a path that was cut off.

    dropped: its length, mm. trim: "start" or "end". entry_given, target_given: whether a person gave these points.
    """
    if dropped <= 0:
        return []
    if trim == "start":
        where = "the entry that was given" if entry_given else "the first point of the path"
        return [f"--trim start leaves out {dropped:.1f} mm: the robot's base is moved so far inwards from {where}"]
    where = "the target that was given" if target_given else "the last point of the path"
    return [f"--trim end leaves out {dropped:.1f} mm: the plan stops so far before {where}"]


def read_csv(path: str | Path, smoothing: float = 0.0, *, units: str | None = None) -> Curve:
    r"""Read the curve of a CSV file.

    Parameters
    ----------
    path : str or Path
        A file whose first line names the columns x_mm, y_mm and z_mm, and radius_mm where the lumen's radius is
        known; each further line is a point of the curve.
    smoothing : float
        How far the curve may be from the spline through these points, mm; see :meth:`Curve.smooth`.
    units : {"mm", "cm", "m", "um"}, optional
        Unit of the lengths in the file, where it is not the one that the file states.

    Returns
    -------
    Curve
        In the coordinates of the file, mm, by arc length.

    Raises
    ------
    CurveError
        The file cannot be read, or its points are no curve; the message names the file.
    OptionError
        `units` is none of these.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "line.csv")
    ...     _ = path.write_text("\n".join(["x_mm,y_mm,z_mm", *(f"0,0,{z}" for z in range(0, 101, 5))]))
    ...     curve = read_csv(path)
    >>> curve
    Curve(100.00 mm)
    """
    path = checked_path(CurveError, path)
    branches = check_branches(path, read_table(path, ReadOptions(units=units))).branches
    if len(branches) > 1:
        raise CurveError(f"{path} has {len(branches)} branches; use problem_from_file to choose one")
    branch = branches[0]
    with name_source_in_errors(path):
        return curve_from_points(branch.points, branch.radius, smoothing)


def _limit_tilt(robot: Robot, tilt: float | None) -> Robot:
    """Return the robot with the limits of its tilt narrowed to +-tilt rad about each axis; unchanged for None."""
    if tilt is None:
        return robot
    if not 0 <= number(OptionError, "tilt", tilt, lambda _: True, "be a number", " rad") <= math.pi:
        meant = did_you_mean(suggest_angle(tilt, between(0, math.pi)))
        raise OptionError(
            f"tilt is {tilt:g} rad, {math.degrees(tilt):g} degrees; it must lie in [0, pi] rad{meant}"
        )
    # The last two entries of q are theta_x and theta_y, eq. (5). Narrower limits of the robot's own stay.
    lower = np.clip(robot.lower[-2:], -tilt, None)
    upper = np.clip(robot.upper[-2:], None, tilt)
    return robot.with_limits(theta=tuple(zip(lower.tolist(), upper.tolist(), strict=True)))
