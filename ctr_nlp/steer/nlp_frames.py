"""Frames of a problem solved as programs, stage after stage."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ctr_nlp.formulations import FORMULATIONS, Stage, default_model
from ctr_nlp.formulations.frames import FrameResult, distinct, reachable, starts
from ctr_nlp.formulations.joint import joint, tip_steps
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.terms.arrival import Arrival, find_arrival, with_frame_arrival
from ctr_nlp.formulations.terms.term import listed
from ctr_nlp.formulations.wall import ROUNDS, SETTLED, Wall, wall_of
from ctr_nlp.models import Model, model_named
from ctr_nlp.simulation.forward import other_way
from ctr_nlp.solvers import SOLVERS, NlpSolver, Solution, default_solver
from ctr_nlp.steer.at_once import AtOnce, reach_of
from ctr_nlp.steer.requests import check_model, checked_terms
from ctr_nlp.support.values import check_choice
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

SEARCH_STARTS, FEW_TUBES = 32, 4
"""Starts of a search without a past, of robots of so many tubes; four times as many for each one more."""
RETRY_STARTS = 8
"""Further starts for a frame on which the solver failed."""
TWIN_ROOM = 0.3
"""Least distance in rad from the limits of tilt at which the other way to write a shape is tried too."""
STRETCH = 50
"""Frames that are solved in one call; between calls, progress is told and Ctrl-C is heeded."""
DEFAULTS = Settings()

Built = Sequence[tuple[Stage, NlpSolver]]
"""Stages and their solvers."""


@dataclass(frozen=True)
class NlpFrames:
    """A FrameSolver: the stages of a formulation, built once and solved for any frame.

    free, inside: stages far from any wall, and within one, where it counts. runs: the same, for all frames in one
    call, of formulations of one stage. margins (T,): least stability margins, NaN where none is asked for. near:
    the wall that frames are kept within, None for none. Others with other margins or another wall are made by
    dataclasses.replace, and share what has been built. wall: that of the lumen, None where none counts. arrival:
    the term that leads the tip to the target's end, None where there is none.
    """

    problem: Problem
    model: Model
    settings: Settings
    free: Built
    inside: Built
    runs: tuple[AtOnce, ...]
    margins: Array
    wall: Wall | None
    near: Wall | None
    build_seconds: float
    description: dict[str, Any]
    arrival: Arrival | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        formulation: str = "joint",
        solver: str | None = None,
        model: str | Model | None = None,
        settings: Settings = DEFAULTS,
        terms: Sequence[Term] = (),
    ) -> NlpFrames:
        """Build the programs; raises OptionError, and ProblemError where the target is not known all along.

        model: None for the default of the formulation (formulations.default_model). terms: further ones of the
        objective, on formulations that take them.
        """
        check_choice("formulation", formulation, FORMULATIONS)
        described = model_named(default_model(formulation) if model is None else model)
        terms = checked_terms(terms)
        if formulation == "joint":  # the stages of others each have an objective of their own
            terms = with_frame_arrival(terms, settings, described)
        check_model(problem, described)
        solver = default_solver() if solver is None else solver
        check_choice("solver", solver, SOLVERS)
        samples, begin = problem.samples, time.perf_counter()
        lumen = problem.sampled_lumen if formulation == "joint" else None
        wall = wall_of(problem.robot, lumen, described, settings)
        at = problem.robot, settings, described, terms
        walled = () if wall is None else joint(*at, walled=True)
        free, inside = (
            [(stage, SOLVERS[solver](stage.nlp)) for stage in stages]
            for stages in (FORMULATIONS[formulation](*at), walled)
        )
        stage, zero = (inside or free)[0][0], np.zeros(len(problem.robot.axes))
        values = [stage.fill(sample, zero) for sample in samples]  # raises where the target is not known
        reach = reach_of(problem.robot, problem.dt, described.several_equilibria)
        runs = () if len(free) > 1 else tuple(AtOnce.of(*each, values, reach) for each in (*free, *inside))
        margin = math.nan if settings.stability_margin is None else settings.stability_margin
        description = {
            "formulation": formulation,
            **described.told,
            "solver": solver,
            "options": settings.options() | {"terms": listed(terms)},
        }
        margins, seconds = np.full(problem.frames, margin), time.perf_counter() - begin
        rest = margins, wall, None, seconds, description, find_arrival(terms)
        return cls(problem, described, settings, free, inside, runs, *rest)

    def search(self, frame: int) -> list[FrameResult]:
        """Distinct answers for a frame without a past, best first; at least one."""
        robot, sample = self.problem.robot, self.problem.samples[frame]
        guesses = starts(robot, sample, SEARCH_STARTS * 4 ** max(0, robot.d - FEW_TUBES), self.settings.seed)
        found = distinct([self._unwound(result) for result in self._searched(frame, guesses)])
        if not found:
            return [FrameResult(guesses[0], success=False, status="no start was solved")]
        best, *others = found
        return [best, *(replace(best, q=twin, warm=None) for twin in self._twin(best.q)), *others]

    def _searched(self, frame: int, guesses: Array) -> list[FrameResult]:
        """What is found from guesses (n, 2d + 2)."""
        if self._at_once is not None:
            return self._at_once.search(frame, self.model.guess(self.problem.robot, guesses))
        return self._attempts(frame, [FrameResult(guess, x=self._unknowns(guess)) for guess in guesses], None)

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Answers for frames, each from the one before, and the seconds that they took.

        Many are solved at once where that is possible, and single ones where it fails.
        """
        left = list(frames)
        while left:
            found = [] if self._at_once is None else self._at_once.follow(left[:STRETCH], self._placed(before))
            if len(found) < min(len(left), STRETCH):
                begin, last = time.perf_counter(), found[-1][0] if found else before
                found.append((self.step(left[len(found)], last), time.perf_counter() - begin))
            left, before = left[len(found) :], found[-1][0]
            yield from found

    @cached_property
    def _at_once(self) -> AtOnce | None:
        """What solves many frames in one call: for one program for all of q, and walls that C can describe."""
        if not self.runs:
            return None
        root = math.sqrt(self.settings.motion_weight) / self.problem.dt
        values: dict[str, Array | float] = {"motion_root": root, "margin": self.margins}
        if self.near is None:
            return self.runs[0].given(values)
        around = self.near.around
        if around is None or not around.ready():
            return None
        values |= {"contact_weight": self.near.weight, "contact_allowed": self.near.allowed}
        return self.runs[-1].given(values, around.surroundings(SETTLED, ROUNDS))

    def _placed(self, before: FrameResult) -> FrameResult:
        """A result with the model's unknowns: those of a robot at rest where they are not known."""
        if before.x is not None or not self.model.several_equilibria:
            return before
        return replace(before, x=self.model.rest(self.problem.robot, before.q))

    def _unwound(self, result: FrameResult) -> FrameResult:
        """An answer without whole turns that a search may have gone through.

        Where q does not determine the unknowns, tubes are turned whole with their tips, until those are no more
        than half a turn from the innermost: a robot comes there from where all its tubes are aligned.
        """
        d, q, x = self.problem.robot.d, result.q.copy(), result.x
        if x is None and abs(q[:d]).max() <= 2 * np.pi:
            return result
        turns = np.round(q[:d] / (2 * np.pi))
        if x is not None:
            own = np.append(np.round(x[: d - 1] / (2 * np.pi)), turns[-1])
            x, turns = x - 2 * np.pi * np.pad(own, (0, len(x) - d)), np.append(own[:-1] + own[-1], own[-1])
        if not turns.any():
            return result
        q[:d] -= 2 * np.pi * turns
        return replace(result, q=q, x=x, warm=None) if self._allowed(q) else result

    def _allowed(self, q: Array) -> bool:
        """Whether q is within the robot's limits."""
        robot = self.problem.robot
        return bool((np.minimum(q - robot.lower, robot.upper - q) > -1e-9).all())

    def _twin(self, q: Array) -> list[Array]:
        """The other way to write the same shape, where the limits of tilt are not near: it may lead further."""
        robot, twin = self.problem.robot, other_way(self.problem.robot, q)
        twin[-2:] -= 2 * np.pi * np.round(twin[-2:] / (2 * np.pi))
        room = np.minimum(twin - robot.lower, robot.upper - twin)[-2:]
        return [twin] if (room > TWIN_ROOM).all() and self._allowed(twin) else []

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """The answer for a frame within speed limits of the one before; other starts are tried on failure."""
        before = self._placed(before)
        result = self._solve(frame, before, before)
        if result.success:
            return result
        low, high = reachable(self.problem.robot, before.q, self.problem.dt)
        guesses = starts(self.problem.robot, self.problem.samples[frame], RETRY_STARTS, self.settings.seed)
        tried = [FrameResult(q, x=self._unknowns(q)) for q in np.clip(guesses, low, high)]
        attempts = self._attempts(frame, [replace(before, warm=None), *tried], before)
        best = min(attempts, key=lambda r: r.objective, default=None)
        return best or replace(result, q=before.q)

    def _unknowns(self, q: Array) -> Array | None:
        """Roughly those of a model whose q does not determine them."""
        return self.model.guess(self.problem.robot, q) if self.model.several_equilibria else None

    def _attempts(
        self, frame: int, guesses: Iterable[FrameResult], before: FrameResult | None
    ) -> list[FrameResult]:
        results = (self._solve(frame, guess, before) for guess in guesses)
        return [result for result in results if result.success]

    def _limits(self, before: FrameResult | None) -> tuple[Array, Array]:
        """Of q, and where q does not determine the unknowns also of the tips' angles."""
        robot, dt = self.problem.robot, self.problem.dt
        low, high = reachable(robot, None if before is None else before.q, dt)
        if not self.model.several_equilibria:
            return low, high
        tips, step = np.zeros(robot.d), np.full(robot.d, np.inf)
        if before is not None and before.x is not None:
            tips, step = before.x[: robot.d], tip_steps(robot, dt)
        return np.append(low, tips - step), np.append(high, tips + step)

    def again(self, frame: int, known: FrameResult) -> FrameResult:
        """The answer for a frame without a past, from a known one that may be free of the wall."""
        return self._solve(frame, replace(known, warm=None), None)

    def _solve(self, index: int, guess: FrameResult, before: FrameResult | None) -> FrameResult:
        """The answer from a guess; near a wall, solved again around itself until that needs the same slack."""
        result, tried = self._solved(index, guess, before), list[FrameResult]()
        while self.near is not None and result.success:
            slack = result.warm[0].x[-1]
            x = result.q if result.x is None else result.x
            needed = self.near.during([self.problem.samples[index]])(x[None])[1][0]
            more = float(self.near.cost(needed) - self.near.cost(slack))
            tried.append(replace(result, objective=result.objective + more))
            if abs(needed - slack) <= SETTLED or len(tried) == ROUNDS:
                break
            result = self._solved(index, result, before)
        return min(tried, key=lambda one: one.objective, default=result)

    def _solved(self, index: int, guess: FrameResult, before: FrameResult | None) -> FrameResult:
        """The answer from a guess, stage after stage."""
        q, solutions, iterations = guess.q.copy(), list[Solution](), 0
        for k, (stage, solver) in enumerate(self.free if self.near is None else self.inside):
            warm: Solution | None = guess.warm[k] if guess.warm else None
            solution, more = self._staged(stage, solver, index, q, guess, before, warm)
            iterations += more
            if not solution.success:
                failure = f"{stage.nlp.name}: {solution.status}, KKT residual {solution.kkt:.1e}"
                return FrameResult(guess.q, False, iterations=iterations, status=failure)
            q[stage.decides] = solution.q[: len(stage.decides)]
            solutions.append(solution)
        kkt = max(solution.kkt for solution in solutions)
        status = ", ".join(solution.status for solution in solutions)
        x = solutions[-1].x[: stage.nlp.x.numel() - stage.nlp.slacks] if self.model.several_equilibria else None
        return FrameResult(q, True, solutions[-1].objective, kkt, iterations, status, tuple(solutions), x)

    def _staged(
        self,
        stage: Stage,
        solver: NlpSolver,
        index: int,
        q: Array,
        guess: FrameResult,
        before: FrameResult | None,
        warm: Solution | None,
    ) -> tuple[Solution, int]:
        """The solution of one stage at q (2d + 2,), and its iterations."""
        low, high = self._limits(before)
        limited = np.append(stage.decides, np.arange(len(q), len(low)))
        values = dict(stage.fill(self.problem.samples[index], q))
        if "margin" in values:
            values["margin"] = self.margins[index]
        values["previous"] = (q if before is None else before.q)[stage.decides]
        if before is not None:
            values["motion_root"] = math.sqrt(self.settings.motion_weight) / self.problem.dt
        else:
            values["motion_root"] = 0.0
        x = q[stage.decides] if guess.x is None else guess.x
        x = x if warm is None else warm.x[: stage.nlp.x.numel() - stage.nlp.slacks]
        if self.near is not None:
            parameters, slack = self.near.during([self.problem.samples[index]])(x[None])
            values |= {name: value[0] for name, value in parameters.items()}
            x = np.append(x, slack)
        iterations = 0
        for further in stage.schedule:
            packed = stage.nlp.pack({**values, **further})
            warm = solver(x, packed, low[limited], high[limited], warm)
            x, iterations = warm.x, iterations + warm.iterations
        assert warm is not None
        return warm, iterations
