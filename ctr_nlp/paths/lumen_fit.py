"""Checks whether a robot fits into its lumen, and other notes on a problem before anything is solved."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.paths.curve import Curve
from ctr_nlp.paths.lumen import tube_outer_radii
from ctr_nlp.paths.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.support.flag_runs import find_flag_runs
from ctr_nlp.typing import Array

FIT_CHECK_SPACING_MM = 0.1
"""Distance between the points of a path that are checked, mm."""
JAGGED_CURVATURE_PER_MM = 0.5
"""Curvature, 1/mm, above which a path follows the noise of its points, as VMTK's lines do until they
are smoothed.
"""
MAX_ENTRY_ANGLE_DEG = 1.0
"""Angle between robot and path at the entry above which a note is given, degrees."""


class Misfit(NamedTuple):
    """A part of the path in which a tube is wider than the lumen.

    Attributes
    ----------
    tube : int
        Its number, from 1.
    start, stop : float
        Ends of that part along the path from the entry, mm.
    radius_excess : float
        By how much its radius exceeds the lumen's at most, mm.
    at : float
        Where that is, mm along the path.
    forced : bool
        Whether the tube must go there to follow the target; otherwise it could only be moved there.
    """

    tube: int
    start: float
    stop: float
    radius_excess: float
    at: float
    forced: bool


def misfits(problem: Problem) -> list[Misfit]:
    """Find where a tube does not fit even in the middle of the lumen.

    The innermost tube must go to the target's end, each other one as far as the lower limit of its beta.

    Parameters
    ----------
    problem : Problem
        Robot and target.

    Returns
    -------
    list of Misfit
        In the order of the tubes; empty where no radius is known.
    """
    if problem.sampled_lumen is None:
        return []
    curve, s = _longest(problem)
    radius = problem.sampled_lumen.project(curve.point(s)).radius
    found = []
    for i, (least, most) in enumerate(_extensions(problem.robot, s[-1])):
        lack = tube_outer_radii(problem.robot)[i] - radius
        # A tube has to extend up to `least` and cannot avoid a narrow part there; between `least` and `most` it
        # can.
        for forced, reached in ((True, (s <= least) & (least > 0)), (False, (s > least) & (s <= most))):
            for first, stop in find_flag_runs(reached & (lack > 0)):
                worst = first + lack[first:stop].argmax()
                found.append(Misfit(i + 1, s[first], s[stop - 1], lack[worst], s[worst], forced))
    return found


def problem_notes(problem: Problem) -> list[str]:
    """Return notes on a problem for its user before it is solved, a sentence each.

    Parameters
    ----------
    problem : Problem
        Robot and target.

    Returns
    -------
    list of str
        On how a file was read, smoothing, jagged paths, the direction at the entry, and tubes that do not fit;
        empty where all is well.
    """
    return [
        *problem.notes,
        *_note_smoothing(problem),
        *_note_jagged_path(problem),
        *_note_entry_direction(problem),
        *_note_misfits(problem),
    ]


def check_radii(problem: Problem) -> None:
    """Raise ProblemError where a problem has no lumen radii, without which there is no clearance."""
    if problem.wall is None:
        raise ProblemError(
            f"clearance is asked for, and {problem.name} has no lumen radii; give them in mm as the column "
            "radius_mm of a CSV file, the point array MaximumInscribedSphereRadius or Radius of a VTK file, the "
            "measurement Radius of a Slicer file, or give a mask"
        )


def sharpest_bend(curve: Curve, length: float) -> tuple[float, float]:
    """Find the sharpest bend of a curve by the turn of its tangent.

    `Curve.curvature` of a curve through points is that of a smoothing spline, which hides the noise of the points.

    Parameters
    ----------
    curve : Curve
        The curve.
    length : float
        Up to which arc length, mm.

    Returns
    -------
    curvature : float
        The largest, 1/mm.
    at : float
        Arc length where it is, mm.
    """
    s = _places(length)
    # For close points the chord between two unit tangents is the angle between them, and angle over length
    # curvature.
    turns = np.linalg.norm(np.diff(curve.tangent(s), axis=0), axis=1) / np.diff(s)
    return float(turns.max()), float(s[turns.argmax()])


def _longest(problem: Problem) -> tuple[Curve, Array]:
    """Return the curve of the longest frame of the target, and arc lengths (n,) of points along it, mm."""
    each = zip(problem.target.curves, problem.target.lengths, strict=True)
    curve, length = max(each, key=lambda pair: pair[1])
    return curve, _places(length)


def _places(length: float) -> Array:
    """Return arc lengths (n,) from 0 to `length`, mm, at most FIT_CHECK_SPACING_MM apart."""
    return np.linspace(0.0, length, max(2, int(np.ceil(length / FIT_CHECK_SPACING_MM)) + 1))


def _extensions(robot: Robot, length: float) -> list[tuple[float, float]]:
    """Return how far each tube must and can extend, mm, while the innermost one extends to `length`."""
    _, low, _ = robot.split(robot.lower)
    _, high, _ = robot.split(robot.upper)
    # Order, eq. (2): a tube must go at least as far as those outside it, and can go no further than those within.
    low = np.maximum.accumulate(low)
    high = np.minimum.accumulate(high[::-1])[::-1]
    low[-1] = length
    if robot.carriage_gap is not None:
        for i in range(robot.d - 2, -1, -1):
            longer = robot.tubes[i + 1].length - robot.tubes[i].length
            # The carriage gap, solved for the outer tube: an inner one that is far out drags it along.
            low[i] = max(low[i], low[i + 1] + robot.carriage_gap - longer)
    high = np.minimum(high, length)
    return [(float(least), float(most)) for least, most in zip(low, np.maximum(low, high), strict=True)]


def _note_smoothing(problem: Problem) -> Iterator[str]:
    """Yield a note where smoothing moved the path."""
    if problem.deviation:
        share = problem.deviation_share
        part = f" and {100 * share:.0f} % of the lumen's radius" if share else ""
        yield f"smoothing moved the path by at most {problem.deviation:.2f} mm{part}"


def _note_jagged_path(problem: Problem) -> Iterator[str]:
    """Yield a note where the path bends at a radius below 2 mm and was not smoothed."""
    curve, s = _longest(problem)
    bend, at = sharpest_bend(curve, s[-1])
    if bend > JAGGED_CURVATURE_PER_MM and not problem.deviation:
        yield (
            f"the path is jagged: at {at:.1f} mm it bends at a radius of {1 / bend:.2g} mm; --smoothing MM "
            "evens it out"
        )


def _note_entry_direction(problem: Problem) -> Iterator[str]:
    """Yield a note where the base cannot tilt into the direction in which the path begins."""
    # R = Ry(theta_y) Rx(theta_x), eq. (4), turns +z to (sin ty cos tx, -sin tx, cos ty cos tx), solved for the
    # tilt.
    x, y, z = tangent = problem.target.curves[-1].tangent(np.zeros(1))[0]
    wanted = [-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)]
    theta_x, theta_y = np.clip(wanted, problem.robot.lower[-2:], problem.robot.upper[-2:])
    base = [np.sin(theta_y) * np.cos(theta_x), -np.sin(theta_x), np.cos(theta_y) * np.cos(theta_x)]
    away, left = np.degrees(np.arccos(np.clip([z, tangent @ base], -1, 1)))
    if left > MAX_ENTRY_ANGLE_DEG:
        yield (
            f"the path starts {away:.1f} degrees off the insertion direction; tilting the base as far as its "
            f"limits allow leaves {left:.1f} degrees"
        )


def _note_misfits(problem: Problem) -> Iterator[str]:
    """Yield a sentence for each tube that does not fit, by whether it must go there."""
    for (tube, forced), group in groupby(misfits(problem), key=lambda each: (each.tube, each.forced)):
        found = list(group)
        width = problem.robot.tubes[tube - 1].outer_diameter
        worst = max(found, key=lambda each: each.radius_excess)
        start = found[0].start
        stop = found[-1].stop
        if forced:
            places = f" in {len(found)} places" if len(found) > 1 else ""
            yield (
                f"tube {tube} ({width:g} mm) does not fit even centred{places} from {start:.1f} to {stop:.1f} mm "
                f"of the path, by up to {worst.radius_excess:.2f} mm at {worst.at:.1f} mm: contact there "
                f"cannot be avoided"
            )
        else:
            yield (
                f"tube {tube} ({width:g} mm) does not fit beyond {start:.1f} mm of the path, where the lumen "
                f"narrows to {width - 2 * worst.radius_excess:.2f} mm (at {worst.at:.1f} mm): it has to stay "
                f"behind"
            )
