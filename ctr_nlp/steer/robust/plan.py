"""A plan for robots whose tubes are not quite known, over all frames at once."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
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
from ctr_nlp.steer.requests import check_described, check_search, checked_motions, checked_terms
from ctr_nlp.steer.robust.corners import Corners
from ctr_nlp.steer.robust.guards import guarded
from ctr_nlp.steer.robust.rounds import RELAXATIONS, Judge, Round, best_of, planned_again, relaxed
from ctr_nlp.steer.robust.search import RobustSearch, Start, Tried
from ctr_nlp.steer.robust.tolerated import described, told_on, told_unknowns
from ctr_nlp.steer.robust.trials import Trials
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.values import whole_number
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

MARGINS = 0.3, 0.5
"""Stability margins of the nominal robot in motions started from: which of them leads furthest differs."""
START_FRAMES = 49
"""Most frames of these motions that are solved: drafts, which begin from them, have 25 to 49."""
MOTION_PART = 0.1
"""Part of the lambda of a plain horizon: robots differ more from the target than smoothness is worth there."""
ROUNDS = 4
"""Times that a motion is planned again for robots that were lost."""


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
        Motions (T, 2d + 2) to start from.
    margins : sequence of float
        Stability margins of the nominal robot in motions frame by frame, which are started from where there are no
        `initial` ones, or too many robots are lost on what comes of these.
    settings : Settings
        `stability_margin` is the least one of every scenario; weights of contact and arrival count for each.
    terms : sequence of Term
        Further terms of the objective.
    progress : callable, optional
        Called as ``progress(done, total, note)``.

    Returns
    -------
    Plan
        With its certificate in ``meta["certificate"]`` (:meth:`Trials.certified`) and the robots that it was
        certified on. Where no motion is found that all scenarios share, the first motion started from; then no
        frame counts as solved.

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
    if not given and not margins:
        raise OptionError(
            "initial and margins are both empty: give motions to start from, or margins to find them"
        )
    motions = (1 + bool(given)) * (2 * (rounds + 1) + RELAXATIONS) + 1
    trials = Trials(problem.robot, model, motions, most_lost)
    terms = with_arrival(checked_terms(terms), settings, model)
    begin, searched = time.perf_counter(), 0.0
    told = told_on(model)
    with deferred_interrupt() as interrupted:
        nominal = Horizon(problem, told, None, start, end, _at(settings, *margins[:1]), terms)
        least = None if settings.stability_margin is None else np.full(problem.frames, settings.stability_margin)
        wall = wall_of(problem.robot, problem.sampled_lumen, model, settings, finer=1)
        tried, made, best = list[Tried](), list[Round](), None
        for starts, seconds in _starts(problem, told, given, margins, nominal, terms, settings):
            searched += seconds
            weight = MOTION_PART * nominal.balanced_weight(starts[0].x) if motion_weight is None else motion_weight
            own = model, nominal.ends, tuple(terms), weight, least
            search = RobustSearch(problem, *own, progress, interrupted, wall)
            drafts = search.drafts(starts, scenarios)
            tried += drafts
            made += _rounds(search, drafts, scenarios, trials, rounds, len(made))
            best = best_of(made, problem.frames)
            if interrupted() or (best is not None and best.lost.few):
                break
        if guards and best is not None and not interrupted():
            made += guarded(best, scenarios, Corners.of(problem.robot, model), trials, len(made))
            best = best_of(made, problem.frames)
        stopped = interrupted()
    asked = {"motion_weight": weight, "most_lost": most_lost, "margins": list(margins), "rounds": rounds}
    asked |= {"terms": listed(terms)}
    ends = {"start": _listed(nominal.ends.start), "end": _listed(nominal.ends.end)}
    meta = {
        "formulation": "robust-horizon",
        **told.told,
        "solver": "interior-point",
        "options": settings.options() | asked | ends,
        "build_s": nominal.build_seconds,
        "search_s": searched,
        "solve_s": time.perf_counter() - begin - searched,
        "interrupted": stopped,
        "contact_weight": None if wall is None else wall.weight,
        "starts": [_described(one) for one in tried],
        "rounds": [one.described() for one in made],
    }
    if best is None:
        return _unsolved(problem, told.configuration(problem.robot, starts[0].x), meta)
    plan = _plan(problem, best, meta)
    return plan if stopped else trials.certified(plan, best.lost, len(made))


def _at(settings: Settings, margin: float = MARGINS[0]) -> Settings:
    """Those of a nominal plan, far from any wall."""
    return replace(settings, stability_margin=margin, contact_weight=0.0)


def _starts(
    problem: Problem,
    model: Model,
    given: Sequence[Array],
    margins: Sequence[float],
    nominal: Horizon,
    terms: Sequence[Term],
    settings: Settings,
) -> Iterator[tuple[list[Start], float]]:
    """Motions to start from, and the seconds that these took: given ones, then those found frame by frame."""
    begin = time.perf_counter()
    followed = [model.follow(problem.robot, motion).x for motion in given]
    starts = [Start(f"motion {k}", x) for k, x in enumerate(followed, 1) if np.isfinite(x).all()]
    if starts:
        yield starts, time.perf_counter() - begin
    begin = time.perf_counter()
    if model.can_snap and margins:
        found = partial(
            per_frame_motions, problem, nominal.ends, progress=None, model=model, terms=terms, most=START_FRAMES
        )
        starts = [Start(f"margin {each:g}", found(settings=_at(settings, each))[0]) for each in margins]
    elif not model.can_snap:
        starts = [Start("the plain plan", nominal.solve().q)]
    elif starts:
        return
    else:
        raise OptionError("no motion of initial leads the robot from equilibrium to equilibrium; give margins too")
    yield starts, time.perf_counter() - begin


def _rounds(
    search: RobustSearch,
    drafts: Sequence[Tried],
    scenarios: Scenarios,
    lost: Judge,
    most: int,
    first: int,
) -> list[Round]:
    """Rounds over the frames of the best draft, then over all; of the next best where none leads to a motion.

    They are numbered from `first` on.
    """
    for draft in drafts:
        if not draft.solved or search.stop():
            break
        coarse = list[Round]()
        if draft.made and search.picked is not None:
            coarse = planned_again(search, draft, scenarios, lost, most, first)
        tried = [(one.tried, one.scenarios) for one in reversed(coarse)] or [(draft, scenarios)]
        for one, joined in tried:
            whole = search.refined(one, joined)
            if whole.shared:
                made = coarse + planned_again(search, whole, joined, lost, most, first + len(coarse))
                return made + relaxed(made[-1], len(scenarios), lost, first + len(made))
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
        "made": one.made,
        "grown": one.grown,
        "status": found.status,
        "iterations": found.iterations,
    }


def _plan(problem: Problem, best: Round, meta: dict[str, Any]) -> Plan:
    """Make a plan of a round."""
    found = best.tried.solution
    condensed, model, robot = Condensed(best.search.motion(best.scenarios)), best.search.model, problem.robot
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
    """The motion (T, 2d + 2) of a start, not solved."""
    why = "interrupted" if meta["interrupted"] else "no motion was found that all scenarios share"
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
