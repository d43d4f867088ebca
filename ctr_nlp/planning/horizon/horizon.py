"""All frames of a problem as one chain (ocp/chain.py), solved by multi-start, and the resulting plan.

The search first ignores the wall. Within a lumen the best motions are then solved again with the wall, at a tenth
of its weight and then at all of it. Where the plan then fails a check, other motions are tried that were solved
frame by frame within the wall, backwards from the last frame: a motion chosen without the wall may end on the
wrong side of a bifurcation. lambda (s^2) weighs motion against shape; by default it is such that the motion of the
start costs a tenth of its shape errors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import DEFAULT_MODEL, KINEMATIC_MODELS, Model, model_named
from ctr_nlp.models.loads import require_constant_load
from ctr_nlp.ocp.chain import Chain
from ctr_nlp.ocp.horizon import EndConfigurations, horizon
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.arrival import with_arrival
from ctr_nlp.ocp.terms.term import describe_terms
from ctr_nlp.ocp.wall import Wall, make_wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.plan.simulation import Simulator
from ctr_nlp.plan.verdicts import NO, REACHED_VERDICT_NAMES
from ctr_nlp.planning.marching import Progress
from ctr_nlp.planning.motions import motions_within_wall, per_frame_motions
from ctr_nlp.planning.multistart import (
    IterateCallback,
    SolvedStart,
    best_solved_start,
    describe_failures,
    distinct,
)
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.planning.starts.search import Search
from ctr_nlp.planning.validation import (
    check_ends,
    check_growth,
    check_model,
    check_search,
    checked_ends,
    checked_motions,
    checked_terms,
)
from ctr_nlp.planning.within_wall import failed_frames
from ctr_nlp.robot.checks import MAX_MOTOR_ANGLES_RAD
from ctr_nlp.solvers import CHAIN_SOLVERS, default_chain_solver
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.value_checks import check_choice
from ctr_nlp.typing import Array

WALL_PARTS = 0.1, 1.0
"""Parts of the contact weight with which a motion is solved within the wall, one after the other. From a motion
deep in the wall, the whole weight at once makes the solver fail.
"""
MAX_LESS_CONTACT_ROUNDS = 2
"""Largest number of times that a motion which presses a little too deep is solved again with less contact."""
MAX_SMALL_EXCESS_MM = 0.5
"""Depth beyond the allowed contact, mm, up to which that is worth trying."""
LIMITS_OF_VERDICTS = {
    "arrives": "arrival_tolerance",
    "follows": "error_allowed",
    "within_wall": "contact_allowed",
}
"""Verdicts whose number is a distance, mm, and the options that limit it."""
LEAST_LIMIT_MM = 0.1
"""A limit counts as this much at least where distances are measured in multiples of it."""
CONTACT_RESERVE = 2.0
"""How many times that depth is taken off the contact that planning allows: penalties yield."""


class Horizon:
    """All frames of a problem as one NLP, built once and solved for any weight and from any motions."""

    def __init__(
        self,
        problem: Problem,
        model: str | Model = DEFAULT_MODEL,
        solver: str | None = None,
        start: npt.ArrayLike | None = None,
        end: npt.ArrayLike | None = None,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        terms: Sequence[Term] = (),
    ) -> None:
        """Build all programs; arguments as in :func:`solve_horizon`.

        Raises OptionError, RobotError, and ProblemError where no motion can keep the limits.
        """
        self._model = model_named(model, "model of a horizon")
        check_model(problem, self._model)
        solver = default_chain_solver() if solver is None else solver
        check_choice("solver of a horizon", solver, CHAIN_SOLVERS)
        if problem.frames < 2:
            raise OptionError("frames is 1; a motion over a horizon needs at least 2")
        # Before anything is built: what is impossible shows at once.
        check_growth(problem)
        begin = time.perf_counter()
        self.problem = problem
        self.ends = EndConfigurations(*checked_ends(problem, "best", start, end))
        if self.ends.end is not None:
            require_constant_load(self._model.applied_load, "a motion to an end that is given")
        self._names = {"formulation": "horizon", **self._model.metadata, "solver": solver}
        self._settings, self._terms = settings, with_arrival(checked_terms(terms), settings, self._model)
        self._wall = make_wall(problem.robot, problem.wall, self._model, settings)
        # Built with a weight of 1 s^2: a chain's motion term is scaled afterwards (with_cost), so that one chain
        # serves all weights.
        self._free = self._build_chain(None)
        inside = self._free if self._wall is None else self._build_chain(self._wall)
        self._simulator = Simulator(problem.robot, self._model)
        own = self._simulator, solver, self.ends, settings, self._terms
        self._search = Search(problem, *own, self._free, inside)
        if self.ends.start is not None and self.ends.end is not None:
            check_ends(problem, self._linear_chain())
        self.build_seconds = time.perf_counter() - begin

    def _build_chain(self, wall: Wall | None) -> Chain:
        """Build the chain of all frames, within a wall or without one, with a motion weight of 1 s^2."""
        at = self.problem.robot, self.problem.target_frames, self.problem.dt, 1.0, self.ends, self._model
        return horizon(*at, fastest_functions, self._settings.stability_margin, wall, self._terms)

    def _linear_chain(self) -> Chain:
        """Return a chain of all frames whose links between frames are linear in its unknowns.

        Limits of position, order, speed and acceleration are those of q, whatever the model. Where the unknowns of
        the model are not q, as on the elastic one, these limits are taken from the chain of the dominant model.
        """
        if not self._free.has_nonlinear_links:
            return self._free
        at = self.problem.robot, self.problem.target_frames, self.problem.dt, 1.0, self.ends
        return horizon(*at, KINEMATIC_MODELS["dominant"])

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
        starts: number of motions solved for all frames, None for the most promising. jobs: number of processes.
        progress, callback: callables. exhaustive: whether every motion found frame by frame is solved for all
        frames. All are those of :func:`solve_horizon`.
        """
        check_search(motion_weight, starts, jobs)
        given = checked_motions(self.problem, initial)
        with deferred_interrupt() as interrupted:
            begin = time.perf_counter()
            found = self.motions(given, progress)
            between = time.perf_counter()
            weight = self.balanced_weight(found[0]) if motion_weight is None else motion_weight
            search = replace(
                self._search, weight=weight, jobs=jobs, progress=progress, seen=callback, stop=interrupted
            )
            wall = None
            free = None
            attempts: Sequence[SolvedStart] = []
            # Motions that the user chose are all solved to the end; those of the search only as far as they are
            # promising.
            every = bool(given or starts or exhaustive)
            if not interrupted():
                ranked = search.rank_motions(found, starts or len(found))
                attempts = search.solve_from_motions(ranked) if every else search.solve_most_promising(ranked)
            if self._wall is not None and not interrupted():
                free = self.configurations(best_solved_start(attempts).motion)
                # The motion that is best without the wall need not be best within it: given motions are all solved
                # there, also as they were given.
                tried = (
                    [one.motion for one in distinct(attempts)] if every else [best_solved_start(attempts).motion]
                )
                tried += found if given else []
                wall, attempts = self._solve_within_wall(self._wall, search, attempts, tried)
            options = self.options(weight, starts, exhaustive)
            meta = {**self._names, "options": options, "build_s": self.build_seconds}
            meta["contact_weight"] = None if wall is None else wall.weight
            plan = self._plan(search.chain_for_wall(wall), found[0], attempts, free, meta)
            if wall is not None and not every and not interrupted():
                plan = self._best_from_last_frame(wall, search, plan, attempts)
            work = {"search_s": between - begin, "solve_s": time.perf_counter() - between}
            stopped = interrupted()
        return replace(plan, meta=plan.meta | work | {"interrupted": stopped})

    def motions(self, given: Sequence[Array] = (), progress: Progress | None = None) -> list[Array]:
        """Return unknowns (T, n) of initial motions: given ones (T, 2d + 2), or solved frame by frame, best first.

        progress: called as in :func:`solve_horizon`.
        """
        at = self.problem, self.ends, self._settings, progress, self._model, self._terms
        return [x for motion in given for x in self._unknowns(motion)] or per_frame_motions(*at)

    def options(self, weight: float, starts: int | None = None, exhaustive: bool = False) -> dict[str, Any]:
        """Return the options of a plan's meta.

        weight: lambda in s^2. starts, exhaustive: as in solve_horizon.
        """
        asked = {"motion_weight": weight, "starts": starts, "exhaustive": exhaustive}
        return {**self._settings.options(), **asked, "terms": describe_terms(self._terms), **self.ends.options}

    def _solve_within_wall(
        self, wall: Wall, search: Search, free: Sequence[SolvedStart], motions: Sequence[Array]
    ) -> tuple[Wall | None, Sequence[SolvedStart]]:
        """Solve motions within a wall; return that wall and the results.

        free: results without the wall. motions: unknowns (T, n) to start from. Where more frames fail within the
        wall than without it, None and `free` are returned.
        """

        def count_failed_frames(one: SolvedStart) -> int:
            success = np.full(self.problem.frames, one.solution.success)
            moved = self._simulator(self.configurations(one.motion))
            return failed_frames(self.problem, moved, one.motion, success)

        within = self._solve_with_growing_wall(wall, search, motions)
        if count_failed_frames(best_solved_start(within)) > count_failed_frames(best_solved_start(free)):
            return None, free
        return wall, within

    @staticmethod
    def _solve_with_growing_wall(wall: Wall, search: Search, motions: Sequence[Array]) -> Sequence[SolvedStart]:
        """Solve motions (T, n) within a wall, roughly and at a part of its weight first; return the results."""
        growing = [replace(wall, weight=part * wall.weight) for part in WALL_PARTS]
        return search.solve_from_motions([search.approach_walls(motion, growing) for motion in motions], wall)

    def _best_from_last_frame(
        self, wall: Wall, search: Search, plan: Plan, attempts: Sequence[SolvedStart]
    ) -> Plan:
        """Return the best of a plan within a wall and, where it fails a check, of plans from other motions.

        These were solved frame by frame within the wall, backwards from the last frame. The first that fails no
        check ends the search. attempts: the solved starts of the plan.
        """
        # On models that cannot snap most checks are not made, and a given end leaves no choice of the last frame.
        if self.ends.any_given or not self._model.can_snap or not _count_failed_checks(plan):
            return plan
        tried = list(attempts)

        def keep_farther_off(one: Plan, solved: Sequence[SolvedStart]) -> Plan:
            """Return a plan that only touches, solved again with less contact allowed, where that is better."""
            aim = wall
            for _ in range(MAX_LESS_CONTACT_ROUNDS):
                excess = _find_contact_excess(one, wall.contact_allowed)
                if search.stop() or not solved or not 0 < excess <= MAX_SMALL_EXCESS_MM:
                    break
                aim = replace(aim, contact_allowed=max(0.0, aim.contact_allowed - CONTACT_RESERVE * excess))
                motion = best_solved_start(solved).motion
                solved = search.solve_from_motions([motion], aim)
                tried.extend(solved)
                # Costs are those of the wall as it was asked for, so that plans can be compared.
                other = self._plan(search.chain_for_wall(wall), motion, solved, one.free, dict(one.meta))
                one = min(one, other, key=_rank_by_checks)
            return one

        plan = keep_farther_off(plan, attempts)
        if not _count_failed_checks(plan):
            motions = []
        else:
            motions = motions_within_wall(self.problem, self._settings, self._model, self._terms, search.stop)
        for motion in motions:
            if search.stop():
                break
            found = self._solve_with_growing_wall(wall, search, [motion])
            tried += found
            other = self._plan(search.chain_for_wall(wall), motion, found, plan.free, dict(plan.meta))
            plan = min(plan, keep_farther_off(other, found), key=_rank_by_checks)
            if not _count_failed_checks(plan):
                break
        meta = {
            "starts": [one.to_meta(self.problem.frames) for one in tried],
            "iterations": sum(one.solution.iterations for one in tried),
        }
        return replace(plan, meta=plan.meta | meta)

    def configurations(self, motion: Array) -> Array:
        """Return the configurations (T, 2d + 2) of a motion's unknowns (T, n)."""
        value = self._free.evaluate(motion.ravel())[1]
        return self._free.configurations(value)[:, : len(self.problem.robot.axes)]

    def balanced_weight(self, motion: Array) -> float:
        """Return the lambda in s^2 at which a motion (T, n) costs a tenth of its shape errors."""
        return self._search.balanced_weight(motion)

    def objective(self, motion: Array, weight: float) -> float:
        """Return the objective of a motion's unknowns (T, n) far from any wall, mm^2, summed over frames.

        weight: lambda in s^2.
        """
        chain, x = self._free.with_cost(weight).linearise_at(motion)
        return chain.evaluate(x)[0]

    def _plan(
        self,
        chain: Chain,
        motion: Array,
        attempts: Sequence[SolvedStart],
        free: Array | None,
        meta: dict[str, Any],
    ) -> Plan:
        """Return the best solved start as a plan; without any, the initial motion (T, n) as not solved.

        chain: that was solved. attempts: solved starts. free: (T, 2d + 2), the motion without the wall, or None.
        meta: of the plan.
        """
        frames = self.problem.frames
        unknown = np.full(frames, np.nan)
        solved = False
        kkt = unknown
        why = {"all": "interrupted before the horizon was begun"}
        if attempts:
            best = best_solved_start(attempts)
            found = best.solution
            solved = best.solution.success
            why = describe_failures(chain, best)
            motion = self._without_excess_turns(best.motion)
            # Multipliers of a point that is no solution say nothing: its KKT residual is left unknown.
            if solved:
                multipliers = np.concatenate([found.lam_x, found.lam_g])
                kkt = replace(chain, parameters=best.parameters).kkt(found.x, multipliers)
        # Objectives by frame belong to the wall as it is near the motion of the plan.
        chain, x = chain.linearise_at(motion)
        meta["starts"] = [one.to_meta(frames) for one in attempts]
        meta["iterations"] = sum(one.solution.iterations for one in attempts)
        return plan_from_configurations(
            self.problem,
            self.configurations(motion),
            meta | {"failures": why},
            success=np.full(frames, solved),
            solve_time=unknown,
            objective=np.add(*chain.by_frame(x)),
            kkt=kkt,
            planned=motion if self._model.several_equilibria else None,
            free=free,
            simulator=self._simulator,
        )

    def _without_excess_turns(self, motion: Array) -> Array:
        """Return a motion (T, n) in which tubes beyond what any drive allows are turned back by whole turns.

        A start far from its solution may take a tube of a model without torsion through many turns, none of which
        changes the shape.
        """
        d = self.problem.robot.d
        if self._model.several_equilibria or self.ends.any_given:
            return motion
        beyond = abs(motion[:, :d]).max(axis=0) > MAX_MOTOR_ANGLES_RAD["alpha"]
        turns = 2 * np.pi * np.round(motion[:, :d].mean(axis=0) / (2 * np.pi))
        return motion - np.pad(np.where(beyond, turns, 0.0), (0, motion.shape[1] - d))

    def _unknowns(self, motion: Array) -> list[Array]:
        """Return unknowns (T, n) to start from for a given motion (T, 2d + 2), one or two of them."""
        if not self._model.several_equilibria:
            return [motion]
        robot = self.problem.robot
        # Simulated, the motion has the equilibria that a robot is in, but NaN or jumps where it snaps; estimated
        # from the motors' angles, it is smooth, but no equilibrium. Either may be the better start.
        return [self._model.follow(robot, motion).x, self._model.guess(robot, motion)]


