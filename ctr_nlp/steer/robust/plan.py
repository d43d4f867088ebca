"""A plan for robots whose tubes are not quite known, over all frames at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.scenarios import MARGIN
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.wall import wall_of
from ctr_nlp.models import Model, model_named
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.steer.horizon import Horizon
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.requests import check_described, check_search
from ctr_nlp.steer.robust.rounds import Lost, Round, planned_again
from ctr_nlp.steer.robust.search import RobustSearch, Start, Tried
from ctr_nlp.steer.robust.tolerated import lost_of, scenarios_of
from ctr_nlp.steer.robust.walled import Walled
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.values import instance, number, strict_json
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

MARGINS = 0.2, 0.3, 0.4, 0.5
"""Stability margins of the nominal plans that are started from: which of them leads furthest differs."""
MOTION_PART = 0.1
"""Part of the lambda of a plain horizon: robots differ more from the target than smoothness is worth there."""
ROUNDS = 4


def solve_robust(
    problem: Problem,
    scenarios: Scenarios | None = None,
    *,
    lost: Callable[[Array, int], Lost] | None = None,
    rounds: int = ROUNDS,
    model: str | Model = "elastic",
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    motion_weight: float | None = None,
    margin: float = MARGIN,
    margins: Sequence[float] = MARGINS,
    settings: Settings = DEFAULTS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
) -> Plan:
    """The plan that robots of scenarios follow a problem's target with, all making one motion.

    scenarios: the first is the problem's own robot; by default those of its tolerances. lost: (q (T, 2d + 2),
    number of a round) -> robots that are lost on this motion, of some drawn for this round, by default within the
    tolerances; these join the scenarios, and it is planned again, in at most so many rounds. margin: the least
    stability margin of every scenario. margins: of the nominal plans started from. start, end, motion_weight,
    settings, terms, progress: as solve_horizon.
    In a lumen, all scenarios are kept off the wall as far as settings say (walled.py), once the motion that is
    free of it is known. Where no motion is found that all share, the plan is the first nominal one, and no frame
    counts as solved. Raises OptionError, ProblemError, RobotError.
    """
    check_described(problem, settings)
    check_search(motion_weight, None, 1)
    model = model_named(model, "model of scenarios")
    scenarios = scenarios_of(problem.robot) if scenarios is None else scenarios
    lost = lost_of(problem.robot, model) if lost is None else lost
    instance(OptionError, "scenarios", scenarios, Scenarios)
    number(OptionError, "margin", margin, lambda x: 0 <= x < 1, "lie in [0, 1)")
    begin = time.perf_counter()
    with deferred_interrupt() as interrupted:
        horizons = [Horizon(problem, model, None, start, end, _at(settings, each), terms) for each in margins]
        starts = [
            _start(problem, model, horizon.solve(motion_weight=motion_weight), each)
            for horizon, each in zip(horizons, margins, strict=True)
        ]
        weight = motion_weight
        if weight is None:
            x = np.concatenate([starts[0].phi, starts[0].q[:, problem.robot.d :]], axis=1)
            weight = MOTION_PART * horizons[0].balanced_weight(x)
        between = time.perf_counter()
        own = model, horizons[0].ends, tuple(terms), weight, margin
        search = RobustSearch(problem, *own, progress, interrupted)
        tried = search.drafts(starts, scenarios)
        made = _rounds(search, tried, scenarios, lost, rounds)
        best = free = _best(problem, made)
        told = [one.described() for one in made]
        wall = wall_of(problem.robot, problem.lumen, model, settings, finer=1)
        if wall is not None and free is not None:
            within = Walled(search, wall, free, settings.clearance_cost, lost, rounds).rounds(len(made))
            if within is not None:
                search, best = within.search, _best(problem, within.made)
                told += [one.described() | {"contact_weight": within.weight} for one in within.made]
        stopped = interrupted()
    options = strict_json(asdict(settings)) | {"motion_weight": weight, "stability_margin": margin}
    options |= {"margins": list(margins), "rounds": rounds, "terms": [str(term) for term in terms]}
    options |= {"start": _listed(horizons[0].ends.start), "end": _listed(horizons[0].ends.end)}
    meta = {
        "formulation": "scenarios",
        "model": model.name,
        "solver": "condensed",
        "options": options,
        "build_s": sum(horizon.build_seconds for horizon in horizons),
        "search_s": between - begin,
        "solve_s": time.perf_counter() - between,
        "interrupted": stopped,
        "contact_weight": None if search.wall is None else search.wall.weight,
        "starts": [_described(one) for one in tried],
        "rounds": told,
    }
    return _plan(problem, search, starts[0], best, None if wall is None else free, meta)


def _at(settings: Settings, margin: float) -> Settings:
    """Those of a nominal plan, far from any wall."""
    return replace(settings, stability_margin=margin, contact_weight=0.0)


def _start(problem: Problem, model: Model, plan: Plan, margin: float) -> Start:
    x = model.follow(problem.robot, plan.q).x
    phi = np.where(np.isfinite(x), x, model.guess(problem.robot, plan.q))[:, : problem.robot.d]
    return Start(f"margin {margin:g}", plan.q, phi)


def _rounds(
    search: RobustSearch,
    drafts: Sequence[Tried],
    scenarios: Scenarios,
    lost: Callable[[Array, int], Lost],
    most: int,
) -> list[Round]:
    """Rounds over the frames of the best draft and then over all; of the next best where none leads
    to a motion.
    """
    for draft in drafts:
        if not draft.solved or search.stop():
            break
        coarse = list[Round]()
        if search.picked is not None and most:
            coarse = planned_again(search, draft, scenarios, lost, most)
        for one in reversed(coarse or [Round(draft, scenarios, 0)]):
            whole = search.refined(one.tried, one.scenarios)
            if whole.solved:
                return coarse + planned_again(search, whole, one.scenarios, lost, most, len(coarse))
    return []


def _listed(q: Array | None) -> list[float] | None:
    return None if q is None else q.tolist()


def _described(one: Tried) -> dict[str, Any]:
    found = one.solution
    return {
        "start": one.start,
        "frames": one.frames,
        "objective": found.objective / one.frames,
        "solved": one.solved,
        "grown": one.grown,
        "status": found.status,
        "iterations": found.iterations,
    }


def _best(problem: Problem, made: Sequence[Round]) -> Round | None:
    """Of rounds over all frames the one in which fewest were lost, the last of these; None without any."""
    whole = [one for one in made if one.tried.frames == problem.frames]
    return min(reversed(whole), key=lambda one: one.lost, default=None)


def _plan(
    problem: Problem,
    search: RobustSearch,
    start: Start,
    best: Round | None,
    free: Round | None,
    meta: dict[str, Any],
) -> Plan:
    """A round as a plan, and the one that was free of the wall; without any, the start, not solved."""
    frames = problem.frames
    unknown = np.full(frames, np.nan)
    if best is None:
        why = "interrupted" if meta["interrupted"] else "no motion was found that all scenarios share"
        given = meta | {"failures": {"all": why}}
        nothing = {"solve_time": unknown, "objective": unknown, "kkt": unknown}
        return plan_from_configurations(problem, start.q, given, success=np.zeros(frames, dtype=bool), **nothing)
    found = best.tried.solution
    condensed = Condensed(search.motion(best.scenarios))
    condensed.look(found.q, found.phi)
    return plan_from_configurations(
        problem,
        found.q,
        meta | {"failures": {}, "iterations": found.iterations, "lost": best.lost},
        success=np.full(frames, found.success),
        solve_time=unknown,
        objective=condensed.by_frame(found.q, found.phi),
        kkt=np.full(frames, found.kkt),
        planned=np.concatenate([found.phi[:, 0], found.q[:, problem.robot.d :]], axis=1),
        free=None if free is None else free.tried.solution.q,
    )
