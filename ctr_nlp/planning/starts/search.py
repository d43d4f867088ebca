"""Multi-start search for the best motion over a horizon, from coarse to fine.

The best starts are solved on a draft, some evenly spaced frames, and only the best drafts on all frames, through
grids that are refined step by step. On the elastic model a motion counts only where the simulated robot stays on
its branch. Objectives are in mm^2, lambda in s^2.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.horizon import EndConfigurations, horizon
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.marching import Forecast, Progress
from ctr_nlp.planning.motions import at_frames, interpolate_frames, perturb_motion, thin_frames
from ctr_nlp.planning.multistart import (
    IterateCallback,
    SolvedStart,
    best_solved_start,
    combine_callbacks,
    distinct,
    no_worse,
    project_to_limits,
    solve_from_motion,
)
from ctr_nlp.planning.stability_refinement import select_realisable_starts
from ctr_nlp.planning.starts.processes import Task, solve_starts_in_processes
from ctr_nlp.solvers import CHAIN_SOLVERS, ChainSolver
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.motion.chain_solution import (
    COLD_START_BARRIER_MM2,
    WALL_START_BARRIER_MM2,
    WARM_START_BARRIER_MM2,
)
from ctr_nlp.typing import Array, Index

MOTION_SHARE = 0.1
"""Share of the shape errors of the start that its motion costs, at the default lambda."""
LEAST_MOTION_WEIGHT = 1e-9
"""Least default of lambda, s^2: where the start follows its target exactly, the share would be 0."""
MIN_DRAFT_FRAMES = 25
"""Least number of frames of a draft: of twice, three times as many, every second, third, ... frame is taken."""
MAX_GRID_REFINEMENT = 8
"""Largest factor between the numbers of frames of one solution of a draft and of the next."""
MAX_LIKELY_DRAFT_EXCESS = 0.05
"""Relative excess of a draft's objective over the best one's up to which it may still lead to a better motion."""
MAX_REFINED_DRAFTS = 3
"""Most drafts that are solved for all frames."""
MIN_DRAFTED_MOTIONS, MAX_PROMISING_MOTION_EXCESS = 3, 0.3
"""Number of best motions of which a draft is always made; of others where their objective exceeds the best one's
by at most this part.
"""


@dataclass(frozen=True)
class Search:
    """The multi-start search for one problem's motion over all frames.

    simulator: of the problem's robot on its model. free, inside: chains of all frames far from any wall and within
    the lumen, with a motion weight of 1 s^2. weight: lambda in s^2. jobs: processes. progress, seen: callbacks.
    stop: asked whether to end.
    """

    problem: Problem
    simulator: Simulator
    solver: str
    ends: EndConfigurations
    settings: Settings
    terms: tuple[Term, ...]
    free: Chain
    inside: Chain
    weight: float = 1.0
    jobs: int = 1
    progress: Progress | None = None
    seen: IterateCallback | None = None
    stop: Callable[[], bool] = lambda: False

    def chain_for_wall(self, wall: Wall | None) -> Chain:
        """Return the chain of all frames within a wall, or far from any where it is None, with this search's
        lambda.
        """
        if wall is None:
            return self._free_chain
        return replace(
            self.inside, local_parameters=wall.local_parameters_during(self.problem.target_frames)
        ).with_cost(self.weight)

    @cached_property
    def _free_chain(self) -> Chain:
        return self.free.with_cost(self.weight)

    def balanced_weight(self, motion: Array) -> float:
        """Return the lambda in s^2 at which a motion (T, n) costs MOTION_SHARE of its shape errors."""
        free, x = self.free.linearise_at(motion)
        # `free` has a motion weight of 1 s^2: what motion costs there is what lambda multiplies.
        shape, moved = (float(part.sum()) for part in free.by_frame(x))
        weight = MOTION_SHARE * shape / moved if moved > 0 else 0.0
        return weight if weight > LEAST_MOTION_WEIGHT else LEAST_MOTION_WEIGHT

    def rank_motions(self, motions: Sequence[Array], count: int) -> list[Array]:
        """Return `count` motions: the given ones, best first in the horizon's own objective, then random changes
        of the best.
        """
        free = self.chain_for_wall(None)
        # Compared within limits: frame by frame motions may exceed accelerations, which only the horizon knows.
        kept = sorted(
            (project_to_limits(*free.linearise_at(motion)) for motion in motions), key=lambda one: one.objective
        )
        ranked = [free.robot_of(one.x) for one in kept]
        changes = perturb_motion(self.problem.robot, ranked[0], self.settings.seed)
        return list(itertools.islice(itertools.chain(ranked, changes), count))

    def solve_from_motions(self, motions: Sequence[Array], wall: Wall | None = None) -> list[SolvedStart]:
        """Solve from all motions near a wall, or far from any where it is None; on models with several equilibria,
        keep the best result whose motion the simulated robot makes.
        """
        chain = self.chain_for_wall(wall)
        count = len(motions)
        found = list[SolvedStart]()
        if self.jobs > 1 and count > 1:
            own = self.solver, self.simulator.model, self.settings.stability_margin, wall, self.terms
            task = Task(
                self.problem.robot, self.problem.target_frames, self.problem.dt, self.weight, self.ends, *own
            )
            found = solve_starts_in_processes(task, motions, self.jobs, self.progress, self.seen)
        for number, motion in enumerate(() if found else motions, start=1):
            if found and self.stop():
                break
            found.append(self._solve_from_motion(chain, motion, number, count))
        return self._keep_realisable(chain, found)

    def approach_walls(self, motion: Array, walls: Sequence[Wall]) -> Array:
        """Return a motion (T, n) moved to where walls let it be, one after the other, on a draft and roughly.

        From a motion deep in a wall many steps lead out of it. With a quarter of the frames they take a quarter of
        the time, and the motion of all frames is then near its solution.
        """
        picked = pick_draft_frames(self.problem.frames)
        draft = motion[picked]
        for wall in walls:
            chain = self._draft_chain(picked, wall)
            one = solve_from_motion(
                chain, self._build_solver, draft, None, self.stop, WALL_START_BARRIER_MM2, roughly=True
            )
            # Each wall starts from the solution of the one before; where there is none, from the same motion
            # again.
            draft = one.motion if one.solution.success else draft
        return interpolate_frames(draft, picked, self.problem.frames)

    def solve_most_promising(self, motions: Sequence[Array]) -> list[SolvedStart]:
        """Solve from the most promising motions (T, n), given best first.

        The best ones are solved on a draft, and the best of these drafts on all frames: at most MAX_REFINED_DRAFTS
        distinct ones whose objective is within a part MAX_LIKELY_DRAFT_EXCESS of the best one's. Where none of
        them has a solution on whose branch the robot stays, and that is at least as good as the best initial
        motion, all motions are solved.
        """
        picked = pick_draft_frames(self.problem.frames)
        if len(picked) == self.problem.frames:
            return self.solve_from_motions(motions)
        drafts = self._drafts(motions, picked)
        chain = self.chain_for_wall(None)
        found = list[SolvedStart]()
        for draft in drafts[:MAX_REFINED_DRAFTS]:
            # The best draft is always refined; later ones only while they are near to it.
            far = draft.solution.objective > (1 + MAX_LIKELY_DRAFT_EXCESS) * drafts[0].solution.objective
            if self.stop() or (found and far):
                break
            whole = self._refine_draft(draft.motion, picked)
            found.append(
                self._solve_from_motion(chain, whole, len(found) + 1, len(drafts), WARM_START_BARRIER_MM2)
            )
        made = self._keep_realisable(chain, found) if found else []
        # After Ctrl-C there is no time to solve all motions: what was found is returned, or the best start as it
        # is.
        if self.stop() or (made and self._is_good(made, motions[0])):
            return made or self.solve_from_motions(motions[:1])
        return self.solve_from_motions(motions)

    def _is_good(self, attempts: Sequence[SolvedStart], motion: Array) -> bool:
        """Return whether the best of attempts is a realisable solution, no worse than an initial motion (T, n)."""
        best, (chain, x) = best_solved_start(attempts), self.chain_for_wall(None).linearise_at(motion)
        return (
            best.on_planned_branch
            and best.solution.success
            and no_worse(best.solution.objective, chain.evaluate(x)[0])
        )

    def _refine_draft(self, motion: Array, picked: Index) -> Array:
        """Return all frames (T, n) of a draft's motion, solved on finer and finer grids and then interpolated.

        motion: (T_draft, n). picked: the draft's frames, from 0.
        """
        frames = self.problem.frames
        # Interpolated over many frames, a motion strays far from its constraints; each grid is at most
        # MAX_GRID_REFINEMENT times finer than the one before.
        while (stride := int(picked[-1] - picked[-2])) > MAX_GRID_REFINEMENT and not self.stop():
            finer = thin_frames(frames, stride // MAX_GRID_REFINEMENT)
            one = self._solve_from_motion(
                self._draft_chain(finer),
                interpolate_frames(motion, picked, frames)[finer],
                1,
                1,
                WARM_START_BARRIER_MM2,
            )
            if not one.solution.success:
                break
            motion = one.motion
            picked = finer
        return interpolate_frames(motion, picked, frames)

    def _draft_chain(self, picked: Index, wall: Wall | None = None) -> Chain:
        """Build the chain of picked frames, evenly spaced, within a wall or without one."""
        # With the time between picked frames as dt, limits of speed mean what they do over all frames.
        frames = [self.problem.target_frames[k] for k in picked]
        dt = self.problem.dt * int(picked[-1] - picked[-2])
        at = self.problem.robot, frames, dt, self.weight, self.ends, self.simulator.model
        return horizon(*at, fastest_functions, self.settings.stability_margin, wall, self.terms)

    def _drafts(self, motions: Sequence[Array], picked: Index) -> list[SolvedStart]:
        """Solve the most promising motions on picked frames; return distinct solutions, best first."""
        # Motions are compared on the draft's own frames, before any is solved.
        chain = self._draft_chain(picked)
        found = list[SolvedStart]()
        thinner = [motion[picked] for motion in motions]
        objectives = [chain.evaluate(chain.linearise_at(motion)[1])[0] for motion in thinner]
        far = (1 + MAX_PROMISING_MOTION_EXCESS) * min(objectives)
        kept = [motion for k, motion in enumerate(thinner) if k < MIN_DRAFTED_MOTIONS or objectives[k] <= far]
        for number, motion in enumerate(kept, start=1):
            if self.stop():
                break
            found.append(self._solve_from_motion(chain, motion, number, len(kept)))
        return [one for one in distinct(found) if one.solution.success]

    def _solve_from_motion(
        self, chain: Chain, motion: Array, number: int, count: int, barrier: float = COLD_START_BARRIER_MM2
    ) -> SolvedStart:
        forecast = None if self.progress is None else Forecast(self.progress, chain.frames, number, count)
        told = combine_callbacks(self.seen if chain.frames == self.problem.frames else None, forecast)
        return solve_from_motion(chain, self._build_solver, motion, told, self.stop, barrier)

    @cached_property
    def _build_solver(self) -> Callable[[Chain], ChainSolver]:
        """Return a function that makes solvers, and reuses the last one for further motions of the same chain."""
        last = list[tuple[Chain, ChainSolver]]()

        def built(chain: Chain) -> ChainSolver:
            if not last or last[0][0] is not chain:
                last[:] = [(chain, CHAIN_SOLVERS[self.solver](chain))]
            return last[0][1]

        return built

    def _keep_realisable(self, chain: Chain, attempts: list[SolvedStart]) -> list[SolvedStart]:
        """Return results; on models with several equilibria, only the best one on whose branch the robot stays."""
        # With one equilibrium for each q there is only one branch.
        if not self.simulator.model.several_equilibria or self.stop():
            return attempts
        margin = self.settings.stability_margin
        solver = CHAIN_SOLVERS[self.solver]
        return select_realisable_starts(self.simulator, chain, solver, attempts, margin, self.stop)


def pick_draft_frames(frames: int) -> Index:
    """Return the numbers of the frames of a draft, from 0, out of `frames` frames; the last is one of them."""
    return thin_frames(frames, max(1, frames // MIN_DRAFT_FRAMES))


def with_draft_frames(problem: Problem) -> tuple[Problem, Index]:
    """Return a problem with the frames of a draft only.

    Parameters
    ----------
    problem : Problem
        Robot and target.

    Returns
    -------
    Problem
        The same motion in 25 to 49 frames, evenly spaced; the problem itself where it has no more.
    Index
        Numbers of these frames among those of the problem, from 0.
    """
    picked = pick_draft_frames(problem.frames)
    if len(picked) == problem.frames:
        return problem, picked
    return at_frames(problem, picked, int(picked[-1] - picked[-2])), picked
