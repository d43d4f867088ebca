"""Shares of time that are spent outside compiled code: in Python and numpy, around calls of C."""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable
from typing import Any

from ctr_nlp.problems import named
from ctr_nlp.steer import Steerer, solve_horizon, solve_per_frame
from ctr_nlp.studies.benchmarks.growth import least

CALLERS = (("codegen/mapped.py", "__call__"), ("frame/run.py", "__call__"), ("motion/loop.py", "iterate"))
"""Functions whose own time is that of the C or of the LAPACK that they call."""
COMPILED = "casadi", "lapack", "scipy.linalg"
"""Words in the names of functions that are not Python."""


def compiled(work: Callable[[], Any]) -> float:
    """Return the seconds of the thread within compiled code while work is done: the own time of what calls it."""
    profile = cProfile.Profile(time.thread_time)
    profile.runcall(work)
    entries: dict[tuple[str, int, str], Any] = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    return float(sum(own for key, (_, _, own, _, _) in entries.items() if _is_compiled(*key)))


def _is_compiled(file: str, line: int, name: str) -> bool:
    if file == "~":
        return any(word in name for word in COMPILED)
    path = file.replace("\\", "/")
    return any(path.endswith(end) and name == function for end, function in CALLERS)


def outside(work: Callable[[], Any], repeats: int = 5) -> float:
    """Return the part of work's time that is spent outside compiled code, from the least times over repeats."""
    whole = least(work, repeats)
    within = min(compiled(work) for _ in range(repeats))
    return max(0.0, 1 - within / whole)


def shares() -> dict[str, float]:
    """Return the parts of time outside compiled code, of steps along cos on both models and of its horizon."""
    problem = named("cos")
    found = {}
    for model in ("dominant", "elastic"):
        steerer = Steerer(problem.robot, _start(model), problem.dt, model=model)
        targets = [frame.points for frame in problem.samples]
        there_and_back = targets + targets[::-1]
        found[f"Steerer.step, {model}"] = outside(lambda s=steerer, all=there_and_back: [s.step(t) for t in all])  # type: ignore[misc]
    found["solve_horizon"] = outside(lambda: solve_horizon(problem, model="dominant"), 3)
    return found


def _start(model: str) -> Any:
    return solve_per_frame(named("cos"), model=model, direction="forward").q[0]
