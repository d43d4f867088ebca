"""Tubes designed together with the motions of several tasks: what is asked for, and what comes of it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ctr_nlp.codesign.doubts import doubts
from ctr_nlp.codesign.rounding import FINALISTS, Stocked, in_stock
from ctr_nlp.codesign.search import AGAIN, NEAR, Candidate, DesignSearch, least
from ctr_nlp.codesign.starts import starts as first_tubes
from ctr_nlp.codesign.stock import StockTube, nearest
from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.shared.design import DesignedTubes, Kept, varying
from ctr_nlp.formulations.shared.manufacture import Manufacture
from ctr_nlp.models import Model, model_named
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.plan.metrics import summary
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.steer.horizon import solve_horizon
from ctr_nlp.steer.motions import at_frames
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.robust import solve_robust
from ctr_nlp.steer.robust.tolerated import scenarios_of
from ctr_nlp.steer.starts.search import drafted
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.values import instance, whole_number
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

STARTS = 6
"""Tubes that a design starts from."""
GROWN = {0.5: (AGAIN, NEAR), 1.0: (NEAR, AGAIN)}
"""Parts of the tolerances for which tubes are designed one after the other, from a design without any, with first
barriers, mm^2, of which the next is tried where one leads to no solution."""
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
        name, bound = self.rule.name, self.rule.lower if np.isfinite(self.rule.lower) else self.rule.upper
        return f"{name} is at its bound, {bound:.4g}; a tenth of that more room would lower e3 by {self.gain:.1%}"


@dataclass(frozen=True)
class Design:
    """A designed robot. names: of the tasks; plans: one for each, on the robot; before (n,): e3 of the tasks'
    motions on the robot that the design began with, mm, over the frames of a draft; rules: what can be made, and
    how far it is used; remarks: the rules that bind; tried: what came of every start; interrupted: whether Ctrl-C
    ended the work; stocked: what to buy and what it loses, where tubes were rounded to a stock; doubts: sentences
    on tubes that are not used or not sold.
    """

    robot: Robot
    names: tuple[str, ...]
    plans: tuple[Plan, ...]
    before: Array
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
    stock: Sequence[StockTube] | None = None,
    settings: Settings = DEFAULTS,
    progress: Progress | None = None,
) -> Design:
    """The tubes with which one robot follows all problems' targets best, and a plan for each problem on them.

    The root mean square of the problems' e3 is made small over tubes and motions at once: pre-curvatures, lengths
    of curved parts and diameters belong to all problems, q of every frame to its own
    (formulations/shared/design.py). The problems' robots must be equal; theirs are the limits, the tolerances and
    the first tubes. The lumen's wall does not count.
    nominal: whether the tolerances are left out; otherwise motions are shared by robots that stand for all within
    them, and each plan is certified on draws (solve_robust). rules: of manufacture. fixed: names of numbers that
    stay as they are, such as outer_diameter_1. constant_curvature: whether curved parts are arcs; otherwise their
    curvatures are linear in arc length. starts: tubes that are tried, the robot's own and random ones
    (settings.seed). stock: tubing (read_stock) to which tubes are rounded, with lengths and curvatures that can be
    made; without it diameters are free. settings.stability_margin: the least of every robot. Ctrl-C ends the work;
    the design is then the best so far, marked as interrupted. Raises OptionError, ProblemError, RobotError.
    """
    tasks = _checked(problems, settings)
    described, count = model_named(model, "model of a design"), whole_number(OptionError, "starts", starts)
    if not described.several_equilibria:
        raise OptionError(
            f"model of a design is {described.name}; tubes' diameters matter on the elastic one alone"
        )
    robot = tasks[0].robot if constant_curvature else varying(tasks[0].robot)
    tubes = DesignedTubes(robot, rules or Manufacture(), tuple(fixed))
    if stock is not None:
        nearest(stock, tubes, tubes.own)  # refuses what cannot nest before anything is solved
    tasks = tuple(replace(task, robot=robot) for task in tasks)
    with deferred_interrupt() as interrupted:
        drafts = tuple(_draft(task) for task in tasks)
        margin = 0.0 if settings.stability_margin is None else settings.stability_margin
        search = DesignSearch(drafts, tubes, described, margin, interrupted)
        tried = _tried(search, count, settings.seed, progress)
        best = least([one for one in tried if one is not None])
        if best is None:
            raise ProblemError("no tubes were found on which all problems can be followed; give more starts")
        before = tried[0].motions.e3 if tried[0] is not None else np.full(len(tasks), np.nan)
        finish = partial(_finished, tasks=tasks if nominal else None)
        best, stocked = finish(best, search)[0], None
        if stock is not None and not interrupted():
            if progress is not None:
                progress(count, count + len(tasks), "tubes of stock")
            found = in_stock(best, search, stock, finish, FINALISTS if nominal else 1)
            best, stocked = (best, None) if found is None else found
        robot = tubes.robot_of(best.p)
        plans = list[Plan]()
        known = np.split(best.motions.q, np.cumsum([task.frames for task in tasks])[:-1])
        for number, (task, q) in enumerate(zip(tasks, known, strict=True)):
            if progress is not None:
                progress(count + number, count + len(tasks), f"plan of {task.name}")
            initial = [q] if len(q) == task.frames else []
            plans.append(planned_on(replace(task, robot=robot), settings, nominal, described, initial))
        stopped = interrupted()
    names, found_doubts = tuple(task.name for task in tasks), doubts(robot, plans, stocked is not None)
    told = tuple(_told(one) for one in tried if one is not None)
    kept = tuple(tubes.kept(best.p))
    return Design(
        robot, names, tuple(plans), before, kept, _remarks(best, kept), told, stopped, stocked, found_doubts
    )


def _checked(problems: Sequence[Problem], settings: Settings) -> tuple[Problem, ...]:
    """Problems whose robots are one."""
    tasks = tuple(problems)
    if not tasks:
        raise ProblemError("a design without problems; give at least one")
    instance(OptionError, "settings", settings, Settings)
    for task in tasks:
        instance(ProblemError, "problem", task, Problem)
        if task.robot != tasks[0].robot:
            raise ProblemError(
                f"the robot of {task.name} is not that of {tasks[0].name}; a design begins with one robot for all"
            )
    if len({task.name for task in tasks}) < len(tasks):
        raise ProblemError("two problems of a design have the same name; plans are written under their names")
    return tasks


def _draft(task: Problem) -> Problem:
    """A task on the frames of a draft."""
    picked = drafted(task.frames)
    return task if len(picked) == task.frames else at_frames(task, picked, int(picked[-1] - picked[-2]))


def _alone(robot: Robot) -> Scenarios:
    """A robot as described."""
    return Scenarios(robot.numbers[None], np.zeros((1, robot.d)), np.ones(1))


def _tried(search: DesignSearch, count: int, seed: int, progress: Progress | None) -> list[Candidate | None]:
    """The robot's own tubes as they are, then what came of every start."""
    found, alone = list[Candidate | None](), _alone(search.tubes.robot)
    for number, (name, p) in enumerate(itertools.islice(first_tubes(search.tubes, seed), count)):
        if progress is not None:
            progress(number, count + len(search.tasks), f"tubes from {name}")
        begun = search.start(name, p)
        if not number:
            found.append(begun)
        if begun is not None and not search.stop():
            found.append(search.settled(begun, alone))
    return found