def _rank_by_checks(plan: Plan) -> tuple[int, float, float]:
    """Return how a plan ranks: by failed checks, then by how far it misses these, then by its objective.

    The distances of tip, shape and contact are added up, as multiples of what is allowed. With contact alone, a
    motion would win that keeps off the wall because it goes elsewhere.
    """
    missed = 0.0
    for name, option in LIMITS_OF_VERDICTS.items():
        verdict = getattr(plan.verdicts, name)
        if verdict.word == NO:
            far = math.inf if verdict.number is None else verdict.number
            missed += far / max(float(plan.options[option]), LEAST_LIMIT_MM)
    return _count_failed_checks(plan), missed, float(plan.objective.mean())


def _find_contact_excess(plan: Plan, allowed: float) -> float:
    """Return the depth, mm, by which a plan presses beyond what is allowed; 0 where it fails another check."""
    wall = plan.verdicts.within_wall
    alone = wall.word == NO and _count_failed_checks(plan) == 1
    return wall.number - allowed if alone and wall.number is not None else 0.0


def _count_failed_checks(plan: Plan) -> int:
    """Return how many of the checks of a reached end a plan fails, apart from those that were not made."""
    return sum(getattr(plan.verdicts, name).word == NO for name in REACHED_VERDICT_NAMES)
