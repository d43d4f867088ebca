"""The search for a motion that scenarios share: from several nominal motions, on some frames first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctr_nlp.formulations.horizon import Ends
from ctr_nlp.formulations.shared.scenarios import shared_motion
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.wall import Wall
from ctr_nlp.models import Model
from ctr_nlp.nlp.scenarios import Guards, Scenarios, SharedMotion
from ctr_nlp.plan.plan import elsewhere
from ctr_nlp.solvers.compiled import fastest
from ctr_nlp.solvers.motion.judged import WIDE
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.solvers.scenarios.interior import COARSE
from ctr_nlp.steer.motions import filled
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.robust.tolerated import bearing_unknowns, told_on
from ctr_nlp.steer.starts.search import drafted
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array, Index

BARRIER = 1e-3
"""First barrier, mm^2, of a motion that is near to one that was solved for: all frames of a draft, or with robots
that have joined."""
UNMADE = 1.02
"""How much better a draft must be that is not made on its few frames, since it is longer to go on with."""
GROWTHS, GROWING = 4, 100
"""Times that scenarios are solved for while they grow from the nominal robot to what they are, on the frames of a
draft; steps of each. Over all frames that would take minutes, and another draft leads further."""


@dataclass(frozen=True)
class Start:
    """A motion as unknowns x (T, 2d + 2) of the nominal robot on the model that plans tell of (tolerated.told_on);
    name: where it comes from.
    """

    name: str
    x: Array


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
        """Whether all scenarios, as they are, are in equilibrium at every frame of this motion, and stable."""
        return self.solution.success and self.grown == 1.0

    @property
    def shared(self) -> bool:
        """Whether this is a motion that they share: the robot is where it is planned to be."""
        return self.solved and self.made

    @property
    def promise(self) -> tuple[bool, float]:
        """The least is the first to go on with. What is not made in a draft's long steps may be in short ones."""
        return not self.solved, self.solution.objective * (1.0 if self.made else UNMADE)


@dataclass(frozen=True)
class RobustSearch:
    """Solves for scenarios of one problem. weight: lambda in s^2; margins (T,): the least of all scenarios in each
    frame, None for any; wall: of the lumen that all are kept in, None where it does not count; guards: of all
    frames, None where there are none.
    """

    problem: Problem
    model: Model
    ends: Ends
    terms: tuple[Term, ...]
    weight: float
    margins: Array | None
    progress: Progress | None = None
    stop: Callable[[], bool] = lambda: False
    wall: Wall | None = None
    guards: Guards | None = None

    def motion(self, scenarios: Scenarios, picked: Index | None = None) -> SharedMotion:
        """The program over all frames, or over picked ones, evenly apart."""
        problem = self.problem
        frames = range(problem.frames) if picked is None else picked.tolist()
        dt = problem.dt * (1 if picked is None or len(picked) < 2 else int(picked[-1] - picked[-2]))
        at = problem.robot, [problem.samples[k] for k in frames], dt, self.weight, self.ends, self.model
        margins = None if self.margins is None else self.margins[frames]
        guards = None if self.guards is None else self.guards.at(list(frames))
        return shared_motion(*at, scenarios, fastest, margins, self.terms, wall=self.wall, guards=guards)

    @cached_property
    def picked(self) -> Index | None:
        """The frames that drafts have; None for all."""
        found = drafted(self.problem.frames)
        return None if len(found) == self.problem.frames else found

    def drafts(self, starts: Sequence[Start], scenarios: Scenarios) -> list[Tried]:
        """What comes of starts on the frames of a draft, the most promising first."""
        tried = list[Tried]()
        for number, start in enumerate(starts):
            if self.progress is not None:
                self.progress(number, len(starts) + 1, f"draft from a motion of {start.name}")
            if not self.stop():
                tried.append(self.solve(start, scenarios, self.picked))
        return sorted(tried, key=lambda one: one.promise)

    def refined(self, draft: Tried, scenarios: Scenarios) -> Tried:
        """All frames of a draft."""
        frames, (_, *each) = self.problem.frames, draft.solution.phi.shape
        if self.picked is None:
            return draft
        q = filled(draft.solution.q, self.picked, frames)
        tips = filled(draft.solution.phi.reshape(len(self.picked), -1), self.picked, frames)
        return self._solved(draft.start, q, tips.reshape(frames, *each), scenarios, None, BARRIER)

    def solve(self, start: Start, scenarios: Scenarios, picked: Index | None = None) -> Tried:
        """All frames, or picked ones, of a start."""
        robot, own = self.problem.robot, self.motion(scenarios, picked).own
        q = told_on(self.model).configuration(robot, start.x)
        tips = np.repeat(bearing_unknowns(robot, self.model, q, start.x)[:, None, own], len(scenarios), axis=1)
        of_frames = slice(None) if picked is None else picked
        return self._solved(start.name, q[of_frames], tips[of_frames], scenarios, picked, WIDE)

    def _solved(
        self, name: str, q: Array, tips: Array, scenarios: Scenarios, picked: Index | None, barrier: float
    ) -> Tried:
        """From tips (T, S, k); where that fails for a draft, as grown."""
        found = SharedSolver(self.motion(scenarios, picked), COARSE)(
            q, tips, barrier, self.stop, rough=picked is not None
        )
        if found.success or picked is None or self.stop():
            return self.looked_at(Tried(name, len(q), found))
        return self.grown(name, q, tips[:, :1], scenarios, picked)

    def grown(self, name: str, q: Array, tips: Array, scenarios: Scenarios, picked: Index | None = None) -> Tried:
        """With scenarios that grow from the nominal robot, of tips (T, 1, k), to what they are."""
        tips = np.repeat(tips, self.motion(scenarios, picked).sizes[1], axis=1)
        done, part, best = 0.0, 0.5, None
        for _ in range(GROWTHS):
            solver = SharedSolver(self.motion(scenarios.shrunk(part), picked), COARSE)
            found = solver(q, tips, WIDE, self.stop, GROWING, rough=picked is not None)
            if found.success:
                done, best, q, tips = part, found, found.q, found.phi
                if part == 1.0:
                    break
                part = 1.0
            else:
                part = (done + part) / 2
            if self.stop():
                break
        tried = Tried(name, len(q), found if best is None else best, done if best is not None else part)
        return self.looked_at(tried)

    def looked_at(self, tried: Tried) -> Tried:
        """The same, having moved the nominal robot through the motion."""
        found, robot = tried.solution, self.problem.robot
        if not found.success:
            return tried
        moved = self.model.follow(robot, found.q)
        return replace(tried, made=not elsewhere(moved.x, found.x, moved.snaps, robot.d).any())
