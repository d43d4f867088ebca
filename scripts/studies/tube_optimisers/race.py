"""The design of tubes, and general optimisers over the same tubes, as long as each may work.

CMA-ES (N. Hansen's package cma) and Nelder-Mead (scipy) see tubes as numbers: for each they ask what motions, each
planned for itself, do on these. The design (codesign/) solves for tubes and motions together.
"""

from __future__ import annotations

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
"""First standard deviation of CMA-ES, and first steps of Nelder-Mead, as parts of the ranges of tubes' numbers."""
FAILED_TASK_OBJECTIVE_MM = 100.0
"""Objective, mm, of tubes on which some task has no motion; for tubes that break rules, by how much they do is
added to it.
"""
SIMPLEX_TOLERANCE = 1e-3
"""A simplex of this size, as a part of the ranges, ends Nelder-Mead, which then begins again elsewhere."""
DESIGN_OPTIMISERS = "design", "CMA-ES", "Nelder-Mead"


@dataclass(frozen=True)
class OptimiserRun:
    """Course of a method: the least root mean square of the tasks' e3, mm, that it had found after so many seconds
    of process time, (n,) each. evaluations: number of tubes on which motions were planned.
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
    """A run under way, which ends after `max_seconds` seconds of process time."""

    method: str
    max_seconds: float
    stop: Callable[[], bool]
    seconds: list[float] = field(default_factory=list)
    e3: list[float] = field(default_factory=list)
    evaluations: int = 0
    begin: float = field(default_factory=time.process_time)

    def record_evaluation(self, rms: float) -> None:
        """Count tubes, and remember their root mean square of e3 where it is the least yet; raises _TimeOver."""
        now = time.process_time() - self.begin
        self.evaluations += 1
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

    Nominal robots. Ctrl-C ends the run at work; those after it are missing. Raises OptionError where the package
    cma is not installed.
    """
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
            try:
                run(search, seed, course)
            except _TimeOver:
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
    """Return a function: parts (n,) of the ranges of the tubes' free numbers -> root mean square of e3, mm."""
    lower, upper = search.tubes.box
    free = lower < upper

    def objective(x: Array) -> float:
        p = np.array(lower)
        p[free] += np.clip(x, 0, 1) * (upper - lower)[free]
        kept = search.tubes.rule_values(p)
        broken = sum(max(rule.lower - rule.value, rule.value - rule.upper, 0.0) for rule in kept)
        if broken:
            return FAILED_TASK_OBJECTIVE_MM + broken
        try:
            rms = search.plan_on_tubes(p).rms
        except CtrError:
            rms = math.inf
        course.record_evaluation(rms)
        return min(rms, FAILED_TASK_OBJECTIVE_MM)

    return objective


def _to_fractions(search: DesignSearch, p: Array) -> Array:
    """Return the free numbers of tubes p as parts, from 0 to 1, of their ranges."""
    lower, upper = search.tubes.box
    free = lower < upper
    return np.asarray(((p - lower)[free] / (upper - lower)[free]).clip(0, 1))


def seconds_to(run: OptimiserRun, e3: float) -> float:
    """Return the process time, s, after which a run had an error of at most `e3` mm; infinite if never."""
    reached = run.seconds[run.e3 <= e3]
    return float(reached[0]) if len(reached) else math.inf


def improvement_rows(runs: Sequence[OptimiserRun]) -> list[dict[str, float | str]]:
    """Return rows for a table: every improvement of every run."""
    return [
        {"method": run.method, "process_s": seconds, "rms_e3_mm": e3}
        for run in runs
        for seconds, e3 in zip(run.seconds.tolist(), run.e3.tolist(), strict=True)
    ]
