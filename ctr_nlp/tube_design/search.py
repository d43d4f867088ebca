"""The search for tubes: tubes and the motions of all tasks, solved together from one start after another.

Unknowns are p (P,) of the tubes (ocp/shared/design.py), shared by all tasks, and q of every frame. A round solves
the joint program by an interior-point method; between rounds, motions are re-planned on the tubes found, since the
joint program is local: it stays on the branch of motions on which it starts. With w_s the weights of scenarios s,
E the mean squared shape error (8), j frames and i tasks, it is

    minimise over p, q   sum_ij ( sum_s w_s E_ijs + lambda_i |W (q_{i,j+1} - q_ij)|^2 / dt_i^2 ) + pull |p - p_0|^2

subject to equilibria, margins, limits and rules of manufacture. The last term, proximal to the start p_0 of a
round, leaves tubes that matter little where they are. See docs/method.md, "Tube design".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ctr_nlp.exceptions import CtrError, ProblemError
from ctr_nlp.models import KINEMATIC_MODELS, Model, model_for_tip_forces
from ctr_nlp.ocp.horizon import EndConfigurations
from ctr_nlp.ocp.scenarios import Scenarios, SharedMotion
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.shared.design import DesignedTubes
from ctr_nlp.ocp.shared.scenarios import shared_motion
from ctr_nlp.ocp.shared.tasks import CurvedPartLimit, join_task_motions
from ctr_nlp.ocp.terms import Term
from ctr_nlp.ocp.terms.arrival import with_arrival
from ctr_nlp.ocp.wall import Wall, make_wall
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.horizon import Horizon, solve_horizon
from ctr_nlp.planning.horizon.horizon import WALL_PARTS
from ctr_nlp.robot import Robot
from ctr_nlp.robust.plan import MOTION_PART
from ctr_nlp.robust.search import InitialMotion, RobustSearch, StartResult
from ctr_nlp.robust.tolerance_scenarios import tips_of, unknowns_of
from ctr_nlp.solvers.compiled_functions import fastest_functions
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.support.pool import Jobs, run_in_parallel
from ctr_nlp.typing import Array

MAX_CANDIDATE_VIOLATION = 1e-3
"""Largest violation, rad and mm, of a point that is no solution yet but from which the search continues."""
INITIAL_STEP_COST_MM2, STEP_COST_FACTOR = 1e-3, 0.1
"""Cost of a step of p by one unit in the first round, mm^2 a frame, and the factor from round to round. A proximal
term: tubes that hardly change the error stay, and those that do are free in the end.
"""
MAX_DESIGN_STEPS, DESIGN_STEPS_PER_TASK = 560, 10
"""Largest number of steps of a round, and more of them for every task, since tubes of many tasks need more."""
MAX_DESIGN_ROUNDS, MIN_DESIGN_IMPROVEMENT = 5, 2e-3
"""Most rounds from a start, and the relative improvement below which they end."""
REPLANNED_BARRIER_MM2, CONTINUED_BARRIER_MM2 = 0.1, 1e-3
"""First barriers, mm^2, of rounds after the first: for motions that were re-planned since, and for those of the
round before, which a larger barrier would move away from their solution.
"""
MAX_ROUNDS_BEFORE_WALLS, MAX_ERROR_NEAR_WALLS_MM = 2, 3.0
"""Most rounds without walls before those in which they count, and the error, mm, with the costs of contact and
arrival, up to which tubes to start from need no such rounds.
"""
WALL_ROUNDS = tuple(zip(WALL_PARTS, (REPLANNED_BARRIER_MM2, CONTINUED_BARRIER_MM2), strict=True))
"""Parts of the wall's weight, and first barriers in mm^2, of the rounds from tubes found without walls."""
SHAPE_ALONE = Settings(contact_weight=0.0, arrival_weight=0.0)
"""Priorities with which only the shape's error counts."""


