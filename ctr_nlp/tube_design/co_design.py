"""Co-design: tubes designed together with the motions of several tasks.

Minimises the shape errors (8) of all frames of all tasks, with the motion terms of eq. (9), over the numbers of
the tubes and the motions, subject to the rules of manufacture and the limits of the robot. See docs/method.md,
"Tube design".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.models import Model, model_for_tip_forces
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.design import RuleValue
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import interpolate_frames
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.starts.search import pick_draft_frames
from ctr_nlp.robot import Robot
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.pool import Jobs, run_in_parallel
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.tube_design.design_warnings import find_design_warnings
from ctr_nlp.tube_design.plans import plan_tasks
from ctr_nlp.tube_design.reaching_tubes import at_last_frames, grow_from_starts, search_of_reached
from ctr_nlp.tube_design.request import draft, search_for
from ctr_nlp.tube_design.rounding import FINALISTS, Finish, StockRounding, round_to_stock
from ctr_nlp.tube_design.search import Candidate, DesignSearch, Robots, error_of, nominal_scenario
from ctr_nlp.tube_design.selection import (
    choose_best_planned,
    choose_certified,
    choose_reaching,
    solve_all_frames,
    tolerance_scenarios,
    tolerant_candidates,
)
from ctr_nlp.tube_design.starts import generate_start_tubes as first_tubes
from ctr_nlp.tube_design.stock import StockTube, nearest_stock
from ctr_nlp.typing import Array

STARTS = 4
"""Tubes that a design starts from."""
MAX_TASKS_WITH_MOTIONS = 4
"""Largest number of tasks within walls for which tubes are designed on motions; for more, on last frames alone,
and for those ends only that come within reach.
"""
BINDING = 1e-3
"""Distance from its bound, relative to it, within which a rule counts as binding."""
MIN_REMARKED_GAIN = 5e-4
"""Least gain, as a part of the error, for which a binding rule is reported."""


@dataclass(frozen=True)
class Remark:
    """A rule of manufacture that binds, and its cost.

    Attributes
    ----------
    rule : RuleValue
        The rule, with its value and bounds.
    gain : float
        Part by which the root mean square error of the tasks would fall, to first order, if the bound were eased
        by a tenth.
    error : str
        What the error is called.
    """

    rule: RuleValue
    gain: float
    error: str = "e3"

    def __str__(self) -> str:
        """Return the remark as a sentence."""
        rule = self.rule
        bound = min(rule.lower, rule.upper, key=lambda bound: abs(bound - rule.value))
        told = f"{rule.name} is at its bound, {abs(bound):.4g}"
        return f"{told}; easing the bound by 10 % would lower {self.error} by {self.gain:.1%}"


@dataclass(frozen=True)
class Design:
    """A designed robot, with the plans of its tasks.

    Attributes
    ----------
    robot : Robot
        The robot with the designed tubes.
    names : tuple of str
        Names of the tasks.
    plans : tuple of Plan
        One a task, on the robot; some may be missing where Ctrl-C came first.
    before : tuple of (float or None)
        e3 of each task's motion on the robot that the design started from, without walls, mm, over the frames of
        a draft; None where it has none.
    rules : tuple of RuleValue
        Rules of manufacture, with the values that the tubes have.
    remarks : tuple of Remark
        Rules that bind, the costliest first.
    start_results : tuple of dict
        Results of the robot's own tubes and of every start, as numbers and strings.
    interrupted : bool
        Whether Ctrl-C ended the work.
    stock_rounding : StockRounding or None
        Tubing to buy and the error that it costs, where tubes were rounded to a stock.
    warnings : tuple of str
        Sentences on tubes that are not used, and on diameters that are rarely sold.
    """

    robot: Robot
    names: tuple[str, ...]
    plans: tuple[Plan, ...]
    before: tuple[float | None, ...]
    rules: tuple[RuleValue, ...]
    remarks: tuple[Remark, ...]
    start_results: tuple[dict[str, Any], ...]
    interrupted: bool
    stock_rounding: StockRounding | None = None
    warnings: tuple[str, ...] = ()


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
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    progress: Progress | None = None,
) -> Design:
    """Design the tubes with which one robot follows the targets of all problems best, and plan each problem on
    them.

    The root mean square of the problems' e3 is minimised over tubes and motions jointly: pre-curvatures, lengths
    of curved parts and diameters are shared by all problems, q of every frame belongs to its own
    (ocp/shared/design.py). With `walls`, the costs of contact and arrival count beside the shape errors, as in
    plans, and tubes are tried until the ends of all problems are reached (:attr:`Verdicts.end_reached`).

    Without `nominal`, motions are shared by scenarios that represent all robots within the tolerances, and each
    plan is certified on simulated robots (:func:`solve_robust`). With a load, all robots of the design are loaded;
    a force that may act at the tip (`tip_force` of the tolerances) counts by how far it bends the robot. On the
    dominant model stiffness does not count, and diameters follow from the rules alone.

    Parameters
    ----------
    problems : sequence of Problem
        Tasks with different names and one robot, whose limits, tolerances and tubes are those to start from.
    nominal : bool
        Whether tubes are designed for the nominal robot, without tolerances.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``.
    rules : Manufacture, optional
        Rules of manufacture; the defaults of :class:`Manufacture` where None.
    fixed : sequence of str
        Names of numbers that stay as they are, such as ``"outer_diameter_1"``.
    constant_curvature : bool
        Whether curved parts are arcs; otherwise their curvature is linear in arc length.
    starts : int
        Number of tubes to start from: the robot's own and random ones (`settings.seed`).
    walls : bool
        Whether walls and the tip's arrival count, for tubes and plans; every problem then needs a wall.
    jobs : int or distributed.Client
        Number of processes, or the cluster, for starts, tasks and plans. With fewer starts than processes, the
        joint program of all problems is solved in this process.
    stock : sequence of StockTube, optional
        Tubing (:func:`read_stock`) to which tubes are rounded, with lengths and curvatures that can be made;
        without it diameters are free.
    settings : Settings
        `stability_margin` is the least of every robot.
    progress : callable, optional
        Called as ``progress(done, total, note)``.

    Returns
    -------
    Design
        The robot, its plans and the results of all starts. Ctrl-C ends the work: the design is then the best so
        far, marked as interrupted, and plans may be missing.

    Raises
    ------
    LoadError, OptionError, ProblemError, RobotError
        An option, a problem or its robot is not what it must be, or no tubes were found on which all problems can
        be followed.

    See Also
    --------
    divide_problems : Divide many problems among several robots.

    Examples
    --------
    Even a small design takes about a minute.

    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> problem = named_problem("arc", frames=4)
    >>> found = ctr.design([problem], nominal=True, model="dominant", starts=1)  # doctest: +SKIP
    >>> found.robot.d, found.interrupted  # doctest: +SKIP
    (3, False)
    """
    count = whole_number(OptionError, "starts", starts)
    with deferred_interrupt() as interrupted:
        whole = search_for(problems, model, rules, fixed, constant_curvature, settings, walls)
        whole, first = replace(whole, stop=interrupted, jobs=jobs), whole.tasks[0].robot
        if not nominal:
            model_for_tip_forces(whole.model, first.tolerances.tip_force > 0).check(first)
        if stock is not None:  # what cannot nest is refused before anything is solved
            nearest_stock(stock, whole.tubes, whole.tubes.nominal_unknowns, whole.has_load)
        plan = partial(_plans, whole, settings, nominal, model, walls, jobs, progress)
        on_last_frames = walls and len(whole.tasks) > MAX_TASKS_WITH_MOTIONS
        if on_last_frames:
            search, begun = at_last_frames(whole), None
            grown = grow_from_starts(search, count, settings.seed, jobs, progress)
            tried = [one.as_candidate(search) for one in grown]
            _check_any(tried)
            within_reach = [int(one.within_reach.sum()) for one in grown]
            best, planned = choose_reaching(tried, search, plan, nominal=nominal, within_reach=within_reach)
            chosen = grown[tried.index(best)]
            rounding = search_of_reached(search, chosen), chosen.as_candidate(search, only_reached=True)
        else:
            # Starts are compared on the frames of drafts, at a fraction of the cost; the best nominal tubes are
            # then solved for all frames.
            search = replace(whole, tasks=tuple(draft(task) for task in whole.tasks))
            robots = tolerance_scenarios if walls and not nominal else nominal_scenario
            begun, tried = _solve_starts(search, robots, count, settings.seed, jobs, progress)
            if begun is not None and not search.counts_more_than_shape:
                tried = [begun, *tried]
            _check_any(tried)
            # Errors of motions for one robot and for many cannot be compared: tubes that were solved for the
            # tolerances come first.
            ranked = sorted(tried, key=lambda one: (not one.has_scenarios, error_of(one)))
            if walls:
                best, planned = choose_reaching(ranked, search, plan, nominal=nominal)
            elif nominal:
                best, planned = choose_best_planned(tried, whole, plan)
            else:
                best, planned = choose_certified(tried, search, plan)
            rounding = search, best
        stocked = None
        if stock is not None and not interrupted():
            finish: Finish = partial(_finish_tubes, tasks=whole.tasks if nominal else None)
            if on_last_frames or (walls and nominal):
                finish = _keep_frames
            rounded = round_to_stock(rounding[1], rounding[0], stock, finish, FINALISTS if nominal else 1)
            if rounded is not None:
                # Plans on the free tubes are none on the rounded ones.
                (best, stocked), planned = rounded, []
        planned = planned or plan(best)
        robot = whole.tubes.robot_of(best.p)
        stopped = interrupted()
    kept = tuple(search.tubes.rule_values(best.p))
    return Design(
        robot=robot,
        names=tuple(task.name for task in whole.tasks),
        plans=tuple(planned),
        before=(None,) * len(whole.tasks) if begun is None else _finite_or_none(begun.motions.error),
        rules=kept,
        remarks=_remarks(best, kept, search.error_name),
        start_results=tuple(_candidate_report(one) for one in tried),
        interrupted=stopped,
        stock_rounding=stocked,
        warnings=find_design_warnings(robot, planned, stocked is not None),
    )


def _check_any(tried: Sequence[Candidate]) -> None:
    """Raise ProblemError where no tubes were found."""
    if not tried:
        raise ProblemError("no tubes were found that solve all problems; give more starts")


def _solve_starts(
    search: DesignSearch, robots: Robots, count: int, seed: int, jobs: Jobs, progress: Progress | None
) -> tuple[Candidate | None, list[Candidate]]:
    """Return the robot's own tubes with motions, and the candidates of all starts that led to motions.

    robots: maps the robot to the scenarios for which the tubes are solved. Starts are distributed over processes
    where there are at least as many starts as processes; otherwise the tasks of each start are.
    """
    begun = dict[int, Candidate | None]()
    found = dict[int, Candidate]()
    starts = list(itertools.islice(first_tubes(search.tubes, seed), count))
    # Never both: processes that start processes of their own would be more than there are cores.
    apart, within = (jobs, 1) if isinstance(jobs, int) and len(starts) >= jobs else (1, jobs)
    alike = replace(search.portable, jobs=within)
    for number, (before, after) in run_in_parallel(partial(_solve_start, alike, robots), starts, apart):
        begun[number] = before
        if after is not None:
            found[number] = after
        if progress is not None:
            progress(len(begun), len(starts), f"tubes from {starts[number][0]}")
    # Start 0 is the robot's own tubes.
    return begun.get(0), [found[number] for number in sorted(found)]


def _solve_start(
    search: DesignSearch, robots: Robots, start: tuple[str, Array]
) -> tuple[Candidate | None, Candidate | None]:
    """Return the tubes of a start with motions, and the best candidate of the rounds from them; None for what has
    none.

    robots: maps the robot to the scenarios for which the candidate is solved once more, where it can be.
    """
    with deferred_interrupt() as interrupted:
        search = replace(search, stop=interrupted)
        begun = search.shape_alone.start(*start)
        found = None if begun is None or interrupted() else search.run_from_start(begun)
        if found is None or robots is nominal_scenario or interrupted():
            return begun, found
        # Tubes that are solved for the nominal robot alone are kept where no motion is shared.
        return begun, search.solve_for(robots, found) or found


def _finish_tubes(
    tried: Sequence[Candidate], search: DesignSearch, tasks: tuple[Problem, ...] | None
) -> tuple[Candidate, DesignSearch, Robots]:
    """Return tubes solved over all frames of `tasks`, or for the tolerances where `tasks` is None, with their
    search and its scenarios.

    Raises ProblemError where no robots within the tolerances share motions on them.
    """
    if tasks is None:
        found = next(tolerant_candidates(tried, search), None)
        if found is None:
            raise ProblemError("no motions were found that all robots within the tolerances share")
        return found, search, tolerance_scenarios
    search = replace(search, tasks=tasks)
    return solve_all_frames(min(tried, key=error_of), search), search, nominal_scenario


def _keep_frames(tried: Sequence[Candidate], search: DesignSearch) -> tuple[Candidate, DesignSearch, Robots]:
    """Return the best tubes on the frames for which they were found, for the nominal robot: within walls no tubes
    are solved for all frames.
    """
    return min(tried, key=error_of), search, nominal_scenario


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
    """Return the plans of all tasks on the tubes of a candidate, the last parameter."""
    tasks = whole.tasks_on(whole.tubes.robot_of(best.p))
    return plan_tasks(tasks, settings, nominal, model, _motions(best, whole), walls, jobs, progress)


def _motions(best: Candidate, whole: DesignSearch) -> list[Array]:
    """Return a candidate's motions (T, 2d + 2), task by task over all frames; those of a draft are filled in
    between.
    """
    if len(best.motions.q) == len(whole.tasks):
        return []  # last frames alone
    picked = [pick_draft_frames(task.frames) for task in whole.tasks]
    if len(best.motions.q) == sum(task.frames for task in whole.tasks):
        return whole.split_by_task(best.motions.q)
    parts = np.split(best.motions.q, np.cumsum([len(frames) for frames in picked])[:-1])
    return [interpolate_frames(q, at, task.frames) for q, at, task in zip(parts, picked, whole.tasks, strict=True)]


def _finite_or_none(errors: Array) -> tuple[float | None, ...]:
    """Return numbers as floats, None for those that are not finite."""
    return tuple(error if math.isfinite(error) else None for error in errors.tolist())


def _candidate_report(one: Candidate) -> dict[str, Any]:
    """Return a candidate as numbers and strings, for reports."""
    return {
        "start": one.start,
        "e3": _finite_or_none(one.motions.error),
        "rms": one.motions.rms,
        "p": one.p.tolist(),
        "iterations": 0 if one.solution is None else one.solution.iterations,
        "solved": one.is_solution,
    }


def _remarks(best: Candidate, kept: Sequence[RuleValue], error: str) -> tuple[Remark, ...]:
    """Return the rules that bind, those first that cost most; error: what the errors of motions are called."""
    if best.solution is None:
        return ()
    found = list[Remark]()
    whole = best.solution.objective
    for rule, price in zip(kept, best.solution.common_multipliers.tolist(), strict=True):
        # Multipliers are positive at upper bounds and negative at lower ones.
        bound = rule.upper if price > 0 else rule.lower
        # Relative to the bound, but for bounds near 0.
        if np.isfinite(bound) and abs(rule.value - bound) <= BINDING * max(abs(bound), BINDING):
            # The price is the derivative of the objective by the bound, so that a tenth of the bound changes the
            # objective by price * bound / 10. e3 is its square root: its relative change is half that of the
            # objective.
            found.append(Remark(rule, abs(price) * abs(bound) / 10 / whole / 2, error))
    return tuple(sorted((one for one in found if one.gain >= MIN_REMARKED_GAIN), key=lambda one: -one.gain))