def _finished(
    best: Candidate, search: DesignSearch, tasks: tuple[Problem, ...] | None
) -> tuple[Candidate, DesignSearch, Scenarios]:
    """Tubes for all frames of tasks, or without these for the tolerances; with what they were found by."""
    if tasks is None:
        return _tolerated(best, search), search, scenarios_of(search.tubes.robot)
    search = replace(search, tasks=tasks)
    return _whole(best, search), search, _alone(search.tubes.robot)


def _whole(best: Candidate, search: DesignSearch) -> Candidate:
    """The same with all frames, from motions planned on its tubes."""
    begun = search.start(best.start, best.p)
    if begun is None or search.stop():
        return best
    found = search.settled(begun, _alone(search.tubes.robot), AGAIN)
    return begun if found is None else found


def _tolerated(best: Candidate, search: DesignSearch) -> Candidate:
    """Tubes for the robots within the tolerances, which grow to what they are."""
    scenarios = scenarios_of(search.tubes.robot)
    for part, barriers in GROWN.items():
        tried = (search.settled(best, scenarios.shrunk(part), barrier) for barrier in barriers)
        best = next((one for one in tried if one is not None and one.solved), best)
    return best


def planned_on(
    task: Problem,
    settings: Settings,
    nominal: bool,
    model: str | Model = "elastic",
    initial: Sequence[Array] = (),
) -> Plan:
    """The plan of a task on its robot as a design makes it: far from any wall, for tolerances unless nominal.

    initial: motions (T, 2d + 2) that a nominal plan is started from as well; of all its plans that of least e3.
    """
    far = replace(settings, contact_weight=0.0)
    if nominal:
        starts = ((), *([q] for q in initial))
        found = [solve_horizon(task, model=model, settings=far, initial=start) for start in starts]
        return min(found, key=lambda plan: (not plan.success.all(), summary(plan)["e3"]))
    return solve_robust(task, model=model, settings=far)


def _told(one: Candidate) -> dict[str, Any]:
    return {
        "start": one.start,
        "e3": one.motions.e3.tolist(),
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