@dataclass(frozen=True)
class Motions:
    """Motions of all tasks, one after the other.

    Attributes
    ----------
    q : ndarray
        Configurations (T, 2d + 2) of all frames of all tasks, rad and mm.
    phi : ndarray
        Angles (T, S, k) of the tubes' tips in S scenarios, rad.
    error : ndarray
        Error (n,) of each task over its frames and scenarios, mm: the root of the mean objective of a robot in a
        frame, which is e3 where walls do not count, and has the costs of contact and arrival beside it where they
        do. NaN where the task's motion is no solution.
    """

    q: Array
    phi: Array
    error: Array

    @property
    def rms(self) -> float:
        """Root mean square of the tasks' errors, mm; infinite where one is not known."""
        known = np.isfinite(self.error).all()
        return float(np.sqrt(np.mean(self.error**2))) if known else np.inf


@dataclass(frozen=True)
class Candidate:
    """Tubes with motions on them.

    Attributes
    ----------
    start : str
        Name of the tubes that the search started from.
    p : ndarray
        Unknowns (P,) of the tubes.
    motions : Motions
        Motions of all tasks.
    solution : SharedSolution or None
        Solution of the last round, where they come from one.
    """

    start: str
    p: Array
    motions: Motions
    solution: SharedSolution | None = None

    @property
    def has_scenarios(self) -> bool:
        """Whether the motions are shared by several robots, not those of the nominal one."""
        return self.motions.phi.shape[1] > 1

    @property
    def is_solution(self) -> bool:
        """Whether tubes and motions come from a round and are a solution."""
        return self.solution is not None and self.solution.success


Robots = Callable[[Robot], Scenarios]
"""Maps a robot to the robots that share its motions, of which it is the first."""


def nominal_scenario(robot: Robot) -> Scenarios:
    """Return the nominal robot as the only scenario."""
    return Scenarios(robot.numbers[None], np.zeros((1, robot.d)), np.ones(1))


def never() -> bool:
    """Return False: the default of `DesignSearch.stop`, for searches that nobody can stop."""
    return False


