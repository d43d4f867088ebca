"""Paths that tubes follow exactly, in closed form, and robots whose tubes do."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from ctr_nlp import Problem, Robot, Tube, curve_from_points, growing
from ctr_nlp.typing import Array

STEP = 0.5
"""mm from point to point of a path."""
TORSION = 0.012


def _arc(length: float, curvature: float, outer: float, torsion: float = 0.0) -> Tube:
    return Tube(2 * length, length, curvature, outer, outer - 0.4, pre_torsion=torsion)


def _pair(torsion: float = 0.0) -> Robot:
    return Robot((_arc(60, 0.006, 2.4, torsion), _arc(110, 0.014, 1.9, torsion)))


ROBOTS = {
    "circle": Robot((_arc(100, 1 / 60, 2.0),)),
    "helix right": Robot((_arc(110, 0.012, 2.0, TORSION),)),
    "helix left": Robot((_arc(110, 0.012, 2.0, -TORSION),)),
    "two tubes": _pair(),
    "three tubes": Robot((_arc(50, 0.005, 2.9, TORSION), *_pair(TORSION).tubes)),
}
ENDS = {
    "circle": (90,),
    "helix right": (100,),
    "helix left": (100,),
    "two tubes": (50, 100),
    "three tubes": (30, 58, 100),
}
"""Where tubes stop, mm."""


def pieces(robot: Robot, ends: tuple[float, ...]) -> list[tuple[float, float]]:
    """Length and curvature of the path between neighbouring ends: by moments of the tubes that are there."""
    starts, found = (0.0, *ends), []
    for i, end in enumerate(ends):
        inner = robot.tubes[i:]
        stiffness = [tube.youngs_modulus * (tube.outer_diameter**4 - tube.inner_diameter**4) for tube in inner]
        moment = sum(each * tube.root_curvature for each, tube in zip(stiffness, inner, strict=True))
        found.append((end - starts[i], moment / sum(stiffness)))
    return found


def frenet(along: list[tuple[float, float]], torsion: float) -> Array:
    """Points (n, 3) of pieces of helices by exponentials of their Frenet equations, turned to no axis."""
    state = np.eye(4)  # columns: tangent, normal, binormal and the point
    state[:3, :3] = np.linalg.qr(np.array([[1.0, 0.4, 0.2], [0.3, 1.0, -0.5], [2.0, 0.1, 1.0]]))[0]
    state[:3, :3] *= np.linalg.det(state[:3, :3])
    points = [state[:3, 3]]
    for length, k in along:
        slopes = np.array([[0, -k, 0, 1], [k, 0, -torsion, 0], [0, torsion, 0, 0], [0, 0, 0, 0]])
        count = round(length / STEP)
        step = expm(slopes * (length / count))
        for _ in range(count):
            state = state @ step
            points.append(state[:3, 3])
    return np.array(points)


class Path(NamedTuple):
    """Arc lengths (n,), mm, and points (n, 3) of a path."""

    s: Array
    points: Array


def path(name: str) -> Path:
    """The one of a robot."""
    robot = ROBOTS[name]
    points = frenet(pieces(robot, ENDS[name]), robot.tubes[-1].pre_torsion)
    return Path(np.linspace(0.0, ENDS[name][-1], len(points)), points)


def problem(name: str, frames: int) -> Problem:
    """A robot and its path, which grows over so many frames."""
    return Problem(name, ROBOTS[name], growing(curve_from_points(path(name).points), frames))
