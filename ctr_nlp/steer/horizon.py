"""Steering over a whole motion at once: where it starts, what is tried, and what is kept."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.chain import Chain
from ctr_nlp.errors import OptionError
from ctr_nlp.formulations.horizon import Ends, horizon
from ctr_nlp.models import MODELS
from ctr_nlp.plan import Plan, plan_from_configurations
from ctr_nlp.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.settings import Settings
from ctr_nlp.solvers import CHAIN_SOLVERS, FEASIBLE, Iterate
from ctr_nlp.solvers.banded import MOST_ITERATIONS, TOLERANCE
from ctr_nlp.steer.attempts import TIE, Attempt, Task, attempt, attempt_in_processes
from ctr_nlp.steer.interrupt import deferred_interrupt
from ctr_nlp.steer.limits import check_ends, check_growth
from ctr_nlp.steer.motions import per_frame_motions, wandered
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress

Array = npt.NDArray[np.float64]

MOTION_SHARE = 0.1
"""What the motion of the start costs by default, as a part of its shape errors."""
LEAST_MOTION_WEIGHT = 1e-9
"""Least default of lambda, s^2: where the start follows its target exactly."""

WINDOW = 12
"""Iterations over which the fall of the KKT residual is looked at."""


def solve_horizon(
    problem: Problem,
    *,
    model: str = "dominant",
    solver: str = "banded",
    start: npt.ArrayLike | None = None,
    end: npt.ArrayLike | None = None,
    motion_weight: float | None = None,
    initial: Sequence[npt.ArrayLike] | None = None,
    starts: int = 1,
    jobs: int = 1,
    settings: Settings = DEFAULTS,
    progress: Progress | None = None,
) -> Plan:
    """The plan that follows a problem's target over all frames at once, eq. (9) over a horizon.

    solver: banded, or ipopt. start: q (2d + 2,) at time 0; end: q of the last frame; free where None.
    motion_weight: lambda in s^2; None takes the one at which the motion of the start costs a tenth of its shape
    errors. initial: motions (T, 2d + 2) to start from; None runs frame by frame, forwards and backwards.
    starts: how many motions are tried: the best of those, then smooth random changes of the best
    (settings.seed), in so many processes as jobs says. settings: of the frames run one by one. The plan is never
    worse than the best motion it started from, and marked where it is no solution. Ctrl-C ends the work; the
    plan is then the best feasible one so far, marked as interrupted. Raises OptionError, ProblemError, RobotError.
    """
    _check(problem, model, solver, motion_weight, starts, jobs)
    given = [_checked_motion(problem, motion) for motion in initial or ()]
    ends = Ends(_checked_end(problem, start, "start"), _checked_end(problem, end, "end"))
    check_growth(problem)
    begin = time.perf_counter()
    chain = horizon(problem.robot, problem.samples, problem.dt, 1.0, ends)
    if ends.start is not None and ends.end is not None:
        check_ends(problem, chain)
    seconds = {"build_s": time.perf_counter() - begin}
    with deferred_interrupt() as interrupted:
        begin = time.perf_counter()
        motions = given or per_frame_motions(problem, ends, settings, progress)
        seconds["search_s"] = time.perf_counter() - begin
        weight = balanced_weight(chain, motions[0]) if motion_weight is None else motion_weight
        chain = chain.with_cost(weight)
        begin = time.perf_counter()
        picked = [] if interrupted() else _picked(problem.robot, chain, motions, starts, settings.seed)
        task = Task(problem.robot, problem.samples, problem.dt, weight, ends, solver)
        attempts = _attempts(task, chain, picked, jobs, progress, interrupted)
        seconds["solve_s"] = time.perf_counter() - begin
        stopped = interrupted()
    options = {
        "motion_weight": weight,
        "start": None if ends.start is None else ends.start.tolist(),
        "end": None if ends.end is None else ends.end.tolist(),
        "starts": starts,
    }
    meta = {
        "formulation": "horizon",
        "model": model,
        "solver": solver,
        "options": asdict(settings) | options,
        "interrupted": stopped,
        **seconds,
    }
    return _plan(problem, chain, motions, attempts, meta)


def balanced_weight(chain: Chain, motion: Array) -> float:
    """The lambda in s^2 at which a motion costs MOTION_SHARE of its shape errors; chain: built with lambda = 1."""
    shape, moved = (float(part.sum()) for part in chain.by_frame(motion.ravel()))
    weight = MOTION_SHARE * shape / moved if moved > 0 else 0.0
    return weight if weight > LEAST_MOTION_WEIGHT else LEAST_MOTION_WEIGHT


def _picked(robot: Robot, chain: Chain, motions: Sequence[Array], count: int, seed: int) -> list[Array]:
    """The best of motions in the horizon's own objective, and random changes of the very best, (T n,)."""

    def badness(motion: Array) -> tuple[bool, float]:
        objective, value = chain.evaluate(motion.ravel())
        return chain.violation(value) > FEASIBLE, objective

    ranked = sorted(motions, key=badness)
    endless = itertools.chain(ranked, wandered(robot, ranked[0], seed))
    return [motion.ravel() for motion in itertools.islice(endless, count)]


