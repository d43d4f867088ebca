"""Frames of a problem solved one by one for scenarios, each frame from the one before.

Each frame is a program over one q = (alpha, beta, theta), rad and mm, which S scenarios share, and the tips (S,
k), rad, of each of them: k is d, or d + 2 under a load. Tips turn by at most tip_step_limits from frame to frame,
so that no scenario changes its branch.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.frame_solver import FrameResult, distinct_results, step_through_frames
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.joint import tip_step_limits
from ctr_nlp.ocp.scenarios import Scenarios, SharedMotion
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.term import describe_terms
from ctr_nlp.paths.problem import Problem
from ctr_nlp.planning.nlp_frames import NlpFrames
from ctr_nlp.robust.rounds import add_failed_samples
from ctr_nlp.robust.tolerance_scenarios import loaded_unknowns, reported_model
from ctr_nlp.robust.trials import FailedSamples
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2, WARM_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios import SharedSolver
from ctr_nlp.typing import Array, Index

NOMINAL_FIRST_FRAME_SOLUTIONS, MAX_FIRST_FRAME_RESULTS = 3, 3
"""Solutions of the nominal robot used as starts in a frame without one before it, and how many results are kept.
"""
MOTION_WEIGHT_FACTORS = 1.0, 1e2, 1e4
"""Factors of the motion weight, used in turn where tips would otherwise turn too far in a frame."""


@dataclass(frozen=True)
class ScenarioFrames:
    """Solver of single frames (a FrameSolver) for scenarios that share q.

    nominal: solvers of the nominal robot, for frames without one before them. margins (T,): least stability
    margins of every scenario, or None. known: results of another run, which are further starts of each frame.

    The `warm` of a result has the tips (S, k) of all scenarios; scenarios that have joined since then start from
    the nominal robot's.
    """

    problem: Problem
    model: Model
    scenarios: Scenarios
    settings: Settings
    terms: tuple[Term, ...]
    margins: Array | None
    nominal: Sequence[NlpFrames]
    build_seconds: float
    description: dict[str, Any]
    known: Mapping[int, FrameResult] | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        scenarios: Scenarios,
        model: Model,
        settings: Settings,
        terms: Sequence[Term],
        margins: Sequence[float],
    ) -> ScenarioFrames:
        """Build the solver.

        problem: robot and target. scenarios: the robots that share q. model: on which they are planned. settings:
        weights, and the least stability margin of every scenario. terms: further terms of the objective. margins:
        stability margins of the nominal robot in frames without one before them, one solver each.
        """
        begin = time.perf_counter()
        nominal = [
            NlpFrames.of(
                problem,
                model=reported_model(model),
                # Walls and arrival do not count frame by frame for several robots, so that they are left out here,
                # too.
                settings=replace(settings, stability_margin=margin, contact_weight=0.0, arrival_weight=0.0),
                terms=terms,
            )
            for margin in margins
        ]
        description = {
            "formulation": "robust-joint",
            **reported_model(model).metadata,
            "solver": "interior-point",
            "options": settings.options() | {"terms": describe_terms(terms)},
        }
        margin = settings.stability_margin
        least = None if margin is None else np.full(problem.frames, margin)
        seconds = time.perf_counter() - begin
        return cls(problem, model, scenarios, settings, tuple(terms), least, nominal, seconds, description)

    def search(self, frame: int) -> list[FrameResult]:
        """Return distinct results for a frame that has no frame before it, best first; at least one."""
        # The nominal robot's solutions are quick to find; each is solved again with all scenarios.
        known = [
            self._with_loaded_unknowns(one)
            for frames in self.nominal
            for one in frames.search(frame)[:NOMINAL_FIRST_FRAME_SOLUTIONS]
        ]
        found = [self.search_near(frame, one) for one in known if one.success]
        return (
            distinct_results([one for one in found if one.success])[:MAX_FIRST_FRAME_RESULTS]
            or found[:1]
            or known[:1]
        )

    def _with_loaded_unknowns(self, known: FrameResult) -> FrameResult:
        """Return a result of the nominal robot with unknowns of the scenarios' model, which may have a load."""
        if known.x is None:
            return known
        return replace(known, x=loaded_unknowns(self.problem.robot, self.model, known.q[None], known.x[None])[0])

    def with_failed_samples(self, lost: FailedSamples) -> ScenarioFrames:
        """Return a solver with lost robots among its scenarios, and the same margins; lost: these robots."""
        # A robust horizon also raises margins where robots were lost; frame by frame that leads to worse branches.
        return replace(self, scenarios=add_failed_samples(self.scenarios, lost))

    def step(self, frame: int, before: FrameResult) -> FrameResult:
        """Solve a frame within speed limits of the one before, starting from there and from a known result.

        frame: its number, from 0. before: result of the frame before. With known results, a run is given up where
        one of its frames failed, since other runs remain.
        """
        if self.known is not None and not before.success:
            return replace(before, iterations=0, status="a frame before it was not solved")
        starts = [before] if self.known is None else [before, self.known[frame]]
        found = [self._solve_frame(frame, start, before) for start in starts]
        # Both starts may be solved, on different branches: then the objective decides.
        return min(found, key=lambda one: (not one.success, one.objective))

    def run(self, frames: Sequence[int], before: FrameResult) -> Iterator[tuple[FrameResult, float]]:
        """Yield results for frames, numbers from 0, each from the one before, and the seconds that each took.

        before: result of the frame before the first one.
        """
        return step_through_frames(self.step, frames, before)

    def search_near(self, frame: int, known: FrameResult) -> FrameResult:
        """Solve a frame, number from 0, that has no frame before it, near a known result."""
        return self._solve_frame(frame, known, None)

    def _solve_frame(self, frame: int, start: FrameResult, before: FrameResult | None) -> FrameResult:
        """Solve a frame from a start; tips may turn from those of the frame before by tip_step_limits at most.

        before: the frame before, None without one.
        """
        robot = self.problem.robot
        iterations = 0
        ends = EndConfigurations(None if before is None else before.q)
        last, far = (start, np.inf) if before is None else (before, tip_step_limits(robot, self.problem.dt))
        # A larger motion weight keeps motors near the frame before, and tips with them. The generator builds
        # programs with larger weights only where they are needed.
        motions = (self._motion(frame, ends, factor) for factor in MOTION_WEIGHT_FACTORS)
        first = next(motions)
        tips, guess = (self._tips(each, first.own) for each in (last, start))
        for solver in map(SharedSolver, itertools.chain([first], motions)):
            # Near the frame before most active limits are known. Where that fails, the large barrier lets the
            # objective decide again which limits become active.
            for barrier in (WARM_START_BARRIER_MM2, COLD_START_BARRIER_MM2):
                found = solver(start.q[None], guess[None], barrier)
                iterations += found.iterations
                # Under a load tips have two entries more, the turn of the tip's frame, which is not limited.
                if found.success and (abs(found.phi[0] - tips)[:, : robot.d] <= far).all():
                    known = found.objective, found.kkt, iterations, found.status, found.phi[0], found.x[0]
                    return FrameResult(found.q[0], True, *known)
        status = f"scenarios: {found.status}, KKT residual {found.kkt:.1e}"
        # A failed frame has the configuration before it, so that a pass can continue from there.
        return FrameResult(last.q, False, iterations=iterations, status=status, warm=tips, x=last.x)

    def _motion(self, frame: int, ends: EndConfigurations, factor: float) -> SharedMotion:
        """Build the program of one frame; factor: multiplies the weight of the step from the frame before."""
        problem = self.problem
        margins = None if self.margins is None else self.margins[frame : frame + 1]
        at = problem.robot, [problem.target_frames[frame]], problem.dt, factor * self.settings.motion_weight, ends
        return shared_motion(*at, self.model, self.scenarios, fastest_functions, margins, self.terms)

    def _tips(self, near: FrameResult, own: Index) -> Array:
        """Return tips (S, k) of all scenarios near a result; own: where tips stand among a robot's unknowns."""
        robot = self.problem.robot
        x = self.model.rest(robot, near.q) if near.x is None else near.x
        # Results of the nominal solver have a Solution as `warm`, not tips: then all scenarios begin as the
        # nominal robot.
        known = np.zeros((0, len(own))) if not isinstance(near.warm, np.ndarray) else near.warm
        return np.concatenate([known, np.repeat(x[None, own], len(self.scenarios) - len(known), axis=0)])
