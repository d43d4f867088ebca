"""The search for a motion that scenarios share: from several nominal motions, on some frames first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctr_nlp.formulations.horizon import Ends
from ctr_nlp.formulations.scenarios import Scenarios, SharedMotion, shared_motion
from ctr_nlp.formulations.terms import Term
from ctr_nlp.models import Model
from ctr_nlp.plan.plan import elsewhere
from ctr_nlp.solvers.compiled import fastest
from ctr_nlp.solvers.motion.judged import CLOSE, WIDE
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.steer.motions import filled
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.starts.search import drafted
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array, Index

GROWTHS = 6
"""Times that scenarios are solved for while they grow from the nominal robot to what they are."""


@dataclass(frozen=True)
class Start:
    """A motion q (T, n) and the nominal robot's tips phi (T, d) along it; name: where it comes from."""

    name: str
    q: Array
    phi: Array


@dataclass(frozen=True)
class Tried:
    """What came of a start on so many frames; grown: the part of their deviations that scenarios were solved for;
    made: the nominal robot makes the motion, as far as has been looked at.
    """

    start: str
    frames: int
    solution: SharedSolution
    grown: float = 1.0
    made: bool = True

    @property
    def solved(self) -> bool:
        """Whether this is a motion that all scenarios, as they are, share."""
        return self.solution.success and self.grown == 1.0 and self.made


@dataclass(frozen=True)
class RobustSearch:
    """Solves for scenarios of one problem. weight: lambda in s^2; margin: least one of every scenario."""

    problem: Problem
    model: Model
    ends: Ends
    terms: tuple[Term, ...]
    weight: float
    margin: float
    progress: Progress | None = None
    stop: Callable[[], bool] = lambda: False

    def motion(self, scenarios: Scenarios, picked: Index | None = None) -> SharedMotion:
        """The program over all frames, or over picked ones, evenly apart."""
        problem = self.problem
        frames = range(problem.frames) if picked is None else picked.tolist()
        dt = problem.dt * (1 if picked is None or len(picked) < 2 else int(picked[-1] - picked[-2]))
        at = problem.robot, [problem.samples[k] for k in frames], dt, self.weight, self.ends, self.model
        return shared_motion(*at, scenarios, fastest, self.margin, self.terms)

    def best(self, starts: Sequence[Start], scenarios: Scenarios) -> tuple[Tried | None, list[Tried]]:
        """The best motion that comes of starts, or None, and all that was tried.

        Starts are solved for some frames, and then the best of these drafts for all frames; the next best one
        where nothing comes of that.
        """
        picked = drafted(self.problem.frames)
        tried = list[Tried]()
        for number, start in enumerate(starts):
            self._tell(number, len(starts) + 1, f"{start.name}, {len(picked)} frames")
            if not self.stop():
                one = self.solve(start, scenarios, picked)
                tried.append(one if len(picked) < self.problem.frames else self.looked_at(one))
        drafts = sorted((one for one in tried if one.solved), key=lambda one: one.solution.objective)
        if len(picked) == self.problem.frames:
            return (drafts[0] if drafts else None), tried
        by_name = {start.name: start for start in starts}
        for draft in drafts:
            self._tell(len(starts), len(starts) + 1, f"{draft.start}, all frames")
            if self.stop():
                break
            tried.append(self.looked_at(self._refined(draft, by_name[draft.start], scenarios, picked)))
            if tried[-1].solved:
                return tried[-1], tried
        return None, tried

    def solve(self, start: Start, scenarios: Scenarios, picked: Index | None = None) -> Tried:
        """From a start; where that fails, with scenarios that grow from the nominal robot to what they are."""
        chosen = slice(None) if picked is None else picked
        q, tips = start.q[chosen], np.repeat(start.phi[chosen, None], len(scenarios), axis=1)
        found = SharedSolver(self.motion(scenarios, picked))(q, tips, WIDE, self.stop)
        if found.success or self.stop():
            return Tried(start.name, len(q), found)
        return self.grown(start.name, q, tips, scenarios, picked)

    def grown(self, name: str, q: Array, tips: Array, scenarios: Scenarios, picked: Index | None = None) -> Tried:
        """The same, with scenarios that differ less from the nominal robot at first."""
        done, part, best = 0.0, 0.5, None
        for _ in range(GROWTHS):
            if self.stop():
                break
            found = SharedSolver(self.motion(scenarios.shrunk(part), picked))(q, tips, WIDE, self.stop)
            if found.success:
                done, best, q, tips = part, found, found.q, found.phi
                if part == 1.0:
                    break
                part = 1.0
            else:
                part = (done + part) / 2
        return Tried(name, len(q), found if best is None else best, done if best is not None else part)

    def looked_at(self, tried: Tried) -> Tried:
        """The same, having moved the nominal robot through the motion."""
        found, robot = tried.solution, self.problem.robot
        if not found.success:
            return tried
        planned = np.concatenate([found.phi[:, 0], found.q[:, robot.d :]], axis=1)
        moved = self.model.follow(robot, found.q)
        return replace(tried, made=not elsewhere(moved.x, planned, moved.snaps).any())

    def _refined(self, draft: Tried, start: Start, scenarios: Scenarios, picked: Index) -> Tried:
        """All frames of a draft; where that fails, all frames of what the draft came of."""
        frames, (_, count, d) = self.problem.frames, draft.solution.phi.shape
        q = filled(draft.solution.q, picked, frames)
        tips = filled(draft.solution.phi.reshape(len(picked), -1), picked, frames).reshape(frames, count, d)
        found = SharedSolver(self.motion(scenarios))(q, tips, CLOSE, self.stop)
        if found.success or self.stop():
            return Tried(draft.start, frames, found)
        return self.solve(start, scenarios)

    def _tell(self, done: int, of: int, what: str) -> None:
        if self.progress is not None:
            self.progress(done, of, what)