def _attempts(
    task: Task,
    chain: Chain,
    motions: Sequence[Array],
    jobs: int,
    progress: Progress | None,
    interrupted: Callable[[], bool],
) -> list[Attempt]:
    if jobs > 1 and len(motions) > 1:

        def done(count: int) -> None:
            if progress is not None:
                progress(count, len(motions), f"{len(motions)} starts in {jobs} processes")

        return attempt_in_processes(task, motions, jobs, done, interrupted)
    solve = CHAIN_SOLVERS[task.solver](chain)
    attempts = []
    for number, motion in enumerate(motions, start=1):
        report = None if progress is None else Forecast(progress, chain.frames, number, len(motions))
        attempts.append(attempt(chain, solve, motion, report, interrupted))
    return attempts


class Forecast:
    """Tells progress how far a solver is: iterations done, and how many its KKT residual's fall lets expect."""

    def __init__(self, progress: Progress, frames: int, number: int, count: int) -> None:
        self._progress = progress
        self._frames = frames
        self._which = f"start {number} of {count}, " if count > 1 else ""
        self._best: list[float] = []

    def __call__(self, iterate: Iterate) -> None:
        error = math.log(max(iterate.error, TOLERANCE))
        self._best.append(min([error, *self._best[-1:]]))
        recent = self._best[-WINDOW:]
        fall = (recent[0] - recent[-1]) / max(len(recent) - 1, 1)
        left = (recent[-1] - math.log(TOLERANCE)) / fall if fall > 0 else WINDOW
        total = iterate.number + max(1, min(math.ceil(left), MOST_ITERATIONS - iterate.number))
        note = (
            f"{self._which}objective {iterate.objective / self._frames:.4g} mm², violation {iterate.violation:.0e}"
        )
        self._progress(iterate.number, total, note)


def _plan(
    problem: Problem, chain: Chain, motions: Sequence[Array], attempts: Sequence[Attempt], meta: dict[str, Any]
) -> Plan:
    """The best attempt as a plan; without any, the first motion, not solved."""
    unknown = np.full(problem.frames, np.nan)
    meta["starts"] = [
        {
            "start_objective": None if math.isinf(one.start_objective) else one.start_objective / problem.frames,
            "objective": one.objective / problem.frames,
            "solved": one.solved,
            "status": one.solution.status,
            "iterations": one.solution.iterations,
            "seconds": one.seconds,
        }
        for one in attempts
    ]
    meta["iterations"] = sum(one.solution.iterations for one in attempts)
    if not attempts:
        failures = {"all": "interrupted before the horizon was begun"}
        q, solved, objective, kkt = motions[0], False, unknown, unknown
    else:
        best = _best(attempts)
        q, solved = best.x.reshape(problem.frames, -1), best.solved
        objective = np.add(*chain.by_frame(best.x))
        multipliers = np.concatenate([best.solution.lam_x, best.solution.lam_g])
        kkt = chain.kkt(best.x, multipliers) if solved else unknown
        failures = {} if solved else _failures(chain, best)
    return plan_from_configurations(
        problem,
        q,
        meta | {"failures": failures},
        success=np.full(problem.frames, solved),
        solve_time=unknown,
        objective=objective,
        kkt=kkt,
    )


def _best(attempts: Sequence[Attempt]) -> Attempt:
    """The solution of least objective, unless some start was better: then the best feasible point."""
    least = min(one.start_objective for one in attempts)
    allowed = least + TIE * (1 + abs(least))

    def badness(one: Attempt) -> tuple[bool, bool, float]:
        return not (one.solved and one.objective <= allowed), not one.feasible, one.objective

    return min(attempts, key=badness)


def _failures(chain: Chain, one: Attempt) -> dict[str, str]:
    """Why an attempt is no solution, by frame where limits are exceeded."""
    excesses = chain.excesses(chain.evaluate(one.x)[1], FEASIBLE)
    if not excesses:
        return {"all": f"{one.solution.status}, KKT residual {one.solution.kkt:.1e}"}
    found: dict[str, str] = {}
    for name, frame, amount in excesses:
        unit = "mm" if "beta" in name or name == "order" else "rad"
        found.setdefault(str(frame), f"{name} exceeded by {amount:.3g} {unit}; relax it, or give more time")
    return found


def _check(problem: Problem, model: str, solver: str, motion_weight: float | None, starts: int, jobs: int) -> None:
    for name, value, allowed in (("model", model, MODELS), ("solver", solver, CHAIN_SOLVERS)):
        if value not in allowed:
            raise OptionError(f"{name} of a horizon is {value!r}; it must be one of {', '.join(allowed)}")
    if problem.frames < 2:
        raise OptionError("frames is 1; a motion over a horizon needs at least 2")
    if motion_weight is not None and not (math.isfinite(motion_weight) and motion_weight >= 0):
        raise OptionError(f"motion_weight is {motion_weight} s^2; it must be a finite number >= 0")
    for name, count in (("starts", starts), ("jobs", jobs)):
        if count < 1:
            raise OptionError(f"{name} is {count}; it must be at least 1")


def _checked_end(problem: Problem, q: npt.ArrayLike | None, name: str) -> Array | None:
    if q is None:
        return None
    found = np.asarray(q, dtype=float)
    problem.robot.check(found, name)
    return found


def _checked_motion(problem: Problem, motion: npt.ArrayLike) -> Array:
    found = np.asarray(motion, dtype=float)
    expected = (problem.frames, len(problem.robot.axes))
    if found.shape != expected or not np.isfinite(found).all():
        raise OptionError(f"initial has a motion of shape {found.shape}; it must be {expected}, of finite numbers")
    return found
