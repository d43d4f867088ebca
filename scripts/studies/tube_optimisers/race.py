"""A race between tube design and general-purpose optimisers over the same tubes, with equal process time.

CMA-ES (N. Hansen's package cma) and Nelder-Mead (scipy) see tubes as numbers: their objective is the root mean
square over tasks of e3, in mm, of motions planned for each candidate by itself. The design (ctr_nlp.design)
optimises tubes and motions jointly. The optimisers' variables are the free numbers of the tubes as fractions of
their ranges, in [0, 1].
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from scipy.optimize import minimize

from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.tube_design.search import Candidate, DesignSearch
from ctr_nlp.tube_design.starts import generate_start_tubes as first_tubes
from ctr_nlp.typing import Array

INITIAL_SEARCH_SPREAD = 0.2
"""First standard deviation of CMA-ES, and first steps of Nelder-Mead, relative to the ranges of tubes' numbers."""
FAILED_TASK_OBJECTIVE_MM = 100.0
"""Objective, mm, of tubes on which the motion of some task cannot be planned. For tubes that break rules of
manufacture, the violation is added to it.
"""
SIMPLEX_TOLERANCE = 1e-3
"""Size of the simplex, relative to the ranges, at which Nelder-Mead ends and restarts from other tubes."""
DESIGN_OPTIMISERS = "design", "CMA-ES", "Nelder-Mead"


@dataclass(frozen=True)
class OptimiserRun:
    """Improvements of one optimiser over process time.

    seconds: (n,), when each improvement was found, s. e3: (n,), the least root mean square of the tasks' e3 by
    then, mm. evaluations: number of tubes on which motions were planned.
    """

    method: str
    seconds: Array
    e3: Array
    evaluations: int

    @property
    def best(self) -> float:
        """Least root mean square of e3, mm; infinite where nothing was found."""
        return float(self.e3[-1]) if len(self.e3) else math.inf


class _TimeOver(Exception):
    """The time is over, or Ctrl-C was pressed."""


@dataclass
class _RunRecorder:
    """Record of a run under way, which ends after `max_seconds` s of process time, or when stop() is True."""

    method: str
    max_seconds: float
    stop: Callable[[], bool]
    seconds: list[float] = field(default_factory=list)
    e3: list[float] = field(default_factory=list)
    evaluations: int = 0
    begin: float = field(default_factory=time.process_time)

    def record_evaluation(self, rms: float) -> None:
        """Count a candidate and record `rms`, its objective in mm, if it is the least yet; raises _TimeOver."""
        now = time.process_time() - self.begin
        self.evaluations += 1
        # A result that comes after the end of the time does not count, though its evaluation began before.
        if now <= self.max_seconds and math.isfinite(rms) and (not self.e3 or rms < self.e3[-1]):
            self.seconds.append(now)
            self.e3.append(rms)
        if now > self.max_seconds or self.stop():
            raise _TimeOver

    def finish_run(self) -> OptimiserRun:
        """Return the run as it is at its end."""
        return OptimiserRun(self.method, np.array(self.seconds), np.array(self.e3), self.evaluations)


def race_optimisers(search: DesignSearch, starts: int, seed: int, times: float = 1.0) -> list[OptimiserRun]:
    """Run the design from `starts` starts, then CMA-ES and Nelder-Mead, each for `times` times its process time.

    search: tasks and tubes that all of them optimise, for the nominal robot. seed: of starts and optimisers.
    Ctrl-C ends the current run, and later ones are missing. Raises OptionError where the package cma is not
    installed.
    """
    # Before the design, which takes long: a missing package is found at once.
    cma_es = _cma_es()
    with deferred_interrupt() as interrupted:
        course = _RunRecorder("design", math.inf, interrupted)
        try:
            _run_design(search, starts, seed, course)
        except _TimeOver:
            return [course.finish_run()]
        most = times * (time.process_time() - course.begin)
        runs = [course.finish_run()]
        for method, run in (("CMA-ES", cma_es), ("Nelder-Mead", _nelder_mead)):
            course = _RunRecorder(method, most, interrupted)
            with contextlib.suppress(_TimeOver):
                run(search, seed, course)
            runs.append(course.finish_run())
            if interrupted():
                break
    return runs


