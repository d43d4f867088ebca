"""Plans on a designed robot, for the tasks that it was designed for and for others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ctr_nlp.models import Model
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.manufacture import diameter_tolerances
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import Robustness
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.robust import solve_robust
from ctr_nlp.support.pool import Jobs, run_in_parallel
from ctr_nlp.typing import Array


def plan_tasks(
    tasks: Sequence[Problem],
    settings: Settings,
    nominal: bool,
    model: str | Model = "elastic",
    initial: Sequence[Array] = (),
    walls: bool = False,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> list[Plan]:
    """Plan tasks on their robot as a design does: for the tolerances, unless nominal.

    Parameters
    ----------
    tasks : sequence of Problem
        Tasks, with the designed robot.
    settings : Settings
        Options of the plans.
    nominal : bool
        Whether plans are made for the nominal robot alone.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``.
    initial : sequence of ndarray
        For each task, if given, a motion (T, 2d + 2) to start from. Robust plans start from others only where that
        one fails; nominal ones always do, and the better of both is the plan.
    walls : bool
        Whether plans are kept within the lumens; otherwise they are made as if there were no walls.
    jobs : int or distributed.Client
        Number of processes, or the cluster, on which plans are made.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each plan.

    Returns
    -------
    list of Plan
        In the order of the tasks; after Ctrl-C some may be missing.
    """
    given = [[motion] for motion in initial] or [list[Array]()] * len(tasks)
    pairs = list(zip(tasks, given, strict=True))
    settings = settings if walls else replace(settings, contact_weight=0.0)
    work = partial(_plan_task, settings, nominal, model)
    found = dict[int, Plan]()
    for number, plan in run_in_parallel(work, pairs, jobs):
        found[number] = plan
        if progress is not None:
            progress(len(found), len(tasks), f"plan of {tasks[number].name}")
    return [found[number] for number in sorted(found)]


def _plan_task(settings: Settings, nominal: bool, model: str | Model, pair: tuple[Problem, list[Array]]) -> Plan:
    """Return the plan of one task, from motions to start from, if any."""
    task, initial = pair
    if nominal:
        starts = ([], initial) if initial else ([],)
        found = [solve_horizon(task, model=model, settings=settings, initial=start) for start in starts]
        # Plans with failed frames last, whatever their error; the error of a plan without any shape counts as
        # infinite.
        return min(found, key=lambda plan: (not plan.success.all(), math.inf if e3(plan) is None else e3(plan)))
    return solve_robust(task, model=model, settings=settings, initial=initial)


def on_tubing_as_sold(plan: Plan, draws: int, seed: int) -> Robustness | None:
    """Simulate a plan on robots whose diameters are off as well, within the tolerances of tubing as it is sold.

    Parameters
    ----------
    plan : Plan
        The plan.
    draws : int
        Number of robots.
    seed : int
        Their seed.

    Returns
    -------
    Robustness or None
        Results on them; None where the tolerances of the robot already include diameters or a covariance.
    """
    robot = plan.robot
    own = plan.robot.tolerances
    if own.covariance is not None or own.diameters(robot.d).any():
        return None
    # A tube has one tolerance for both diameters here: the larger of those with which they are sold.
    sold = replace(own, diameter=tuple(max(diameter_tolerances(tube.outer_diameter)) for tube in robot.tubes))
    told = replace(robot, tolerances=sold).to_dict()
    # A plan reads its robot, and so the samples, from its metadata.
    return replace(plan, meta=plan.meta | {"robot": told}).robustness(draws, seed)
