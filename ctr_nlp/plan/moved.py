"""What is known of a motion once the robot was moved through it: shapes, margins, snaps, clearance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.formulations.around import Beside
from ctr_nlp.models import Model, Snap
from ctr_nlp.plan.measures import rms_over_sigma, root_mean_square
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.forward import Simulation, simulated
from ctr_nlp.target.lumen import Lumen
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Flags

ELSEWHERE = 0.05
"""rad: a robot whose tubes are turned by more from what was planned is in another equilibrium."""


class Moved(NamedTuple):
    """arrays, told: fields of a plan and entries of its meta. simulation: the robot moved through its motion."""

    arrays: dict[str, Any]
    told: dict[str, Any]
    simulation: Simulation


def moved(
    robot: Robot,
    q: Array,
    model: str | Model,
    *,
    target: Array,
    lumen: Array | None = None,
    free: Array | None = None,
) -> Moved:
    """The robot moved on a model through q (T, 2d + 2), towards target (T, 101, 3) mm.

    lumen: (N, 4) mm, where it is known; free: the motion (T, 2d + 2) that was found without the wall.
    """
    found, clearance = simulated(robot, q, model), None
    if lumen is not None:
        clearance = Beside(Lumen(lumen)).clearances(robot, robot.split(q)[1], found.shape, SIGMA)
    arrays = {
        "shape": found.shape,
        "tip_direction": found.tip_direction,
        "stability": found.stability,
        "stability_between": found.stability_between,
        "clearance": clearance,
    }
    reached = np.asarray(np.isfinite(found.shape).all(axis=(1, 2)))
    told = {
        "snaps": [snap._asdict() for snap in found.snaps],
        "e3_free": e3_of(free_errors(robot, free, target, model), reached),
    }
    return Moved(arrays, told, found)


def free_errors(robot: Robot, free: Array | None, target: Array, model: str | Model) -> Array | None:
    """e2 (T,) in mm of a motion (T, 2d + 2) that was found without the wall; None without one."""
    if free is None:
        return None
    return rms_over_sigma(np.linalg.norm(simulated(robot, free, model).shape - target, axis=-1))


def e3_of(e2: Array | None, reached: Flags) -> float | None:
    """e3 in mm of e2 (T,) over the frames that are reached; None where it is not known in all of them."""
    if e2 is None or not np.isfinite(e2[reached]).all():
        return None
    return root_mean_square(e2[reached])


def elsewhere(x: Array, planned: Array, snaps: Sequence[Snap]) -> Flags:
    """In which frames (T,) a robot with unknowns x (T, n) is not where it was planned to be, or just snapped."""
    away = ~(np.abs(x - planned).max(axis=1) < ELSEWHERE)
    away[[snap.frame - 1 for snap in snaps]] = True
    return away


def lost(away: Flags, snaps: Sequence[Snap]) -> dict[str, str]:
    """Failures, by frame from 1, of frames (T,) in which a robot is away from where it was planned to be."""
    found = {}
    for frame in (np.flatnonzero(away) + 1).tolist():
        before = [snap.frame for snap in snaps if snap.frame <= frame]
        why = f"it snaps in frame {before[-1]}" if before else "another equilibrium is reached first"
        found[str(frame)] = f"the robot would be elsewhere: {why}"
    return found
