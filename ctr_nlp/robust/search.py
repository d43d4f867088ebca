"""The search for a motion that scenarios share: from several nominal motions, on some frames first (drafts).

Near a fold of its equilibria a robot's tips turn far for little turns of its motors: scenarios may then have no
equilibrium where the nominal robot's plan leads. Where a draft is not solved, they grow from the nominal robot to
what they are, by bisection of the part by which they differ from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import ConstraintScenarios, Scenarios, SharedMotion
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.wall import Wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import find_off_branch_frames
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import interpolate_frames
from ctr_nlp.planning.starts.search import pick_draft_frames
from ctr_nlp.robust.tolerance_scenarios import loaded_unknowns, reported_model
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.solvers.scenarios.interior_point import COARSE_LAST_BARRIER_MM2
from ctr_nlp.typing import Array, Index

BARRIER = 1e-3
"""First barrier, mm^2, of a motion near one that was solved for: of all frames of a draft, or with robots that
have joined.
"""
OFF_BRANCH_DRAFT_PENALTY = 1.02
"""Factor by which the objective of a draft counts more if the robot does not make its motion on the draft's few
frames: it may make it on all frames.
"""
MAX_SCENARIO_GROWTH_SOLVES, MAX_SCENARIO_GROWTH_STEPS = 4, 100
"""Most solves while scenarios grow from the nominal robot to what they are, on the frames of a draft, and most
steps of each. Over all frames that would take minutes, and another draft leads further.
"""


@dataclass(frozen=True)
class InitialMotion:
    """A motion to start from: unknowns x (T, 2d + 2) of the nominal robot on the model that plans are reported on
    (tolerated.told_on); name: where it comes from.
    """

    name: str
    x: Array


@dataclass(frozen=True)
class StartResult:
    """The result of a start on so many frames.

    grown: part of their differences from the nominal robot with which scenarios were solved for.
    on_planned_branch: whether the nominal robot makes the motion, as far as that was checked.
    """

    start: str
    frames: int
    solution: SharedSolution
    grown: float = 1.0
    on_planned_branch: bool = True

    @property
    def is_solved(self) -> bool:
        """Whether all scenarios, with their whole differences, are in stable equilibria in every frame."""
        return self.solution.success and self.grown == 1.0

    @property
    def is_shared(self) -> bool:
        """Whether all scenarios share the motion and the simulated nominal robot is where it is planned to be."""
        return self.is_solved and self.on_planned_branch

    @property
    def promise(self) -> tuple[bool, float]:
        """Key whose least value is the draft to go on with: solved ones first, then by objective."""
        # What the robot does not make in a draft's long steps, it may make in short ones: that is a handicap, not
        # a verdict.
        return not self.is_solved, self.solution.objective * (
            1.0 if self.on_planned_branch else OFF_BRANCH_DRAFT_PENALTY
        )


@dataclass(frozen=True)
class RobustSearch:
    """Solves for scenarios of one problem.

    ends: given configurations. weight: lambda in s^2. margins (T,): least stability margins of all scenarios, or
    None. progress, stop: callbacks. wall: of the lumen that all robots are kept in, None where it does not count.
    guards: of all frames, or None.
    """

    problem: Problem
    model: Model
    ends: EndConfigurations
    terms: tuple[Term, ...]
    weight: float
    margins: Array | None
    progress: Progress | None = None
    stop: Callable[[], bool] = lambda: False
    wall: Wall | None = None
    guards: ConstraintScenarios | None = None

    def motion(self, scenarios: Scenarios, picked: Index | None = None) -> SharedMotion:
        """The program over all frames, or over picked ones, evenly apart."""
        problem = self.problem
        frames = range(problem.frames) if picked is None else picked.tolist()
        # With the time between picked frames as dt, limits of speed mean what they do over all frames.
        dt = problem.dt * (1 if picked is None or len(picked) < 2 else int(picked[-1] - picked[-2]))
        at = problem.robot, [problem.target_frames[k] for k in frames], dt, self.weight, self.ends, self.model
        margins = None if self.margins is None else self.margins[frames]
        # Guards belong to frames of the whole motion: a draft takes those of its own.
        guards = None if self.guards is None else self.guards.at(list(frames))
        return shared_motion(
            *at, scenarios, fastest_functions, margins, self.terms, wall=self.wall, constraint_scenarios=guards
        )

    @cached_property
    def draft_frames(self) -> Index | None:
        """Frames of drafts, from 0; None where a draft has all frames."""
        found = pick_draft_frames(self.problem.frames)
        return None if len(found) == self.problem.frames else found

    def drafts(self, starts: Sequence[InitialMotion], scenarios: Scenarios) -> list[StartResult]:
        """Solve starts on the frames of a draft, and return the results, the most promising first."""
        tried = list[StartResult]()
        for number, start in enumerate(starts):
            if self.progress is not None:
                self.progress(number, len(starts) + 1, f"draft from a motion of {start.name}")
            if not self.stop():
                tried.append(self.solve(start, scenarios, self.draft_frames))
        return sorted(tried, key=lambda one: one.promise)

    def refine_draft(self, draft: StartResult, scenarios: Scenarios) -> StartResult:
        """Solve all frames from the result of a draft, whose motion and tips are interpolated."""
        frames, (_, *each) = self.problem.frames, draft.solution.phi.shape
        if self.draft_frames is None:
            return draft
        q = interpolate_frames(draft.solution.q, self.draft_frames, frames)
        tips = interpolate_frames(
            draft.solution.phi.reshape(len(self.draft_frames), -1), self.draft_frames, frames
        )
        # Tips (T, S, k) were one row a frame while they were interpolated.
        return self._solve_from(draft.start, q, tips.reshape(frames, *each), scenarios, None, BARRIER)

    def solve(self, start: InitialMotion, scenarios: Scenarios, picked: Index | None = None) -> StartResult:
        """Solve all frames, or picked ones, from a start."""
        robot = self.problem.robot
        own = self.motion(scenarios, picked).own
        q = reported_model(self.model).configuration(robot, start.x)
        # All scenarios begin with the nominal robot's tips: their own equations need not hold at a start.
        tips = np.repeat(loaded_unknowns(robot, self.model, q, start.x)[:, None, own], len(scenarios), axis=1)
        of_frames = slice(None) if picked is None else picked
        return self._solve_from(
            start.name, q[of_frames], tips[of_frames], scenarios, picked, COLD_START_BARRIER_MM2
        )

    def _solve_from(
        self, name: str, q: Array, tips: Array, scenarios: Scenarios, picked: Index | None, barrier: float
    ) -> StartResult:
        """Solve from q (T, 2d + 2) and tips (T, S, k); for a draft, grow the scenarios where that fails.

        name: of the start. barrier: the first one, mm^2.
        """
        found = SharedSolver(self.motion(scenarios, picked), COARSE_LAST_BARRIER_MM2)(
            q, tips, barrier, self.stop, rough=picked is not None
        )
        # Growing takes several solves: on a draft these are cheap.
        if found.success or picked is None or self.stop():
            return self.with_branch_check(StartResult(name, len(q), found))
        return self.grow_scenarios(name, q, tips[:, :1], scenarios, picked)

    def grow_scenarios(
        self, name: str, q: Array, tips: Array, scenarios: Scenarios, picked: Index | None = None
    ) -> StartResult:
        """Solve for scenarios that grow from the nominal robot, with its tips (T, 1, k), to what they are."""
        tips = np.repeat(tips, self.motion(scenarios, picked).sizes[1], axis=1)
        # Half of the differences first, then all of them; after a failure, half way between the last success and
        # it. Each solve starts from the last success.
        done = 0.0
        part = 0.5
        best = None
        for _ in range(MAX_SCENARIO_GROWTH_SOLVES):
            solver = SharedSolver(self.motion(scenarios.shrink_differences(part), picked), COARSE_LAST_BARRIER_MM2)
            found = solver(
                q, tips, COLD_START_BARRIER_MM2, self.stop, MAX_SCENARIO_GROWTH_STEPS, rough=picked is not None
            )
            if found.success:
                done = part
                best = found
                q = found.q
                tips = found.phi
                if part == 1.0:
                    break
                part = 1.0
            else:
                part = (done + part) / 2
            if self.stop():
                break
        # The best that was reached is kept, with the part that it stands for: it is not `solved`, and says in the
        # plan's meta how far it came.
        tried = StartResult(name, len(q), found if best is None else best, done if best is not None else part)
        return self.with_branch_check(tried)

    def with_branch_check(self, tried: StartResult) -> StartResult:
        """Return a result with `made` set: whether the simulated nominal robot is where it is planned to be."""
        found = tried.solution
        robot = self.problem.robot
        if not found.success:
            return tried
        moved = self.model.follow(robot, found.q)
        return replace(
            tried, on_planned_branch=not find_off_branch_frames(moved.x, found.x, moved.snaps, robot.d).any()
        )
