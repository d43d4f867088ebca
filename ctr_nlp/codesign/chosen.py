"""Tubes chosen by the plans on them: for the robot as described, and for all robots within the tolerances."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ctr_nlp.codesign.search import AGAIN, NEAR, Candidate, DesignSearch, error_of
from ctr_nlp.nlp.scenarios import Scenarios
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.plan import Plan
from ctr_nlp.robot import Robot
from ctr_nlp.steer.robust.tolerated import scenarios_of

MOST_FRAMES = 1500
"""Frames of all tasks for which tubes are found; of more, those of drafts say as much."""
PROMISE = 0.9
"""Further tubes are tried where their motions have less than this part of the error that the best plans have."""
FIRM = 0.3
"""Least margin of all robots within the tolerances while tubes are designed for them, where it can be kept: it
hardly costs any error, and plans, which need not have as much, have it in hand."""
ATTEMPTS = 4
"""Tubes for tolerances that are tried, at most, until all plans on them are certified."""


def best_planned(
    found: Sequence[Candidate], search: DesignSearch, plan: Callable[[Candidate], list[Plan]]
) -> tuple[Candidate, list[Plan]]:
    """Tubes and plans on them; of several those with the best plans.

    A plan holds its margin between frames, too, which may cost it much of what the motion has that tubes were
    found with. Tubes are therefore tried in the order of these motions, until the next promise little more.
    """
    ranked = sorted(found, key=error_of)
    tried = list[tuple[float, Candidate, list[Plan]]]()
    for number, one in enumerate(ranked, start=1):
        best = for_all_frames(one, search)
        plans = plan(best)
        error = _error(plans) if len(plans) == len(search.tasks) else math.inf  # not after Ctrl-C
        tried.append((error, best, plans))
        least = min(tried, key=lambda each: each[0])
        if search.stop() or number == len(ranked) or error_of(ranked[number]) >= PROMISE * least[0]:
            break
    return least[1:]


def for_all_frames(best: Candidate, search: DesignSearch) -> Candidate:
    """Tubes for all frames of the tasks, from motions planned on those of a draft, unless these are very many."""
    if sum(task.frames for task in search.tasks) > MOST_FRAMES:
        return best
    begun = search.start(best.start, best.p)
    if begun is None or search.stop():
        return best
    found = search.settled(begun, first=AGAIN)
    return begun if found is None else found


def _error(plans: Sequence[Plan]) -> float:
    """The root mean square of plans' e3, mm; infinite where one was not solved."""
    errors = [e3(plan) if plan.success.all() else None for plan in plans]
    return float(np.sqrt(np.mean([math.inf if error is None else error**2 for error in errors])))


def tolerated(robot: Robot) -> Scenarios:
    """Robots that stand for all within a robot's tolerances, with the forces that may act at its tip.

    Tubes decide how far a force bends them, so that errors under forces count here; motions hardly do, and plans
    leave them out.
    """
    return scenarios_of(robot, pushed=True)


def certified(
    found: Sequence[Candidate], search: DesignSearch, plan: Callable[[Candidate], list[Plan]]
) -> tuple[Candidate, list[Plan]]:
    """Tubes for the robots within the tolerances, and plans on them; of several those on which most plans hold.

    Tubes are tried until all do: that motions exist on some frames says little of the ways between these.
    """
    tried = list[tuple[Candidate, list[Plan], int]]()
    for best in itertools.islice(tolerant(found, search), ATTEMPTS):
        plans = plan(best)
        tried.append((best, plans, sum(plan.meta.get("certificate", {}).get("held", False) for plan in plans)))
        if tried[-1][2] == len(search.tasks) or search.stop():
            break
    if not tried:
        best = min(found, key=error_of)
        return best, plan(best)
    best, plans, _ = min(tried, key=lambda one: (-one[2], error_of(one[0])))
    return best, plans


def tolerant(found: Sequence[Candidate], search: DesignSearch) -> Iterator[Candidate]:
    """Tubes for the robots within the tolerances, on which these share motions, the most promising first."""
    for firm, one in _promising(found, search):
        if search.stop():
            return
        begun = None if one is None else firm.shared(one, tolerated)
        settled = None if begun is None else firm.settled(begun, tolerated, NEAR)
        if settled is not None and settled.solved:
            yield settled


def _promising(
    found: Sequence[Candidate], search: DesignSearch
) -> Iterator[tuple[DesignSearch, Candidate | None]]:
    """Tubes to begin with and margins to keep: each with its own motions, then with those planned anew on it."""
    for one in sorted(found, key=error_of):
        for margin in sorted({FIRM, search.margin}, reverse=True):
            firm = replace(search, margin=margin)
            yield firm, one
            yield firm, firm.start(one.start, one.p)
