"""Several robots for many tasks: which tasks share a robot.

Within walls, tubes are chosen by the ends that they reach (reaching_tubes.py). Without, tasks are divided by
Lloyd's algorithm on their errors (Least squares quantization in PCM, IEEE Transactions on Information Theory
28(2), 1982). It alternates two steps: design tubes for every group, then assign every task to the tubes that
follow it best. Up to local minima of the designs, neither step raises the sum of squared errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.cluster.vq import kmeans2

from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.models import Model
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.design import DesignedTubes
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.measures import e3
from ctr_nlp.planning.horizon import solve_horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.robot import Robot
from ctr_nlp.support.interrupt import deferred_interrupt, end_if_interrupted
from ctr_nlp.support.pool import Jobs, run_in_parallel
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.tube_design.reaching_tubes import ReachingTubes, choose_reaching_tubes
from ctr_nlp.tube_design.request import draft, search_for
from ctr_nlp.tube_design.search import DesignSearch
from ctr_nlp.tube_design.starts import generate_start_tubes
from ctr_nlp.typing import Array, Index

MAX_GROUPING_ROUNDS, MIN_GROUPING_IMPROVEMENT = 6, 5e-3
"""Largest number of rounds, and the relative improvement of the error below which they end."""
PATH_FEATURE_STRIDE = 5
"""Stride with which the 101 points of a target's last frame are taken for the first comparison of paths."""

REACH_BEFORE_SHAPE = 1e6
"""Error, mm, beyond any of a shape, of a task whose end is out of reach."""

Group = tuple[int, ...]
"""Numbers of the tasks that share a robot, from 0."""


def divide_problems(
    problems: Sequence[Problem],
    robots: int,
    *,
    model: str | Model = "elastic",
    rules: Manufacture | None = None,
    fixed: Sequence[str] = (),
    constant_curvature: bool = False,
    walls: bool = False,
    jobs: Jobs = 1,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    progress: Progress | None = None,
) -> list[list[Problem]]:
    """Divide problems into groups, each to be given a robot of its own by :func:`design`.

    Without walls, the first groups are those of similar paths (k-means). Then tubes are designed for each group,
    on the frames of drafts and for the nominal robot, and every problem is assigned to the tubes that follow it
    best. These two steps are repeated while more problems are followed, or the root mean square of the errors
    falls.

    Within walls, tubes are designed for the last frames of problems, for one robot after the other, so that as
    many ends as possible come within reach of the nominal robots. Every problem is then assigned to the robot that
    reaches its end best, or misses it by least.

    Parameters
    ----------
    problems : sequence of Problem
        Tasks, which share one robot.
    robots : int
        Number of groups, from 1 to the number of problems.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``.
    rules : Manufacture, optional
        Rules of manufacture; the defaults of :class:`Manufacture` where None.
    fixed : sequence of str
        Names of numbers that stay as they are, such as ``"outer_diameter_1"``.
    constant_curvature : bool
        Whether curved parts are arcs; otherwise their curvature is linear in arc length.
    walls : bool
        Whether the problems' walls and the tip's arrival count.
    jobs : int or distributed.Client
        Number of processes, or the cluster, for the designs of groups.
    settings : Settings
        `seed` of k-means, and `stability_margin`, the least of every robot.
    progress : callable, optional
        Called as ``progress(done, total, note)`` after each division.

    Returns
    -------
    list of list of Problem
        One list a robot; none is empty. Within walls the problems of a group come with the tubes that were found
        for it, from which :func:`design` then starts.

    Raises
    ------
    LoadError, OptionError, ProblemError, RobotError
        An option is out of range, or the problems do not suit a design.
    KeyboardInterrupt
        Ctrl-C was pressed.

    See Also
    --------
    assign_to_robots : Assign further problems to robots that were designed.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> tasks = [named_problem("arc", frames=3), named_problem("line", frames=3)]
    >>> [len(group) for group in ctr.divide_problems(tasks, robots=1)]
    [2]
    >>> groups = ctr.divide_problems(tasks, robots=2, model="dominant")  # doctest: +SKIP
    >>> [len(group) for group in groups]  # doctest: +SKIP
    [1, 1]
    """
    tasks = list(problems)
    count = whole_number(OptionError, "robots", robots)
    if count > len(tasks):
        raise OptionError(
            f"robots is {count} and there are {len(tasks)} problems; give at most one robot a problem"
        )
    search = search_for(tasks, model, rules, fixed, constant_curvature, settings, walls)
    if count == 1:
        return [tasks]
    if walls:
        found_tubes = choose_reaching_tubes(search, count, settings.seed, jobs, progress)
        return [
            [replace(tasks[i], robot=search.tubes.robot_of(one.p)) for i in group]
            for one, group in zip(found_tubes, _groups(_assign_by_reach(found_tubes), count), strict=True)
        ]
    search = replace(search, tasks=tuple(draft(task) for task in search.tasks))
    groups = _groups(_cluster_paths(search.tasks, count, settings.seed), count)
    begun = [_first_tubes(search.tubes, settings.seed)] * count
    least = (len(tasks), np.inf)
    for number in range(MAX_GROUPING_ROUNDS):
        found = dict(
            run_in_parallel(
                partial(_design_for_group, search.portable), list(zip(groups, begun, strict=True)), jobs
            )
        )
        end_if_interrupted()
        # Groups change little from round to round: their last tubes are good starts for the next ones.
        begun = [found[k].p for k in range(count)]
        errors = np.array([found[k].errors for k in range(count)])
        unserved, rms = _summarise_errors(errors)
        if progress is not None:
            left = f", {unserved} not followed" if unserved else ""
            progress(number + 1, MAX_GROUPING_ROUNDS, f"groups of problems, error {rms:.3f} mm{left}")
        # Fewest tasks that no robot follows first, then the error: an error over fewer tasks is no progress.
        if (unserved, rms) >= (least[0], (1 - MIN_GROUPING_IMPROVEMENT) * least[1]):
            break
        least = (unserved, rms)
        before = groups
        groups = _groups(assign_by_errors(errors), count)
        # Nothing moved: tubes would be designed for the same groups again.
        if groups == before:
            break
    return [[tasks[i] for i in group] for group in groups]


