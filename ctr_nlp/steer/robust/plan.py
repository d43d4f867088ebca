"""Robust plans over all frames at once: one motion for all robots within the tolerances.

    min  sum_j ( sum_s w_s E_j(phi_sj, q_j; tubes_s) + lambda |W (q_{j+1} - q_j)|^2 / dt^2 )
    subject to  alpha(phi_sj, q_j; tubes_s) = alpha_j + delta_s

over the shared q_j = (alpha, beta, theta), rad and mm, of every frame j and the tips phi_sj, rad, of every robot
s, with limits and a least stability margin of each ("Plans for robots that are not quite known" in
docs/method.md). The scenarios s are few; simulated robots tell whether others within the tolerances do as well,
and those that do not join the scenarios.
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
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.terms.arrival import with_arrival
from ctr_nlp.formulations.terms.term import listed
from ctr_nlp.formulations.wall import wall_of
from ctr_nlp.models import Model
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.plan.robustness import MOST_LOST
from ctr_nlp.simulation.forward import Simulator
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.steer.horizon import Horizon
from ctr_nlp.steer.motions import per_frame_motions
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.realised import MOST
from ctr_nlp.steer.requests import check_described, check_search, checked_motions, checked_terms
from ctr_nlp.steer.robust.corners import Corners
from ctr_nlp.steer.robust.guards import guarded
from ctr_nlp.steer.robust.held import ROUNDS as IMPROVEMENTS
from ctr_nlp.steer.robust.held import Purpose, improved
from ctr_nlp.steer.robust.rounds import RELAXATIONS, Judge, Round, best_of, planned_again, relaxed
from ctr_nlp.steer.robust.search import RobustSearch, Start, Tried
from ctr_nlp.steer.robust.tolerated import described, told_on, told_unknowns
from ctr_nlp.steer.robust.trials import Trials
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.values import whole_number
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

MARGINS = (0.5,)
"""Stability margins of the nominal robot in motions frame by frame, the starts beside its plan."""
SPARE = 0.1
"""Margin beyond the one asked for with which scenarios are planned for: margins are less between frames, and on
robots that are not among them. Plans need fewer rounds with it, and errors are larger by 1 % at most.
"""
START_FRAMES = 49
"""Most frames of these motions that are solved: drafts, which begin from them, have 25 to 49 frames."""
MOTION_PART = 0.1
"""Share of the lambda of a nominal horizon: robots differ more from the target than smoothness is worth there."""
NOT_SHARED = "no motion was found that all robots within the tolerances share"
REFINED = 2
"""Most rounds over the frames of a draft, from the last one back, of which all frames are tried."""
ROUNDS = 4
"""Most times that a motion is planned again for robots that were lost."""


def solve_robust(
    problem: Problem,
    scenarios: Scenarios | None = None,
    *,
    most_lost: float = MOST_LOST,
    rounds: int = ROUNDS,
    guards: bool = False,
    model: str | Model = "elastic",
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    motion_weight: float | None = None,
    initial: Sequence[npt.ArrayLike] = (),
    margins: Sequence[float] = MARGINS,
    settings: Settings = DEFAULTS,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    nominal: Callable[[Plan], None] | None = None,
) -> Plan:
    """Plan one motion that all robots within the tolerances follow, arrive with, and keep off the wall with.

    Robots that stand for the tolerances (scenarios) share the motors' angles and extensions of every frame, and
    each has tips of its own. Minimised is their mean shape error, with what contact and arrival of each cost,
    subject to a stability margin of each. A motion is then tried on simulated robots; those that snap or leave the
    branch join the scenarios, and it is planned again.

    Parameters
    ----------
    problem : Problem
        Robot and target; the robot's tolerances say how built robots differ from it.
    scenarios : Scenarios, optional
        The robots that are planned for, the first of which is the problem's own. By default a two-level design of
        the tolerances (Plackett and Burman, 1946), and the nominal robot under the forces that may act at its tip,
        whose errors do not count.
    most_lost : float
        Share of all robots within the tolerances that may snap or leave the branch, known with 95 % confidence.
    rounds : int
        How often a motion is planned again for robots that were lost, at most.
    guards : bool
        Whether robots at the corners of the tolerances are kept as well, which takes several times as long.
    model : str or Model
        ``"elastic"``, ``"dominant"`` or ``Loaded(load)``. On a model that cannot snap, the plan of the nominal
        robot is started from.
    start, end : array_like, optional
        Configurations q (2d + 2,) at time 0 and in the last frame.
    motion_weight : float, optional
        Lambda in s^2; by default a tenth of that of a nominal horizon.
    initial : sequence of array_like
        Motions (T, 2d + 2) to start from. By default the plan of the nominal robot (:func:`solve_horizon`).
    margins : sequence of float
        Stability margins of the nominal robot in motions frame by frame, which are started from where too many
        robots are lost on what comes of the others.
    settings : Settings
        `stability_margin` is the least one of every scenario, which are planned for with SPARE more; weights of
        contact and arrival count for each.
    terms : sequence of Term
        Further terms of the objective.
    progress : callable, optional
        Called as ``progress(done, total, note)``.
    nominal : callable, optional
        Called with the plan of the nominal robot, seconds before all the others are planned for; not where
        `initial` motions are given, or the robot bears a load.

    Returns
    -------
    Plan
        With its certificate in ``meta["certificate"]`` (:meth:`Trials.certified`) and the robots that it was
        certified on. Where no motion is found that all scenarios share, the plan of the nominal robot, and
        ``meta["not_shared"]`` says so; without one, the first motion started from, no frame of which counts as
        solved.

    Raises
    ------
    OptionError, ProblemError, RobotError
        An option, the problem or the robot is not what it must be.
    """
    check_described(problem, settings)
    check_search(motion_weight, None, 1)
    whole_number(OptionError, "rounds", rounds, 0)
    model, scenarios = described(problem.robot, model, scenarios)
    given = checked_motions(problem, initial)
    if not (given or margins) and told_on(model).bears is not None:
        raise OptionError(
            "initial and margins are both empty: give motions to start from, or margins to find them"
        )
    # Most motions that can be tried: each is judged with its part of the 5 % (Trials), which holds only if none
    # comes unplanned. For two sets of starts: rounds on a draft and on all frames, relaxations, and improvements
    # with a round each; and once with guards.
    motions = 2 * (2 * (rounds + 1) + RELAXATIONS + 2 * IMPROVEMENTS) + 1
    trials = Trials(problem.robot, model, motions, most_lost)
    terms = with_arrival(checked_terms(terms), settings, model)
    purpose = Purpose(problem, model, settings)
    # `weight` stays None until a first start is known from which the default can be found.
    begin, searched, weight = time.perf_counter(), 0.0, motion_weight
    told = told_on(model)
    with deferred_interrupt() as interrupted:
        planner = Horizon(problem, told, None, start, end, settings, terms)
        least = None
        if settings.stability_margin is not None:
            least = np.full(problem.frames, min(settings.stability_margin + SPARE, MOST))
        wall = wall_of(problem.robot, problem.sampled_lumen, model, settings, finer=1)
        starts = _Starts(planner, told, given, margins, terms, settings, progress, interrupted, nominal)
        tried, made, best, open_ = list[Tried](), list[Round](), None, list[Tried]()
        # Ways to find starts, one after the other; a later one is used where the drafts of the earlier ones are
        # not good, or their motions lose too many robots.
        for number, find in enumerate(starts.ways):
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
            # Drafts that no rounds were made from yet; good or not, they are compared with those of the next way.
            open_ = sorted(open_ + drafts, key=lambda one: one.promise)
            last = number + 1 == len(starts.ways)
            # A draft that is poor, though solved, is put aside while there is another way to find starts.
            if not (last or given or interrupted()) and open_ and not _good(open_[0], settings):
                continue
            made += _rounds(search, open_, scenarios, trials, rounds, len(made))
            best, open_ = best_of(made, problem.frames), []
            if best is not None and best.lost.few and not interrupted():
                # Few robots are lost: only now is it worth asking how many also arrive and keep off the wall.
                judged = best._replace(failing=purpose(best.tried.solution.q, len(made)))
                made = [judged if one is best else one for one in made]
                made += improved(judged, purpose, trials, len(made))
                best = best_of(made, problem.frames)
            if interrupted() or (best is not None and best.lost.few):
                break
        if guards and best is not None and not interrupted():
            made += guarded(best, scenarios, Corners.of(problem.robot, model), trials, len(made))
            best = best_of(made, problem.frames)
        stopped = interrupted()
    asked: dict[str, Any] = {
        "motion_weight": weight,
        "most_lost": most_lost,
        "margins": list(margins),
        "rounds": rounds,
    }
    asked |= {"terms": listed(terms)}
    meta = {
        "formulation": "robust-horizon",
        **told.told,
        "solver": "interior-point",
        "options": settings.options() | asked | planner.ends.options,
        "build_s": planner.build_seconds,
        "search_s": searched,
        "solve_s": time.perf_counter() - begin - searched,
        "interrupted": stopped,
        "contact_weight": None if wall is None else wall.weight,
        "starts": [_described(one) for one in tried],
        "rounds": [one.described() for one in made],
    }
    # No motion for all robots: the user gets the nominal plan, which says so.
    if best is None and starts.plan is not None and starts.plan.success.all():
        kept = {"interrupted": stopped, "starts": meta["starts"], "rounds": meta["rounds"]}
        kept |= {} if stopped else {"not_shared": NOT_SHARED}
        return replace(starts.plan, meta=starts.plan.meta | kept)
    if best is None:
        return _unsolved(problem, told.configuration(problem.robot, found[0].x), meta)
    plan = _plan(problem, best, meta)
    return plan if stopped else trials.certified(plan, best.lost, len(made))


@dataclass
class _Starts:
    """Finds motions to start from: given ones, or the plan of the nominal robot; and others, frame by frame.

    planner: of the nominal robot's horizon. model: on which plans are reported. given: motions (T, 2d + 2).
    margins: of motions frame by frame. told: called with the nominal plan. plan: that plan, once it is known.
    """

    planner: Horizon
    model: Model
    given: Sequence[Array]
    margins: Sequence[float]
    terms: Sequence[Term]
    settings: Settings
    progress: Progress | None
    stop: Callable[[], bool]
    told: Callable[[Plan], None] | None
    plan: Plan | None = None

    @property
    def ways(self) -> list[Callable[[], list[Start]]]:
        """Ways to find starts; where the first finds a good one, the others are not needed."""
        first = self._given if self.given else self._nominal
        return [first, *([self._frame_by_frame] if self.model.can_snap and self.margins else [])]

    def _given(self) -> list[Start]:
        robot = self.planner.problem.robot
        followed = [self.model.follow(robot, motion).x for motion in self.given]
        # A motion on which the nominal robot snaps has NaN: scenarios cannot be started from there.
        found = [Start(f"motion {k}", x) for k, x in enumerate(followed, 1) if np.isfinite(x).all()]
        if not (found or self.margins):
            raise OptionError(
                "no motion of initial leads the robot from equilibrium to equilibrium; give margins too"
            )
        return found

    def _nominal(self) -> list[Start]:
        """Return the nominal robot's plan as a start; nothing where that robot snaps, or bears a known load."""
        if self.model.bears is not None:
            return []
        self.plan = self.planner.solve(progress=self.progress)
        if self.told is not None:
            self.told(self.plan)
        x = self.model.follow(self.planner.problem.robot, self.plan.q).x if self.model.can_snap else self.plan.q
        return [Start("the nominal plan", x)] if np.isfinite(x).all() else []

    def _frame_by_frame(self) -> list[Start]:
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
        return [Start(f"margin {each.stability_margin:g}", found(settings=each)[0]) for each in asked]


