"""Robust plans frame by frame: one motion that the nominal robot and perturbed robots (scenarios) all follow.

Each frame's program has one q and the tips of every scenario as unknowns, and starts from the frame before it. The
motion is then simulated on samples; those that snap or leave the branch join the scenarios.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.planning.marching import Pass, Progress, run_again, run_passes
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.per_frame import plan_from_pass
from ctr_nlp.planning.validation import Direction, check_problem_and_settings, checked_ends
from ctr_nlp.robust.frames import ScenarioFrames
from ctr_nlp.robust.tolerance_scenarios import reported_unknowns, resolve_scenarios
from ctr_nlp.robust.trials import Trials
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.value_checks import whole_number

PER_FRAME_START_MARGINS = 0.1, 0.5
"""Stability margins of the nominal robot in the frames from which runs start."""
MAX_PER_FRAME_REPLANNING_ROUNDS = 3
"""Largest number of times that a motion is re-planned for robots that were lost."""
MAX_REPLANNED_COST_GROWTH = 0.1
"""Relative growth of the mean objective up to which the first re-planned run is taken without solving others."""


def solve_robust_per_frame(
    problem: Problem,
    scenarios: Scenarios | None = None,
    *,
    most_lost: float = MOST_LOST,
    rounds: int = MAX_PER_FRAME_REPLANNING_ROUNDS,
    model: str | Model = "elastic",
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
) -> Plan:
    """Plan one motion frame by frame that all robots within the tolerances follow.

    Robots that represent the tolerances (scenarios) share the motors' angles and extensions of every frame. The
    motion is simulated on samples; those that snap or leave the branch join the scenarios, and it is planned
    again. Walls do not count. :func:`solve_robust` plans over all frames at once, with walls and arrival.

    Parameters
    ----------
    problem : Problem
        Robot and target; the robot's tolerances say how built robots differ from it.
    scenarios : Scenarios, optional
        The robots that are planned for, the first of which is the problem's own. By default a two-level design of
        the tolerances (Plackett and Burman, The design of optimum multifactorial experiments, Biometrika 33,
        1946), and the nominal robot under the forces that may act at its tip, whose errors do not count.
    most_lost : float
        Share of all robots within the tolerances that may snap or leave the branch, with 95 % confidence.
    rounds : int
        Largest number of times that the motion is re-planned for robots that were lost, at least 0.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``.
    direction : str
        Order in which frames are solved: ``"forward"``, ``"backward"``, or ``"best"`` for the better of both.
    start : array_like, optional
        Configuration q (2d + 2,) at time 0, from which the motion starts forward.
    settings : Settings
        `stability_margin` is the least one of every scenario.
    terms : sequence of Term
        Further terms of the objective (ctr_nlp.ocp.terms).
    progress : callable, optional
        Called as ``progress(done, total, note)``.

    Returns
    -------
    Plan
        Returned also where frames failed. Its certificate is in ``meta["certificate"]``, unless no frame was
        reached or Ctrl-C ended the work.

    Raises
    ------
    LoadError, OptionError, ProblemError, RobotError
        An option, the problem or the robot is not what it must be.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.problems import named_problem
    >>> problem = named_problem("arc", frames=3)
    >>> plan = ctr.solve_robust_per_frame(problem, rounds=0)  # doctest: +SKIP
    >>> plan.meta["certificate"]["draws"]  # doctest: +SKIP
    500
    """
    check_problem_and_settings(problem, settings)
    checked_ends(problem, direction, start)
    whole_number(OptionError, "rounds", rounds, 0)
    model, scenarios = resolve_scenarios(problem.robot, model, scenarios)
    trials = Trials(problem.robot, model, most_lost)
    with deferred_interrupt() as interrupted:
        solver = ScenarioFrames.of(problem, scenarios, model, settings, terms, PER_FRAME_START_MARGINS)
        passes, seconds = run_passes(problem, solver, direction, start, progress=progress)
        ranked = sorted(passes, key=lambda one: one.cost(problem))
        best = ranked[0]
        trial = trials(best.motion(problem), 0)
        made = [(solver, best, trial)]
        # A cutting-set method (Mutapcic and Boyd, Cutting-set methods for robust convex optimization, Optimization
        # Methods and Software 24(3), 2009): only robots that the last motion loses are added, so that programs
        # stay small.
        while not trial.few and len(made) <= rounds and not interrupted():
            solver = solver.with_failed_samples(trial)
            best = _rerun_best(ranked, solver, interrupted)
            trial = trials(best.motion(problem), len(made))
            made.append((solver, best, trial))
        stopped = interrupted()
    # Fewest failed frames first, then the smallest share of lost robots. The objective does not decide: later
    # rounds cost more because they keep robots stable that earlier ones lost.
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
            {"scenarios": len(frames.scenarios), "lost": len(lost.frames), "drawn": lost.sample_count}
            for frames, _, lost in made
        ],
    }
    plan = plan_from_pass(problem, solver, _with_reported_unknowns(best, problem, model), None, options, work)
    return plan if stopped or not plan.reached_frames.any() else trials.certify_plan(plan, len(made))


def _with_reported_unknowns(best: Pass, problem: Problem, model: Model) -> Pass:
    """Return a run with the unknowns of the model on which the plan is reported.

    best: the run, with unknowns of `model`, on which scenarios are planned. problem: robot and target.
    """
    q = best.motion(problem)
    robot = problem.robot
    found = {
        j: one if one.x is None else replace(one, x=reported_unknowns(robot, model, q[j : j + 1], one.x[None])[0])
        for j, one in best.results.items()
    }
    return replace(best, results=found)


def _rerun_best(ranked: Sequence[Pass], solver: ScenarioFrames, stop: Callable[[], bool]) -> Pass:
    """Re-run motions in the order of their cost; return the first that costs about as much as the best one did.

    Where none does, the cheapest new one is returned. ranked: the runs before, cheapest first. solver: with the
    new scenarios. stop: called between runs, returns whether to end.
    """
    problem = solver.problem
    found = list[Pass]()
    failed, least = ranked[0].cost(problem)
    for one in ranked:
        found.append(run_again(one, replace(solver, known=one.results), stop))
        if stop() or found[-1].cost(problem) <= (failed, (1 + MAX_REPLANNED_COST_GROWTH) * least):
            break
    return min(found, key=lambda one: one.cost(problem))
