"""Robust plans on robots that are not quite known while a force comes and goes at the tip, from any side."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.loads import Load
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.robot.draws import drawn
from ctr_nlp.simulation.drawn import lost_draws
from ctr_nlp.steer import solve_horizon
from ctr_nlp.steer.robust import solve_robust
from ctr_nlp.studies.borne.tip import directions_of
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Flags

DRAWS, SEED, SIDES = 200, 1, 26
"""Robots that a plan is tried on, which its own search does not see, and the sides from which a force comes."""
ACROSS = (0.0, 1.0, 0.0)
"""The direction of a force that is known."""
MARGIN = Settings(stability_margin=0.3)
"""Of plans that know it, and of those without it that they are compared with: about what robust plans have."""


@dataclass(frozen=True)
class Withstood:
    """What a robust plan does under a force of force N, planned for one of planned_for N.

    certified: whether the search's own draws bore it. e3: as planned, mm; e3_drawn: its mean over draws that each
    bear the force from one side. lost: draws that are lost under it from any of 26 sides; lost_without: under
    none, both of draws. seconds: of planning, process time.
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


def lost_from_any_side(plan: Plan, force: float, draws: int = DRAWS, sides: int = SIDES) -> Flags:
    """Which draws (n,) of a plan's robot are lost while a force, N, comes in the first frame and goes in the last
    one, from any of 6, 14 or 26 sides; a force of 0 has none.
    """
    robot = replace(plan.robot, tolerances=replace(plan.robot.tolerances, tip_force=0.0))
    known, lost = drawn(robot, draws, SEED), np.zeros(draws, dtype=bool)
    for direction in directions_of(sides) if force else np.zeros((1, 3)):
        pushed = replace(known, forces=np.tile(force * direction, (draws, 1)))
        lost |= lost_draws(robot, pushed, plan.q, "elastic") > 0
    return lost


def withstood(
    problem: Problem,
    planned_for: float,
    forces: Sequence[float],
    draws: int = DRAWS,
    most_lost: float = MOST_LOST,
) -> list[Withstood]:
    """One robust plan of a problem, and what it does under each of some forces, N; most_lost: as solve_robust."""
    tolerances = replace(problem.robot.tolerances, tip_force=planned_for)
    begin = time.process_time()
    tolerant = replace(problem, robot=replace(problem.robot, tolerances=tolerances))
    plan = solve_robust(tolerant, most_lost=most_lost)
    seconds = time.process_time() - begin
    without = int(lost_from_any_side(plan, 0.0, draws).sum())
    return [
        Withstood(
            problem.name or "",
            planned_for,
            force,
            plan.complete,
            bool(plan.meta.get("certificate", {}).get("held", False)),
            summary(plan)["e3"],
            _drawn_e3(plan, force, draws),
            draws,
            int(lost_from_any_side(plan, force, draws).sum()),
            without,
            seconds,
        )
        for force in forces
    ]


def _drawn_e3(plan: Plan, force: float, draws: int) -> float:
    """The mean e3 of draws that each bear the force from one side, mm."""
    tolerances = replace(plan.robot.tolerances, tip_force=force)
    told = replace(plan, meta=plan.meta | {"robot": replace(plan.robot, tolerances=tolerances).to_dict()})
    errors = told.robustness(draws, SEED).errors
    return math.nan if errors is None else errors.mean


@dataclass(frozen=True)
class Compensated:
    """Plans of a problem without a force and for a known one, N: e3 of both, mm, of the first under the force, and
    whether the second snaps anywhere while the force comes, stays and goes.
    """

    problem: str
    force: float
    e3_without: float
    e3_unaware: float
    e3: float
    solved: bool
    snaps: bool


def compensated(problem: Problem, force: float) -> Compensated:
    """A problem planned with and without knowledge of a force across the robot."""
    load = Load(tuple(force * part for part in ACROSS))
    free = solve_horizon(problem, model="elastic", settings=MARGIN)
    plan = solve_horizon(problem, model=Loaded(load), settings=MARGIN)
    without, unaware, aware = (summary(each)["e3"] for each in (free, free.under(load), plan))
    return Compensated(problem.name or "", force, without, unaware, aware, plan.complete, bool(plan.meta["snaps"]))
