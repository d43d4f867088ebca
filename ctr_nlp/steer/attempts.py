"""Solving one chain from a motion, and which of several attempts is the best."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.formulations.wall import ROUNDS, SETTLED
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.solvers import CHAIN_SOLVERS, FEASIBLE, ChainSolver, Iterate, Solution, Watch, default_chain_solver
from ctr_nlp.solvers.motion.judged import NEAR, WIDE, judged
from ctr_nlp.typing import Array

Report = Callable[[Iterate], None]

TIE = 1e-9
"""Objectives that differ by this part are the same."""
SAME = 1e-6
"""Attempts whose objectives differ by less than this part are one."""
SLOW = 0.9
"""Where a chain holds near a motion only, slacks that two rounds bring no nearer than this to what is needed go to
and fro between two places of the wall, and further rounds do not help."""
LENGTHS = "order", "carriage gap", "clearance"
"""Constraints in mm."""


@dataclass(frozen=True)
class Attempt:
    """What came of one motion: a solution or, where success is False, the best feasible iterate, else the last.

    motion: of the robot's unknowns (T, n - slacks). parameters: of the chain that was solved. start_objective:
    mm^2, of the motion brought within limits; inf where there is none. feasible: the point is. made: the robot
    makes the motion, as far as has been looked at.
    """

    solution: Solution
    motion: Array
    parameters: Array
    feasible: bool
    start_objective: float
    seconds: float
    made: bool = True

    def as_iterate(self) -> Iterate:
        """The last of its iterations; its violation is 0 or not known."""
        found = self.solution
        violation = 0.0 if self.feasible else math.nan
        return Iterate(found.iterations, found.objective, violation, found.kkt, found.x)

    def described(self, frames: int) -> dict[str, Any]:
        """For a plan's meta; objectives as means over frames, mm^2."""
        start = None if math.isinf(self.start_objective) else self.start_objective / frames
        return {
            "start_objective": start,
            "objective": self.solution.objective / frames,
            "solved": self.solution.success,
            "status": self.solution.status,
            "iterations": self.solution.iterations,
            "seconds": self.seconds,
        }


def best_of(attempts: Sequence[Attempt]) -> Attempt:
    """The solution of least objective, unless some start was better: then the best feasible point; a made one."""
    least = min(one.start_objective for one in attempts)

    def badness(one: Attempt) -> tuple[bool, bool, bool, float]:
        found = one.solution
        solved = found.success and no_worse(found.objective, least)
        return not one.made, not solved, not one.feasible, found.objective

    return min(attempts, key=badness)


def distinct(attempts: Sequence[Attempt]) -> list[Attempt]:
    """Attempts, best first, without those whose objective was met before."""
    ranked = sorted(attempts, key=lambda one: (not one.solution.success, one.solution.objective))
    objectives = [one.solution.objective for one in ranked]
    return [
        one
        for k, one in enumerate(ranked)
        if k == 0 or abs(objectives[k] - objectives[k - 1]) > SAME * (1 + abs(objectives[k]))
    ]


def failures(chain: Chain, one: Attempt) -> dict[str, str]:
    """Why an attempt is no solution, by frame where limits are exceeded, else for all; empty where it is one."""
    if one.solution.success:
        return {}
    chain = replace(chain, parameters=one.parameters)
    found: dict[str, str] = {}
    for name, frame, amount in chain.excesses(chain.evaluate(one.solution.x)[1], FEASIBLE):
        unit = "mm" if "beta" in name or name in LENGTHS else "rad"
        found.setdefault(str(frame), f"{name} exceeded by {amount:.3g} {unit}; relax it, or give more time")
    return found or {"all": f"{one.solution.status}, KKT residual {one.solution.kkt:.1e}"}


def no_worse(objective: float, than: float) -> bool:
    """Whether an objective is at most another, rounding apart."""
    return objective <= than + TIE * (1 + abs(objective))


def together(*reports: Report | None) -> Report | None:
    """One report that hands every iterate to all of these; None where nobody is to be told."""
    known = [report for report in reports if report is not None]

    def report(iterate: Iterate) -> None:
        for each in known:
            each(iterate)

    return report if known else None


