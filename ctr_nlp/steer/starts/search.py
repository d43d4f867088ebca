"""The search for the best motion over a horizon: which starts are solved, how far, and what comes of them.

Coarse to fine: the best starts are solved on a draft, some of the frames evenly apart, and only the best drafts on
all frames, through grids that are refined step by step. On the elastic model a motion counts only where the
simulated robot makes it. Objectives are in mm^2, lambda in s^2.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from ctr_nlp.formulations.horizon import Ends, horizon
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.wall import Wall
from ctr_nlp.nlp.chain import Chain
from ctr_nlp.simulation.forward import Simulator
from ctr_nlp.solvers import CHAIN_SOLVERS, ChainSolver
from ctr_nlp.solvers.compiled import fastest
from ctr_nlp.solvers.motion.judged import CLOSE, WIDE
from ctr_nlp.steer.attempts import (
    Attempt,
    Report,
    attempt,
    best_of,
    distinct,
    no_worse,
    together,
    within_limits,
)
from ctr_nlp.steer.motions import at_frames, filled, thinned, wandered
from ctr_nlp.steer.passes import Forecast, Progress
from ctr_nlp.steer.realised import realised
from ctr_nlp.steer.starts.processes import Task, attempt_in_processes
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array, Index

MOTION_SHARE = 0.1
"""Share of the shape errors of the start that its motion costs, at the default lambda."""
LEAST_MOTION_WEIGHT = 1e-9
"""Least default of lambda, s^2: where the start follows its target exactly, the share would be 0."""
DRAFTED = 25
"""Least number of frames of a draft: of twice, three times as many, every second, third, ... frame is taken."""
FINER = 8
"""Largest factor between the numbers of frames of one solution of a draft and of the next."""
LIKELY = 0.05
"""Relative excess of a draft's objective over the best one's up to which it may still lead to a better motion."""
MOST = 3
"""Most drafts that are solved for all frames."""
FEW, PROMISING = 3, 0.3
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
    ends: Ends
    settings: Settings
    terms: tuple[Term, ...]
    free: Chain
    inside: Chain
    weight: float = 1.0
    jobs: int = 1
    progress: Progress | None = None
    seen: Report | None = None
    stop: Callable[[], bool] = lambda: False

    def near(self, wall: Wall | None) -> Chain:
        """Return the chain of all frames within a wall, or far from any where it is None, with this search's
        lambda.
        """
        if wall is None:
            return self._far
        return replace(self.inside, surroundings=wall.during(self.problem.samples)).with_cost(self.weight)

    @cached_property
    def _far(self) -> Chain:
        return self.free.with_cost(self.weight)

    def balanced_weight(self, motion: Array) -> float:
        """Return the lambda in s^2 at which a motion (T, n) costs MOTION_SHARE of its shape errors."""
        free, x = self.free.around(motion)
        # `free` has a motion weight of 1 s^2: what motion costs there is what lambda multiplies.
        shape, moved = (float(part.sum()) for part in free.by_frame(x))
        weight = MOTION_SHARE * shape / moved if moved > 0 else 0.0
        return weight if weight > LEAST_MOTION_WEIGHT else LEAST_MOTION_WEIGHT

    def ranked(self, motions: Sequence[Array], count: int) -> list[Array]:
        """Return `count` motions: the given ones, best first in the horizon's own objective, then random changes
        of the best.
        """
        free = self.near(None)
        # Compared within limits: frame by frame motions may exceed accelerations, which only the horizon knows.
        kept = sorted((within_limits(*free.around(motion)) for motion in motions), key=lambda one: one.objective)
        ranked = [free.robot_of(one.x) for one in kept]
        changes = wandered(self.problem.robot, ranked[0], self.settings.seed)
        return list(itertools.islice(itertools.chain(ranked, changes), count))

    def attempts(self, motions: Sequence[Array], wall: Wall | None = None) -> list[Attempt]:
        """Solve from all motions near a wall, or far from any where it is None; on models with several equilibria,
        keep the best result whose motion the simulated robot makes.
        """
        chain, count = self.near(wall), len(motions)
        found = list[Attempt]()
        if self.jobs > 1 and count > 1:
            own = self.solver, self.simulator.model, self.settings.stability_margin, wall, self.terms
            task = Task(self.problem.robot, self.problem.samples, self.problem.dt, self.weight, self.ends, *own)
            found = attempt_in_processes(task, motions, self.jobs, self.progress, self.seen)
        for number, motion in enumerate(() if found else motions, start=1):
            if found and self.stop():
                break
            found.append(self._attempt(chain, motion, number, count))
        return self._made(chain, found)

    def likely(self, motions: Sequence[Array]) -> list[Attempt]:
        """Solve from those motions that promise most; motions are given best first.

        The best ones are solved on a draft, and the best of these drafts for all frames: at most MOST distinct
        ones whose objective is within a part LIKELY of the best one's. Where none of them leads to a solution that
        the robot makes, and that is at least as good as the best motion was already, all motions are solved.
        """
        picked = drafted(self.problem.frames)
        if len(picked) == self.problem.frames:
            return self.attempts(motions)
        drafts, chain = self._drafts(motions, picked), self.near(None)
        found = list[Attempt]()
        for draft in drafts[:MOST]:
            # The best draft is always refined; later ones only while they are near to it.
            far = draft.solution.objective > (1 + LIKELY) * drafts[0].solution.objective
            if self.stop() or (found and far):
                break
            whole = self._refined(draft.motion, picked)
            found.append(self._attempt(chain, whole, len(found) + 1, len(drafts), CLOSE))
        made = self._made(chain, found) if found else []
        # After Ctrl-C there is no time to solve all motions: what was found is returned, or the best start as it
        # is.
        if self.stop() or (made and self._good(made, motions[0])):
            return made or self.attempts(motions[:1])
        return self.attempts(motions)

    def _good(self, attempts: Sequence[Attempt], motion: Array) -> bool:
        """Return whether the best result is a solution that the robot makes, and no worse than a motion (T, n)
        was.
        """
        best, (chain, x) = best_of(attempts), self.near(None).around(motion)
        return best.made and best.solution.success and no_worse(best.solution.objective, chain.evaluate(x)[0])

    def _refined(self, motion: Array, picked: Index) -> Array:
        """Return all frames (T, n) of a draft's motion, solved on finer and finer grids until few frames are left
        out.

        picked: the draft's frames, from 0.
        """
        frames = self.problem.frames
        # Interpolated over many frames, a motion strays far from its constraints; each grid is at most FINER times
        # finer than the one before.
        while (stride := int(picked[-1] - picked[-2])) > FINER and not self.stop():
            finer = thinned(frames, stride // FINER)
            one = self._attempt(self._thin(finer), filled(motion, picked, frames)[finer], 1, 1, CLOSE)
            if not one.solution.success:
                break
            motion, picked = one.motion, finer
        return filled(motion, picked, frames)

    def _thin(self, picked: Index) -> Chain:
        """Build the chain of picked frames, evenly apart, far from any wall."""
        # With the time between picked frames as dt, limits of speed mean what they do over all frames.
        frames, dt = [self.problem.samples[k] for k in picked], self.problem.dt * int(picked[-1] - picked[-2])
        at = self.problem.robot, frames, dt, self.weight, self.ends, self.simulator.model
        return horizon(*at, fastest, self.settings.stability_margin, extra=self.terms)

    def _drafts(self, motions: Sequence[Array], picked: Index) -> list[Attempt]:
        """Solve the motions that promise most on picked frames; return distinct solutions, best first."""
        # Motions are compared on the draft's own frames, before any is solved.
        chain, found = self._thin(picked), list[Attempt]()
        thinner = [motion[picked] for motion in motions]
        objectives = [chain.evaluate(chain.around(motion)[1])[0] for motion in thinner]
        far = (1 + PROMISING) * min(objectives)
        kept = [motion for k, motion in enumerate(thinner) if k < FEW or objectives[k] <= far]
        for number, motion in enumerate(kept, start=1):
            if self.stop():
                break
            found.append(self._attempt(chain, motion, number, len(kept)))
        return [one for one in distinct(found) if one.solution.success]

    def _attempt(self, chain: Chain, motion: Array, number: int, count: int, barrier: float = WIDE) -> Attempt:
        forecast = None if self.progress is None else Forecast(self.progress, chain.frames, number, count)
        told = together(self.seen if chain.frames == self.problem.frames else None, forecast)
        return attempt(chain, self._built, motion, told, self.stop, barrier)

    @cached_property
    def _built(self) -> Callable[[Chain], ChainSolver]:
        """Return a function that makes solvers, and reuses the last one for further motions of the same chain."""
        last = list[tuple[Chain, ChainSolver]]()

        def built(chain: Chain) -> ChainSolver:
            if not last or last[0][0] is not chain:
                last[:] = [(chain, CHAIN_SOLVERS[self.solver](chain))]
            return last[0][1]

        return built

    def _made(self, chain: Chain, attempts: list[Attempt]) -> list[Attempt]:
        """Return results; on models with several equilibria, only the best one whose motion the robot makes."""
        # With one equilibrium for each q the robot makes every motion.
        if not self.simulator.model.several_equilibria or self.stop():
            return attempts
        margin, solver = self.settings.stability_margin, CHAIN_SOLVERS[self.solver]
        return realised(self.simulator, chain, solver, attempts, margin, self.stop)


def drafted(frames: int) -> Index:
    """The numbers of the frames of a draft, from 0; the last is one of them."""
    return thinned(frames, max(1, frames // DRAFTED))


def with_draft_frames(problem: Problem) -> tuple[Problem, Index]:
    """Take the frames of a draft alone.

    Parameters
    ----------
    problem : Problem
        Robot and target.

    Returns
    -------
    Problem
        The same motion in 25 to 49 frames, evenly apart; the problem itself where it has no more.
    Index
        Numbers of these frames among those of the problem, from 0.
    """
    picked = drafted(problem.frames)
    if len(picked) == problem.frames:
        return problem, picked
    return at_frames(problem, picked, int(picked[-1] - picked[-2])), picked
