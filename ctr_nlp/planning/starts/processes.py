"""Starts of a horizon solved in parallel processes.

A process receives a description of the chain and its solver, and builds programs of its own. Processes and not
threads, since a CasADi solver that two threads use crashes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ctr_nlp.models import Model
from ctr_nlp.ocp.horizon import EndConfigurations, horizon
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.target import Frame
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.multistart import IterateCallback, SolvedStart, best_solved_start, solve_from_motion
from ctr_nlp.robot import Robot
from ctr_nlp.solvers import CHAIN_SOLVERS
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.pool import run_in_parallel
from ctr_nlp.typing import Array


@dataclass(frozen=True)
class Task:
    """A chain and its solver, described so that another process can build them.

    frames: targets. dt: time between frames, s. motion_weight: lambda in s^2. ends: given configurations, if any.
    solver: its name. stability_margin: the least one, or None. wall: that counts, or None. terms: further ones.
    """

    robot: Robot
    frames: tuple[Frame, ...]
    dt: float
    motion_weight: float
    ends: EndConfigurations
    solver: str
    model: Model
    stability_margin: float | None = None
    wall: Wall | None = None
    terms: tuple[Term, ...] = ()

    def solve(self, motion: Array) -> SolvedStart:
        """Build the chain and solve it from a motion (T, n), until Ctrl-C."""
        at = self.robot, self.frames, self.dt, self.motion_weight, self.ends, self.model
        chain = horizon(*at, fastest_functions, self.stability_margin, self.wall, self.terms)
        # A process that Ctrl-C reaches ends its solve, and still returns what it has.
        with deferred_interrupt() as interrupted:
            return solve_from_motion(chain, CHAIN_SOLVERS[self.solver], motion, None, interrupted)


def solve_starts_in_processes(
    task: Task,
    motions: Sequence[Array],
    jobs: int,
    progress: Progress | None,
    callback: IterateCallback | None = None,
) -> list[SolvedStart]:
    """Solve from every motion in up to `jobs` parallel processes; return results in the order of the motions.

    task: the chain and its solver. motions: (T, n) each, to start from. progress: called after each start.
    callback: called with the result of each start that is the best so far. After Ctrl-C some results may be
    missing.
    """
    found = dict[int, SolvedStart]()
    best = None
    for number, one in run_in_parallel(task.solve, motions, min(jobs, len(motions))):
        found[number] = one
        if progress is not None:
            progress(len(found), len(motions), f"initial guesses, in {jobs} processes")
        # Iterates of several processes would come mixed up: only whole results are passed on.
        if callback is not None and (best is None or best_solved_start([best, one]) is one):
            best = one
            callback(one.as_iterate())
    # Processes end in any order; sorted, the outcome does not depend on how fast they were.
    return [found[number] for number in sorted(found)]
