"""Selection among designed tubes by the plans on them: for the nominal robot, and for all robots within the
tolerances.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ctr_nlp.ocp.scenarios import Scenarios
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.robust.tolerance_scenarios import scenarios_from_tolerances
from ctr_nlp.tube_design.search import (
    CONTINUED_BARRIER_MM2,
    REPLANNED_BARRIER_MM2,
    Candidate,
    DesignSearch,
    error_of,
)

MAX_DESIGNED_FRAMES = 1500
"""Frames of all tasks, together, for which tubes are solved; with more, the frames of drafts decide."""
PROMISING_ERROR_RATIO = 0.9
"""Ratio of the error of further tubes' motions to that of the best plans below which these tubes are tried too."""
TOLERANT_DESIGN_MARGIN = 0.3
"""Stability margin of all robots within the tolerances while tubes are designed for them, where it can be
satisfied. It hardly costs any error, and is a reserve for the plans, whose margin is smaller.
"""
SELECTION_SAMPLES, SELECTION_SAMPLE_SEED = 200, 71
"""Number and seed of the simulated robots by which tubes are chosen within walls."""
MAX_TOLERANT_CANDIDATES = 4
"""Largest number of tubes for tolerances that are tried until all plans on them are certified."""


def choose_best_planned(
    found: Sequence[Candidate], search: DesignSearch, plan: Callable[[Candidate], list[Plan]]
) -> tuple[Candidate, list[Plan]]:
    """Choose the tubes with the best plans, for the nominal robot.

    A plan satisfies its margin between frames, too, which may make its error much larger than that of the motion
    that was found with the tubes. Tubes are therefore tried in the order of these motions' errors, until the next
    error is hardly smaller than that of the best plans.

    Parameters
    ----------
    found : sequence of Candidate
        Designed tubes, at least one.
    search : DesignSearch
        The search that found them.
    plan : callable
        Maps tubes to the plans of all tasks on them; fewer after Ctrl-C.

    Returns
    -------
    best : Candidate
        The chosen tubes.
    plans : list of Plan
        The plans on them.
    """
    ranked = sorted(found, key=error_of)
    tried = list[tuple[float, Candidate, list[Plan]]]()
    for number, one in enumerate(ranked, start=1):
        best = solve_all_frames(one, search)
        plans = plan(best)
        error = _error(plans) if len(plans) == len(search.tasks) else math.inf  # not after Ctrl-C
        tried.append((error, best, plans))
        least = min(tried, key=lambda each: each[0])
        # `number` counts from 1, so that ranked[number] is the next one.
        if search.stop() or number == len(ranked) or error_of(ranked[number]) >= PROMISING_ERROR_RATIO * least[0]:
            break
    return least[1:]


def solve_all_frames(best: Candidate, search: DesignSearch) -> Candidate:
    """Solve tubes over all frames of the tasks, starting from tubes found on the frames of a draft.

    Parameters
    ----------
    best : Candidate
        Tubes of a draft.
    search : DesignSearch
        The search over all frames.

    Returns
    -------
    Candidate
        The tubes for all frames; those of the draft where there are more than MAX_DESIGNED_FRAMES, no motions on
        them, or Ctrl-C came.
    """
    # With walls the frames of the draft decide: the last ones, which count most, are among them.
    if search.counts_more_than_shape or sum(task.frames for task in search.tasks) > MAX_DESIGNED_FRAMES:
        return best
    begun = search.start(best.start, best.p)
    if begun is None or search.stop():
        return best
    found = search.run_rounds(begun, first=REPLANNED_BARRIER_MM2)
    return begun if found is None else found


def _error(plans: Sequence[Plan]) -> float:
    """Return the root mean square of plans' e3, mm; infinite where a frame of one was not solved."""
    errors = [e3(plan) if plan.success.all() else None for plan in plans]
    return float(np.sqrt(np.mean([math.inf if error is None else error**2 for error in errors])))


def tolerance_scenarios(robot: Robot) -> Scenarios:
    """Return scenarios that represent all robots within the tolerances, with the forces that may act at the tip.

    The deflection by a force depends on the tubes, and hardly on motions: forces count here, and are left out when
    motions are planned.

    Parameters
    ----------
    robot : Robot
        The nominal robot.

    Returns
    -------
    Scenarios
        The nominal robot first.
    """
    return scenarios_from_tolerances(robot, with_tip_force=True)