@dataclass(frozen=True)
class DesignSearch:
    """Search for tubes over tasks that differ in their targets alone.

    Attributes
    ----------
    tasks : tuple of Problem
        Tasks with one robot.
    tubes : DesignedTubes
        The tubes as unknowns, with rules of manufacture.
    model : Model
        Kinematic model.
    margin : float
        Least stability margin of every robot.
    priorities : Settings
        Costs of contact and arrival, with their tolerances; by default neither counts.
    stop : callable
        Returns whether to stop; asked between steps.
    on_candidate : callable or None
        Called with the candidate of every round.
    jobs : int or distributed.Client
        Number of processes, or the cluster, for independent tasks; see `run_in_parallel`.
    """

    tasks: tuple[Problem, ...]
    tubes: DesignedTubes
    model: Model
    margin: float
    priorities: Settings = SHAPE_ALONE
    stop: Callable[[], bool] = never
    on_candidate: Callable[[Candidate], None] | None = None
    jobs: Jobs = 1

    @property
    def has_load(self) -> bool:
        """Whether a load acts on the robots, or may, so that stiffnesses count and not only their ratios."""
        return self.model.applied_load is not None or self.tubes.robot.tolerances.tip_force > 0

    @cached_property
    def settings(self) -> Settings:
        """Settings of the tasks' motions."""
        return replace(self.priorities, stability_margin=self.margin)

    @cached_property
    def _terms(self) -> tuple[Term, ...]:
        """Terms of the tasks' motions besides the shape error and the wall."""
        return with_arrival((), self.settings, self.model)

    def split_by_task(self, of_all: Array) -> list[Array]:
        """Split rows `of_all` (T, ...) of all tasks' frames, task by task."""
        return np.split(of_all, np.cumsum([task.frames for task in self.tasks])[:-1])

    def tasks_on(self, robot: Robot) -> list[Problem]:
        """Return the tasks with another robot."""
        return [replace(task, robot=robot) for task in self.tasks]

    def plan_on_tubes(self, p: Array) -> list[Plan]:
        """Plan every task separately on given tubes p, for the nominal robot.

        Parameters
        ----------
        p : ndarray
            Unknowns (P,) of the tubes.

        Returns
        -------
        list of Plan
            In the order of the tasks. After Ctrl-C some are no solutions.

        Raises
        ------
        CtrError
            p is no robot, or Ctrl-C came before all tasks were given to processes.
        """
        robot = self.tubes.robot_of(p)
        plan = partial(solve_horizon, model=self.model, settings=self.settings)
        if self.jobs == 1:
            return [plan(task) for task in self.tasks_on(robot)]
        return self._plan_in_processes(plan, robot)

    def motions_of(self, p: Array, plans: Sequence[Plan]) -> Motions:
        """Return the motions of plans of all tasks on tubes p.

        Parameters
        ----------
        p : ndarray
            Unknowns (P,) of the tubes.
        plans : sequence of Plan
            From `plan_on_tubes`.

        Returns
        -------
        Motions
            Of the nominal robot (S = 1).
        """
        robot = self.tubes.robot_of(p)
        q = np.concatenate([plan.q for plan in plans])
        tips = [tips_of(self.model, robot, self.model.follow(robot, plan.q).x) for plan in plans]
        # Tips (T, k) of one robot become those of S = 1 scenarios, (T, 1, k).
        phi = np.concatenate(tips)[:, None]
        if not np.isfinite(phi).all():
            return Motions(q, phi, np.full(len(plans), np.nan))
        error = self._errors(self.motion(p, q, nominal_scenario, 0.0), q, phi, p)
        return Motions(q, phi, np.where([plan.success.all() for plan in plans], error, np.nan))

    def _errors(self, motion: SharedMotion, q: Array, phi: Array, p: Array) -> Array:
        """Return the errors (n,), mm, of the tasks at q (T, 2d + 2), tips phi (T, S, k) and tubes p (P,), see
        Motions.
        """
        condensed = Condensed(motion)
        condensed.update_local_parameters(q, phi, p)
        # The objective itself has the motion term and the pull on p, which are no errors. Squares (T, S) of robots
        # in frames are averaged over scenarios, then over the frames of each task.
        squares = condensed.by_robot(q, phi, p) @ motion.weights
        return np.sqrt([part.mean() for part in self.split_by_task(squares)])

    def _plan_in_processes(self, plan: Callable[[Problem], Plan], robot: Robot) -> list[Plan]:
        """Return the plans of the tasks on a robot, made in processes or on a cluster."""
        made = dict(run_in_parallel(plan, self.tasks_on(robot), self.jobs))
        if len(made) < len(self.tasks):
            raise ProblemError("the work on some tasks of a design was interrupted")
        return [made[number] for number in range(len(self.tasks))]

    def start(self, name: str, p: Array) -> Candidate | None:
        """Plan the tasks on tubes to start from.

        Parameters
        ----------
        name : str
            What the start is called.
        p : ndarray
            Unknowns (P,) of the tubes.

        Returns
        -------
        Candidate or None
            None where no robot has these tubes, or it cannot be moved as the tasks ask.
        """
        try:
            motions = self.motions_of(p, self.plan_on_tubes(p))
        except CtrError:
            return None
        return Candidate(name, p, motions) if np.isfinite(motions.phi).all() else None

    def motion(self, p: Array, q: Array, robots: Robots, pull: float) -> SharedMotion:
        """Build the joint program of tubes and motions.

        Parameters
        ----------
        p : ndarray
            Unknowns (P,) of the tubes from which it is solved, p_0.
        q : ndarray
            Configurations (T, 2d + 2) of all tasks' frames from which it is solved, rad and mm.
        robots : callable
            Maps the robot to the scenarios that share its motions.
        pull : float
            Cost of a step of p by one unit, mm^2 a frame.

        Returns
        -------
        SharedMotion
            The program, with the tubes' numbers as unknowns that all frames share.
        """
        robot = self.tubes.robot_of(p)
        made = list[SharedMotion]()
        scenarios = robots(robot)
        for task, of_task in zip(self.tasks_on(robot), self.split_by_task(q), strict=True):
            weight = MOTION_PART * self._motion_weight(task, of_task)
            margins = np.full(task.frames, self.margin)
            at = (
                robot,
                task.target_frames,
                task.dt,
                weight,
                EndConfigurations(),
                model_for_tip_forces(self.model, scenarios.has_tip_forces),
                scenarios,
            )
            one = shared_motion(
                *at,
                fastest_functions,
                margins,
                (CurvedPartLimit(), *self._terms),
                self._wall(task),
                self.tubes.free_number_names,
            )
            # Upper limits of beta are the curved lengths of the start; these are unknowns now, and CurvedPartLimit
            # bounds beta.
            upper = one.upper.copy()
            upper[:, robot.d : 2 * robot.d] = robot.reach
            made.append(replace(one, upper=upper))
        # The errors are summed over frames: the pull grows with their number, and so keeps its weight against
        # them.
        return join_task_motions(made, self.tubes.common(scenarios, p, pull * len(q)))

    def _wall(self, task: Problem) -> Wall | None:
        """Return the wall of a task as all its scenarios see it; None where walls do not count."""
        # One subsample, as robust plans have it: the wall is updated several times in every solve.
        return make_wall(task.robot, task.wall, self.model, self.settings, subsamples=1)

    def _motion_weight(self, task: Problem, q: Array) -> float:
        """Return lambda in s^2, as a horizon without walls balances it, from a motion of robots without a load; 0
        for a single frame, in which nothing moves.
        """
        if task.frames == 1:
            return 0.0
        free = self.model if self.model.applied_load is None else KINEMATIC_MODELS[self.model.name]
        horizon = Horizon(task, free, settings=self.settings)
        return horizon.balanced_weight(np.nan_to_num(free.follow(task.robot, q).x))

    def share_motions(self, candidate: Candidate, robots: Robots) -> Candidate | None:
        """Find motions that scenarios share, on the same tubes.

        Parameters
        ----------
        candidate : Candidate
            Tubes, with motions of the nominal robot.
        robots : callable
            Maps the robot to the scenarios.

        Returns
        -------
        Candidate or None
            The same tubes with shared motions, each task's by itself; None where one has none or Ctrl-C came.
        """
        robot = self.tubes.robot_of(candidate.p)
        tips = self.split_by_task(candidate.motions.phi[:, 0])
        tasks = list(zip(self.tasks_on(robot), self.split_by_task(candidate.motions.q), tips, strict=True))
        work = partial(self.portable.share_task_motion, candidate.start, robots(robot))
        tried = dict[int, StartResult]()
        for number, one in run_in_parallel(work, tasks, self.jobs):
            if not one.is_solved:
                return None
            tried[number] = one
        if len(tried) < len(tasks):
            return None  # Ctrl-C came first
        found = [tried[number].solution for number in range(len(tasks))]
        # The objective is the sum over frames of the weighted mean squared error; its motion term is small beside
        # it.
        error = np.sqrt([one.objective / len(one.q) for one in found])
        q, phi = (np.concatenate([getattr(one, name) for one in found]) for name in ("q", "phi"))
        return replace(candidate, motions=Motions(q, phi, error))

    def share_task_motion(
        self, start: str, scenarios: Scenarios, task_and_motion: tuple[Problem, Array, Array]
    ) -> StartResult:
        """Solve for a motion of one task that scenarios share.

        Parameters
        ----------
        start : str
            Name of the start.
        scenarios : Scenarios
            The robots that share it.
        task_and_motion : tuple of (Problem, ndarray, ndarray)
            The task, a motion (T, 2d + 2) to start from, and the nominal tips (T, k) there.

        Returns
        -------
        StartResult
            The motion, solved or not.
        """
        task, of_task, tips = task_and_motion
        weight = MOTION_PART * self._motion_weight(task, of_task)
        margins = np.full(task.frames, self.margin)
        x = unknowns_of(self.model, task.robot, tips, of_task)
        with deferred_interrupt() as interrupted:
            own = (
                model_for_tip_forces(self.model, scenarios.has_tip_forces),
                EndConfigurations(),
                self._terms,
                weight,
                margins,
            )
            search = RobustSearch(task, *own, stop=interrupted, wall=self._wall(task))
            return search.solve(InitialMotion(start, x), scenarios)

    @property
    def portable(self) -> DesignSearch:
        """The search without what cannot be pickled for another process."""
        return replace(self, tubes=replace(self.tubes), stop=never, on_candidate=None, jobs=1)

    def run_round(self, candidate: Candidate, robots: Robots, pull: float, barrier: float) -> Candidate | None:
        """Run one round: solve jointly for tubes and motions, from known ones.

        Parameters
        ----------
        candidate : Candidate
            Tubes and motions to start from.
        robots : callable
            Maps the robot to the scenarios that share its motions.
        pull : float
            Cost of a step of p by one unit, mm^2 a frame.
        barrier : float
            First barrier, mm^2.

        Returns
        -------
        Candidate or None
            None where the result violates equations or constraints by more than MAX_CANDIDATE_VIOLATION.
        """
        motion = self.motion(candidate.p, candidate.motions.q, robots, pull)
        steps = MAX_DESIGN_STEPS + DESIGN_STEPS_PER_TASK * len(self.tasks)
        found = SharedSolver(motion)(
            candidate.motions.q, candidate.motions.phi, barrier, self.stop, steps, candidate.p
        )
        if max(found.violation, found.equation_violation) > MAX_CANDIDATE_VIOLATION:
            return None
        # Evaluated in a program of the tubes found, whose diameters are those that the wall has to leave room for.
        there = self.motion(found.p, found.q, robots, pull) if motion.local_parameters else motion
        error = self._errors(there, found.q, found.phi, found.p)
        return Candidate(candidate.start, found.p, Motions(found.q, found.phi, error), found)

    def best_of_both(self, candidate: Candidate) -> Candidate:
        """Re-plan every task on the tubes of a candidate, and keep the better of its two motions."""
        again = self.start(candidate.start, candidate.p)
        if again is None:
            return candidate
        # NaN compares false: a task without a new plan keeps the motion that it has.
        better = again.motions.error < candidate.motions.error
        # One choice a task, repeated for each of its frames.
        rows = np.repeat(better, [task.frames for task in self.tasks])
        q = np.where(rows[:, None], again.motions.q, candidate.motions.q)
        phi = np.where(rows[:, None, None], again.motions.phi, candidate.motions.phi[:, :1])
        error = np.where(better, again.motions.error, candidate.motions.error)
        return replace(candidate, motions=Motions(q, phi, error))

    @property
    def shape_alone(self) -> DesignSearch:
        """The search in which neither walls nor arrival count."""
        return replace(self, priorities=SHAPE_ALONE)

    def with_wall_part(self, part: float) -> DesignSearch:
        """Return the search in which the wall counts with a part of its weight."""
        weight = part * self.priorities.contact_weight
        return replace(self, priorities=replace(self.priorities, contact_weight=weight))

    @property
    def error_name(self) -> str:
        """Name of the quantity in the tasks' errors, as reports write it."""
        return "the error with the costs of contact and arrival" if self.counts_more_than_shape else "e3"

    @property
    def counts_more_than_shape(self) -> bool:
        """Whether walls or the tip's arrival count."""
        return self.priorities != SHAPE_ALONE

    def run_from_start(self, start: Candidate) -> Candidate | None:
        """Run rounds from tubes to start from; where walls count, first without them.

        Tubes to start from are far from any that keep off the wall, and a round that begins deep within it fails.
        The rounds without walls end near them; the wall then counts with a part of its weight, and with all of it.

        Parameters
        ----------
        start : Candidate
            Tubes and motions to start from, found without walls.

        Returns
        -------
        Candidate or None
            The best result; None where the first round already failed.
        """
        if not self.counts_more_than_shape:
            return self.run_rounds(start)
        # Tubes that were designed within walls before are near already; others are not, and break rules at first.
        found = self.start(start.start, start.p) if self.tubes.satisfies_rules(start.p) else None
        if found is None or found.motions.rms > MAX_ERROR_NEAR_WALLS_MM:
            shaped = self.shape_alone.run_rounds(start, most=MAX_ROUNDS_BEFORE_WALLS)
            if shaped is None:
                return None
            found = self.with_own_error(shaped)
        for part, barrier in WALL_ROUNDS:
            if self.stop():
                break
            again = self.with_wall_part(part).run_round(found, nominal_scenario, INITIAL_STEP_COST_MM2, barrier)
            if again is not None:
                found = self.with_own_error(again)
                if self.on_candidate is not None:
                    self.on_candidate(found)
        return found

    def solve_for(self, robots: Robots, candidate: Candidate) -> Candidate | None:
        """Solve tubes of the nominal robot once more for all scenarios, from their own motions.

        Parameters
        ----------
        robots : callable
            Maps the robot to the scenarios that share its motions.
        candidate : Candidate
            Tubes with motions of the nominal robot.

        Returns
        -------
        Candidate or None
            Tubes and motions for the scenarios; None where they share no motions from there, or Ctrl-C came.
        """
        begun = self.share_motions(candidate, robots)
        if begun is None or self.stop():
            return None
        found = self.run_round(begun, robots, INITIAL_STEP_COST_MM2, CONTINUED_BARRIER_MM2)
        return found if found is not None and found.is_solution else None

    def with_own_error(self, candidate: Candidate) -> Candidate:
        """Return a candidate for the nominal robot with the errors that its motions have in this search."""
        p = candidate.p
        own = candidate.motions
        error = self._errors(self.motion(p, own.q, nominal_scenario, 0.0), own.q, own.phi, p)
        return replace(candidate, motions=replace(own, error=error))

    def run_rounds(
        self,
        start: Candidate,
        robots: Robots = nominal_scenario,
        first: float = COLD_START_BARRIER_MM2,
        most: int = MAX_DESIGN_ROUNDS,
    ) -> Candidate | None:
        """Run rounds from a start and return the best result.

        Parameters
        ----------
        start : Candidate
            Tubes and motions to start from.
        robots : callable
            Maps the robot to the scenarios that share its motions. With `nominal_scenario` motions are re-planned
            between rounds.
        first : float
            Barrier of the first round, mm^2.
        most : int
            Largest number of rounds.

        Returns
        -------
        Candidate or None
            The one with the least error; None where the first round already failed.
        """
        found = list[Candidate]()
        known = start
        pull = INITIAL_STEP_COST_MM2
        barrier = first
        for _ in range(most):
            again = self.run_round(known, robots, pull, barrier)
            if again is None or self.stop():
                break
            found.append(again)
            if self.on_candidate is not None:
                self.on_candidate(again)
            if (
                len(found) > 1
                and found[-2].motions.rms - again.motions.rms < MIN_DESIGN_IMPROVEMENT * again.motions.rms
            ):
                break
            # Motions that were re-planned are further from a solution of the joint program than those of the round
            # before, and need a larger barrier.
            known, barrier = (
                (self.best_of_both(again), REPLANNED_BARRIER_MM2)
                if robots is nominal_scenario
                else (again, CONTINUED_BARRIER_MM2)
            )
            # p_0 moves with every round: the proximal term slows tubes down but does not bias them; a smaller one
            # is faster.
            pull *= STEP_COST_FACTOR
        return min(found, key=error_of, default=None)


def error_of(candidate: Candidate) -> float:
    """Return the root mean square of the tasks' errors, mm, by which candidates are compared."""
    return candidate.motions.rms
