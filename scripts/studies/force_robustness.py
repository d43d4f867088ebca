"""Study of robust plans under tip forces: samples of a robot with a force that is applied and taken away.

The force is a dead load: its direction is fixed in the base frame. A plan is made for one size of force, and
tested under others.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.loads.tip import cube_directions
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loads import Load
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.plan.sample_motions import find_failure_frames
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.robot.samples import sample_robots
from ctr_nlp.robust import solve_robust
from ctr_nlp.typing import Flags

FORCE_STUDY_SAMPLES, FORCE_STUDY_SEED, FORCE_STUDY_DIRECTIONS = 200, 1, 26
"""Number of Monte Carlo samples, their seed, which is not that of planning, and number of force directions."""
KNOWN_FORCE_DIRECTION = (0.0, 1.0, 0.0)
"""Direction of a force that is known when planning."""
KNOWN_FORCE_SETTINGS = Settings(stability_margin=0.3)
"""Settings of plans with and without a known force: about the margin that robust plans have."""


@dataclass(frozen=True)
class ForceTrial:
    """Result of a robust plan, made for one tip force, under another one.

    Attributes
    ----------
    problem : str
        Name of the problem.
    planned_for, force : float
        Tip forces that the plan was made for, and under which it is simulated, N.
    solved : bool
        Whether all frames were solved.
    certified : bool
        Whether the plan's own samples met the required share.
    e3, e3_drawn : float
        Error as planned, and its mean over samples with the force in a direction of their own, mm.
    draws : int
        Number of samples.
    lost, lost_without : int
        Samples that snap or end on another branch under the force in any of the directions, and without a force.
    seconds : float
        Process time of planning, s.
    """

    problem: str
    planned_for: float
    force: float
    solved: bool
    certified: bool
    e3: float
    e3_drawn: float
    draws: int
    lost: int
    lost_without: int
    seconds: float


def failed_from_any_side(
    plan: Plan, force: float, samples: int = FORCE_STUDY_SAMPLES, direction_count: int = FORCE_STUDY_DIRECTIONS
) -> Flags:
    """Find the samples that fail under a force that is applied in the first frame and taken away in the last one.

    Parameters
    ----------
    plan : Plan
        The plan, whose robot's tolerances are sampled except for the tip force.
    force : float
        Force at the tip, N; 0 for none.
    samples : int
        Number n of Monte Carlo samples.
    direction_count : int
        Number of directions that the force comes from: 6, 14 or 26.

    Returns
    -------
    (n,) array of bool
        Samples that snap, have no equilibrium or end on another branch in any of these directions.
    """
    # The same force for all samples: with a tip force among the tolerances each would have a direction of its own.
    robot = replace(plan.robot, tolerances=replace(plan.robot.tolerances, tip_force=0.0))
    known = sample_robots(robot, samples, FORCE_STUDY_SEED)
    lost = np.zeros(samples, dtype=bool)
    for direction in cube_directions(direction_count) if force else np.zeros((1, 3)):
        pushed = replace(known, forces=np.tile(force * direction, (samples, 1)))
        lost |= find_failure_frames(robot, pushed, plan.q, "elastic") > 0
    return lost


def evaluate_under_forces(
    problem: Problem,
    planned_for: float,
    forces: Sequence[float],
    samples: int = FORCE_STUDY_SAMPLES,
    most_lost: float = MOST_LOST,
) -> list[ForceTrial]:
    """Plan a problem robustly for one tip force, and simulate the plan under several.

    Parameters
    ----------
    problem : Problem
        Robot and target.
    planned_for : float
        Tip force that the plan is made for, N.
    forces : sequence of float
        Tip forces under which it is simulated, N.
    samples : int
        Number of Monte Carlo samples.
    most_lost : float
        Share of robots that may fail; see :func:`solve_robust`.

    Returns
    -------
    list of ForceTrial
        One result a force.
    """
    # Time of this process alone: other work on the machine does not count.
    tolerances = replace(problem.robot.tolerances, tip_force=planned_for)
    begin = time.process_time()
    tolerant = replace(problem, robot=replace(problem.robot, tolerances=tolerances))
    plan = solve_robust(tolerant, most_lost=most_lost)
    seconds = time.process_time() - begin
    without = int(failed_from_any_side(plan, 0.0, samples).sum())
    return [
        ForceTrial(
            problem.name or "",
            planned_for,
            force,
            plan.complete,
            bool(plan.meta.get("certificate", {}).get("held", False)),
            summary(plan)["e3"],
            _sampled_e3(plan, force, samples),
            samples,
            int(failed_from_any_side(plan, force, samples).sum()),
            without,
            seconds,
        )
        for force in forces
    ]


def _sampled_e3(plan: Plan, force: float, samples: int) -> float:
    """Return the mean e3, mm, of samples with the force, N, in a direction of their own; NaN where unknown."""
    tolerances = replace(plan.robot.tolerances, tip_force=force)
    # A plan samples the robot in its meta: with this tip force among the tolerances every sample has one.
    told = replace(plan, meta=plan.meta | {"robot": replace(plan.robot, tolerances=tolerances).to_dict()})
    errors = told.robustness(samples, FORCE_STUDY_SEED).errors
    return math.nan if errors is None else errors.mean


@dataclass(frozen=True)
class ForceCompensation:
    """Result of planning with and without knowledge of a constant tip force.

    Attributes
    ----------
    problem : str
        Name of the problem.
    force : float
        Size of the force, N.
    e3_without, e3_unaware, e3 : float
        Errors, mm: of the plan made without the force, of the same plan under it, and of the plan made for it.
    solved : bool
        Whether all frames of the plan made for the force were solved.
    snaps : bool
        Whether that plan snaps while the force is applied, stays, and is taken away.
    """

    problem: str
    force: float
    e3_without: float
    e3_unaware: float
    e3: float
    solved: bool
    snaps: bool


def plan_with_known_force(problem: Problem, force: float) -> ForceCompensation:
    """Plan a problem with and without knowledge of a force across the robot.

    Parameters
    ----------
    problem : Problem
        Robot, with Young's moduli in MPa, and target.
    force : float
        Size of the force along the base's y axis, N.

    Returns
    -------
    ForceCompensation
        Errors of both plans.
    """
    load = Load(tuple(force * part for part in KNOWN_FORCE_DIRECTION))
    free = solve_horizon(problem, model="elastic", settings=KNOWN_FORCE_SETTINGS)
    plan = solve_horizon(problem, model=Loaded(load), settings=KNOWN_FORCE_SETTINGS)
    without, unaware, aware = (summary(each)["e3"] for each in (free, free.with_load(load), plan))
    return ForceCompensation(
        problem.name or "", force, without, unaware, aware, plan.complete, bool(plan.meta["snaps"])
    )