class Start(NamedTuple):
    """A motion x (T n,), its objective in mm^2, and by how much it leaves limits at most."""

    x: Array
    objective: float
    violation: float


def within_limits(chain: Chain, x: Array) -> Start:
    """The motion x (T n,) itself, or the one nearest to it that keeps all limits, where there is one.

    Where limits are curved, the nearest motion is as hard to find as the best: it is left to the solver.
    """
    start = _start(chain, np.clip(x, chain.lower.ravel(), chain.upper.ravel()))
    if chain.curved or start.violation <= FEASIBLE:
        return start
    return _start(chain, CHAIN_SOLVERS[default_chain_solver()](chain.nearest(start.x))(start.x, Watch()).x)


def _start(chain: Chain, x: Array) -> Start:
    objective, value = chain.evaluate(x)
    return Start(x, objective, chain.violation(value))


def attempt(
    chain: Chain,
    solver: Callable[[Chain], ChainSolver],
    motion: Array,
    report: Report | None,
    stop: Callable[[], bool],
    barrier: float = WIDE,
) -> Attempt:
    """Solve a chain from a motion, as Chain.around takes it, or from the feasible one nearest to it.

    barrier: the first, mm^2.
    Where a chain holds near a motion only, it is solved again around its solution until that needs the same slack.
    The result is never worse than the start.
    """
    begin, tried, missing = time.perf_counter(), list[Attempt](), list[float]()
    near, x0 = chain.around(motion)
    while (
        len(tried) < ROUNDS and not settled(missing) and not (tried and (stop() or not tried[-1].solution.success))
    ):
        known = np.concatenate([tried[-1].solution.lam_x, tried[-1].solution.lam_g]) if tried else None
        one = _solved(near, solver(near), x0, NEAR if tried else barrier, report, stop, known)
        near, x0 = chain.around(one.motion)
        missing.append(float(abs(x0 - one.solution.x).max()))
        objective = near.evaluate(x0)[0] if missing[-1] > 0 else one.solution.objective
        tried.append(replace(one, solution=replace(one.solution, objective=objective)))
    best = best_of(tried)
    iterations = sum(one.solution.iterations for one in tried)
    return replace(
        best,
        solution=replace(best.solution, iterations=iterations),
        start_objective=tried[0].start_objective,
        seconds=time.perf_counter() - begin,
    )


def settled(missing: Sequence[float]) -> bool:
    """Whether slacks of the last round were what they had to be, mm, or two rounds have brought them no nearer."""
    return bool(missing) and (missing[-1] <= SETTLED or missing[-1] > SLOW * [math.inf, math.inf, *missing][-3])


def _solved(
    chain: Chain,
    solve: ChainSolver,
    x0: Array,
    barrier: float,
    report: Report | None,
    stop: Callable[[], bool],
    multipliers: Array | None,
) -> Attempt:
    """Solve a chain from x0 (T n,) as it is; where the result would be worse, once more, from near it.

    multipliers: of all rows, where a neighbouring chain's are known.
    """
    x0, objective, violation = within_limits(chain, x0)
    start = objective if violation <= FEASIBLE else np.inf
    watch = Watch(report, stop, Iterate(0, objective, violation, np.inf, x0))
    solution = _kept(chain, solve(x0, watch, barrier, multipliers), watch, start)
    if not (solution.success or watch.best is None or stop()):
        again = _kept(chain, solve(watch.best.x, watch, NEAR), watch, start)
        solution = replace(again, iterations=solution.iterations + again.iterations)
    feasible = chain.violation(chain.evaluate(solution.x)[1]) <= FEASIBLE
    return Attempt(solution, chain.robot_of(solution.x), chain.parameters, feasible, start, 0.0)


def _kept(chain: Chain, solution: Solution, watch: Watch, start: float) -> Solution:
    """A solution that is no worse than its start; else the best point that was seen.

    A start that was optimal already is met again only to the solver's tolerance: then it is a solution itself.
    """
    if watch.best is None or (solution.success and no_worse(solution.objective, start)):
        return solution
    x = np.clip(watch.best.x, chain.lower.ravel(), chain.upper.ravel())
    multipliers = np.concatenate([solution.lam_x, solution.lam_g])
    return judged(chain, x, multipliers, solution.status, solution.iterations)
