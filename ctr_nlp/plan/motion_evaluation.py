"""Results of moving a robot through its motion: shapes, margins, snaps, clearance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.models import Model, Snap
from ctr_nlp.ocp.compiled_wall import WallDistance
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import rms_over_sigma, root_mean_square
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.plan.simulation import Simulation, Simulator, shapes_between
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Flags

PLANNED_BRANCH_TOLERANCE_RAD = 0.05
"""rad: a robot whose tubes are turned by more from what was planned is in another equilibrium."""


class MotionEvaluation(NamedTuple):
    """Results of a simulated motion. arrays, metadata: fields of a plan and entries of its meta. simulation: the
    robot moved through its motion.
    """

    arrays: dict[str, Any]
    metadata: dict[str, Any]
    simulation: Simulation


def evaluate_motion(
    simulator: Simulator, q: Array, *, target: Array, lumen: Lumen | None = None, free: Array | None = None
) -> MotionEvaluation:
    """Move the robot through q (T, 2d + 2), towards target (T, 101, 3) mm.

    lumen: the wall, where it is known; free: the motion (T, 2d + 2) that was found without the wall.
    """
    robot = simulator.robot
    found = simulator(q)
    clearance = None
    between = None
    if lumen is not None:
        clearance = WallDistance(lumen).clearances(robot, robot.split(q)[1], found.shape, SIGMA_GRID)
        between = clearance_between(robot, q, simulator.model, lumen)
    arrays = {
        "shape": found.shape,
        "tip_direction": found.tip_direction,
        "stability": found.stability,
        "stability_between": found.stability_between,
        "clearance": clearance,
        "clearance_between": between,
    }
    reached = np.asarray(np.isfinite(found.shape).all(axis=(1, 2)))
    told = {
        "snaps": [snap._asdict() for snap in found.snaps],
        "e3_free": e3_of(free_errors(simulator, free, target), reached),
    }
    return MotionEvaluation(arrays, told, found)


def clearance_between(robot: Robot, q: Array, model: str | Model, lumen: Lumen) -> Array:
    """Return the least clearance from a lumen's wall on the way to each frame, and in it.

    Parameters
    ----------
    robot : Robot
        The robot that is moved.
    q : (T, 2d + 2) array
        Configurations of the frames; rad, mm and rad.
    model : str or Model
        The kinematic model.
    lumen : Lumen
        Its wall.

    Returns
    -------
    (T, 101) array
        The least clearance in mm of each place sigma over 10 sub-steps to a frame; negative beyond the wall. The
        first frame has no way to it. NaN where the robot has no shape.
    """
    found = shapes_between(robot, q, model)
    clearance = WallDistance(lumen).clearances(robot, found.beta, found.shape, SIGMA_GRID)
    least = np.full((len(q), len(SIGMA_GRID)), np.nan)
    np.fmin.at(least, found.frames, clearance)
    return least


def lumen_of(plan: PlanData) -> Lumen | None:
    """Return the lumen whose table (N, 4) a plan holds; None where none is known."""
    return None if plan.lumen is None else Lumen(plan.lumen)


def free_errors(simulator: Simulator, free: Array | None, target: Array) -> Array | None:
    """Return e2 (T,) in mm of the motion `free` (T, 2d + 2) that was found without the wall; None without one."""
    if free is None:
        return None
    return rms_over_sigma(np.linalg.norm(simulator(free).shape - target, axis=-1))


def e3_of(e2: Array | None, reached: Flags) -> float | None:
    """e3 in mm of e2 (T,) over the frames that are reached; None where it is not known in all of them."""
    if e2 is None or not np.isfinite(e2[reached]).all():
        return None
    return root_mean_square(e2[reached])


def find_off_branch_frames(x: Array, planned: Array, snaps: Sequence[Snap], d: int) -> Flags:
    """Tell in which frames (T,) a robot of d tubes with unknowns x (T, n) is on another branch than planned, or
    just snapped.

    Whole turns of the innermost tube with all others, which change nothing, do not count. planned (T, n): unknowns
    of the plan.
    """
    apart = x - planned
    apart[:, d - 1] -= 2 * np.pi * np.round(apart[:, d - 1] / (2 * np.pi))
    # Negated so that NaN, where there is no equilibrium, counts as away.
    away = ~(np.abs(apart).max(axis=1) < PLANNED_BRANCH_TOLERANCE_RAD)
    away[[snap.frame - 1 for snap in snaps]] = True
    return away


def describe_branch_failures(away: Flags, snaps: Sequence[Snap]) -> dict[str, str]:
    """Failures, by frame from 1, of frames (T,) in which a robot is away from where it was planned to be."""
    found = {}
    for frame in (np.flatnonzero(away) + 1).tolist():
        before = [snap.frame for snap in snaps if snap.frame <= frame]
        why = f"it snaps in frame {before[-1]}" if before else "another equilibrium is reached first"
        found[str(frame)] = f"the robot would be elsewhere: {why}"
    return found
