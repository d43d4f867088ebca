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
    """The plan that robots of scenarios follow a problem's target with, all making one motion, far from any wall.

    scenarios: the first is the problem's own robot; by default those of its tolerances. lost: (q (T, 2d + 2),
    number of a round) -> robots that are lost on this motion, of some drawn for this round, by default within the
    tolerances; these join the scenarios, and it is planned again, in at most so many rounds. margin: the least
    stability margin of every scenario. margins: of the nominal plans started from. start, end, motion_weight,
    settings, terms, progress: as solve_horizon.
    Where no motion is found that all scenarios share, the plan is the first nominal one, and no frame counts as
    solved. Raises OptionError, ProblemError, RobotError.
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
        "contact_weight": None,
        "starts": [_described(one) for one in tried],
        "rounds": [one.described() for one in made],
    }
    return _plan(problem, search, starts[0], made, meta)


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


def _plan(
    problem: Problem, search: RobustSearch, start: Start, made: Sequence[Round], meta: dict[str, Any]
) -> Plan:
    """The round in which fewest were lost, the last of these, as a plan."""
    frames = problem.frames
    unknown = np.full(frames, np.nan)
    if not made:
        why = "interrupted" if meta["interrupted"] else "no motion was found that all scenarios share"
        given = meta | {"failures": {"all": why}}
        nothing = {"solve_time": unknown, "objective": unknown, "kkt": unknown}
        return plan_from_configurations(problem, start.q, given, success=np.zeros(frames, dtype=bool), **nothing)
    whole = [one for one in made if one.tried.frames == frames]
    best = min(reversed(whole), key=lambda one: one.lost)
    found = best.tried.solution
    condensed = Condensed(search.motion(best.scenarios))
    return plan_from_configurations(
        problem,
        found.q,
        meta | {"failures": {}, "iterations": found.iterations, "lost": best.lost},
        success=np.full(frames, found.success),
        solve_time=unknown,
        objective=condensed.by_frame(found.q, found.phi),
        kkt=np.full(frames, found.kkt),
        planned=np.concatenate([found.phi[:, 0], found.q[:, problem.robot.d :]], axis=1),
    )
