"""Robust plans over all frames at once: one motion for all robots within the tolerances.

    min  sum_j ( sum_s w_s E_j(phi_sj, q_j; tubes_s) + lambda |W (q_{j+1} - q_j)|^2 / dt^2 )
    subject to  alpha(phi_sj, q_j; tubes_s) = alpha_j + delta_s

over the shared q_j = (alpha, beta, theta), rad and mm, of every frame j and the tips phi_sj, rad, of every robot
s, with limits and a least stability margin of each. E_j is the shape error (8), w_s a weight, tubes_s and delta_s
the tubes and the motors' zeros of robot s ("Robust plans" in docs/method.md). The
scenarios s are few. Monte Carlo samples check the motion on other robots within the tolerances; those that fail
join the scenarios.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model
from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.arrival import with_arrival
from ctr_nlp.ocp.terms.term import describe_terms
from ctr_nlp.ocp.wall import make_wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.horizon import Horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import per_frame_motions
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.stability_refinement import MAX_FRAME_MARGIN
from ctr_nlp.planning.validation import check_problem_and_settings, check_search, checked_motions, checked_terms
from ctr_nlp.robust.arrival_rounds import ArrivalJudge, improve_arrival
from ctr_nlp.robust.constraint_scenarios import plan_with_constraint_scenarios
from ctr_nlp.robust.rounds import (
    FailureJudge,
    Round,
    best_round,
    relax_scenarios,
    replan_for_failures,
)
from ctr_nlp.robust.search import InitialMotion, RobustSearch, StartResult
from ctr_nlp.robust.tolerance_scenarios import reported_model, reported_unknowns, resolve_scenarios
from ctr_nlp.robust.tolerance_vertices import ToleranceVertices
from ctr_nlp.robust.trials import Trials
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.typing import Array

ROBUST_START_MARGINS = (0.5,)
"""Stability margins of the nominal robot in motions frame by frame, which are starts besides its plan."""
EXTRA_SCENARIO_MARGIN = 0.1
"""Margin of the scenarios beyond the one asked for: margins are less between frames, and on robots that are no
scenarios. Plans need fewer rounds with it, and errors are larger by 1 % at most.
"""
START_FRAMES = 49
"""Largest number of frames solved in these motions: drafts, which start from them, have 25 to 49 frames."""
MOTION_PART = 0.1
"""Factor of the default lambda of a nominal horizon: errors of perturbed robots matter more than smoothness."""
NOT_SHARED = "no motion was found that all robots within the tolerances share"
MAX_REFINED_ROUNDS = 2
"""Largest number of rounds on a draft, from the last one back, that are refined to all frames."""
MAX_ROBUST_REPLANNING_ROUNDS = 4
"""Largest number of times that a motion is re-planned for robots that were lost."""


def solve_robust(
    problem: Problem,
    scenarios: Scenarios | None = None,
    *,
    most_lost: float = MOST_LOST,
    rounds: int = MAX_ROBUST_REPLANNING_ROUNDS,
    guards: bool = False,
    model: str | Model = "elastic",
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    motion_weight: float | None = None,
    initial: Sequence[npt.ArrayLike] = (),
    margins: Sequence[float] = ROBUST_START_MARGINS,
    settings: Settings = DEFAULT_PLANNER_SETTINGS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    nominal: Callable[[Plan], None] | None = None,
) -> Plan:
    """Plan one motion with which all robots within the tolerances follow the target, arrive, and avoid the wall.

    Robots that represent the tolerances (scenarios) share the motors' angles and extensions of every frame, and
    each has tips of its own. The objective is their mean shape error plus the cost of contact and arrival of each;
    each has a least stability margin. The motion is then simulated on samples; those that snap or leave the branch
    join the scenarios, and it is planned again.

    Parameters
    ----------
    problem : Problem
        Robot and target; the robot's tolerances say how built robots differ from it.
    scenarios : Scenarios, optional
        The robots that are planned for, the first of which is the problem's own. By default a two-level design of
        the tolerances (Plackett and Burman, 1946), and the nominal robot under the forces that may act at its tip,
        whose errors do not count.
    most_lost : float
        Share of all robots within the tolerances that may snap or leave the branch, with 95 % confidence.
    rounds : int
        Largest number of times that a motion is re-planned for robots that were lost.
    guards : bool
        Whether robots at the vertices of the tolerance box are constraint scenarios, too, which takes several
        times as long.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``. On a model that cannot snap, the only start is the plan
        of the nominal robot.
    start, end : array_like, optional
        Configurations q (2d + 2,) at time 0 and in the last frame.
    motion_weight : float, optional
        Lambda in s^2; by default a tenth of that of a nominal horizon.
    initial : sequence of array_like
        Motions (T, 2d + 2) to start from. By default the plan of the nominal robot (:func:`solve_horizon`).
    margins : sequence of float
        Stability margins of the nominal robot in motions frame by frame, which are further starts where too many
        robots are lost on the motions from the first ones.
    settings : Settings
        `stability_margin` is the least one of every scenario, to which EXTRA_SCENARIO_MARGIN is added in planning;
        weights of contact and arrival count for each.
    terms : sequence of Term
        Further terms of the objective.
    progress : callable, optional
        Called as ``progress(done, total, note)``.
    nominal : callable, optional
        Called with the plan of the nominal robot as soon as it is known; not where `initial` motions are given, or
        the robot is loaded.

    Returns
    -------
    Plan
        With its certificate in ``meta["certificate"]`` (:meth:`Trials.certify_plan`) and the samples of that.
        Where no motion is found that all scenarios share, the plan of the nominal robot with
        ``meta["not_shared"]``; without such a plan, the first start, with no frame marked as solved.

    Raises
    ------
    OptionError, ProblemError, RobotError
        An option, the problem or the robot is not what it must be.
    """
    check_problem_and_settings(problem, settings)
    check_search(motion_weight, None, 1)
    whole_number(OptionError, "rounds", rounds, 0)
    model, scenarios = resolve_scenarios(problem.robot, model, scenarios)
    given = checked_motions(problem, initial)
    if not (given or margins) and reported_model(model).applied_load is not None:
        raise OptionError(
            "initial and margins are both empty; give motions as initial guesses, or margins to find some"
        )
    trials = Trials(problem.robot, model, most_lost)
    terms = with_arrival(checked_terms(terms), settings, model)
    purpose = ArrivalJudge(problem, model, settings)
    # `weight` stays None until a first start is known from which the default can be found.
    begin = time.perf_counter()
    searched = 0.0
    weight = motion_weight
    told = reported_model(model)
    with deferred_interrupt() as interrupted:
        planner = Horizon(problem, told, None, start, end, settings, terms)
        least = None
        if settings.stability_margin is not None:
            least = np.full(
                problem.frames, min(settings.stability_margin + EXTRA_SCENARIO_MARGIN, MAX_FRAME_MARGIN)
            )
        wall = make_wall(problem.robot, problem.wall, model, settings, subsamples=1)
        starts = _Starts(planner, told, given, margins, terms, settings, progress, interrupted, nominal)
        tried = list[StartResult]()
        made = list[Round]()
        best = None
        open_ = list[StartResult]()
        # Methods to find starts, in turn; a later one is used where the drafts of the earlier ones are poor,
        # or too many robots are lost on their motions.
        for number, find in enumerate(starts.start_finders):
            begun = time.perf_counter()
            found = find()
            searched += time.perf_counter() - begun
            if not found:
                continue
            if weight is None:
                # One lambda for the whole search, from the first start: objectives of later starts can be compared
                # with it.
                weight = MOTION_PART * planner.balanced_weight(found[0].x)
            own = model, planner.ends, tuple(terms), weight, least
            search = RobustSearch(problem, *own, progress, interrupted, wall)
            drafts = search.drafts(found, scenarios)
            tried += drafts
            # Drafts without rounds so far; good or not, they are compared with those of the next method.
            open_ = sorted(open_ + drafts, key=lambda one: one.promise)
            last = number + 1 == len(starts.start_finders)
            # A draft that is poor, though solved, is put aside while there is another method to find starts.
            if not (last or given or interrupted()) and open_ and not _good(open_[0], settings):
                continue
            made += _rounds(search, open_, scenarios, trials, rounds, len(made))
            best = best_round(made, problem.frames)
            open_ = []
            if best is not None and best.lost.few and not interrupted():
                # Only a motion on which few robots are lost is worth checking for arrival and contact.
                judged = best._replace(failing=purpose(best.tried.solution.q, len(made)))
                made = [judged if one is best else one for one in made]
                made += improve_arrival(judged, purpose, trials, len(made))
                best = best_round(made, problem.frames)
            if interrupted() or (best is not None and best.lost.few):
                break
        if guards and best is not None and not interrupted():
            made += plan_with_constraint_scenarios(
                best, scenarios, ToleranceVertices.of(problem.robot, model), trials, len(made)
            )
            best = best_round(made, problem.frames)
        stopped = interrupted()
    asked: dict[str, Any] = {
        "motion_weight": weight,
        "most_lost": most_lost,
        "margins": list(margins),
        "rounds": rounds,
    }
    asked |= {"terms": describe_terms(terms)}
    meta = {
        "formulation": "robust-horizon",
        **told.metadata,
        "solver": "interior-point",
        "options": settings.options() | asked | planner.ends.options,
        "build_s": planner.build_seconds,
        "search_s": searched,
        "solve_s": time.perf_counter() - begin - searched,
        "interrupted": stopped,
        "contact_weight": None if wall is None else wall.weight,
        "starts": [_start_to_meta(one) for one in tried],
        "rounds": [one.to_meta() for one in made],
    }
    # No motion for all robots: the user gets the nominal plan, which says so.
    if best is None and starts.plan is not None and starts.plan.success.all():
        kept = {"interrupted": stopped, "starts": meta["starts"], "rounds": meta["rounds"]}
        kept |= {} if stopped else {"not_shared": NOT_SHARED}
        return replace(starts.plan, meta=starts.plan.meta | kept)
    if best is None:
        return _plan_without_solution(problem, told.configuration(problem.robot, found[0].x), meta)
    plan = _plan(problem, best, meta)
    return plan if stopped else trials.certify_plan(plan, len(made))


@dataclass
class _Starts:
    """Finds initial guesses: given motions, or the plan of the nominal robot; and others, frame by frame.

    planner: horizon of the nominal robot. model: on which plans are reported. given: motions (T, 2d + 2). margins:
    of motions frame by frame. terms, settings: of the objective. progress: callback. stop: returns whether to end.
    on_nominal_plan: called with the nominal plan. plan: that plan, once it is known.
    """

    planner: Horizon
    model: Model
    given: Sequence[Array]
    margins: Sequence[float]
    terms: Sequence[Term]
    settings: Settings
    progress: Progress | None
    stop: Callable[[], bool]
    on_nominal_plan: Callable[[Plan], None] | None
    plan: Plan | None = None

    @property
    def start_finders(self) -> list[Callable[[], list[InitialMotion]]]:
        """Methods that find starts; where the first finds a good one, the others are not needed."""
        first = self._follow_given_motions if self.given else self._nominal
        return [first, *([self._frame_by_frame] if self.model.can_snap and self.margins else [])]

    def _follow_given_motions(self) -> list[InitialMotion]:
        robot = self.planner.problem.robot
        followed = [self.model.follow(robot, motion).x for motion in self.given]
        # A motion on which the nominal robot snaps has NaN: scenarios cannot be started from there.
        found = [InitialMotion(f"motion {k}", x) for k, x in enumerate(followed, 1) if np.isfinite(x).all()]
        if not (found or self.margins):
            raise OptionError(
                "none of the motions in initial can be simulated without losing equilibrium; give margins, too, "
                "so that other start motions are found"
            )
        return found

    def _nominal(self) -> list[InitialMotion]:
        """Return the nominal robot's plan as a start; nothing where that robot snaps, or is loaded."""
        if self.model.applied_load is not None:
            return []
        self.plan = self.planner.solve(progress=self.progress)
        if self.on_nominal_plan is not None:
            self.on_nominal_plan(self.plan)
        x = self.model.follow(self.planner.problem.robot, self.plan.q).x if self.model.can_snap else self.plan.q
        return [InitialMotion("the nominal plan", x)] if np.isfinite(x).all() else []

    def _frame_by_frame(self) -> list[InitialMotion]:
        """Return motions frame by frame without a wall, one for each of the margins."""
        found = partial(
            per_frame_motions,
            *(self.planner.problem, self.planner.ends),
            progress=None,
            model=self.model,
            terms=self.terms,
            most=START_FRAMES,
        )
        asked = (replace(self.settings, stability_margin=each) for each in self.margins)
        return [InitialMotion(f"margin {each.stability_margin:g}", found(settings=each)[0]) for each in asked]


