"""Evaluation of a motion by simulation: shapes, margins, snaps, clearance, and frames on another branch.

A planner finds equilibria frame by frame. Which of several equilibria a real robot is in depends on its history:
shapes are therefore taken from a simulation through the whole motion, and not from the planner's solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.models import Model, Snap
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.paths.lumen import outermost_tube_radii
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.walls import Body, WallGeometry, Walls
from ctr_nlp.plan.measures import rms_over_sigma, root_mean_square
from ctr_nlp.plan.plan_data import WALL_FORCE_ARRAYS
from ctr_nlp.plan.simulation import Simulation, Simulator, shapes_between
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Flags, Index

PLANNED_BRANCH_TOLERANCE_RAD = 0.05
"""rad: a robot whose tubes are turned by more from what was planned is in another equilibrium."""
FIELD_ERROR_MM = 0.6
"""mm by which a distance field may be off near a wall, with cells of up to 0.8 mm: less than a cell, in the middle
of a lumen as narrow as the robot, and far less elsewhere. On 42 plans in an airway of 0.6 mm voxels it is 0.45."""
MEASURED_CLEARANCE_MM = 1.0
"""Clearances below this, mm, are measured at the triangles of a wall."""


class MotionEvaluation(NamedTuple):
    """Results of a simulated motion.

    arrays: fields of a plan. metadata: entries of its meta. simulation: the robot moved through its motion.
    """

    arrays: dict[str, Any]
    metadata: dict[str, Any]
    simulation: Simulation


def evaluate_motion(
    simulator: Simulator, q: Array, *, target: Array, wall: WallGeometry | None = None, free: Array | None = None
) -> MotionEvaluation:
    """Simulate a motion and compute the fields of a plan that follow from it.

    simulator: of the robot on a model. q: (T, 2d + 2), rad and mm. target: (T, 101, 3) in mm. wall: the
    wall that counts, None if unknown. free: (T, 2d + 2), the motion that was found without the wall, or None.
    """
    robot = simulator.robot
    found = simulator(q)
    of_walls = between = None
    if wall is not None:
        of_walls = wall_clearances(robot, wall, robot.split(q)[1], found.shape)
        between = clearances_between(robot, q, simulator.model, wall)
    arrays = {
        "shape": found.shape,
        "tip_direction": found.tip_direction,
        "stability": found.stability,
        "stability_between": found.stability_between,
        **name_clearances(of_walls, between),
        # Forces of a wall belong to the evaluation before: here the robot passes through walls.
        **dict.fromkeys(WALL_FORCE_ARRAYS),
    }
    reached = np.asarray(np.isfinite(found.shape).all(axis=(1, 2)))
    told = {
        "snaps": [snap._asdict() for snap in found.snaps],
        "e3_free": e3_of(free_errors(simulator, free, target), reached),
    }
    return MotionEvaluation(arrays, told, found)


def name_clearances(of_walls: Array | None, between: Array | None) -> dict[str, Any]:
    """Return the fields of a plan on clearance; of_walls, between: (T, W, 101) mm, in frames and on the way there.

    Each wall has clearances of its own where there are several.
    """
    if of_walls is None or between is None:
        return dict.fromkeys(("clearance", "clearance_between", "wall_clearance", "wall_clearance_between"))
    several = of_walls.shape[1] > 1
    return {
        # fmin, since it is not known only where no wall's is.
        "clearance": np.fmin.reduce(of_walls, axis=1),
        "clearance_between": np.fmin.reduce(between, axis=1),
        "wall_clearance": of_walls if several else None,
        "wall_clearance_between": between if several else None,
    }


def wall_clearances(robot: Robot, wall: WallGeometry, beta: Array, shape: Array) -> Array:
    """Compute the clearance between a robot and each of its walls.

    Parameters
    ----------
    robot : Robot
        The robot.
    wall : WallGeometry
        A lumen, or several walls.
    beta : ndarray
        Extensions (T, d), mm.
    shape : ndarray
        Shapes (T, 101, 3), mm, at uniform sigma; NaN where the robot has none.

    Returns
    -------
    ndarray
        Clearance (T, W, 101), mm, of W walls; negative beyond a wall or its margin. Where a body's triangles are
        known, the least of each row is exact: points that may be it are measured at the triangles.
    """
    return np.stack([clearance_from_wall(robot, part, beta, shape, axes=(1,)) for part in parts_of(wall)], axis=1)


def parts_of(wall: WallGeometry) -> list[WallGeometry]:
    """Return the walls that a wall consists of, one by one."""
    return wall.each if isinstance(wall, Walls) else [wall]


def clearance_from_wall(
    robot: Robot, part: WallGeometry, beta: Array, shape: Array, axes: tuple[int, ...]
) -> Array:
    """Compute the clearance between robots and one wall.

    Parameters
    ----------
    robot : Robot
        The robot.
    part : WallGeometry
        A lumen or a body.
    beta : ndarray
        Extensions (T, d), mm.
    shape : ndarray
        Shapes (.., T, 101, 3), mm, at uniform sigma; NaN where a robot has none.
    axes : tuple of int
        Axes of the result over which the least must be exact.

    Returns
    -------
    ndarray
        Clearance (.., T, 101), mm; negative beyond the wall or its margin. Where a body's triangles are known,
        points that may be the least over `axes` are measured at these. Where an outer tube ends between two
        points, the first of them has the least of itself and that end.
    """
    alone = Walls(None, (part,)) if isinstance(part, Body) else part
    points, radii, before = _with_tube_ends(robot, beta, shape)
    clear = WallDistance(alone)(points) - radii
    if isinstance(part, Body) and part.surface is not None:
        least = np.fmin.reduce(clear, axis=axes, keepdims=True)
        small = clear < np.minimum(least + FIELD_ERROR_MM, MEASURED_CLEARANCE_MM)
        clear[small] = part.room(points[small]) - np.broadcast_to(radii, clear.shape)[small]
    for tube, place in enumerate(before.T):
        at = (..., np.arange(len(beta)), place)
        clear[at] = np.fmin(clear[at], clear[..., len(SIGMA_GRID) + tube])
    return clear[..., : len(SIGMA_GRID)]


def _with_tube_ends(robot: Robot, beta: Array, shape: Array) -> tuple[Array, Array, Index]:
    """Return points of robots followed by the ends of their outer tubes, the radii there, and where the ends are.

    beta: extensions (T, d), mm. shape: (.., T, 101, 3), mm. Points are (.., T, 101 + d - 1, 3), radii of the
    outermost tubes (T, 101 + d - 1), mm; the last has for each end the number of the point before it, (T, d - 1).
    """
    count, last = len(beta), len(SIGMA_GRID) - 1
    # Frames without a configuration have no shape, either.
    beta = np.nan_to_num(beta)
    ends = beta[:, :-1] / np.maximum(beta[:, -1:], np.finfo(float).tiny)
    # At its own end, a tube is still the outermost.
    radii = outermost_tube_radii(robot, beta, np.hstack([np.tile(SIGMA_GRID, (count, 1)), ends]))
    before = np.minimum((last * ends + 1e-9).astype(int), last - 1)
    part = (last * ends - before)[..., None]
    frames = np.arange(count)[:, None]
    # Points are a mm or two apart, so that the line between them is within 0.02 mm of the robot.
    between = (1 - part) * shape[..., frames, before, :] + part * shape[..., frames, before + 1, :]
    return np.concatenate([shape, between], axis=-2), radii, before


def clearances_between(robot: Robot, q: Array, model: str | Model, wall: WallGeometry) -> Array:
    """Compute the least clearance from each wall in each frame and on the path to it.

    Parameters
    ----------
    robot : Robot
        The robot that is moved.
    q : (T, 2d + 2) array
        Configurations of the frames; rad, mm and rad.
    model : str or Model
        The kinematic model.
    wall : WallGeometry
        A lumen, or several walls.

    Returns
    -------
    (T, W, 101) array
        The least clearance in mm at each sigma over the 10 sub-steps to a frame; negative beyond the wall. In the
        first frame it is that of the frame alone. NaN where the robot has no shape.
    """
    found = shapes_between(robot, q, model)
    clearance = wall_clearances(robot, wall, found.beta, found.shape)
    least = np.full((len(q), *clearance.shape[1:]), np.nan)
    # Several rows belong to one frame: with fmin.at all of them count, with plain indexing only the last would.
    np.fmin.at(least, found.frames, clearance)
    return least


def free_errors(simulator: Simulator, free: Array | None, target: Array) -> Array | None:
    """Return e2 (T,) in mm of the motion that was found without the wall; None without one.

    simulator: of the robot on a model. free: (T, 2d + 2), that motion, or None. target: (T, 101, 3) in mm.
    """
    if free is None:
        return None
    return rms_over_sigma(np.linalg.norm(simulator(free).shape - target, axis=-1))


def e3_of(e2: Array | None, reached: Flags) -> float | None:
    """Return e3 in mm of e2 (T,) over the frames `reached` (T,); None where e2 is unknown in one of these."""
    if e2 is None or not np.isfinite(e2[reached]).all():
        return None
    return root_mean_square(e2[reached])


def find_off_branch_frames(x: Array, planned: Array, snaps: Sequence[Snap], d: int) -> Flags:
    """Return the frames (T,) in which a robot is on another branch than planned, or has just snapped.

    x, planned: (T, n), simulated and planned unknowns. snaps: of the simulation. d: number of tubes.
    """
    # x begins with the tips' angles: the outer ones relative to the innermost tip, whose own angle is absolute.
    # Whole turns of that one turn all tubes together and change no shape.
    apart = x - planned
    apart[:, d - 1] -= 2 * np.pi * np.round(apart[:, d - 1] / (2 * np.pi))
    # Negated so that NaN, where there is no equilibrium, counts as away.
    away = ~(np.abs(apart).max(axis=1) < PLANNED_BRANCH_TOLERANCE_RAD)
    away[[snap.frame - 1 for snap in snaps]] = True
    return away


def describe_branch_failures(away: Flags, snaps: Sequence[Snap]) -> dict[str, str]:
    """Return the failure messages, by frame number from 1, of frames in which the robot left the planned branch.

    away: (T,) of bool, these frames. snaps: of the simulation.
    """
    found = {}
    for frame in (np.flatnonzero(away) + 1).tolist():
        before = [snap.frame for snap in snaps if snap.frame <= frame]
        why = f"it snaps in frame {before[-1]}" if before else "another equilibrium is reached first"
        found[str(frame)] = f"the robot would be elsewhere: {why}"
    return found
