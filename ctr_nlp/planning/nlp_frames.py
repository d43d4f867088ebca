"""Frames of a problem solved as programs: the joint formulation, eq. (9), or two stages, eqs. (10) to (12).

Unknowns of a stage are q = (alpha, beta, theta) in rad and mm, or a part of it; on the elastic model, whose
equilibria q does not determine, also the angles of the tubes' tips (models/elastic/torsion.py). Near a wall a
slack z, the mm by which the clearance is missed, comes last among them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ctr_nlp.models import Model, model_named
from ctr_nlp.ocp import FORMULATIONS, Stage, default_model
from ctr_nlp.ocp.frame_solver import FrameResult, distinct_results, reachable_bounds, sobol_starts
from ctr_nlp.ocp.joint import joint, tip_step_limits
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.arrival import ArrivalTerm, find_arrival, with_frame_arrival
from ctr_nlp.ocp.terms.term import describe_terms
from ctr_nlp.ocp.wall import MAX_WALL_RELINEARISATIONS, WALL_SLACK_TOLERANCE_MM, Wall, make_wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.simulation import equivalent_configurations
from ctr_nlp.planning.compiled_frames import CompiledFrames, reach_of
from ctr_nlp.planning.validation import check_model, checked_terms
from ctr_nlp.solvers import SOLVERS, NlpSolver, Solution, default_solver
from ctr_nlp.support.value_checks import check_choice
from ctr_nlp.typing import Array

FRAME_SEARCH_STARTS, MAX_TUBES_FOR_SEARCH_STARTS = 32, 4
"""Number of starts of a search without a frame before, for robots of up to so many tubes; four times as many for
each further tube.
"""
RETRY_STARTS = 8
"""Further starts for a frame that the solver could not solve from the frame before."""
MIN_EQUIVALENT_TILT_ROOM_RAD = 0.3
"""Least distance from the limits of tilt, rad, at which the other configuration of the same shape is tried too."""
FRAMES_PER_COMPILED_CALL = 50
"""Frames that are solved in one call; between calls, progress is reported and Ctrl-C takes effect."""
DEFAULT_PLANNER_SETTINGS = Settings()

Built = Sequence[tuple[Stage, NlpSolver]]
"""Stages and their solvers."""


@dataclass(frozen=True)
class NlpFrames:
    """Solver of single frames (a FrameSolver): the stages of a formulation, built once and solved for any frame.

    free, inside: stages without a wall, and within one; inside is empty where no wall counts. runs: compiled
    programs of formulations of one stage, for many frames in one call. margins (T,): least stability margins, NaN
    where none is asked for. active_wall: the wall that frames are kept within, None for none. wall: that of the
    lumen, None where it costs nothing. arrival: the term that pulls the tip to the target's end, or None.

    Solvers with other margins or another wall are made by dataclasses.replace and share everything that was built.
    """

    problem: Problem
    model: Model
    settings: Settings
    free: Built
    inside: Built
    runs: tuple[CompiledFrames, ...]
    margins: Array
    wall: Wall | None
    active_wall: Wall | None
    build_seconds: float
    description: dict[str, Any]
    arrival: ArrivalTerm | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        formulation: str = "joint",
        solver: str | None = None,
        model: str | Model | None = None,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        terms: Sequence[Term] = (),
    ) -> NlpFrames:
        """Build the programs of a problem.

        formulation, solver: names, as in solve_per_frame; None for the default solver. model: None for the default
        of the formulation (ocp.default_model). settings: weights and margins. terms: further ones of the
        objective, on formulations that take them. Raises OptionError, and ProblemError where the target is not
        known in every frame.
        """
        check_choice("formulation", formulation, FORMULATIONS)
        # Two stages need a curvature that alpha does not change, which the dominant model has.
        described = model_named(default_model(formulation) if model is None else model)
        terms = checked_terms(terms)
        if formulation == "joint":  # the stages of others each have an objective of their own
            terms = with_frame_arrival(terms, settings, described)
        check_model(problem, described)
        solver = default_solver() if solver is None else solver
        check_choice("solver", solver, SOLVERS)
        samples = problem.target_frames
        begin = time.perf_counter()
        # Only the program over all of q can trade contact against shape; two stages have no wall.
        geometry = problem.wall if formulation == "joint" else None
        wall = make_wall(problem.robot, geometry, described, settings)
        at = problem.robot, settings, described, terms
        walled = () if wall is None else joint(*at, walled=True)
        free, inside = (
            [(stage, SOLVERS[solver](stage.nlp)) for stage in stages]
            for stages in (FORMULATIONS[formulation](*at), walled)
        )
        # Filled once, so that a target that is not known in some frame is found now and not after minutes.
        stage = (inside or free)[0][0]
        zero = np.zeros(len(problem.robot.axes))
        values = [stage.fill(sample, zero) for sample in samples]  # raises where the target is not known
        reach = reach_of(problem.robot, problem.dt, described.several_equilibria)
        # The second of two stages needs the first one's solution, frame by frame: that is not one program to be
        # run over many frames.
        runs = () if len(free) > 1 else tuple(CompiledFrames.of(*each, values, reach) for each in (*free, *inside))
        margin = math.nan if settings.stability_margin is None else settings.stability_margin
        description = {
            "formulation": formulation,
            **described.metadata,
            "solver": solver,
            "options": settings.options() | {"terms": describe_terms(terms)},
        }
        margins = np.full(problem.frames, margin)
        seconds = time.perf_counter() - begin
        rest = margins, wall, None, seconds, description, find_arrival(terms)
        return cls(problem, described, settings, free, inside, runs, *rest)

    def search(self, frame: int) -> list[FrameResult]:
        """Return distinct results for a frame that has no frame before it, best first; at least one."""
        robot = self.problem.robot
        sample = self.problem.target_frames[frame]
        # alpha has a dimension for each tube, and a search has to cover all of them: hence 4 to the power of tubes
        # beyond the usual number.
        guesses = sobol_starts(
            robot,
            sample,
            FRAME_SEARCH_STARTS * 4 ** max(0, robot.d - MAX_TUBES_FOR_SEARCH_STARTS),
            self.settings.seed,
        )
        found = distinct_results(
            [self._remove_whole_turns(result) for result in self._search_solutions(frame, guesses)]
        )
        if not found:
            return [FrameResult(guesses[0], success=False, status="no start was solved")]
        best, *others = found
        # The twin follows the best at once: of a few candidates that are run through all frames, it should be one,
        # as the other tilt may stay within limits for longer.
        return [best, *(replace(best, q=twin, warm=None) for twin in self._equivalent_tilt(best.q)), *others]

    def _search_solutions(self, frame: int, guesses: Array) -> list[FrameResult]:
        """Return the solutions of a frame that has no frame before it, from guesses (n, 2d + 2)."""
        if self._compiled_frames is not None:
            return self._compiled_frames.search(frame, self.model.guess(self.problem.robot, guesses))
        return self._solve_from_guesses(
            frame, [FrameResult(guess, x=self._unknowns(guess)) for guess in guesses], None
        )

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Yield results for frames, each from the one before, and the seconds that each took.

        Compiled code solves up to FRAMES_PER_COMPILED_CALL frames in one call. The frame at which it fails is
        solved by `step`, which has further starts, and the next call continues from there.
        """
        left = list(frames)
        while left:
            found = (
                []
                if self._compiled_frames is None
                else self._compiled_frames.follow(left[:FRAMES_PER_COMPILED_CALL], self._with_unknowns(before))
            )
            if len(found) < min(len(left), FRAMES_PER_COMPILED_CALL):
                begin = time.perf_counter()
                last = found[-1][0] if found else before
                found.append((self.step(left[len(found)], last), time.perf_counter() - begin))
            left = left[len(found) :]
            before = found[-1][0]
            yield from found

    @cached_property
    def _compiled_frames(self) -> CompiledFrames | None:
        """Return the compiled solver of many frames, or None where there is none.

        It needs a formulation of one program and, within a wall, a wall that was compiled.
        """
        if not self.runs:
            return None
        # Residuals are squared by the program: root^2 |W (q - q_before)|^2 is the motion term of eq. (9).
        root = math.sqrt(self.settings.motion_weight) / self.problem.dt
        values: dict[str, Array | float] = {"motion_root": root, "margin": self.margins}
        if self.active_wall is None:
            return self.runs[0].with_parameters(values)
        around = self.active_wall.compiled_wall
        if around is None or not around.ready():
            return None
        values |= {
            "contact_weight": self.active_wall.weight,
            "contact_allowed": self.active_wall.contact_threshold,
        }
        return self.runs[-1].with_parameters(
            values, around.local_parameter_source(WALL_SLACK_TOLERANCE_MM, MAX_WALL_RELINEARISATIONS)
        )

    def _with_unknowns(self, before: FrameResult) -> FrameResult:
        """Return a result with the model's unknowns; where missing, those of the robot at rest at its q."""
        if before.x is not None or not self.model.several_equilibria:
            return before
        return replace(before, x=self.model.rest(self.problem.robot, before.q))

    def _remove_whole_turns(self, result: FrameResult) -> FrameResult:
        """Return a solution without the whole turns of tubes that a search may have gone through.

        Where q does not determine the unknowns, tubes are turned by whole turns together with their tips, until
        each tip is at most half a turn from the innermost one: that equilibrium is reached from aligned tubes. The
        result is left as it is where q would leave its limits.
        """
        d = self.problem.robot.d
        q = result.q.copy()
        x = result.x
        if x is None and abs(q[:d]).max() <= 2 * np.pi:
            return result
        # Without tips the shape has period 2 pi in each alpha: turns may be taken off each motor.
        turns = np.round(q[:d] / (2 * np.pi))
        if x is not None:
            # x holds tips relative to the innermost one, which itself is absolute: the turns of tube i are those
            # of its relative tip plus those of the innermost. Motors are turned by as much as tips, so that the
            # twist of every transmission stays what it is.
            own = np.append(np.round(x[: d - 1] / (2 * np.pi)), turns[-1])
            x = x - 2 * np.pi * np.pad(own, (0, len(x) - d))
            turns = np.append(own[:-1] + own[-1], own[-1])
        if not turns.any():
            return result
        q[:d] -= 2 * np.pi * turns
        return replace(result, q=q, x=x, warm=None) if self._is_within_limits(q) else result

    def _is_within_limits(self, q: Array) -> bool:
        """Whether q is within the robot's limits."""
        robot = self.problem.robot
        return bool((np.minimum(q - robot.lower, robot.upper - q) > -1e-9).all())

    def _equivalent_tilt(self, q: Array) -> list[Array]:
        """Return the other configuration of the same shape where it is well within the limits of tilt, else
        nothing.

        theta_x and pi - theta_x give the same shape with all alpha turned by half a turn
        (equivalent_configurations). From there a motion may continue longer before it reaches a limit.
        """
        robot = self.problem.robot
        twin = equivalent_configurations(self.problem.robot, q)
        # Whole turns of the tilt change nothing: it is written within half a turn of 0.
        twin[-2:] -= 2 * np.pi * np.round(twin[-2:] / (2 * np.pi))
        room = np.minimum(twin - robot.lower, robot.upper - twin)[-2:]
        return [twin] if (room > MIN_EQUIVALENT_TILT_ROOM_RAD).all() and self._is_within_limits(twin) else []

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """Solve a frame within speed limits of the one before; where that fails, from further starts.

        Where all starts fail, the result has success False, and the q of the frame before.
        """
        before = self._with_unknowns(before)
        result = self._solve(frame, before, before)
        if result.success:
            return result
        low, high = reachable_bounds(self.problem.robot, before.q, self.problem.dt)
        guesses = sobol_starts(
            self.problem.robot, self.problem.target_frames[frame], RETRY_STARTS, self.settings.seed
        )
        tried = [FrameResult(q, x=self._unknowns(q)) for q in np.clip(guesses, low, high)]
        # The frame before is a start once more, without its multipliers: they may belong to other active limits.
        attempts = self._solve_from_guesses(frame, [replace(before, warm=None), *tried], before)
        best = min(attempts, key=lambda r: r.objective, default=None)
        return best or replace(result, q=before.q)

    def _unknowns(self, q: Array) -> Array | None:
        """Estimate the unknowns of a model whose q does not determine them; None on other models."""
        return self.model.guess(self.problem.robot, q) if self.model.several_equilibria else None

    def _solve_from_guesses(
        self, frame: int, guesses: Iterable[FrameResult], before: FrameResult | None
    ) -> list[FrameResult]:
        results = (self._solve(frame, guess, before) for guess in guesses)
        return [result for result in results if result.success]

    def _limits(self, before: FrameResult | None) -> tuple[Array, Array]:
        """Return lower and upper bounds of q and, where q does not determine the unknowns, of the tips' angles.

        before: the frame before, from which speeds limit both; None where there is none.
        """
        robot = self.problem.robot
        dt = self.problem.dt
        low, high = reachable_bounds(robot, None if before is None else before.q, dt)
        if not self.model.several_equilibria:
            return low, high
        tips = np.zeros(robot.d)
        step = np.full(robot.d, np.inf)
        if before is not None and before.x is not None:
            tips = before.x[: robot.d]
            step = tip_step_limits(robot, dt)
        return np.append(low, tips - step), np.append(high, tips + step)

    def search_near(self, frame: int, known: FrameResult) -> FrameResult:
        """Solve a frame that has no frame before it, near a known solution, which may be one without the wall."""
        # Multipliers of a program without the wall do not fit the one with it.
        return self._solve(frame, replace(known, warm=None), None)

    def _solve(self, index: int, guess: FrameResult, before: FrameResult | None) -> FrameResult:
        """Solve a frame from a guess; near a wall, re-linearise it around each solution until the slack agrees.

        before: the frame before, or None.
        """
        result = self._solve_stages(index, guess, before)
        tried = list[FrameResult]()
        while self.active_wall is not None and result.success:
            slack = result.warm[0].x[-1]
            x = result.q if result.x is None else result.x
            # The program has the wall only to second order around its guess. At its solution the wall is expanded
            # again, and the slack that is really needed there is compared with the one found.
            needed = self.active_wall.local_parameters_during([self.problem.target_frames[index]])(x[None])[1][0]
            # Rounds are compared by their real contact, not by that of their expansion.
            more = float(self.active_wall.cost(needed) - self.active_wall.cost(slack))
            tried.append(replace(result, objective=result.objective + more))
            if abs(needed - slack) <= WALL_SLACK_TOLERANCE_MM or len(tried) == MAX_WALL_RELINEARISATIONS:
                break
            result = self._solve_stages(index, result, before)
        return min(tried, key=lambda one: one.objective, default=result)

    def _solve_stages(self, index: int, guess: FrameResult, before: FrameResult | None) -> FrameResult:
        """Solve the stages of a frame one after the other from a guess; return the last solution with all of q."""
        q = guess.q.copy()
        solutions = list[Solution]()
        iterations = 0
        for k, (stage, solver) in enumerate(self.free if self.active_wall is None else self.inside):
            warm: Solution | None = guess.warm[k] if guess.warm else None
            solution, more = self._solve_stage(stage, solver, index, q, guess, before, warm)
            iterations += more
            if not solution.success:
                failure = f"{stage.nlp.name}: {solution.status}, KKT residual {solution.kkt:.1e}"
                return FrameResult(guess.q, False, iterations=iterations, status=failure)
            # A stage decides a part of q, and takes the rest from the stages before it.
            q[stage.decides] = solution.q[: len(stage.decides)]
            solutions.append(solution)
        kkt = max(solution.kkt for solution in solutions)
        status = ", ".join(solution.status for solution in solutions)
        x = solutions[-1].x[: stage.nlp.x.numel() - stage.nlp.slacks] if self.model.several_equilibria else None
        return FrameResult(q, True, solutions[-1].objective, kkt, iterations, status, tuple(solutions), x)

    def _solve_stage(
        self,
        stage: Stage,
        solver: NlpSolver,
        index: int,
        q: Array,
        guess: FrameResult,
        before: FrameResult | None,
        warm: Solution | None,
    ) -> tuple[Solution, int]:
        """Solve one stage with the rest of q (2d + 2,) as parameters; return its solution and the iterations.

        warm: solution of a neighbouring program of the same stage, or None.
        """
        low, high = self._limits(before)
        # Tips, which follow q in the bounds, are unknowns of every stage on models that have them.
        limited = np.append(stage.decides, np.arange(len(q), len(low)))
        values = dict(stage.fill(self.problem.target_frames[index], q))
        if "margin" in values:
            values["margin"] = self.margins[index]
        values["previous"] = (q if before is None else before.q)[stage.decides]
        if before is not None:
            values["motion_root"] = math.sqrt(self.settings.motion_weight) / self.problem.dt
        else:
            values["motion_root"] = 0.0
        x = q[stage.decides] if guess.x is None else guess.x
        x = x if warm is None else warm.x[: stage.nlp.x.numel() - stage.nlp.slacks]
        if self.active_wall is not None:
            parameters, slack = self.active_wall.local_parameters_during([self.problem.target_frames[index]])(
                x[None]
            )
            values |= {name: value[0] for name, value in parameters.items()}
            x = np.append(x, slack)
        iterations = 0
        # Continuation: a stage with jumps, eq. (11), is smoothed over a width that shrinks from solve to solve,
        # each of which starts from the one before. Other stages have a schedule of one entry.
        for further in stage.schedule:
            packed = stage.nlp.pack({**values, **further})
            warm = solver(x, packed, low[limited], high[limited], warm)
            x = warm.x
            iterations = iterations + warm.iterations
        assert warm is not None
        return warm, iterations
