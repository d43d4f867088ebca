"""Plans on a designed robot, of tasks that it was designed for and of others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.shared.manufacture import diameters_within
from ctr_nlp.models import Model
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import Robustness
from ctr_nlp.steer.horizon import solve_horizon
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.robust import solve_robust
from ctr_nlp.support.pool import Jobs, side_by_side
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array


def planned_on(
    tasks: Sequence[Problem],
    settings: Settings,
    nominal: bool,
    model: str | Model = "elastic",
    initial: Sequence[Array] = (),
    walls: bool = False,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> list[Plan]:
    """Plans of tasks on their robot as a design makes them: for tolerances unless nominal.

    walls: whether they are kept within the lumens; otherwise they are made as if there were no walls. initial: for
    each task, if given, a motion (T, 2d + 2) to start from. Robust plans start from others only where that does
    not do; nominal ones always, and the better of both is the plan. jobs: as of side_by_side. After Ctrl-C some
    plans may be missing.
    """
    given = [[motion] for motion in initial] or [list[Array]()] * len(tasks)
    pairs = list(zip(tasks, given, strict=True))
    settings = settings if walls else replace(settings, contact_weight=0.0)
    work, found = partial(_planned, settings, nominal, model), dict[int, Plan]()
    for number, plan in side_by_side(work, pairs, jobs):
        found[number] = plan
        if progress is not None:
            progress(len(found), len(tasks), f"plan of {tasks[number].name}")
    return [found[number] for number in sorted(found)]


def _planned(settings: Settings, nominal: bool, model: str | Model, pair: tuple[Problem, list[Array]]) -> Plan:
    task, initial = pair
    if nominal:
        starts = ([], initial) if initial else ([],)
        found = [solve_horizon(task, model=model, settings=settings, initial=start) for start in starts]
        return min(found, key=lambda plan: (not plan.success.all(), e3(plan) or math.inf))
    return solve_robust(task, model=model, settings=settings, initial=initial)


def on_tubing_as_sold(plan: Plan, draws: int, seed: int) -> Robustness | None:
    """What becomes of a plan on draws whose diameters are off too, by as much as those of tubing that is sold.

    None where the tolerances of its robot say themselves by how much diameters are off.
    """
    robot, own = plan.robot, plan.robot.tolerances
    if own.covariance is not None or own.diameters(robot.d).any():
        return None
    sold = replace(own, diameter=tuple(max(diameters_within(tube.outer_diameter)) for tube in robot.tubes))
    told = replace(robot, tolerances=sold).to_dict()
    return replace(plan, meta=plan.meta | {"robot": told}).robustness(draws, seed)
