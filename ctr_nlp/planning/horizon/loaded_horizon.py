"""Motions under a known load, over all frames, started from motions of the unloaded robot.

Unknowns of a loaded robot are its tips' angles phi, its extensions beta and the rotation w of the tip's frame. The
direction of its base then gives the tilt theta, except at a pole, theta_x = 90 deg. Therefore the robot is solved
as the only one of several scenarios (ocp/shared/scenarios.py): theta is an unknown besides w, two equations equate
the base's direction with that of theta, and there is no pole. See "Loads" in docs/method.md.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.models import KINEMATIC_MODELS, Model
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.models.loaded.tips import tip_angles
from ctr_nlp.ocp.scenarios import Scenarios, SharedMotion
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.arrival import with_arrival
from ctr_nlp.ocp.wall import make_wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.planning.horizon.horizon import Horizon
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import per_frame_motions
from ctr_nlp.planning.multistart import SAME_SOLUTION_RELATIVE_TOLERANCE, IterateCallback
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.stability_refinement import (
    MAX_MARGIN_SHORTFALL,
    MarginShortfall,
    find_margin_shortfall,
    refine_margins,
)
from ctr_nlp.planning.validation import check_search, checked_motions, checked_terms
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2, WARM_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.typing import Array

EXTRA_START_MARGINS = 0.2, 0.0, 0.1
"""Stability margins, beyond the one asked for, of the motions frame by frame that are initial guesses, in turn.