def assign_to_robots(
    problems: Sequence[Problem],
    robots: Sequence[Robot],
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    jobs: Jobs = 1,
    model: str | Model = "elastic",
    walls: bool = False,
) -> Index:
    """Assign each problem to the robot that follows it best, on some of its frames and without tolerances.

    Parameters
    ----------
    problems : sequence of Problem
        Tasks; their own robots do not count.
    robots : sequence of Robot
        Robots to choose from.
    settings : Settings
        Options of the plans.
    jobs : int or distributed.Client
        Number of processes, or the cluster, on which plans are made.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``.
    walls : bool
        Whether walls and the tip's arrival count.

    Returns
    -------
    ndarray of int
        For each problem the number of its robot, from 0. A robot to which no problem is assigned gets the one with
        the largest error among those whose robots have another.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C was pressed.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> robots = [ctr.table_i_robot(), ctr.table_i_robot(literal=True)]
    >>> tasks = [named_problem("arc", frames=3), named_problem("line", frames=3)]
    >>> ctr.assign_to_robots(tasks, robots, model="dominant")
    array([0, 1])
    """
    pairs = [replace(draft(task), robot=robot) for robot in robots for task in problems]
    found = dict(run_in_parallel(partial(_plan_error, settings, model, walls), pairs, jobs))
    end_if_interrupted()
    return assign_by_errors(np.array([found[k] for k in range(len(pairs))]).reshape(len(robots), len(problems)))


def assign_by_errors(errors: Array) -> Index:
    """Assign each task to a robot by their errors, so that every robot has at least one.

    Parameters
    ----------
    errors : ndarray
        Errors (k, n) of n tasks on k robots, mm; NaN where a robot cannot follow a task.

    Returns
    -------
    ndarray of int
        Numbers (n,) of robots, from 0.
    """
    errors = np.nan_to_num(errors, nan=np.inf)
    choice = errors.argmin(axis=0)
    for robot in range(len(errors)):
        if not (choice == robot).any():
            shared = np.bincount(choice, minlength=len(errors))[choice] > 1
            # Tasks that are alone on their robot (-1) must not leave it empty in turn.
            choice[np.where(shared, errors.min(axis=0), -1.0).argmax()] = robot
    return choice


