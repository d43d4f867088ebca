"""Tubes designed together with the motions of several tasks: what is asked for, and what comes of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ctr_nlp.codesign.chosen import best_planned, certified, for_all_frames, tolerant, tolerated
from ctr_nlp.codesign.doubts import doubts
from ctr_nlp.codesign.plans import planned_on
from ctr_nlp.codesign.request import draft, search_for
from ctr_nlp.codesign.rounding import FINALISTS, Stocked, in_stock
from ctr_nlp.codesign.search import Candidate, DesignSearch, Robots, alone, error_of
from ctr_nlp.codesign.starts import starts as first_tubes
from ctr_nlp.codesign.stock import StockTube, nearest
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.shared.design import Kept
from ctr_nlp.formulations.shared.manufacture import Manufacture
from ctr_nlp.models import Model, bearing
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.steer.motions import filled
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.starts.search import drafted
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.pool import Jobs, side_by_side
from ctr_nlp.support.values import whole_number
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

STARTS = 4
"""Tubes that a design starts from."""
BINDING = 1e-3
"""A rule binds where it is kept by less than this part of its bound."""
TOLD = 5e-4
"""Least gain of a rule that is remarked."""


@dataclass(frozen=True)
class Remark:
    """A rule that binds, and by what part the tasks' root mean square error would fall if it were eased by a
    tenth.
    """

    rule: Kept
    gain: float

    def __str__(self) -> str:
        """In a sentence."""
        rule = self.rule
        bound = min(rule.lower, rule.upper, key=lambda bound: abs(bound - rule.value))
        told = f"{rule.name} is at its bound, {abs(bound):.4g}"
        return f"{told}; a tenth of that more room would lower e3 by {self.gain:.1%}"


@dataclass(frozen=True)
class Design:
    """A designed robot.

    names: of the tasks; plans: one for each, on the robot, unless Ctrl-C came first; before: e3 of each task's
    motion on the robot that the design began with, mm, over the frames of a draft, None where it has none; rules:
    what can be made, and how far it is used; remarks: the rules that bind; tried: what came of every start;
    interrupted: whether Ctrl-C ended the work; stocked: what to buy and what it loses, where tubes were rounded to
    a stock; doubts: sentences on tubes that are not used or not sold.
    """

    robot: Robot
    names: tuple[str, ...]
    plans: tuple[Plan, ...]
    before: tuple[float | None, ...]
    rules: tuple[Kept, ...]
    remarks: tuple[Remark, ...]
    tried: tuple[dict[str, Any], ...]
    interrupted: bool
    stocked: Stocked | None = None
    doubts: tuple[str, ...] = ()


def design(
    problems: Sequence[Problem],
    *,
    nominal: bool = False,
    model: str | Model = "elastic",
    rules: Manufacture | None = None,
    fixed: Sequence[str] = (),
    constant_curvature: bool = False,
    starts: int = STARTS,
    walls: bool = False,
    jobs: Jobs = 1,
    stock: Sequence[StockTube] | None = None,
    settings: Settings = DEFAULTS,
    progress: Progress | None = None,
) -> Design:
    """The tubes with which one robot follows all problems' targets best, and a plan for each problem on them.

    The root mean square of the problems' e3 is made small over tubes and motions at once: pre-curvatures, lengths
    of curved parts and diameters belong to all problems, q of every frame to its own
    (formulations/shared/design.py). The problems' robots must be equal; theirs are the limits, the tolerances and
    the first tubes.
    nominal: whether the tolerances are left out; otherwise motions are shared by robots that stand for all within
    them, and each plan is certified on draws (solve_robust). Under a load (model=Loaded(load)), tubes and motions
    are those that follow the targets best while they bear it; a force that may act at the tip (tip_force of the
    tolerances) counts by how far it bends the robot. rules: of manufacture. fixed: names of numbers that
    stay as they are, such as outer_diameter_1. constant_curvature: whether curved parts are arcs; otherwise their
    curvatures are linear in arc length. starts: tubes that are tried, the robot's own and random ones
    (settings.seed). walls: whether the plans are kept within the lumens; tubes are solved for as if there were no
    walls. jobs: in how many processes starts, tasks and plans are worked on, or a distributed.Client, on whose
    cluster they are: of a cohort of dozens of problems only what all of them share is then solved for here.
    stock: tubing (read_stock) to
    which tubes are rounded, with lengths and curvatures that can be made; without it diameters are free.
    settings.stability_margin: the least of every robot. On the dominant model stiffness does not count, and
    diameters are found by the rules alone. Ctrl-C ends the work; the design is then the best so far,
    marked as interrupted, and plans may be missing. Raises LoadError, OptionError, ProblemError, RobotError.
    """
    count = whole_number(OptionError, "starts", starts)
    with deferred_interrupt() as interrupted:
        whole = search_for(problems, model, rules, fixed, constant_curvature, settings)
        whole, first = replace(whole, stop=interrupted, jobs=jobs), whole.tasks[0].robot
        if not nominal:
            bearing(whole.model, first.tolerances.tip_force > 0).check(first)
        if stock is not None:  # what cannot nest is refused before anything is solved
            nearest(stock, whole.tubes, whole.tubes.own, whole.pushed)
        search = replace(whole, tasks=tuple(draft(task) for task in whole.tasks))
        begun, found = _tried(search, count, settings.seed, jobs, progress)
        tried = [one for one in (begun, *found) if one is not None]
        if not tried:
            raise ProblemError("no tubes were found on which all problems can be followed; give more starts")
        plan = partial(_plans, whole, settings, nominal, model, walls, jobs, progress)
        if nominal:
            best, planned = best_planned(tried, whole, plan)
        else:
            best, planned = certified(tried, search, plan)
        stocked = None
        if stock is not None and not interrupted():
            finish = partial(_finished, tasks=whole.tasks if nominal else None)
            rounded = in_stock(best, search, stock, finish, FINALISTS if nominal else 1)
            if rounded is not None:
                (best, stocked), planned = rounded, []
        planned = planned or plan(best)
        robot = whole.tubes.robot_of(best.p)
        stopped = interrupted()
    kept = tuple(search.tubes.kept(best.p))
    return Design(
        robot=robot,
        names=tuple(task.name for task in whole.tasks),
        plans=tuple(planned),
        before=(None,) * len(whole.tasks) if begun is None else _known(begun.motions.e3),
        rules=kept,
        remarks=_remarks(best, kept),
        tried=tuple(_told(one) for one in tried),
        interrupted=stopped,
        stocked=stocked,
        doubts=doubts(robot, planned, stocked is not None),
    )


def _tried(
    search: DesignSearch, count: int, seed: int, jobs: Jobs, progress: Progress | None
) -> tuple[Candidate | None, list[Candidate]]:
    """The robot's own tubes as they are, and what came of every start that led anywhere.

    Starts are worked on side by side where there are as many as processes; otherwise the tasks of each are.
    """
    begun, found = dict[int, Candidate | None](), dict[int, Candidate]()
    starts = list(itertools.islice(first_tubes(search.tubes, seed), count))
    apart, within = (jobs, 1) if isinstance(jobs, int) and len(starts) >= jobs else (1, jobs)
    alike = replace(search.portable, jobs=within)
    for number, (before, after) in side_by_side(partial(_settled, alike), starts, apart):
        begun[number] = before
        if after is not None:
            found[number] = after
        if progress is not None:
            progress(len(begun), len(starts), f"tubes from {starts[number][0]}")
    return begun.get(0), [found[number] for number in sorted(found)]


def _settled(search: DesignSearch, start: tuple[str, Array]) -> tuple[Candidate | None, Candidate | None]:
    """What tubes do as they are, and what comes of them."""
    with deferred_interrupt() as interrupted:
        search = replace(search, stop=interrupted)
        begun = search.start(*start)
        return begun, None if begun is None or interrupted() else search.settled(begun)


def _finished(
    tried: Sequence[Candidate], search: DesignSearch, tasks: tuple[Problem, ...] | None
) -> tuple[Candidate, DesignSearch, Robots]:
    """Tubes for all frames of tasks, or without these for the tolerances; with what they were found by.

    Raises ProblemError where no robots within the tolerances share motions on them.
    """
    if tasks is None:
        found = next(tolerant(tried, search), None)
        if found is None:
            raise ProblemError("no motions were found that all robots within the tolerances share")
        return found, search, tolerated
    search = replace(search, tasks=tasks)
    return for_all_frames(min(tried, key=error_of), search), search, alone


def _plans(
    whole: DesignSearch,
    settings: Settings,
    nominal: bool,
    model: str | Model,
    walls: bool,
    jobs: Jobs,
    progress: Progress | None,
    best: Candidate,
) -> list[Plan]:
    """Those of all tasks on the tubes of a candidate."""
    tasks = whole.on(whole.tubes.robot_of(best.p))
    return planned_on(tasks, settings, nominal, model, _motions(best, whole), walls, jobs, progress)


def _motions(best: Candidate, whole: DesignSearch) -> list[Array]:
    """Those (T, 2d + 2) of a candidate on the robots of all frames or of a draft, task by task over all frames."""
    picked = [drafted(task.frames) for task in whole.tasks]
    if len(best.motions.q) == sum(task.frames for task in whole.tasks):
        return whole.each(best.motions.q)
    parts = np.split(best.motions.q, np.cumsum([len(frames) for frames in picked])[:-1])
    return [filled(q, at, task.frames) for q, at, task in zip(parts, picked, whole.tasks, strict=True)]


def _known(errors: Array) -> tuple[float | None, ...]:
    """Numbers, and None for what is not known."""
    return tuple(error if math.isfinite(error) else None for error in errors.tolist())


def _told(one: Candidate) -> dict[str, Any]:
    return {
        "start": one.start,
        "e3": _known(one.motions.e3),
        "rms": one.motions.rms,
        "p": one.p.tolist(),
        "iterations": 0 if one.solution is None else one.solution.iterations,
        "solved": one.solved,
    }


def _remarks(best: Candidate, kept: Sequence[Kept]) -> tuple[Remark, ...]:
    """Of the rules that bind, those first that cost most."""
    if best.solution is None:
        return ()
    found, whole = list[Remark](), best.solution.objective
    for rule, price in zip(kept, best.solution.prices.tolist(), strict=True):
        bound = rule.upper if price > 0 else rule.lower
        if np.isfinite(bound) and abs(rule.value - bound) <= BINDING * max(abs(bound), BINDING):
            found.append(Remark(rule, abs(price) * abs(bound) / 10 / whole / 2))
    return tuple(sorted((one for one in found if one.gain >= TOLD), key=lambda one: -one.gain))
