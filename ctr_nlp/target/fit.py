"""What is worth knowing of a robot in its lumen before anything is solved."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.robot import Robot
from ctr_nlp.support.runs import runs
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.lumen import outer_radius
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

SPACING_MM = 0.1
"""Between places along a path that are looked at."""
JAGGED = 0.5
"""A path of a larger curvature, in 1/mm, follows the noise of its points, as VMTK's lines do until smoothed."""
ASKEW_DEG = 1.0
"""An angle between robot and path at the entry that is worth a word."""


class Misfit(NamedTuple):
    """A tube, from 1, that is wider than the lumen from start to stop, mm along the path from the entry.

    lack: by how much its radius exceeds the lumen's at most, mm, and at: where. forced: it must go there to follow
    the target; otherwise it could only be slid there.
    """

    tube: int
    start: float
    stop: float
    lack: float
    at: float
    forced: bool


def misfits(problem: Problem) -> list[Misfit]:
    """Where a tube does not fit even in the middle of the lumen; none where no radius is known.

    The innermost tube must go to the target's end, each other one as far as the lower limit of its beta.
    """
    if problem.sampled_lumen is None:
        return []
    curve, s = _longest(problem)
    radius, found = problem.sampled_lumen.near(curve.point(s)).radius, []
    for i, (least, most) in enumerate(_extensions(problem.robot, s[-1])):
        lack = outer_radius(problem.robot)[i] - radius
        for forced, reached in ((True, (s <= least) & (least > 0)), (False, (s > least) & (s <= most))):
            for first, stop in runs(reached & (lack > 0)):
                worst = first + lack[first:stop].argmax()
                found.append(Misfit(i + 1, s[first], s[stop - 1], lack[worst], s[worst], forced))
    return found


def notes(problem: Problem) -> list[str]:
    """What to tell of a problem before it is solved, a sentence each."""
    return [*_smoothed(problem), *_jagged(problem), *_askew(problem), *_narrow(problem)]


def check_radii(problem: Problem) -> None:
    """Raise ProblemError where clearance cannot be had, no radius of the lumen being known."""
    if problem.lumen is None:
        raise ProblemError(
            f"clearance is asked for, and {problem.name} has no lumen radii; give them in mm as the column "
            "radius_mm of a CSV file, the point array MaximumInscribedSphereRadius or Radius of a VTK file, the "
            "measurement Radius of a Slicer file, or give a mask"
        )


def sharpest_bend(curve: Curve, length: float) -> tuple[float, float]:
    """The largest curvature in 1/mm of a curve up to a length in mm, as its tangent turns, and where that is, mm.

    Curve.curvature looks through the noise of given points.
    """
    s = _places(length)
    turns = np.linalg.norm(np.diff(curve.tangent(s), axis=0), axis=1) / np.diff(s)
    return float(turns.max()), float(s[turns.argmax()])


def _longest(problem: Problem) -> tuple[Curve, Array]:
    """The longest of the targets, and places (n,) along it, mm."""
    each = zip(problem.target.curves, problem.target.lengths, strict=True)
    curve, length = max(each, key=lambda pair: pair[1])
    return curve, _places(length)


def _places(length: float) -> Array:
    return np.linspace(0.0, length, max(2, int(np.ceil(length / SPACING_MM)) + 1))


def _extensions(robot: Robot, length: float) -> list[tuple[float, float]]:
    """How far each tube must and can extend, mm, while the innermost extends to length."""
    _, low, _ = robot.split(robot.lower)
    _, high, _ = robot.split(robot.upper)
    low, high = np.maximum.accumulate(low), np.minimum.accumulate(high[::-1])[::-1]
    low[-1] = length
    if robot.carriage_gap is not None:
        for i in range(robot.d - 2, -1, -1):
            longer = robot.tubes[i + 1].length - robot.tubes[i].length
            low[i] = max(low[i], low[i + 1] + robot.carriage_gap - longer)
    high = np.minimum(high, length)
    return [(float(least), float(most)) for least, most in zip(low, np.maximum(low, high), strict=True)]


def _smoothed(problem: Problem) -> Iterator[str]:
    if problem.deviation:
        share = problem.deviation_share
        part = f" and {100 * share:.0f} % of the lumen's radius" if share else ""
        yield f"smoothing moved the path by at most {problem.deviation:.2f} mm{part}"


def _jagged(problem: Problem) -> Iterator[str]:
    curve, s = _longest(problem)
    bend, at = sharpest_bend(curve, s[-1])
    if bend > JAGGED and not problem.deviation:
        yield (
            f"the path is jagged: at {at:.1f} mm it bends at a radius of {1 / bend:.2g} mm; --smoothing MM "
            "evens it out"
        )


def _askew(problem: Problem) -> Iterator[str]:
    """Where the base cannot tilt to where the path leads at once: R = Ry(theta_y) Rx(theta_x)."""
    x, y, z = tangent = problem.target.curves[-1].tangent(np.zeros(1))[0]
    wanted = [-np.arcsin(np.clip(y, -1, 1)), np.arctan2(x, z)]
    theta_x, theta_y = np.clip(wanted, problem.robot.lower[-2:], problem.robot.upper[-2:])
    base = [np.sin(theta_y) * np.cos(theta_x), -np.sin(theta_x), np.cos(theta_y) * np.cos(theta_x)]
    away, left = np.degrees(np.arccos(np.clip([z, tangent @ base], -1, 1)))
    if left > ASKEW_DEG:
        yield (
            f"the path sets out {away:.1f} degrees away from the insertion direction; with the tilt that it may "
            f"have, the base stays {left:.1f} degrees away"
        )


def _narrow(problem: Problem) -> Iterator[str]:
    """A sentence for each tube and whether it must go where it does not fit."""
    for (tube, forced), group in groupby(misfits(problem), key=lambda each: (each.tube, each.forced)):
        found = list(group)
        width = problem.robot.tubes[tube - 1].outer_diameter
        worst, start, stop = max(found, key=lambda each: each.lack), found[0].start, found[-1].stop
        if forced:
            places = f" in {len(found)} places" if len(found) > 1 else ""
            yield (
                f"tube {tube} ({width:g} mm) does not fit even centred{places} from {start:.1f} to {stop:.1f} mm "
                f"of the path, by up to {worst.lack:.2f} mm at {worst.at:.1f} mm: contact there cannot be avoided"
            )
        else:
            yield (
                f"tube {tube} ({width:g} mm) does not fit beyond {start:.1f} mm of the path, where the lumen "
                f"narrows to {width - 2 * worst.lack:.2f} mm (at {worst.at:.1f} mm): it has to stay behind"
            )
