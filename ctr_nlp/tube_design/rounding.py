"""Rounding of designed tubes to what can be bought and heat set: diameters, lengths, then curvatures tube by tube.

After every rounding the numbers that are not yet rounded are designed again, together with the motions, so that
they compensate for the error of the rounding: a greedy search for the best point of a grid.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.exceptions import CtrError, ProblemError
from ctr_nlp.ocp.shared.design import DESIGN_LENGTH_UNIT_MM, DesignedTubes
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2
from ctr_nlp.tube_design.search import (
    CONTINUED_BARRIER_MM2,
    INITIAL_STEP_COST_MM2,
    REPLANNED_BARRIER_MM2,
    Candidate,
    DesignSearch,
    Robots,
    error_of,
    nominal_scenario,
)
from ctr_nlp.tube_design.stock import DIAMETER_COLUMNS, StockTube, nearest_stock, with_diameters
from ctr_nlp.typing import Array

MAX_DRAFT_COMBINATIONS, FINALISTS = 8, 2
"""Combinations of tubes that are designed for on the frames of a draft, and how many of these are rounded to the
end.
"""
ROUNDINGS_PER_STEP = 2
"""Number of nearest ways to round that are tried at every step."""
LENGTH_STEP = 0.5
"""Step to which lengths of curved parts are rounded, mm."""
FORM_RADIUS_STEPS_MM = ((200.0, 1.0), (2000.0, 10.0), (math.inf, 100.0))
"""Largest radius, mm, and step of the radii of heat-setting forms up to there, mm. Forms can be cut to any radius,
but the radius that a tube keeps differs by some percent from tube to tube (see Tolerances): much smaller steps
have no meaning. No published series of radii is known to us: this one is ours."""

MIN_COMPARED_CURVATURE = 0.1
"""Curvature, 1/(100 mm), below which changes count relative to this one."""

Finish = Callable[[Sequence[Candidate], DesignSearch], tuple[Candidate, DesignSearch, Robots]]
"""Solves the best tubes of a draft for all frames, or for the tolerances."""


@dataclass(frozen=True)
class StockRounding:
    """Result of rounding designed tubes to a stock.

    Attributes
    ----------
    tubes : tuple of StockTube
        Tubing to buy, outermost first.
    free_errors, rounded_errors : ndarray
        Errors (n,) of the tasks' motions with free tubes and with these, mm, over the same frames and scenarios.
    combination_count : int
        Number of combinations of which they are the best.
    error : str
        What these errors are called.
    """

    tubes: tuple[StockTube, ...]
    free_errors: Array
    rounded_errors: Array
    combination_count: int
    error: str = "e3"

    @property
    def loss(self) -> float:
        """Increase of the root mean square of the errors over that of the free tubes, relative to the latter."""
        return float(np.sqrt(np.mean(self.rounded_errors**2) / np.mean(self.free_errors**2)) - 1)

    def __str__(self) -> str:
        """Return the result as a sentence."""
        parts = "; ".join(f"tube {i}: {one.part}" for i, one in enumerate(self.tubes, 1))
        change = f"{'raise' if self.loss >= 0 else 'lower'} {self.error} by {abs(self.loss):.1%}"
        return f"Tubes of stock ({parts}) {change}"


def round_to_stock(
    best: Candidate, search: DesignSearch, stock: Sequence[StockTube], finish: Finish, finalists: int = FINALISTS
) -> tuple[Candidate, StockRounding] | None:
    """Find the best tubes of a stock, starting from designed ones.

    Combinations are tried in the order of the distance from the designed stiffnesses (`nearest_stock`).

    Parameters
    ----------
    best : Candidate
        Designed tubes with free diameters.
    search : DesignSearch
        The search that found them, on the frames of a draft.
    stock : sequence of StockTube
        Tubing that can be bought.
    finish : callable
        Solves tubes for all frames, or for the tolerances; see `Finish`.
    finalists : int
        How many combinations are rounded to the end.

    Returns
    -------
    tuple of (Candidate, StockRounding) or None
        The rounded tubes and their errors; None when the search was stopped.

    Raises
    ------
    OptionError
        No tubes of the stock nest.
    ProblemError
        None of those tried can follow the tasks.
    """
    drafts = list[tuple[Candidate, DesignSearch, tuple[StockTube, ...]]]()
    chosen = nearest_stock(stock, search.tubes, best.p, search.has_load)[:MAX_DRAFT_COMBINATIONS]
    for tubes in chosen:
        if search.stop():
            break
        # Diameters are fixed from here on; lengths and curvatures are designed again for them.
        on = _fix_entries(
            _relax_diameter_rules(search), with_diameters(search.tubes, best.p, tubes), DIAMETER_COLUMNS
        )
        begun = on.start(best.start, on.tubes.nominal_unknowns)
        if begun is not None:
            again = on.run_round(begun, nominal_scenario, INITIAL_STEP_COST_MM2, COLD_START_BARRIER_MM2)
            drafts.append((begun if again is None else again, on, tubes))
    drafts.sort(key=lambda one: error_of(one[0]))
    ended = list[tuple[Candidate, tuple[StockTube, ...]]]()
    for draft, on, tubes in drafts:
        if len(ended) == finalists:
            break
        with suppress(CtrError):  # where rounding leaves no robot that can be made
            found = _round_tubes(*finish([draft], on))
            # Against the rules as they were given: the search that found these tubes had half of the diameters'
            # rules.
            if found is not None and all(r.lower <= r.value <= r.upper for r in search.tubes.rule_values(found.p)):
                ended.append((found, tubes))
    if not ended:
        if search.stop():
            return None
        raise ProblemError("no tubes of the stock were found that solve all problems")
    found, tubes = min(ended, key=lambda one: error_of(one[0]))
    return found, StockRounding(tubes, best.motions.error, found.motions.error, len(chosen), search.error_name)


def _relax_diameter_rules(search: DesignSearch) -> DesignSearch:
    """Return the search with half of the rules on diameters, which are checked when diameters are chosen.

    A fixed wall that just satisfies its rule would leave an interior-point method no interior.
    """
    rules = search.tubes.rules
    eased = {name: getattr(rules, name) / 2 for name in ("wall", "clearance", "channel")}
    return replace(search, tubes=replace(search.tubes, rules=replace(rules, **eased)))


def _fix_entries(search: DesignSearch, p: Array, kinds: Sequence[str]) -> DesignSearch:
    """Return the search with the entries of the given kinds fixed at their values in p (P,)."""
    tubes = search.tubes
    names = tuple(name for name in tubes.names if name.startswith(tuple(kinds)) or name in tubes.fixed)
    return replace(search, tubes=replace(tubes, robot=tubes.robot_of(p), fixed=names))


def _round_tubes(candidate: Candidate, search: DesignSearch, robots: Robots) -> Candidate | None:
    """Return tubes with lengths and curvatures that can be made; None where no motion exists on them."""
    d = search.tubes.robot.d
    # The multipliers of the free tubes are kept for the remarks on binding rules: rounded tubes are no solution.
    solution = candidate.solution
    steps = [tuple(f"curved_length_{i}" for i in range(1, d + 1))]
    steps += [
        tuple(f"{kind}_{i}" for kind in ("curvature", "root_curvature", "tip_curvature")) for i in range(1, d + 1)
    ]
    for names in steps:
        ways = [
            _redesign_rest(candidate, search, p, names, robots)
            for p in round_entries(search.tubes, candidate.p, names)[:ROUNDINGS_PER_STEP]
        ]
        candidate, search = min(ways, key=lambda way: error_of(way[0]))
    # On the nominal robot, re-planned motions may be better than those carried through all roundings.
    again = search.start(candidate.start, search.tubes.nominal_unknowns) if robots is nominal_scenario else None
    found = min((one for one in (candidate, again) if one is not None), key=error_of)
    return None if not np.isfinite(found.motions.rms) else replace(found, solution=solution)


def _redesign_rest(
    candidate: Candidate, search: DesignSearch, p: Array, names: Sequence[str], robots: Robots
) -> tuple[Candidate, DesignSearch]:
    """Design what is not fixed again, entries `names` being fixed at p (P,); errors are NaN where that fails."""
    search = _fix_entries(search, p, names)
    unknown = replace(candidate.motions, error=np.full_like(candidate.motions.error, np.nan))
    start = replace(candidate, p=search.tubes.nominal_unknowns, motions=unknown)
    found = (
        search.run_round(start, robots, INITIAL_STEP_COST_MM2, barrier)
        # The small barrier stays near the motions so far; the larger one finds others where that fails.
        for barrier in (CONTINUED_BARRIER_MM2, REPLANNED_BARRIER_MM2)
    )
    return next((one for one in found if one is not None), start), search


def round_entries(tubes: DesignedTubes, p: Array, names: Sequence[str]) -> list[Array]:
    """Return ways to round entries of p up or down to what can be made, nearest first.

    Parameters
    ----------
    tubes : DesignedTubes
        The tubes, with rules and fixed entries.
    p : ndarray
        Unknowns (P,) of the tubes.
    names : sequence of str
        Entries to round; fixed ones among them stay.

    Returns
    -------
    list of ndarray
        Rounded p (P,). Those that break a rule are left out, but the nearest is returned where all do.
    """
    lower, upper = tubes.box
    at = [k for k, name in enumerate(tubes.names) if name in names and lower[k] < upper[k]]
    ways = [[each for each in _around(tubes.names[k], p[k]) if lower[k] <= each <= upper[k]] or [p[k]] for k in at]
    found = list[tuple[bool, float, Array]]()
    # Duplicates are dropped: a value that can be made is its own neighbour above and below.
    for way in itertools.product(*map(dict.fromkeys, ways)):
        other = p.copy()
        other[at] = way
        # Relative changes, since a length and a curvature of one order matter alike; a curvature near 0 has no
        # relative one.
        changes = (np.array(way) - p[at]) / np.maximum(abs(p[at]), MIN_COMPARED_CURVATURE)
        found.append((not tubes.satisfies_rules(other), float(np.sum(changes**2)), other))
    found.sort(key=lambda each: each[:2])
    return [other for broken, _, other in found if not broken] or [found[0][2]]


def _around(name: str, value: float) -> tuple[float, ...]:
    """Return the values that can be made below and above an entry of p; lengths in 100 mm, curvatures in 1/(100
    mm).
    """
    if name.startswith("curved_length"):
        step = LENGTH_STEP / DESIGN_LENGTH_UNIT_MM
        return math.floor(value / step) * step, math.ceil(value / step) * step
    if value == 0:
        return (value,)
    # Forms are made by radius: curvatures between two neighbouring radii are further apart the smaller these are.
    # The radius of an S-shaped tube's root is negative.
    radius = DESIGN_LENGTH_UNIT_MM / value
    step = next(step for most, step in FORM_RADIUS_STEPS_MM if abs(radius) <= most)
    return tuple(
        DESIGN_LENGTH_UNIT_MM / (whole * step) for whole in (math.floor(radius / step), math.ceil(radius / step))
    )
