"""The search for the best motion over a horizon: which starts are solved, how far, and what comes of them."""

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
"""What the motion of the start costs by default, as a part of its shape errors."""
LEAST_MOTION_WEIGHT = 1e-9
"""Least default of lambda, s^2: where the start follows its target exactly."""
DRAFTED = 25
"""Least number of frames of a draft: of twice, three times as many, every second, third, ... one is taken."""
FINER = 8
"""How many times more frames than one solution of a draft has the next may have."""
LIKELY = 0.05
"""A draft whose objective is above the best one's by no more than this part may still lead to a better motion."""
MOST = 3
"""Drafts that are solved for all frames."""
FEW, PROMISING = 3, 0.3
"""Of so many motions, the best ones, a draft is made; of others where their objective is above the best one's by
no more than this part."""


@dataclass(frozen=True)
class Search:
    """Attempts at the horizon of one problem, from one motion or many.

    simulator: of the problem's robot on its model. free, inside: chains of all frames far from any wall and
    within the lumen, with a motion weight of 1 s^2. weight: lambda in s^2. jobs: processes. Progress and seen are
    told of what goes on, and stop() ends it.
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
        """The chain near a wall, or far from any."""
        if wall is None:
            return self._far
        return replace(self.inside, surroundings=wall.during(self.problem.samples)).with_cost(self.weight)

    @cached_property
    def _far(self) -> Chain:
        return self.free.with_cost(self.weight)

    def balanced_weight(self, motion: Array) -> float:
        """The lambda in s^2 at which a motion costs MOTION_SHARE of its shape errors."""
        free, x = self.free.around(motion)
        shape, moved = (float(part.sum()) for part in free.by_frame(x))
        weight = MOTION_SHARE * shape / moved if moved > 0 else 0.0
        return weight if weight > LEAST_MOTION_WEIGHT else LEAST_MOTION_WEIGHT

    def ranked(self, motions: Sequence[Array], count: int) -> list[Array]:
        """The best of motions in the horizon's own objective, then random changes of the very best."""
        free = self.near(None)
        kept = sorted((within_limits(*free.around(motion)) for motion in motions), key=lambda one: one.objective)
        ranked = [free.robot_of(one.x) for one in kept]
        changes = wandered(self.problem.robot, ranked[0], self.settings.seed)
        return list(itertools.islice(itertools.chain(ranked, changes), count))

    def attempts(self, motions: Sequence[Array], wall: Wall | None = None) -> list[Attempt]:
        """What comes of motions near a wall, or far from any; on the elastic model, that the robot makes."""
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
        """What comes of those motions that promise most; motions are given best first.

        The best ones are solved for some of the frames, and the best of these drafts for all frames: at most MOST
        distinct ones whose objective is within a part LIKELY of the best one's. Where none of them leads to a
        solution that is made, and that is at least as good as the best motion was already, all motions are solved.
        """
        picked = drafted(self.problem.frames)
        if len(picked) == self.problem.frames:
            return self.attempts(motions)
        drafts, chain = self._drafts(motions, picked), self.near(None)
        found = list[Attempt]()
        for draft in drafts[:MOST]:
            far = draft.solution.objective > (1 + LIKELY) * drafts[0].solution.objective
            if self.stop() or (found and far):
                break
            whole = self._refined(draft.motion, picked)
            found.append(self._attempt(chain, whole, len(found) + 1, len(drafts), CLOSE))
        made = self._made(chain, found) if found else []
        if self.stop() or (made and self._good(made, motions[0])):
            return made or self.attempts(motions[:1])
        return self.attempts(motions)

    def _good(self, attempts: Sequence[Attempt], motion: Array) -> bool:
        """Whether a solution that is made is among them, and no worse than a motion."""
        best, (chain, x) = best_of(attempts), self.near(None).around(motion)
        return best.made and best.solution.success and no_worse(best.solution.objective, chain.evaluate(x)[0])

    def _refined(self, motion: Array, picked: Index) -> Array:
        """All frames (T, n) of a draft, solved for more and more of them until few are left out."""
        frames = self.problem.frames
        while (stride := int(picked[-1] - picked[-2])) > FINER and not self.stop():
            finer = thinned(frames, stride // FINER)
            one = self._attempt(self._thin(finer), filled(motion, picked, frames)[finer], 1, 1, CLOSE)
            if not one.solution.success:
                break
            motion, picked = one.motion, finer
        return filled(motion, picked, frames)

    def _thin(self, picked: Index) -> Chain:
        """The chain of picked frames, evenly apart, far from any wall."""
        frames, dt = [self.problem.samples[k] for k in picked], self.problem.dt * int(picked[-1] - picked[-2])
        at = self.problem.robot, frames, dt, self.weight, self.ends, self.simulator.model
        return horizon(*at, fastest, self.settings.stability_margin, extra=self.terms)

    def _drafts(self, motions: Sequence[Array], picked: Index) -> list[Attempt]:
        """Distinct solutions for picked frames, from motions that promise one, best first."""
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
        """Makes solvers, and keeps the last for further motions of the same chain."""
        last = list[tuple[Chain, ChainSolver]]()

        def built(chain: Chain) -> ChainSolver:
            if not last or last[0][0] is not chain:
                last[:] = [(chain, CHAIN_SOLVERS[self.solver](chain))]
            return last[0][1]

        return built

    def _made(self, chain: Chain, attempts: list[Attempt]) -> list[Attempt]:
        """Attempts; where there are several equilibria, the best that the robot makes."""
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
