"""Multi-start search for a motion that scenarios share, from several nominal motions, on some frames first.

Near a fold of its equilibria a robot's tips turn far for small turns of its motors: scenarios may then have no
equilibrium near the nominal robot's plan. Where a draft is not solved, a homotopy is used: scenarios grow from the
nominal robot to their full differences, with bisection of the step.
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
"""First barrier parameter, mm^2, of a motion near a known solution: a draft refined to all frames, or with robots
that have joined.
"""
OFF_BRANCH_DRAFT_PENALTY = 1.02
"""Factor of the objective of a draft on whose few frames the simulated robot leaves the planned branch: on all
frames it may stay on it.
"""
MAX_SCENARIO_GROWTH_SOLVES, MAX_SCENARIO_GROWTH_STEPS = 4, 100
"""Largest number of solves of a homotopy on a draft, and of steps of each. Over all frames it would take minutes,
and another draft is more promising.
"""


@dataclass(frozen=True)
class InitialMotion:
    """An initial guess of a motion.

    name: where it comes from. x (T, 2d + 2): unknowns of the nominal robot on the model on which plans are
    reported (tolerance_scenarios.reported_model).
    """

    name: str
    x: Array


@dataclass(frozen=True)
class StartResult:
    """The result of solving from one start.

    start: its name. frames: number of frames. solution: the result. grown: part of their differences from the
    nominal robot with which scenarios were solved for. on_planned_branch: whether the simulated nominal robot
    stays on the planned branch, as far as that was checked.
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
        """Whether all scenarios share the motion and the simulated nominal robot stays on the planned branch."""
        return self.is_solved and self.on_planned_branch

    @property
    def promise(self) -> tuple[bool, float]:
        """Sort key of drafts, best first: solved ones, then by objective."""
        # A robot that leaves the branch in a draft's long steps may stay on it in short ones: that is a handicap,
        # no exclusion.
        return not self.is_solved, self.solution.objective * (
            1.0 if self.on_planned_branch else OFF_BRANCH_DRAFT_PENALTY
        )


@dataclass(frozen=True)
class RobustSearch:
    """Solver of one problem for scenarios.

    model: on which scenarios are planned. ends: given configurations. terms: of the objective. weight: lambda in
    s^2. margins (T,): least stability margins of all scenarios, or None. progress, stop: callbacks. wall: of the
    lumen, None where it does not count. guards: constraint scenarios of all frames, or None.
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
        """Build the program for scenarios over all frames, or over `picked` ones, evenly spaced, from 0."""
        problem = self.problem
        frames = range(problem.frames) if picked is None else picked.tolist()
        # With the time between picked frames as dt, limits of speed mean what they do over all frames.
        dt = problem.dt * (1 if picked is None or len(picked) < 2 else int(picked[-1] - picked[-2]))
        at = problem.robot, [problem.target_frames[k] for k in frames], dt, self.weight, self.ends, self.model
        margins = None if self.margins is None else self.margins[frames]
        # Constraint scenarios belong to frames of the whole motion: a draft takes those of its own frames.
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
        """Solve starts for scenarios on the frames of a draft; return the results, the most promising first."""
        tried = list[StartResult]()
        for number, start in enumerate(starts):
            if self.progress is not None:
                which = f", initial guess {number + 1} of {len(starts)}" if len(starts) > 1 else ""
                self.progress(number, len(starts), f"one motion for all robots within the tolerances{which}")
            if not self.stop():
                tried.append(self.solve(start, scenarios, self.draft_frames))
        return sorted(tried, key=lambda one: one.promise)

    def report_step(self, step: str) -> None:
        """Report a step of unknown length that begins, in words."""
        if self.progress is not None:
            self.progress(0, 1, step)

    def refine_draft(self, draft: StartResult, scenarios: Scenarios) -> StartResult:
        """Solve all frames for scenarios from the result of a draft, whose motion and tips are interpolated."""
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
        """Solve all frames, or `picked` ones (from 0), for scenarios from a start."""
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
        """Solve from q (T, 2d + 2) and tips (T, S, k); on a draft, by homotopy where that fails.

        name: of the start. picked: frames of a draft, None for all. barrier: the first barrier parameter, mm^2.
        """
        found = SharedSolver(self.motion(scenarios, picked), COARSE_LAST_BARRIER_MM2)(
            q, tips, barrier, self.stop, rough=picked is not None
        )
        # A homotopy takes several solves: on a draft these are cheap.
        if found.success or picked is None or self.stop():
            return self.with_branch_check(StartResult(name, len(q), found))
        return self.grow_scenarios(name, q, tips[:, :1], scenarios, picked)

    def grow_scenarios(
        self, name: str, q: Array, tips: Array, scenarios: Scenarios, picked: Index | None = None
    ) -> StartResult:
        """Solve by homotopy: scenarios grow from the nominal robot to their full differences.

        name: of the start. q: (T, 2d + 2). tips: (T, 1, k) of the nominal robot, rad. picked: frames of a draft,
        from 0; None for all.
        """
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
        # The last success is returned with its part: it does not count as solved, and the plan's meta reports how
        # far it came.
        tried = StartResult(name, len(q), found if best is None else best, done if best is not None else part)
        return self.with_branch_check(tried)

    def with_branch_check(self, tried: StartResult) -> StartResult:
        """Return a result with `on_planned_branch` set by a simulation of the nominal robot; tried: the result."""
        found = tried.solution
        robot = self.problem.robot
        if not found.success:
            return tried
        # A solution is an equilibrium in every frame. Whether the robot reaches it depends on the motion in
        # between.
        moved = self.model.follow(robot, found.q)
        return replace(
            tried, on_planned_branch=not find_off_branch_frames(moved.x, found.x, moved.snaps, robot.d).any()
        )
