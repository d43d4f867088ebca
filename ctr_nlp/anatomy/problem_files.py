"""From a file of anatomy to the problem of advancing into it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import blamed, checked
from ctr_nlp.anatomy.choose import passage
from ctr_nlp.anatomy.files import read_table, title
from ctr_nlp.exceptions import CurveError, OptionError, RobotError
from ctr_nlp.robot import Robot, table_i_robot
from ctr_nlp.robot.units import angle_meant, between, did_you_mean
from ctr_nlp.support.values import checked_path, instance, number
from ctr_nlp.target.curve import Curve, curve_from_points
from ctr_nlp.target.placing import placed, trimmed, unit
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import check_frames, growing


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
    smoothing: float = 0.0,
    trim: Literal["start", "end"] | None = None,
    insertion: npt.ArrayLike | None = None,
    tilt: float | None = None,
) -> Problem:
    """The problem of advancing along a path in a file: a centreline file or a mask of the lumen.

    branch: which one, by name or number from 1. entry, target: points (3,) in mm between which it is followed;
    insertion: direction (3,) in which the robot is inserted there (default: that of the first 10 mm); all in the
    file's own coordinates. reverse: the file's lines run from tip to root. smoothing: mm that the followed curve
    may keep from the path, see Curve.smoothed. trim: which end to drop where the path is longer than the robot
    reaches. tilt: how far the base may turn about each of its axes, rad, where the robot's limits allow more.
    The problem's lumen is the whole branch. Raises CurveError, ProblemError, RobotError, OptionError.
    """
    path = checked_path(CurveError, path)
    check_frames(frames)
    if trim not in (None, "start", "end"):
        raise OptionError(f"trim is {trim!r}; it must be 'start' or 'end'")
    if robot is not None:
        instance(RobotError, "robot", robot, Robot)
    robot = _tilting(robot or table_i_robot(), tilt)
    along = None if insertion is None else unit(insertion)
    found = passage(path, branch, entry, target, reverse)
    with blamed(path):
        followed = found.path.smoothed(smoothing)
        if trim is not None:
            followed = trimmed(followed, robot.reach, trim)
        followed, to_robot = placed(followed, None if along is None else found.to_lps[:3, :3] @ along)
    lumen = None if found.branch.radius is None else found.branch.moved(to_robot)
    return Problem(
        title(path),
        robot,
        growing(followed, frames),
        duration,
        to_robot=to_robot @ found.to_lps,
        lumen=lumen,
        space=found.space,
    )


def read_csv(path: str | Path, smoothing: float = 0.0) -> Curve:
    """The curve of a CSV file with columns x_mm, y_mm, z_mm and optionally radius_mm; raises CurveError."""
    path = checked_path(CurveError, path)
    (branch,) = checked(path, read_table(path)).branches
    with blamed(path):
        return curve_from_points(branch.points, branch.radius, smoothing)


def _tilting(robot: Robot, tilt: float | None) -> Robot:
    """The robot with its tilt within tilt rad about each axis too."""
    if tilt is None:
        return robot
    if not 0 <= number(OptionError, "tilt", tilt, lambda _: True, "be a number", " rad") <= math.pi:
        meant = did_you_mean(angle_meant(tilt, between(0, math.pi)))
        raise OptionError(
            f"tilt is {tilt:g} rad, {math.degrees(tilt):g} degrees; it must lie in [0, pi] rad{meant}"
        )
    lower, upper = np.clip(robot.lower[-2:], -tilt, None), np.clip(robot.upper[-2:], None, tilt)
    return robot.with_limits(theta=tuple(zip(lower.tolist(), upper.tolist(), strict=True)))