def choose_certified(
    found: Sequence[Candidate], search: DesignSearch, plan: Callable[[Candidate], list[Plan]]
) -> tuple[Candidate, list[Plan]]:
    """Choose the tubes on which most plans are certified, for the robots within the tolerances.

    Tubes are tried until all plans on them are certified: motions that exist at the frames of a draft may fail
    between these.

    Parameters
    ----------
    found : sequence of Candidate
        Designed tubes, at least one.
    search : DesignSearch
        The search that found them, on the frames of a draft.
    plan : callable
        Maps tubes to the plans of all tasks on them.

    Returns
    -------
    best : Candidate
        The chosen tubes; the best nominal ones where no motions were found that all robots share.
    plans : list of Plan
        The plans on them.
    """
    tried = list[tuple[Candidate, list[Plan], int]]()
    for best in itertools.islice(tolerant_candidates(found, search), MAX_TOLERANT_CANDIDATES):
        plans = plan(best)
        tried.append((best, plans, sum(plan.meta.get("certificate", {}).get("held", False) for plan in plans)))
        if tried[-1][2] == len(search.tasks) or search.stop():
            break
    if not tried:
        best = min(found, key=error_of)
        return best, plan(best)
    # Most certified plans first; the error decides among equals.
    best, plans, _ = min(tried, key=lambda one: (-one[2], error_of(one[0])))
    return best, plans


def choose_reaching(
    found: Sequence[Candidate],
    search: DesignSearch,
    plan: Callable[[Candidate], list[Plan]],
    *,
    nominal: bool = False,
    within_reach: Sequence[int] | None = None,
) -> tuple[Candidate, list[Plan]]:
    """Choose the tubes with which most ends are reached within walls.

    An end is reached where the verdicts of its plan say so (:attr:`Verdicts.end_reached`), on simulated robots
    that neither planning nor the evaluation of the design sees; for the nominal robot without these
    (:attr:`Verdicts.end_reached_as_described`). Tubes are tried until all ends are reached.

    Parameters
    ----------
    found : sequence of Candidate
        Designed tubes, at least one, in the order in which they are tried.
    search : DesignSearch
        The search that found them, in which walls count.
    plan : callable
        Maps tubes to the plans of all tasks on them.
    nominal : bool
        Whether ends are reached by the nominal robot alone.
    within_reach : sequence of int, optional
        Upper bounds, one for each tubes, of the ends that can be reached; tubes that cannot reach more than those
        tried are left out.

    Returns
    -------
    best : Candidate
        The tubes with most ends reached; among equals those whose plans hold on most simulated robots.
    plans : list of Plan
        The plans on them, with samples.
    """
    most = within_reach if within_reach is not None else [len(search.tasks)] * len(found)
    tried = list[tuple[int, float, Candidate, list[Plan]]]()
    for best, at_most in itertools.islice(zip(found, most, strict=True), MAX_TOLERANT_CANDIDATES):
        if tried and at_most <= max(one[0] for one in tried):
            continue
        plans = plan(best) if nominal else [_with_selection_samples(one) for one in plan(best)]
        told = [one.verdicts for one in plans]
        reached = sum(one.end_reached_as_described if nominal else one.end_reached for one in told)
        held = sum(one.holds.number or 0.0 for one in told)
        tried.append((reached, held, best, plans))
        if reached == len(search.tasks) or search.stop():
            break
    _, _, best, plans = max(tried, key=lambda one: one[:2])
    return best, plans


def _with_selection_samples(plan: Plan) -> Plan:
    """Return a plan with the samples by which tubes are chosen; itself where no frame of it was reached."""
    if not plan.reached_frames.any():
        return plan
    return plan.with_samples(SELECTION_SAMPLES, SELECTION_SAMPLE_SEED)


def tolerant_candidates(found: Sequence[Candidate], search: DesignSearch) -> Iterator[Candidate]:
    """Yield tubes for the robots within the tolerances, on which these share motions, the most promising first.

    Parameters
    ----------
    found : sequence of Candidate
        Tubes designed for the nominal robot.
    search : DesignSearch
        The search that found them.

    Yields
    ------
    Candidate
        Solved tubes and motions, with the margin TOLERANT_DESIGN_MARGIN first, then with the search's own.
    """
    for firm, one in _promising(found, search):
        if search.stop():
            return
        begun = None if one is None else firm.share_motions(one, tolerance_scenarios)
        settled = None if begun is None else firm.run_rounds(begun, tolerance_scenarios, CONTINUED_BARRIER_MM2)
        if settled is not None and settled.is_solution:
            yield settled


def _promising(
    found: Sequence[Candidate], search: DesignSearch
) -> Iterator[tuple[DesignSearch, Candidate | None]]:
    """Yield tubes to start from, with searches that enforce a margin: each with its own motions, then with
    re-planned ones.
    """
    for one in sorted(found, key=error_of):
        # The larger margin first, which leaves plans more in hand.
        for margin in sorted({TOLERANT_DESIGN_MARGIN, search.margin}, reverse=True):
            firm = replace(search, margin=margin)
            yield firm, one
            yield firm, firm.start(one.start, one.p)