def _run_design(search: DesignSearch, starts: int, seed: int, course: _RunRecorder) -> None:
    def note(found: Candidate) -> None:
        course.record_evaluation(found.motions.rms if found.is_solution else math.inf)

    search = replace(search, stop=course.stop, on_candidate=note)
    for start in islice(first_tubes(search.tubes, seed), starts):
        begun = search.start(*start)
        if begun is not None:
            course.record_evaluation(begun.motions.rms)
            search.run_rounds(begun)


def _cma_es() -> Callable[[DesignSearch, int, _RunRecorder], None]:
    try:
        import cma
    except ImportError as error:
        raise OptionError("the package cma is missing; install ctr_nlp[studies]") from error

    def run(search: DesignSearch, seed: int, course: _RunRecorder) -> None:
        objective = _objective(search, course)
        first = _to_fractions(search, search.tubes.nominal_unknowns)
        while True:
            # The seed 0 stands for the time of day in cma.
            options = {"bounds": [0, 1], "seed": seed + 1, "verbose": -9}
            strategy = cma.CMAEvolutionStrategy(first, INITIAL_SEARCH_SPREAD, options)
            while not strategy.stop():
                asked = strategy.ask()
                strategy.tell(asked, [objective(x) for x in asked])
            seed += 1

    return run


def _nelder_mead(search: DesignSearch, seed: int, course: _RunRecorder) -> None:
    objective = _objective(search, course)
    for _, p in first_tubes(search.tubes, seed):
        x = _to_fractions(search, p)
        steps = np.where(x + INITIAL_SEARCH_SPREAD <= 1, INITIAL_SEARCH_SPREAD, -INITIAL_SEARCH_SPREAD)
        simplex = np.vstack([x, x + np.diag(steps)])
        minimize(
            objective, x, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": SIMPLEX_TOLERANCE}
        )


def _objective(search: DesignSearch, course: _RunRecorder) -> Callable[[Array], float]:
    """Return the objective: fractions (n,) of the ranges of the free numbers -> root mean square of e3, mm."""
    lower, upper = search.tubes.box
    free = lower < upper

    def objective(x: Array) -> float:
        p = np.array(lower)
        p[free] += np.clip(x, 0, 1) * (upper - lower)[free]
        kept = search.tubes.rule_values(p)
        broken = sum(max(rule.lower - rule.value, rule.value - rule.upper, 0.0) for rule in kept)
        # Tubes that cannot be manufactured cost no planning; worse than any motion, and graded, so that a search
        # finds its way back.
        if broken:
            course.record_evaluation(math.inf)  # so that a search among such tubes ends, too
            return FAILED_TASK_OBJECTIVE_MM + broken
        try:
            rms = search.motions_of(p, search.plan_on_tubes(p)).rms
        except CtrError:
            rms = math.inf
        course.record_evaluation(rms)
        # Finite also where nothing could be planned: the optimisers' tests for termination subtract values.
        return min(rms, FAILED_TASK_OBJECTIVE_MM)

    return objective


def _to_fractions(search: DesignSearch, p: Array) -> Array:
    """Return the free numbers of tubes p (P,) as fractions (n,) of their ranges, in [0, 1]."""
    lower, upper = search.tubes.box
    free = lower < upper
    return np.asarray(((p - lower)[free] / (upper - lower)[free]).clip(0, 1))


def seconds_to(run: OptimiserRun, e3: float) -> float:
    """Return the process time, s, after which a run had an error of at most `e3` mm; infinite if never."""
    reached = run.seconds[run.e3 <= e3]
    return float(reached[0]) if len(reached) else math.inf


def improvement_rows(runs: Sequence[OptimiserRun]) -> list[dict[str, float | str]]:
    """Return rows for a table: each improvement of each of `runs`, with its process time, s, and e3, mm."""
    return [
        {"method": run.method, "process_s": seconds, "rms_e3_mm": e3}
        for run in runs
        for seconds, e3 in zip(run.seconds.tolist(), run.e3.tolist(), strict=True)
    ]