def _good(draft: Tried, settings: Settings) -> bool:
    """Whether a draft's mean error over robots, with all that its contact and misses cost, is what is allowed."""
    # The objective is a sum over frames of mean squared errors, mm^2; error_allowed is in mm.
    return draft.shared and draft.solution.objective <= draft.frames * settings.error_allowed**2


def _rounds(
    search: RobustSearch,
    drafts: Sequence[Tried],
    scenarios: Scenarios,
    lost: Judge,
    most: int,
    first: int,
) -> list[Round]:
    """Make rounds over the frames of the best draft, then over all; from the next draft where none leads to a
    motion.

    drafts: the most promising first. scenarios: planned for from the beginning. lost: judges each round's motion;
    rounds are numbered from `first` on. most: rounds on a draft, and on all frames.
    """
    for draft in drafts:
        if not draft.solved or search.stop():
            break
        coarse = list[Round]()
        if draft.made and search.picked is not None:
            coarse = planned_again(search, draft, scenarios, lost, most, first)
        # The last round of the draft has met most of the lost robots already; an earlier one may be easier to
        # refine.
        tried = [(one.tried, one.scenarios) for one in reversed(coarse)] or [(draft, scenarios)]
        for one, joined in tried[:REFINED]:
            whole = search.refined(one, joined)
            if whole.shared:
                made = coarse + planned_again(search, whole, joined, lost, most, first + len(coarse))
                return made + relaxed(made[-1], len(scenarios), lost, first + len(made))
    return []