def _assign_by_reach(robots: Sequence[ReachingTubes]) -> Index:
    """Assign each task to the tubes that miss its end by least or, among equals, follow it best there."""
    out_of_reach = np.stack([one.excess for one in robots])
    shape = np.array(
        [[np.inf if one is None else one.result.objective for one in each.last_frames] for each in robots]
    )
    # Objectives, mm^2, decide among the ends within reach alone.
    return assign_by_errors(np.where(out_of_reach > 0, REACH_BEFORE_SHAPE * (1 + out_of_reach), np.sqrt(shape)))


def _summarise_errors(errors: Array) -> tuple[int, float]:
    """Return how many tasks no robot follows and the RMS, mm, of the best errors of the others, from errors (k, n)
    in mm with NaN where a robot cannot follow a task.
    """
    best = np.nan_to_num(errors, nan=np.inf).min(axis=0)
    known = np.isfinite(best)
    return int((~known).sum()), float(np.sqrt(np.mean(best[known] ** 2))) if known.any() else np.inf


def _cluster_paths(tasks: Sequence[Problem], count: int, seed: int) -> Index:
    """Return groups (n,), from 0, of tasks with similar paths, whatever plane they bend in first and to which
    side.
    """
    features = np.array([_normalise_path(task.target_frames[-1].points) for task in tasks]).reshape(len(tasks), -1)
    # k-means may leave a group empty, for which no robot can be designed: assign_by_errors then fills it.
    centres, labels = kmeans2(features, count, minit="++", rng=np.random.default_rng(seed))
    return (
        assign_by_errors(np.linalg.norm(features[None] - centres[:, None], axis=2))
        if len(set(labels)) < count
        else labels
    )


def _normalise_path(points: Array) -> Array:
    """Return some points of a path, turned about z to lead towards +x, and mirrored if it then ends towards -y."""
    # Paths that differ by such a turn and mirror are the same task for a robot that can turn about z. x + iy makes
    # the turn a product; weights that grow along the path let its end decide the side.
    aside = points[:, :2].mean(axis=0)
    turned = np.exp(-1j * np.angle(complex(*aside))) * (points[:, 0] + 1j * points[:, 1])
    side = 1.0 if (turned.imag * np.arange(len(turned))).sum() >= 0 else -1.0
    return np.stack([turned.real, side * turned.imag, points[:, 2]], axis=1)[::PATH_FEATURE_STRIDE]


def _groups(choice: Index, count: int) -> tuple[Group, ...]:
    """Return the tasks of each of `count` robots, by which robot each task takes (n,)."""
    return tuple(tuple(np.flatnonzero(choice == robot).tolist()) for robot in range(count))


def _first_tubes(tubes: DesignedTubes, seed: int) -> Array:
    """Return unknowns (P,) of tubes to start from: the robot's own, or random ones where those break a rule."""
    starts = (p for _, p in generate_start_tubes(tubes, seed))
    return next((p for p in starts if tubes.satisfies_rules(p)), tubes.nominal_unknowns)


class _GroupDesign(NamedTuple):
    """Tubes p (P,) for a group of tasks, and errors (n,) of all tasks on them, mm; NaN for those not followed."""

    p: Array
    errors: Array


def _design_for_group(search: DesignSearch, group: tuple[Group, Array]) -> _GroupDesign:
    """Return tubes for the tasks of a group, from given ones, and how well all tasks are followed on them."""
    numbers, p = group
    with deferred_interrupt() as interrupted:
        # Tubes are solved for the tasks of the group alone, and then tried on all tasks.
        own = replace(search, tasks=tuple(search.tasks[i] for i in numbers), stop=interrupted)
        begun = own.shape_alone.start("tubes of the group", p)
        settled = None if begun is None or interrupted() else own.run_from_start(begun)
        p = p if settled is None else settled.p
        try:
            plans = search.plan_on_tubes(p)
            errors = search.motions_of(p, plans).error
        except CtrError:
            return _GroupDesign(p, np.full(len(search.tasks), np.nan))
        return _GroupDesign(p, errors)


def _plan_error(settings: Settings, model: str | Model, walls: bool, task: Problem) -> float:
    """Return the error of a problem's plan, mm: e3 or, with walls, the root of its mean objective; NaN where there
    is none or a frame of it was not solved.
    """
    try:
        plain = settings if walls else replace(settings, contact_weight=0.0, arrival_weight=0.0)
        plan = solve_horizon(task, model=model, settings=plain)
    except CtrError:
        return np.nan
    found = float(np.sqrt(plan.objective.mean())) if walls else e3(plan)
    return found if plan.success.all() and found is not None else np.nan
