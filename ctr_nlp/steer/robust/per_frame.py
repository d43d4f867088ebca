"""A plan for robots whose tubes are not quite known, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.models import Model
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Pass, Progress, run_again, run_passes
from ctr_nlp.steer.per_frame import plan_of
from ctr_nlp.steer.requests import Direction, check_described, checked_ends
from ctr_nlp.steer.robust.frames import ScenarioFrames
from ctr_nlp.steer.robust.tolerated import described, told_unknowns
from ctr_nlp.steer.robust.trials import Trials
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.values import whole_number
from ctr_nlp.target.problem import Problem

MARGINS = 0.1, 0.5
"""Stability margins of the robot as described in the frames that runs begin at."""
ROUNDS = 3
"""Times that a motion is planned again for robots that were lost."""
DEARER = 0.1
"""By what part of itself the mean objective may grow before other runs are looked at, too."""


def solve_robust_per_frame(
    problem: Problem,
    scenarios: Scenarios | None = None,
    *,
    most_lost: float = MOST_LOST,
    rounds: int = ROUNDS,
    model: str | Model = "elastic",
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    settings: Settings = DEFAULTS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
) -> Plan:
    """The plan that robots of scenarios follow a problem's target with frame by frame, all making one motion.

    scenarios, most_lost, rounds: as solve_robust. direction, start, settings, terms, progress: as solve_per_frame;
    settings.stability_margin is the least of every scenario. Walls do not count. Raises OptionError, RobotError.
    """
    check_described(problem, settings)
    checked_ends(problem, direction, start)
    whole_number(OptionError, "rounds", rounds, 0)
    model, scenarios = described(problem.robot, model, scenarios)
    trials = Trials(problem.robot, model, rounds + 1, most_lost)
    with deferred_interrupt() as interrupted:
        solver = ScenarioFrames.of(problem, scenarios, model, settings, terms, MARGINS)
        passes, seconds = run_passes(problem, solver, direction, start, progress=progress)
        ranked = sorted(passes, key=lambda one: one.cost(problem))
        best = ranked[0]
        trial = trials(best.motion(problem), 0)
        made = [(solver, best, trial)]
        while not trial.few and len(made) <= rounds and not interrupted():
            solver = solver.harder(trial)
            best = _best_again(ranked, solver, interrupted)
            trial = trials(best.motion(problem), len(made))
            made.append((solver, best, trial))
        stopped = interrupted()
    solver, best, trial = min(made, key=lambda one: (one[1].cost(problem)[0], one[2].share))
    options = {
        "direction": best.direction,
        "passes": len(passes),
        "start": None if start is None else np.asarray(start, dtype=float).tolist(),
        "most_lost": most_lost,
        "rounds": rounds,
    }
    work: dict[str, Any] = {
        "search_s": seconds,
        "interrupted": stopped,
        "contact_weight": None,
        "rounds": [
            {"scenarios": len(frames.scenarios), "lost": len(lost.frames), "drawn": lost.drawn}
            for frames, _, lost in made
        ],
    }
    plan = plan_of(problem, solver, _told(best, problem, model), None, options, work)
    return plan if stopped or not plan.reached.any() else trials.certified(plan, trial, len(made))


def _told(best: Pass, problem: Problem, model: Model) -> Pass:
    """The same run with the unknowns that a plan tells of."""
    q, robot = best.motion(problem), problem.robot
    found = {
        j: one if one.x is None else replace(one, x=told_unknowns(robot, model, q[j : j + 1], one.x[None])[0])
        for j, one in best.results.items()
    }
    return replace(best, results=found)


def _best_again(ranked: Sequence[Pass], solver: ScenarioFrames, stop: Callable[[], bool]) -> Pass:
    """The first of ranked runs that, run again, is about as good as the best of them was; else the best then."""
    problem, found = solver.problem, list[Pass]()
    failed, least = ranked[0].cost(problem)
    for one in ranked:
        found.append(run_again(one, replace(solver, known=one.results), stop))
        if stop() or found[-1].cost(problem) <= (failed, (1 + DEARER) * least):
            break
    return min(found, key=lambda one: one.cost(problem))