A motion with just the margin asked for may end close to the snap, and from there the search under the load finds a
branch of equilibria that the robot does not reach.
"""
MAX_MARGIN_OBJECTIVE_FACTOR = 1.01
"""Factor up to which the objective may grow where a motion's margin is enforced between frames, for the motion to
be accepted at once. Where that costs more, another start may avoid the other branch.
"""


class LoadedHorizon:
    """All frames of a problem with a loaded robot, built once and solved for any weight."""

    def __init__(
        self,
        problem: Problem,
        model: Model,
        solver: str | None = None,
        start: npt.ArrayLike | None = None,
        end: npt.ArrayLike | None = None,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        terms: Sequence[Term] = (),
    ) -> None:
        """Build; arguments and errors as in Horizon, and LoadError where the load does not fit the robot.

        Raises ProblemError where, within a wall, the target's base is at the pole of the tilt.
        """
        assert isinstance(model, Loaded)
        model.check_planning(problem.robot)
        begin = time.perf_counter()
        asked = solver, start, end
        self.problem = problem
        self._model = model
        self._settings = settings
        self._terms = with_arrival(checked_terms(terms), settings, model)
        wall = make_wall(problem.robot, problem.wall, model, settings)
        # The program of the one scenario is built without the wall. A motion that it finds is solved again within
        # the wall by the usual chain, whose theta follows from x and has the pole.
        self._inside = None if wall is None else Horizon(problem, model, *asked, settings, terms)
        margin = settings.stability_margin
        self._margins = None if margin is None else np.full(problem.frames, margin)
        # The robot without the load only provides starts: where it would touch the wall says little of where the
        # loaded one does.
        free = replace(settings, contact_weight=0.0)
        self._without = Horizon(problem, KINEMATIC_MODELS[model.name], *asked, free, self._terms)
        self._simulator = Simulator(problem.robot, model)
        self.build_seconds = time.perf_counter() - begin

    def solve(
        self,
        initial: Sequence[npt.ArrayLike] = (),
        motion_weight: float | None = None,
        starts: int | None = None,
        jobs: int = 1,
        progress: Progress | None = None,
        callback: IterateCallback | None = None,
        exhaustive: bool = False,
    ) -> Plan:
        """Search for the best motion and return its plan.

        initial: motions (T, 2d + 2) to start from. motion_weight: lambda in s^2, None for the balanced one.
        starts, jobs, callback, exhaustive: of the search of the unloaded robot. progress: callable. All are those
        of :func:`solve_horizon`.
        """
        check_search(motion_weight, starts, jobs)
        without = self._without
        given = checked_motions(self.problem, initial)
        with deferred_interrupt() as interrupted:
            begin = time.perf_counter()
            first = without.motions(given, progress)[0]
            weight = without.balanced_weight(first) if motion_weight is None else motion_weight
            # A motion under the load that costs no more than the unloaded robot's best is good enough to end the
            # search. A user who asks for more starts wants the whole search: no motion is below -inf.
            limit = -math.inf if starts or exhaustive else without.objective(first, weight)
            between = time.perf_counter()
            # Lazily: the unloaded horizon takes longest, and is solved only where motions frame by frame fail.
            search = functools.partial(without.solve, given, weight, starts, jobs, progress, callback, exhaustive)
            motions = itertools.chain(
                given, self._larger_margin_motions(first, progress), self._unloaded_motion(search)
            )
            found = self._solve_with_load(motions, weight, limit, interrupted)
            if found is not None and found.success and self._inside is not None and not interrupted():
                return self._inside.solve([found.q], weight, progress=progress)
            stopped = interrupted()
        meta = {
            "formulation": "horizon",
            **self._model.metadata,
            "solver": "interior-point",
            "options": without.options(weight, starts, exhaustive) | self._settings.options(),
            "build_s": self.build_seconds,
            "search_s": between - begin,
            "solve_s": time.perf_counter() - between,
            "iterations": 0 if found is None else found.iterations,
            "interrupted": stopped,
            "contact_weight": None,
        }
        return self._plan(without.configurations(first), found, weight, meta)

    def _larger_margin_motions(self, first: Array, progress: Progress | None) -> Iterator[Array]:
        """Yield motions (T, 2d + 2), frame by frame without the load, with each margin of EXTRA_START_MARGINS in
        turn.

        first (T, n): unknowns of the motion with no more margin than asked, which is known already.
        """
        asked = self._settings.stability_margin
        without = self._without
        for more in EXTRA_START_MARGINS:
            if more == 0.0:
                yield without.configurations(first)
            elif asked is not None and asked + more < 1:
                settings = replace(self._settings, stability_margin=asked + more)
                at = (
                    self.problem,
                    without.ends,
                    settings,
                    progress,
                    KINEMATIC_MODELS[self._model.name],
                    self._terms,
                )
                yield without.configurations(per_frame_motions(*at)[0])

    def _unloaded_motion(self, search: Callable[[], Plan]) -> Iterator[Array]:
        """Yield the motion (T, 2d + 2) of the plan without the load, which is searched for only now."""
        yield search().q

    def _solve_with_load(
        self, motions: Iterator[Array], weight: float, limit: float, stop: Callable[[], bool]
    ) -> SharedSolution | None:
        """Solve motions under the load, in turn, with margins enforced between frames, too; return the best.

        motions: (T, 2d + 2), without the load. weight: lambda in s^2. limit: objective, mm^2, at or below which a
        motion is accepted at once if enforcing its margin costs little (MAX_MARGIN_OBJECTIVE_FACTOR). Without such
        a motion the best one on whose branch the simulated robot stays is returned; else the first that was
        solved, else the last result; None where none was started. stop: returns whether to end.
        """
        motion = self._motion(weight, self._margins)
        found: SharedSolution | None = None
        solved: list[SharedSolution] = []
        while not stop() and (q := next(motions, None)) is not None:
            found = self._solve_from(q, motion, stop)
            # A start with a solution that is known already adds nothing.
            if stop() or not found.success or _is_known_solution(found, solved):
                continue
            solved.append(found)
            most = min(limit, MAX_MARGIN_OBJECTIVE_FACTOR * found.objective)
            held = self._refine_loaded_margins(found, weight, most, stop)
            if held is not None and held[1] <= MAX_MARGIN_SHORTFALL and held[0].objective <= most:
                return held[0]
        # None was cheap enough: now margins of all are enforced between frames at any cost, and compared.
        every = [self._refine_loaded_margins(one, weight, math.inf, stop) for one in solved]
        made = [held for held in every if held is not None]
        if made:
            return min(made, key=lambda one: (max(one[1], MAX_MARGIN_SHORTFALL), one[0].objective))[0]
        return solved[0] if solved else found

    def _refine_loaded_margins(
        self, first: SharedSolution, weight: float, most: float, stop: Callable[[], bool]
    ) -> tuple[SharedSolution, float] | None:
        """Raise the margins of frames until a motion keeps its margin between them; return it and the shortfall.

        first: the motion as solved. weight: lambda in s^2. most: objective, mm^2, above which it is given up. None
        where the simulated robot leaves the branch.
        """
        d = self.problem.robot.d
        margin = self._settings.stability_margin

        def find_shortfall(found: SharedSolution) -> MarginShortfall:
            return find_margin_shortfall(self._simulator(found.q), found.x, margin, d)

        def solve_with_margins(found: SharedSolution, raised: Array) -> SharedSolution | None:
            solved = SharedSolver(self._motion(weight, raised))(found.q, found.phi, WARM_START_BARRIER_MM2, stop)
            return solved if solved.success and solved.objective <= most else None

        return refine_margins(first, self._margins, find_shortfall, solve_with_margins, stop)

    def _motion(self, weight: float, margins: Array | None) -> SharedMotion:
        """Build the program of the one robot; weight: lambda in s^2; margins (T,): of each frame, or None."""
        problem = self.problem
        robot = self.problem.robot
        # One scenario: the robot itself, without differences of its motors' zeros, and with all the weight.
        alone = Scenarios(robot.numbers[None], np.zeros((1, robot.d)), np.ones(1))
        at = robot, problem.target_frames, problem.dt, weight, self._without.ends, self._model, alone
        return shared_motion(*at, fastest_functions, margins, self._terms)

    def _solve_from(self, q: Array, motion: SharedMotion, stop: Callable[[], bool]) -> SharedSolution:
        """Solve under the load from a motion q (T, 2d + 2) without it, the load being raised frame by frame."""
        robot = self.problem.robot
        model = self._model
        tips = tip_angles(KINEMATIC_MODELS[model.name].follow(robot, q).x, robot.d)
        # Raised frame by frame, the load needs no history between frames. Where the unloaded robot has no known
        # equilibrium, tips at their motors' angles are the guess.
        x = model.grow_load(robot, q, np.where(np.isfinite(tips), tips, q[:, : robot.d]))
        solve = SharedSolver(motion)
        # The wide barrier first lets the objective decide which limits become active; where that fails, one that
        # stays nearer to the start.
        for barrier in (COLD_START_BARRIER_MM2, WARM_START_BARRIER_MM2):
            found = solve(q, x[:, None, motion.own], barrier, stop)
            if found.success or stop():
                break
        return found

    def _plan(self, q: Array, found: SharedSolution | None, weight: float, meta: dict[str, Any]) -> Plan:
        """Make a plan of the motion found; where the search was interrupted before that, of q (T, 2d + 2), not
        solved.

        weight: lambda in s^2. meta: of the plan.
        """
        frames = self.problem.frames
        unknown = np.full(self.problem.frames, np.nan)
        if found is None:
            why = {"all": "interrupted before the load was looked at"}
            known: dict[str, Any] = {"objective": unknown, "kkt": unknown}
            solved = False
            planned = None
        else:
            condensed = Condensed(self._motion(weight, self._margins))
            condensed.update_local_parameters(found.q, found.phi)
            known = {"objective": condensed.by_frame(found.q, found.phi), "kkt": np.full(frames, found.kkt)}
            why = {} if found.success else {"all": f"{found.status}, KKT residual {found.kkt:.1e}"}
            q = found.q
            solved = found.success
            planned = found.x
        return plan_from_configurations(
            self.problem,
            q,
            meta | {"failures": why},
            success=np.full(frames, solved),
            solve_time=unknown,
            planned=planned,
            simulator=self._simulator,
            **known,
        )


def _is_known_solution(found: SharedSolution, solved: Sequence[SharedSolution]) -> bool:
    """Return whether another start came to the same solution: one whose objective is the same
    (SAME_SOLUTION_RELATIVE_TOLERANCE).
    """
    return any(
        abs(found.objective - one.objective) <= SAME_SOLUTION_RELATIVE_TOLERANCE * (1 + abs(one.objective))
        for one in solved
    )
