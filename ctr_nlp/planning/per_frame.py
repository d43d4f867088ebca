"""Planning frame by frame, eqs. (6) and (9): a first frame is found by search, then each from the one before it.

On the elastic model a pass is then simulated: where the stability margin is violated between frames, the frames on
both sides are solved again with a larger one (stability_refinement.py). Within a lumen, the pass is solved again
with its wall (within_wall.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.models import Model
from ctr_nlp.ocp.frame_solver import FrameResult, FrameSolver
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.arrival import ARRIVAL_MOTION_FRACTION, EXCESS_ARRIVAL_FACTOR
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.plan.plan_data import planned_model
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.marching import Pass, Progress, run_passes
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS, NlpFrames
from ctr_nlp.planning.stability_refinement import refine_pass_margins
from ctr_nlp.planning.validation import Direction, check_problem_and_settings, checked_ends
from ctr_nlp.planning.within_wall import run_within_wall
from ctr_nlp.solvers.frame.sqp import IPOPT_FALLBACK_TEXT
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.typing import Array


def solve_per_frame(
    problem: Problem,
    formulation: str = "joint",
    *,
    model: str | Model | None = None,
    solver: str | None = None,
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
) -> Plan:
    """Plan a motion frame by frame, each frame from the one before it.

    Frames that could not be solved are marked in the plan. Ctrl-C ends the work; the plan then has what was
    solved and is marked as interrupted.

    Parameters
    ----------
    problem : Problem
        Robot and target.
    formulation : str
        ``"joint"``, ``"two-stage"`` or ``"two-stage-exact"``.
    model : str or Model, optional
        ``"elastic"`` or ``"dominant"``, or ``Loaded(load)`` for a loaded robot. By default elastic for the joint
        formulation, and dominant for two stages, which need a curvature that alpha does not change.
    solver : str, optional
        ``"sqp"`` or ``"ipopt"``; by default sqp where there is a C compiler.
    direction : str
        Order in which frames are solved: ``"forward"``, ``"backward"``, or ``"best"`` for the better of both.
    start : array_like, optional
        Configuration q (2d + 2,) at time 0, from which the motion starts forward.
    settings : Settings
        Weights, widths and seeds.
    terms : sequence of Term
        Further terms of the objective (ctr_nlp.ocp.terms), on the joint formulation.
    progress : callable, optional
        Called as ``progress(done, total, note)``.

    Returns
    -------
    Plan
        Returned also where frames failed: see ``plan.success`` and ``plan.verdicts``.

    Raises
    ------
    OptionError, RobotError
        An option or the robot is not what it must be.
    """
    check_problem_and_settings(problem, settings)
    checked_ends(problem, direction, start)
    return march(
        problem,
        NlpFrames.of(problem, formulation, solver, model, settings, terms),
        direction,
        start,
        progress,
    )


def march(
    problem: Problem,
    solver: FrameSolver,
    direction: Direction = "best",
    start: npt.ArrayLike | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Solve all frames of a problem with any FrameSolver and return the plan.

    problem, direction, start and progress are those of :func:`solve_per_frame`. solver: of single frames.
    """
    simulator = Simulator(problem.robot, planned_model(solver.description))
    with deferred_interrupt() as interrupted:
        passes, search_seconds = run_passes(problem, solver, direction, start, progress=progress)
        # Passes are compared as simulated: a plan on another branch is useless, however small its objective.
        best = _least_simulated_error(passes, solver, problem, simulator)
        free: Array | None = None
        wall: Wall | None = None
        # Margins and walls are those of programs; reference methods, which are FrameSolvers too, have neither.
        if isinstance(solver, NlpFrames) and not interrupted():
            best, solver = refine_pass_margins(solver, best, simulator, interrupted)
            # The plan keeps the motion without the wall, so that the cost of the wall can be reported.
            free = None if solver.wall is None else best.motion(problem)
            best, wall = run_within_wall(solver, best, simulator, interrupted)
        stopped = interrupted()
    options = {
        "direction": best.direction,
        "passes": len(passes),
        "start": None if start is None else np.asarray(start, dtype=float).tolist(),
    }
    weight = None if wall is None else wall.weight
    work = {"search_s": search_seconds, "interrupted": stopped, "contact_weight": weight}
    return plan_from_pass(problem, solver, best, free, options, work, simulator)


def _least_simulated_error(
    passes: Sequence[Pass], solver: FrameSolver, problem: Problem, simulator: Simulator
) -> Pass:
    """Return the pass on which the simulated robot is nearest to its target; a single one is not simulated.

    Where the solver has a term of arrival, a tip error counts as it does in a plan: each mm beyond the tolerance
    costs EXCESS_ARRIVAL_FACTOR times the weight in the last tenth (ARRIVAL_MOTION_FRACTION) of the frames.
    """
    if len(passes) == 1:
        return passes[0]
    arrival = solver.arrival if isinstance(solver, NlpFrames) else None

    def simulated_cost(one: Pass) -> tuple[int, float]:
        failed, square = one.simulated_error(problem, simulator)
        if arrival is None:
            return failed, square
        missed = one.tip_miss_distance(problem, simulator, arrival.required)
        # The error is a mean over all frames, of which only the last ones have the cost of arrival: hence the
        # factor ARRIVAL_MOTION_FRACTION.
        return failed, square + ARRIVAL_MOTION_FRACTION * EXCESS_ARRIVAL_FACTOR * arrival.weight * missed

    return min(passes, key=simulated_cost)


def _unknowns(results: Sequence[FrameResult]) -> Array | None:
    """Return the unknowns (T, n) of frames on a model whose q does not determine them, NaN in frames not reached;
    None on other models.
    """
    known = [result.x for result in results if result.x is not None]
    if not known:
        return None
    return np.array([np.full_like(known[0], np.nan) if result.x is None else result.x for result in results])


def plan_from_pass(
    problem: Problem,
    solver: FrameSolver,
    best: Pass,
    free: Array | None,
    options: dict[str, Any],
    work: dict[str, Any],
    simulator: Simulator | None = None,
) -> Plan:
    """Build the plan of a pass through all frames.

    problem: robot and target. solver: of single frames, whose description goes into the plan's meta. best: the
    pass. free: (T, 2d + 2), its motion without the wall, or None. options, work: entries of meta. simulator: of
    the robot, which may have the motion in its cache.
    """
    # Frames that Ctrl-C left out are failures with a reason of their own.
    missing = FrameResult(np.zeros(0), success=False, status="not reached")
    results = [best.results.get(j, missing) for j in range(problem.frames)]
    meta = {
        **solver.description,
        **work,
        "options": solver.description["options"] | options,
        "build_s": solver.build_seconds,
        "iterations": sum(result.iterations for result in results),
        # Frames count from 0 in code, and from 1 wherever a person reads them.
        "failures": {str(j + 1): r.status for j, r in enumerate(results) if not r.success},
        "fallbacks": {str(j + 1): r.status for j, r in enumerate(results) if IPOPT_FALLBACK_TEXT in r.status},
    }
    return plan_from_configurations(
        problem,
        best.motion(problem),
        meta,
        success=np.array([result.success for result in results]),
        solve_time=np.array([best.seconds.get(j, np.nan) for j in range(problem.frames)]),
        objective=np.array([result.objective for result in results]),
        kkt=np.array([result.kkt for result in results]),
        planned=_unknowns(results),
        free=free,
        simulator=simulator,
    )
