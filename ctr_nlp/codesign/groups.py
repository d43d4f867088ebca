"""Several robots for many tasks: which tasks share one, by Lloyd's algorithm on the tasks' errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.cluster.vq import kmeans2

from ctr_nlp.codesign.request import draft, search_for
from ctr_nlp.codesign.search import DesignSearch
from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.shared.manufacture import Manufacture
from ctr_nlp.models import Model
from ctr_nlp.plan.measures import e3
from ctr_nlp.robot import Robot
from ctr_nlp.steer.horizon import solve_horizon
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.support.interrupt import deferred_interrupt, end_if_interrupted
from ctr_nlp.support.pool import Jobs, side_by_side
from ctr_nlp.support.values import whole_number
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array, Index

ROUNDS, ENOUGH = 6, 5e-3
"""Divisions that are tried, at most; no more where one lowers the error by less than this part of it."""
EVERY = 5
"""Of the 101 points of a target's last frame, those by which paths are compared at first."""

Group = tuple[int, ...]
"""Numbers of tasks that share a robot."""


def divided(
    problems: Sequence[Problem],
    robots: int,
    *,
    model: str | Model = "elastic",
    rules: Manufacture | None = None,
    fixed: Sequence[str] = (),
    constant_curvature: bool = False,
    jobs: Jobs = 1,
    settings: Settings = DEFAULTS,
    progress: Progress | None = None,
) -> list[list[Problem]]:
    """Problems in so many groups, each to be given a robot of its own (design).

    Groups of alike paths come first (k-means); then tubes are designed for each group, on some frames and without
    tolerances, every problem goes to the tubes that follow it best, and so on for as long as the root mean square
    of the errors falls (Lloyd, Least squares quantization in PCM, IEEE Transactions on Information Theory 28(2),
    1982). Options as of design. Raises OptionError, ProblemError; KeyboardInterrupt after Ctrl-C.
    """
    tasks = list(problems)
    count = whole_number(OptionError, "robots", robots)
    if count > len(tasks):
        raise OptionError(
            f"robots is {count} and there are {len(tasks)} problems; give at most one robot a problem"
        )
    search = search_for(tasks, model, rules, fixed, constant_curvature, settings)
    if count == 1:
        return [tasks]
    search = replace(search, tasks=tuple(draft(task) for task in search.tasks))
    groups = _groups(_alike(search.tasks, count, settings.seed), count)
    begun, least = [search.tubes.own] * count, (len(tasks), np.inf)
    for number in range(ROUNDS):
        found = dict(side_by_side(partial(_served, search), list(zip(groups, begun, strict=True)), jobs))
        end_if_interrupted()
        begun, errors = [found[k][0] for k in range(count)], np.array([found[k][1] for k in range(count)])
        unserved, rms = _how_well(errors)
        if progress is not None:
            progress(number + 1, ROUNDS, f"groups of problems, e3 {rms:.3f} mm")
        if (unserved, rms) >= (least[0], (1 - ENOUGH) * least[1]):
            break
        least, before, groups = (unserved, rms), groups, _groups(taken(errors), count)
        if groups == before:
            break
    return [[tasks[i] for i in group] for group in groups]


def suited(
    problems: Sequence[Problem],
    robots: Sequence[Robot],
    settings: Settings = DEFAULTS,
    jobs: Jobs = 1,
    model: str | Model = "elastic",
) -> Index:
    """Which of several robots, from 0, follows each problem best on some of its frames, without tolerances."""
    pairs = [replace(draft(task), robot=robot) for robot in robots for task in problems]
    found = dict(side_by_side(partial(_error, settings, model), pairs, jobs))
    end_if_interrupted()
    return taken(np.array([found[k] for k in range(len(pairs))]).reshape(len(robots), len(problems)))


def taken(errors: Array) -> Index:
    """Which robot each task takes, (n,) from 0, by their errors (k, n); NaN where a robot cannot follow it.

    A robot that no task would take gets the one that is followed worst of those whose robots keep another.
    """
    errors = np.nan_to_num(errors, nan=np.inf)
    choice = errors.argmin(axis=0)
    for robot in range(len(errors)):
        if not (choice == robot).any():
            shared = np.bincount(choice, minlength=len(errors))[choice] > 1
            choice[np.where(shared, errors.min(axis=0), -1.0).argmax()] = robot
    return choice


def _how_well(errors: Array) -> tuple[int, float]:
    """How many tasks no robot follows, by their errors (k, n), and the RMS in mm of the others on their best."""
    known = np.isfinite(errors).any(axis=0)
    best = np.nanmin(errors[:, known], axis=0) if known.any() else np.array([np.inf])
    return int((~known).sum()), float(np.sqrt(np.mean(best**2)))


def _alike(tasks: Sequence[Problem], count: int, seed: int) -> Index:
    """Groups (n,), from 0, of tasks with alike paths, whatever plane they begin to bend in and to which side."""
    features = np.array([_standing(task.samples[-1].points) for task in tasks]).reshape(len(tasks), -1)
    centres, labels = kmeans2(features, count, minit="++", rng=np.random.default_rng(seed))
    return taken(np.linalg.norm(features[None] - centres[:, None], axis=2)) if len(set(labels)) < count else labels


def _standing(points: Array) -> Array:
    """Some points of a path, turned about z to lead towards +x, and mirrored if it then ends towards -y."""
    aside = points[:, :2].mean(axis=0)
    turned = np.exp(-1j * np.angle(complex(*aside))) * (points[:, 0] + 1j * points[:, 1])
    side = 1.0 if (turned.imag * np.arange(len(turned))).sum() >= 0 else -1.0
    return np.stack([turned.real, side * turned.imag, points[:, 2]], axis=1)[::EVERY]


def _groups(choice: Index, count: int) -> tuple[Group, ...]:
    return tuple(tuple(np.flatnonzero(choice == robot).tolist()) for robot in range(count))


def _served(search: DesignSearch, group: tuple[Group, Array]) -> tuple[Array, Array]:
    """Tubes p for the tasks of a group, from given ones, and e3 (n,) of all tasks on them, mm."""
    numbers, p = group
    with deferred_interrupt() as interrupted:
        own = replace(search, tasks=tuple(search.tasks[i] for i in numbers), stop=interrupted)
        begun = own.start("tubes of the group", p)
        settled = None if begun is None or interrupted() else own.settled(begun)
        p = p if settled is None else settled.p
        try:
            return p, search.planned(p).e3
        except CtrError:
            return p, np.full(len(search.tasks), np.nan)


def _error(settings: Settings, model: str | Model, task: Problem) -> float:
    """e3 of a problem's plan, mm; NaN where there is none."""
    try:
        plain = replace(settings, contact_weight=0.0, arrival_weight=0.0)
        plan = solve_horizon(task, model=model, settings=plain)
    except CtrError:
        return np.nan
    found = e3(plan)
    return found if plan.success.all() and found is not None else np.nan