def _described(one: Tried) -> dict[str, Any]:
    found = one.solution
    return {
        "start": one.start,
        "frames": one.frames,
        "objective": found.objective / one.frames,
        "solved": one.solved,
        "made": one.made,
        "grown": one.grown,
        "status": found.status,
        "iterations": found.iterations,
    }


def _plan(problem: Problem, best: Round, meta: dict[str, Any]) -> Plan:
    """Make a plan of the best round; meta: of the plan."""
    found = best.tried.solution
    condensed, model, robot = Condensed(best.search.motion(best.scenarios)), best.search.model, problem.robot
    # What depends on where robots are, such as the wall near them, is described at the solution before objectives
    # are evaluated there.
    condensed.look(found.q, found.phi)
    return plan_from_configurations(
        problem,
        found.q,
        meta | {"failures": {}, "iterations": found.iterations},
        success=np.full(problem.frames, found.success),
        solve_time=np.full(problem.frames, np.nan),
        objective=condensed.by_frame(found.q, found.phi),
        kkt=np.full(problem.frames, found.kkt),
        planned=told_unknowns(robot, model, found.q, found.x),
        simulator=Simulator(robot, told_on(model)),
    )


def _unsolved(problem: Problem, start: Array, meta: dict[str, Any]) -> Plan:
    """Make a plan of a start, configurations (T, 2d + 2), in which no frame counts as solved."""
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
