"""Multi-start: solving one chain (all frames as one NLP) from a motion, and choosing the best of several results.

The problem is not convex, so that several initial guesses are solved. Every solve guarantees a result no worse
than its start: where the solver ends above it, the best feasible iterate is returned. Near a wall the chain is a
linearisation, which is renewed around each solution until the slacks z (mm by which the clearance is missed) no
longer change.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.wall import MAX_WALL_RELINEARISATIONS, WALL_SLACK_TOLERANCE_MM
from ctr_nlp.solvers import (
    CHAIN_SOLVERS,
    FEASIBILITY_TOLERANCE,
    ChainSolver,
    Iterate,
    Solution,
    Watch,
    default_chain_solver,
)
from ctr_nlp.solvers.frame.adapter import KKT_TOLERANCE
from ctr_nlp.solvers.motion.chain_solution import (
    COLD_START_BARRIER_MM2,
    LOCAL_START_BARRIER_MM2,
    evaluate_chain_solution,
)
from ctr_nlp.typing import Array

IterateCallback = Callable[[Iterate], None]

OBJECTIVE_TIE_RELATIVE_TOLERANCE = 1e-9
"""Relative difference of objectives up to which they count as equal: that of rounding."""
SAME_SOLUTION_RELATIVE_TOLERANCE = 1e-6
"""Relative difference of objectives up to which two starts count as having the same solution."""
MAX_SLACK_RATIO_IN_TWO_ROUNDS = 0.9
"""Where a chain is a linearisation, errors of the slacks that two rounds reduce by less than this factor alternate
between two points of the wall, and further rounds do not help."""
SETTLED_WALL_MM = 0.02
"""Error of the slacks from which on a linearised wall hardly changes, and solves are exact."""
BARRIER_PER_WALL_ERROR_MM = 0.1
"""First barrier of a further round, mm^2, for each mm of the slacks' error in the one before."""
CONSTRAINTS_IN_MM = "order", "carriage gap", "clearance"
"""Constraints in mm."""


class Effort(NamedTuple):
    """How well a chain is to be solved.

    tolerance: largest KKT residual, mm^2 per unit of the unknowns; None for the solver's own. iterations: after
    which the solve ends, and is not tried again from its best iterate; None for the solver's own.
    """

    tolerance: float | None = None
    iterations: int | None = None


FULL, BRIEF = Effort(), Effort(iterations=150)
"""Efforts for a solution, from anywhere and from near it: some searches then go to and fro across a corner of the
objective, and the point that they started from is as good.
"""
ROUGH = Effort(KKT_TOLERANCE / 2, 150)
"""Effort near a wall that will be linearised again."""


@dataclass(frozen=True)
class SolvedStart:
    """The result of solving from one motion: a solution or, where success is False, the best feasible iterate,
    else the last one.

    motion (T, n - slacks): the robot's unknowns. parameters: of the chain that was solved. feasible: whether the
    point satisfies all limits. start_objective: objective of the start after it was projected to its limits, mm^2;
    inf where that was not possible. seconds: of the solve. on_planned_branch: whether the simulated robot stays on
    the planned branch, as far as that was checked.
    """

    solution: Solution
    motion: Array
    parameters: Array
    feasible: bool
    start_objective: float
    seconds: float
    on_planned_branch: bool = True

    def as_iterate(self) -> Iterate:
        """Return the result as one iterate, for callbacks; its violation is 0 where it is feasible, else NaN."""
        found = self.solution
        violation = 0.0 if self.feasible else math.nan
        return Iterate(found.iterations, found.objective, violation, found.kkt, found.x)

    def to_meta(self, frames: int) -> dict[str, Any]:
        """Return the entry of this start in a plan's meta; objectives are means over `frames` frames, mm^2."""
        # JSON has no infinity: a start without an objective is null there.
        start = None if math.isinf(self.start_objective) else self.start_objective / frames
        return {
            "start_objective": start,
            "objective": self.solution.objective / frames,
            "solved": self.solution.success,
            "status": self.solution.status,
            "iterations": self.solution.iterations,
            "seconds": self.seconds,
        }


def best_solved_start(attempts: Sequence[SolvedStart]) -> SolvedStart:
    """Return the best of several solved starts.

    That is the solution of least objective, unless some start had a lower one: then the best feasible point.
    Motions on whose branch the simulated robot stays come before all others. attempts: the solved starts.
    """
    # A solution above some start's own objective does not count as solved: a plan must never be worse than the
    # best initial guess.
    least = min(one.start_objective for one in attempts)

    def sort_key(one: SolvedStart) -> tuple[bool, bool, bool, float]:
        found = one.solution
        solved = found.success and no_worse(found.objective, least)
        # False sorts before True: on the branch, then solved, then feasible; the objective decides among equals.
        return not one.on_planned_branch, not solved, not one.feasible, found.objective

    return min(attempts, key=sort_key)


