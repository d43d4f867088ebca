"""Choice among robots: which of them reaches the end of a path, which comes nearest, and what binds.

Each robot is planned with the priorities of every plan: the wall, then the tip's arrival, then the shape's error.
Its plan is judged by its verdicts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ctr_nlp.exceptions import CtrError
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.verdicts import NOT_CHECKED, REACHED_VERDICT_NAMES, YES, Verdict
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.robot import Robot
from ctr_nlp.robust import solve_robust
from ctr_nlp.support.pool import Jobs, run_in_parallel


@dataclass(frozen=True)
class RobotChoice:
    """How well one robot reaches the end of a path.

    Attributes
    ----------
    name : str
        Name of the robot.
    robot : Robot
        The robot.
    cost : float
        Root of the mean objective of a frame, mm: the shape's error with the costs of contact and arrival;
        infinite where there is no plan.
    plan : Plan or None
        Its plan; None where none could be made.
    reason : str
        Why there is no plan; empty where there is one.
    """

    name: str
    robot: Robot
    cost: float
    plan: Plan | None
    reason: str = ""

    @property
    def reaches(self) -> bool:
        """Whether the end is reached, as far as it was checked: no verdict that counts is *no*."""
        return self.plan is not None and self.binding is None and self.plan.verdicts.solved.word == YES

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Order of robots, the best first: whether it reaches the end, its plan's failed verdicts, its cost."""
        failed = math.inf if self.plan is None else len(self.plan.verdicts.failed_names)
        return not self.reaches, failed, self.cost

    @property
    def binding(self) -> Verdict | None:
        """The first verdict that keeps the robot from the end; None where there is none, or no plan."""
        if self.plan is None:
            return None
        counted = [getattr(self.plan.verdicts, name) for name in REACHED_VERDICT_NAMES]
        # Samples that were not simulated are no reason against a robot; everything else has to be checked.
        wanted = [one for one in counted if one is not self.plan.verdicts.holds or one.word != NOT_CHECKED]
        return next((one for one in wanted if one.word != YES), None)


def compare_robots(
    problem: Problem,
    robots: Mapping[str, Robot],
    *,
    robust: bool = False,
    samples: int = 200,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> list[RobotChoice]:
    """Plan one problem for several robots on the elastic model, and compare the plans.

    Parameters
    ----------
    problem : Problem
        The path and its walls; its own robot does not count.
    robots : mapping of str to Robot
        Robots by name.
    robust : bool
        Whether plans are made for the tolerances and simulated on samples, which takes about a minute a robot.
    samples : int
        Number of simulated robots of each robust plan.
    settings : Settings
        Options of the plans.
    jobs : int or distributed.Client
        Number of processes, or the cluster, on which plans are made.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each robot.

    Returns
    -------
    list of RobotChoice
        Robots that reach the end first; then those whose plans fail fewest verdicts; then the least cost. After
        Ctrl-C some are missing.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> problem = named_problem("arc", frames=3)
    >>> robots = {"paper": ctr.table_i_robot(), "literal": ctr.table_i_robot(literal=True)}
    >>> [one.name for one in ctr.compare_robots(problem, robots)]  # doctest: +SKIP
    ['paper', 'literal']
    """
    work = partial(_choice_of, problem, settings, samples if robust else None)
    found = list[RobotChoice]()
    if progress is not None:
        progress(0, len(robots), ", ".join(robots))
    for _, one in run_in_parallel(work, list(robots.items()), jobs):
        found.append(one)
        if progress is not None:
            planned = {each.name for each in found}
            progress(len(found), len(robots), ", ".join(name for name in robots if name not in planned))
    return sorted(found, key=lambda one: one.rank)


def choose_robot(
    problem: Problem,
    robots: Mapping[str, Robot],
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    *,
    jobs: Jobs = 1,
    progress: Progress | None = None,
) -> RobotChoice | None:
    """Choose the robot that fits a path best, the first one of :func:`compare_robots`.

    Parameters
    ----------
    problem : Problem
        The path and its walls; its own robot does not count.
    robots : mapping of str to Robot
        Robots by name.
    settings : Settings
        Options of the plans.
    jobs : int or distributed.Client
        Number of processes, or the cluster, on which plans are made.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each robot.

    Returns
    -------
    RobotChoice or None
        The best robot; None where none of them can be planned for.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> robots = {"paper": ctr.table_i_robot(), "literal": ctr.table_i_robot(literal=True)}
    >>> ctr.choose_robot(named_problem("arc", frames=3), robots).name
    'paper'
    """
    found = compare_robots(problem, robots, settings=settings, jobs=jobs, progress=progress)
    return next((one for one in found if math.isfinite(one.cost)), None)


def _choice_of(problem: Problem, settings: Settings, samples: int | None, named: tuple[str, Robot]) -> RobotChoice:
    """Return how well one robot, given with its name, reaches the end; samples: None for the nominal robot."""
    name, robot = named
    try:
        task = replace(problem, robot=robot)
        plan = solve_horizon(task, settings=settings)
        cost = float(np.sqrt(plan.objective.mean())) if plan.success.all() else math.inf
        if samples is not None:
            # Costs are those of nominal plans, which can be compared.
            plan = solve_robust(task, settings=settings, initial=[plan.q] if plan.success.all() else ())
        return RobotChoice(name, robot, cost, plan if samples is None else plan.check(samples))
    except CtrError as error:
        return RobotChoice(name, robot, math.inf, None, str(error))