def _good(draft: StartResult, settings: Settings) -> bool:
    """Return whether a draft's mean squared error over robots, with costs of contact and arrival, is allowed."""
    # The objective is a sum over frames of mean squared errors, mm^2; error_allowed is in mm.
    return draft.is_shared and draft.solution.objective <= draft.frames * settings.error_allowed**2


def _rounds(
    search: RobustSearch,
    drafts: Sequence[StartResult],
    scenarios: Scenarios,
    lost: FailureJudge,
    most: int,
    first: int,
) -> list[Round]:
    """Re-plan the best draft for lost robots, first on its frames, then on all; the next draft where that fails.

    search: of the problem. drafts: the most promising first. scenarios: planned for from the beginning. lost:
    finds the robots that are lost on each round's motion. most: rounds on a draft, and again on all frames. first:
    number of the first motion.
    """
    for draft in drafts:
        if not draft.is_solved or search.stop():
            break
        coarse = list[Round]()
        if draft.on_planned_branch and search.draft_frames is not None:
            coarse = replan_for_failures(search, draft, scenarios, lost, most, first)
        # The last round of the draft has most lost robots among its scenarios; an earlier one may be easier to
        # refine.
        tried = [(one.tried, one.scenarios) for one in reversed(coarse)] or [(draft, scenarios)]
        for one, joined in tried[:MAX_REFINED_ROUNDS]:
            search.report_step("one motion for all robots within the tolerances, all frames")
            whole = search.refine_draft(one, joined)
            if whole.is_shared:
                made = coarse + replan_for_failures(search, whole, joined, lost, most, first + len(coarse))
                return made + relax_scenarios(made[-1], len(scenarios), lost, first + len(made))
    return []