def distinct(attempts: Sequence[SolvedStart]) -> list[SolvedStart]:
    """Return the solved starts `attempts`, best first, without those with the objective of one before."""
    # Objectives stand for solutions: two different local optima with equal objectives would be taken for one, and
    # nothing is lost, since either serves.
    ranked = sorted(attempts, key=lambda one: (not one.solution.success, one.solution.objective))
    objectives = [one.solution.objective for one in ranked]
    return [
        one
        for k, one in enumerate(ranked)
        if k == 0
        or abs(objectives[k] - objectives[k - 1]) > SAME_SOLUTION_RELATIVE_TOLERANCE * (1 + abs(objectives[k]))
    ]


def describe_failures(chain: Chain, one: SolvedStart) -> dict[str, str]:
    """Return why a result is no solution, by frame (from 1) where limits are exceeded, else under "all".

    chain: of all frames. one: the result; an empty dict is returned where it is a solution.
    """
    if one.solution.success:
        return {}
    # Margins may have been raised, and the wall linearised again, since the chain was built: limits are those of
    # the chain that was solved.
    chain = replace(chain, parameters=one.parameters)
    found: dict[str, str] = {}
    for name, frame, amount in chain.excesses(chain.evaluate(one.solution.x)[1], FEASIBILITY_TOLERANCE):
        unit = "mm" if "beta" in name or name in CONSTRAINTS_IN_MM else "rad"
        found.setdefault(str(frame), f"{name} exceeded by {amount:.3g} {unit}; relax it, or give more time")
    return found or {"all": f"{one.solution.status}, KKT residual {one.solution.kkt:.1e}"}


def no_worse(objective: float, than: float) -> bool:
    """Return whether an objective is at most `than`, up to rounding (OBJECTIVE_TIE_RELATIVE_TOLERANCE)."""
    return objective <= than + OBJECTIVE_TIE_RELATIVE_TOLERANCE * (1 + abs(objective))


def combine_callbacks(*reports: IterateCallback | None) -> IterateCallback | None:
    """Return one callback that passes every iterate to all given ones; None where all of these are None."""
    known = [report for report in reports if report is not None]

    def report(iterate: Iterate) -> None:
        for each in known:
            each(iterate)

    return report if known else None


class EvaluatedMotion(NamedTuple):
    """A motion x (T n,), its objective in mm^2, and its largest violation of a limit."""

    x: Array
    objective: float
    violation: float


def project_to_limits(chain: Chain, x: Array) -> EvaluatedMotion:
    """Return the motion x (T n,) or, where it violates limits of a chain, the nearest one that keeps them.

    Where a frame has nonlinear constraints, the nearest feasible motion is as hard to find as the best one: x is
    then only clipped to its bounds, and the rest is left to the solver.
    """
    start = _evaluate_motion(chain, np.clip(x, chain.lower.ravel(), chain.upper.ravel()))
    if chain.has_nonlinear_constraints or start.violation <= FEASIBILITY_TOLERANCE:
        return start
    # With linear constraints the projection is a convex quadratic program, so that any solver finds it.
    return _evaluate_motion(
        chain, CHAIN_SOLVERS[default_chain_solver()](chain.nearest(start.x))(start.x, Watch()).x
    )


def _evaluate_motion(chain: Chain, x: Array) -> EvaluatedMotion:
    objective, value = chain.evaluate(x)
    return EvaluatedMotion(x, objective, chain.violation(value))