def _start_to_meta(one: StartResult) -> dict[str, Any]:
    found = one.solution
    return {
        "start": one.start,
        "frames": one.frames,
        "objective": found.objective / one.frames,
        "solved": one.is_solved,
        "made": one.on_planned_branch,
        "grown": one.grown,
        "status": found.status,
        "iterations": found.iterations,
    }


def _plan(problem: Problem, best: Round, meta: dict[str, Any]) -> Plan:
    """Build the plan of the best round; problem: robot and target; meta: of the plan."""
    found = best.tried.solution
    condensed = Condensed(best.search.motion(best.scenarios))
    model = best.search.model
    robot = problem.robot
    # The wall is known to the program as a linearisation near the robots: it is renewed at the solution before
    # objectives are evaluated there.
    condensed.update_local_parameters(found.q, found.phi)
    return plan_from_configurations(
        problem,
        found.q,
        meta | {"failures": {}, "iterations": found.iterations},
        success=np.full(problem.frames, found.success),
        solve_time=np.full(problem.frames, np.nan),
        objective=condensed.by_frame(found.q, found.phi),
        kkt=np.full(problem.frames, found.kkt),
        planned=reported_unknowns(robot, model, found.q, found.x),
        simulator=Simulator(robot, reported_model(model)),
    )


def _plan_without_solution(problem: Problem, start: Array, meta: dict[str, Any]) -> Plan:
    """Build a plan from a start, configurations (T, 2d + 2), with no frame solved; meta: of the plan."""
    why = "interrupted" if meta["interrupted"] else NOT_SHARED
    unknown = np.full(problem.frames, np.nan)
    return plan_from_configurations(
        problem,
        start,
        meta | {"failures": {"all": why}},
        success=np.zeros(problem.frames, dtype=bool),
        solve_time=unknown,
        objective=unknown,
        kkt=unknown,
    )