def solve_from_motion(
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    motion: Array,
    report: IterateCallback | None,
    stop: Callable[[], bool],
    barrier: float = COLD_START_BARRIER_MM2,
    roughly: bool = False,
) -> SolvedStart:
    """Solve a chain from a motion (T, n - slacks), as :meth:`Chain.linearise_at` takes it.

    solver: builds a solver for a chain. report: called with every iterate. stop: returns whether to end. barrier:
    the first barrier parameter, mm^2. A chain that is a linearisation, as at a wall, is solved again around its
    solution until the slacks agree with the wall there: roughly, but for the last rounds; in all of them where
    `roughly` is asked for. The result is never worse than the start.
    """
    begin = time.perf_counter()
    tried = list[SolvedStart]()
    missing = list[float]()
    near, x0 = chain.linearise_at(motion)
    known: Array | None = None
    exact = chain.local_parameters is None
    for rounds_left in reversed(range(MAX_WALL_RELINEARISATIONS)):
        near_solution = bool(tried) and tried[-1].solution.success
        effort = ROUGH if not exact else BRIEF if near_solution else FULL
        one = _solve_chain(near, solver(near), x0, barrier, report, stop, known, effort)
        near, x0 = chain.linearise_at(one.motion)
        # linearise_at keeps the robot's unknowns and recomputes only the slacks: the difference to the solution's
        # x is the error of the linearised wall, mm.
        missing.append(float(abs(x0 - one.solution.x).max()))
        # The objective is that of the wall at the solution, not of the linearisation that it was found with.
        objective = near.evaluate(x0)[0] if missing[-1] > 0 else one.solution.objective
        tried.append(replace(one, solution=replace(one.solution, objective=objective)))
        done = wall_rounds_done(missing)
        if stop() or (exact and not one.solution.success) or (done and (exact or roughly)):
            break
        # As long as the wall still changes, exact solutions would be lost work.
        exact = exact or (not roughly and (done or missing[-1] <= SETTLED_WALL_MM or rounds_left == 1))
        # From the second round on the active limits are known: multipliers are passed on, and the barrier is the
        # smaller the less the wall has changed, so that the solver stays near the solution that it has.
        known = np.concatenate([one.solution.lam_x, one.solution.lam_g])
        barrier = float(
            np.clip(BARRIER_PER_WALL_ERROR_MM * missing[-1], LOCAL_START_BARRIER_MM2, COLD_START_BARRIER_MM2)
        )
    best = best_solved_start(tried)
    iterations = sum(one.solution.iterations for one in tried)
    return replace(
        best,
        solution=replace(best.solution, iterations=iterations),
        start_objective=tried[0].start_objective,
        seconds=time.perf_counter() - begin,
    )


def wall_rounds_done(missing: Sequence[float]) -> bool:
    """Return whether the re-linearisation of a wall has ended.

    missing: error of the slacks in each round, mm. It ends where the last one is within WALL_SLACK_TOLERANCE_MM,
    or where two rounds have not reduced it below MAX_SLACK_RATIO_IN_TWO_ROUNDS times its value: solutions then
    alternate between two points.
    """
    # The two inf in front stand for rounds before the first, so that three rounds are needed before slowness
    # counts.
    return bool(missing) and (
        missing[-1] <= WALL_SLACK_TOLERANCE_MM
        or missing[-1] > MAX_SLACK_RATIO_IN_TWO_ROUNDS * [math.inf, math.inf, *missing][-3]
    )


def _solve_chain(
    chain: Chain,
    solve: ChainSolver,
    x0: Array,
    barrier: float,
    report: IterateCallback | None,
    stop: Callable[[], bool],
    multipliers: Array | None,
    effort: Effort,
) -> SolvedStart:
    """Solve a chain from x0 (T n,) and, where the result is worse than x0, once more from the best iterate.

    solve: the chain's solver. barrier: the first barrier parameter, mm^2. report, stop: callbacks. multipliers: of
    all rows, where those of a neighbouring chain are known. effort: to take.
    """
    x0, objective, violation = project_to_limits(chain, x0)
    # A start that violates limits is no promise: its objective may be lower than that of any feasible motion.
    start = objective if violation <= FEASIBILITY_TOLERANCE else np.inf
    watch = Watch(report, stop, Iterate(0, objective, violation, np.inf, x0), effort.iterations)
    solution = _select_best_point(chain, solve(x0, watch, barrier, multipliers, effort.tolerance), watch, start)
    # A solver that failed still passed feasible points. The second solve starts from the best of them with a small
    # barrier, which keeps it in that basin.
    if not (solution.success or watch.best is None or stop() or effort.iterations):
        again = _select_best_point(chain, solve(watch.best.x, watch, LOCAL_START_BARRIER_MM2), watch, start)
        solution = replace(again, iterations=solution.iterations + again.iterations)
    feasible = chain.violation(chain.evaluate(solution.x)[1]) <= FEASIBILITY_TOLERANCE
    return SolvedStart(solution, chain.robot_of(solution.x), chain.parameters, feasible, start, 0.0)


def _select_best_point(chain: Chain, solution: Solution, watch: Watch, start: float) -> Solution:
    """Return a solution if it is no worse than its start, else the best iterate of the solver.

    watch: has the best iterate. start: objective of the start, mm^2. A start that was optimal already is reached
    again only to the solver's tolerance; by its own KKT residual it is then a solution itself.
    """
    if watch.best is None or (solution.success and no_worse(solution.objective, start)):
        return solution
    # An interior-point iterate may lie outside its bounds by rounding; clipped, it keeps them exactly.
    x = np.clip(watch.best.x, chain.lower.ravel(), chain.upper.ravel())
    multipliers = np.concatenate([solution.lam_x, solution.lam_g])
    return evaluate_chain_solution(chain, x, multipliers, solution.status, solution.iterations)
